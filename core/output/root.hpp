#pragma once
// The one root finder: of a function that changes sign between two points.

#include <algorithm>
#include <cmath>

namespace invariode {

inline int sign_of(double v) { return (v > 0) - (v < 0); }

/// Shrinks [a, b], on which e changes sign, to `width` by Chandrupatla's method (Adv. Eng. Software 28 (1997) 145):
/// inverse quadratic interpolation where the three latest points are in a shape that makes it converge, else bisection.
/// e(t, value) returns false to give up. The end with the smaller |e| is the root.
template <class E>
bool find_root(E&& e, double a, double ea, double b, double eb, double width, double& root) {
  double c = a, ec = ea;
  double fraction = 0.5;
  for (;;) {
    const double x = a + fraction * (b - a);
    double ex = 0;
    if (!e(x, ex)) return false;
    if (sign_of(ex) == sign_of(ea)) {
      c = a, ec = ea;
    } else {
      c = b, ec = eb;
      b = a, eb = ea;
    }
    a = x, ea = ex;
    root = std::abs(ea) < std::abs(eb) ? a : b;
    const double least = 0.5 * width / std::abs(b - a);
    if (least > 0.5 || ea == 0 || eb == 0 || x == b || x == c) return true;
    const double xi = (a - b) / (c - b), phi = (ea - eb) / (ec - eb);
    fraction = 0.5;
    if (phi * phi < xi && (1 - phi) * (1 - phi) < 1 - xi)
      fraction = ea / (eb - ea) * ec / (eb - ec) + (c - a) / (b - a) * ea / (ec - ea) * eb / (ec - eb);
    fraction = std::isnan(fraction) ? 0.5 : std::clamp(fraction, least, 1 - least);
  }
}

}  // namespace invariode
