// What a step costs at least: ode45 written out by hand for one problem at a time, f inlined, with the same formulas,
// step control and stored output as in core/. `benchmarks/native.py` compiles it with the flags of the core.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace {

struct LotkaVolterra {
  static constexpr std::size_t n = 2;
  static void f(double, const double* y, double* out) {
    out[0] = 2.0 * y[0] * (1.0 - y[1]);
    out[1] = -y[1] * (1.0 - y[0]);
  }
};

struct ThreeBody {
  static constexpr std::size_t n = 4;
  static constexpr double mu = 1 / 82.45;
  static void f(double, const double* y, double* out) {
    constexpr double mu1 = 1 - mu;
    const double x = y[0], z = y[1], a = x + mu, b = x - mu1;
    const double s1 = a * a + z * z, s2 = b * b + z * z;
    const double r1 = s1 * std::sqrt(s1), r2 = s2 * std::sqrt(s2);
    out[0] = y[2];
    out[1] = y[3];
    out[2] = 2.0 * y[3] + x - mu1 * a / r1 - mu * b / r2;
    out[3] = -2.0 * y[2] + z - mu1 * z / r1 - mu * z / r2;
  }
};

double ulp(double t) { return std::nextafter(std::abs(t), std::numeric_limits<double>::infinity()) - std::abs(t); }

template <class Problem>
class Ode45 {
  static constexpr std::size_t n = Problem::n;
  using Vector = std::array<double, n>;

 public:
  /// Integrates to tf; the number of accepted steps, and y at tf in `y`.
  std::size_t run(double tf, double rtol, double atol, double* y_inout) {
    std::copy(y_inout, y_inout + n, y.begin());
    double t = 0;
    Problem::f(t, y.data(), k1.data());
    const double thr = atol / rtol;
    double h = tf / 10;
    double r = 0;
    for (std::size_t i = 0; i < n; ++i) r = std::max(r, std::abs(k1[i]) / std::max(std::abs(y[i]), thr));
    r /= 0.8 * std::pow(rtol, 0.2);
    if (h * r > 1) h = 1 / r;
    store(t);
    while (t < tf) {
      const double hmin = 16 * ulp(t);
      h = std::max(hmin, std::min(tf / 10, h));
      bool last = 1.1 * h >= tf - t;
      if (last) h = tf - t;
      bool failed = false;
      double t1, error;
      for (;;) {
        t1 = last ? tf : t + h;
        error = attempt(t, h, t1, thr);
        if (error <= rtol) break;
        if (h <= hmin) return 0;
        h = std::max(hmin, h * (failed ? 0.5 : std::max(0.1, 0.8 * std::pow(rtol / error, 0.2))));
        failed = true;
        last = false;
      }
      t = t1;
      y = candidate;
      k1 = k7;
      store(t);
      if (!failed) {
        const double tau = 1.25 * std::pow(error / rtol, 0.2);
        h = tau > 0.2 ? h / tau : 5 * h;
      }
    }
    std::copy(y.begin(), y.end(), y_inout);
    return times.size() - 1;
  }

 private:
  double attempt(double t, double h, double t1, double thr) {
    Vector s;
    for (std::size_t i = 0; i < n; ++i) s[i] = y[i] + h * (1. / 5 * k1[i]);
    Problem::f(t + h / 5, s.data(), k2.data());
    for (std::size_t i = 0; i < n; ++i) s[i] = y[i] + h * (3. / 40 * k1[i] + 9. / 40 * k2[i]);
    Problem::f(t + 3. / 10 * h, s.data(), k3.data());
    for (std::size_t i = 0; i < n; ++i) s[i] = y[i] + h * (44. / 45 * k1[i] + -56. / 15 * k2[i] + 32. / 9 * k3[i]);
    Problem::f(t + 4. / 5 * h, s.data(), k4.data());
    for (std::size_t i = 0; i < n; ++i)
      s[i] = y[i] + h * (19372. / 6561 * k1[i] + -25360. / 2187 * k2[i] + 64448. / 6561 * k3[i] + -212. / 729 * k4[i]);
    Problem::f(t + 8. / 9 * h, s.data(), k5.data());
    for (std::size_t i = 0; i < n; ++i)
      s[i] = y[i] + h * (9017. / 3168 * k1[i] + -355. / 33 * k2[i] + 46732. / 5247 * k3[i] + 49. / 176 * k4[i] +
                         -5103. / 18656 * k5[i]);
    Problem::f(t + h, s.data(), k6.data());
    const double purified = t1 - t;
    for (std::size_t i = 0; i < n; ++i)
      candidate[i] = y[i] + purified * (35. / 384 * k1[i] + 500. / 1113 * k3[i] + 125. / 192 * k4[i] +
                                        -2187. / 6784 * k5[i] + 11. / 84 * k6[i]);
    Problem::f(t1, candidate.data(), k7.data());
    double norm = 0;
    for (std::size_t i = 0; i < n; ++i) {
      const double e = 71. / 57600 * k1[i] + -71. / 16695 * k3[i] + 71. / 1920 * k4[i] + -17253. / 339200 * k5[i] +
                       22. / 525 * k6[i] + -1. / 40 * k7[i];
      norm = std::max(norm, std::abs(e / std::max(std::max(std::abs(y[i]), std::abs(candidate[i])), thr)));
    }
    return std::abs(purified) * norm;
  }

  void store(double t) {
    times.push_back(t);
    values.insert(values.end(), y.begin(), y.end());
  }

  Vector y, candidate, k1, k2, k3, k4, k5, k6, k7;
  std::vector<double> times, values;
};

}  // namespace

extern "C" {
std::size_t lotka_volterra(double tf, double rtol, double atol, double* y) {
  return Ode45<LotkaVolterra>().run(tf, rtol, atol, y);
}
std::size_t three_body(double tf, double rtol, double atol, double* y) {
  return Ode45<ThreeBody>().run(tf, rtol, atol, y);
}
// The same functions as user functions of a solve, compiled by the same compiler; the Jacobi integral and its gradient.
void lotka_volterra_f(double t, const double* y, double* out, const double*) { LotkaVolterra::f(t, y, out); }
void three_body_f(double t, const double* y, double* out, const double*) { ThreeBody::f(t, y, out); }
void three_body_g(double, const double* y, double* out, const double*) {
  constexpr double mu = ThreeBody::mu, mu1 = 1 - mu;
  const double x = y[0], z = y[1], a = x + mu, b = x - mu1;
  out[0] =
      (y[2] * y[2] + y[3] * y[3] - x * x - z * z) / 2 - mu1 / std::sqrt(a * a + z * z) - mu / std::sqrt(b * b + z * z);
}
void three_body_gjac(double, const double* y, double* out, const double*) {
  constexpr double mu = ThreeBody::mu, mu1 = 1 - mu;
  const double x = y[0], z = y[1], a = x + mu, b = x - mu1;
  const double s1 = a * a + z * z, s2 = b * b + z * z;
  const double r1 = s1 * std::sqrt(s1), r2 = s2 * std::sqrt(s2);
  out[0] = -x + mu1 * a / r1 + mu * b / r2;
  out[1] = -z + mu1 * z / r1 + mu * z / r2;
  out[2] = y[2];
  out[3] = y[3];
}

/// So many calls of a user function, and nothing else; each waits for the one before, as in a solve.
void call(void (*function)(double, const double*, double*, const double*), std::size_t count, double* y) {
  double out[8] = {};
  for (std::size_t i = 0; i < count; ++i) {
    function(0, y, out, nullptr);
    y[0] += 0 * out[0];
  }
}
}
