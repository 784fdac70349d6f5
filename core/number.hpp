#pragma once
// What a template on the number asks of it: of doubles here, of packs of them by functions of the same names
// (run/lanes/pack.hpp). Where something is true is a bool of doubles, and a mask of packs.

#include <cmath>

namespace invariode {

inline double choose(bool condition, double yes, double no) { return condition ? yes : no; }
inline double absolute(double x) { return std::abs(x); }
inline double square_root(double x) { return std::sqrt(x); }

/// std::max(a, b), std::min(a, b): the first where they do not compare.
template <class Real>
Real larger(const Real& a, const Real& b) {
  return choose(a < b, b, a);
}
template <class Real>
Real smaller(const Real& a, const Real& b) {
  return choose(b < a, b, a);
}

}  // namespace invariode
