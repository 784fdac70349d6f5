#pragma once
// Problems, methods and runs that the native tests share.

#include <algorithm>
#include <cmath>
#include <cstring>
#include <functional>
#include <iterator>
#include <limits>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "integrate.hpp"
#include "methods.hpp"
#include "methods/adams.hpp"
#include "methods/ndf.hpp"
#include "methods/radau.hpp"

namespace invariode::test {

inline constexpr double infinity = std::numeric_limits<double>::infinity();
inline constexpr double NaN = std::numeric_limits<double>::quiet_NaN();
inline constexpr double pi = 3.14159265358979323846;

/// A callable (t, y, out), returning Status or nothing, as a user function. It must outlive the callback.
template <class F>
Callback as_callback(F& function) {
  const auto call = [](void* context, double t, const double* y, double* out) noexcept -> Status {
    F& f = *static_cast<F*>(context);
    if constexpr (std::is_void_v<decltype(f(t, y, out))>) {
      f(t, y, out);
      return Status::ok;
    } else {
      return f(t, y, out);
    }
  };
  return {call, &function};
}

inline bool same_bits(const double* a, const double* b, std::size_t n) {
  return std::memcmp(a, b, n * sizeof(double)) == 0;
}
template <class A, class B>
bool same_bits(const A& a, const B& b) {
  return a.size() == b.size() && (a.empty() || same_bits(a.data(), b.data(), a.size()));
}

/// Largest difference of components.
inline double distance(const double* a, const double* b, std::size_t n) {
  MaxNorm norm;
  for (std::size_t i = 0; i < n; ++i) norm.add(a[i] - b[i]);
  return norm.value();
}

// ---------------------------------------------------------------------------------------------------------- problems

using Function = std::function<void(double t, const double* y, double* out)>;

struct Problem {
  const char* name;
  std::vector<double> y0;
  double tf;
  Function f;
  std::size_t m = 0;  // invariants
  Function g;
  Function jacobian;
  Function solution = {};
};

/// x' = v, v' = −x, and its energy.
inline Problem harmonic() {
  return {.name = "harmonic",
          .y0 = {1, 0},
          .tf = 100,
          .f = [](double, const double* y, double* out) { out[0] = y[1], out[1] = -y[0]; },
          .m = 1,
          .g = [](double, const double* y, double* r) { r[0] = (y[0] * y[0] + y[1] * y[1]) / 2; },
          .jacobian = [](double, const double* y, double* J) { J[0] = y[0], J[1] = y[1]; },
          .solution = [](double t, const double*, double* y) { y[0] = std::cos(t), y[1] = -std::sin(t); }};
}

/// The same about the moving point t: the invariant depends on t.
inline Problem moving() {
  return {
      .name = "moving",
      .y0 = {1, 0},
      .tf = 50,
      .f = [](double t, const double* y, double* out) { out[0] = y[1], out[1] = t - y[0]; },
      .m = 1,
      .g = [](double t, const double* y, double* r) { r[0] = ((y[0] - t) * (y[0] - t) + (y[1] - 1) * (y[1] - 1)) / 2; },
      .jacobian = [](double t, const double* y, double* J) { J[0] = y[0] - t, J[1] = y[1] - 1; }};
}

/// Two bodies, eccentricity e, from the pericentre; energy and angular momentum.
inline Problem kepler(double e, double tf = 50) {
  return {.name = "kepler",
          .y0 = {1 - e, 0, 0, std::sqrt((1 + e) / (1 - e))},
          .tf = tf,
          .f =
              [](double, const double* y, double* out) {
                const double r2 = y[0] * y[0] + y[1] * y[1], r3 = r2 * std::sqrt(r2);
                out[0] = y[2], out[1] = y[3], out[2] = -y[0] / r3, out[3] = -y[1] / r3;
              },
          .m = 2,
          .g =
              [](double, const double* y, double* r) {
                r[0] = (y[2] * y[2] + y[3] * y[3]) / 2 - 1 / std::sqrt(y[0] * y[0] + y[1] * y[1]);
                r[1] = y[0] * y[3] - y[1] * y[2];
              },
          .jacobian =
              [](double, const double* y, double* J) {
                const double r2 = y[0] * y[0] + y[1] * y[1], r3 = r2 * std::sqrt(r2);
                J[0] = y[0] / r3, J[1] = y[1] / r3, J[2] = y[2], J[3] = y[3];
                J[4] = y[3], J[5] = -y[2], J[6] = -y[1], J[7] = y[0];
              },
          .solution =
              [e](double t, const double*, double* y) {
                double E = t;  // Kepler's equation E − e sin E = t, by Newton
                for (int k = 0; k < 20; ++k) E -= (E - e * std::sin(E) - t) / (1 - e * std::cos(E));
                const double b = std::sqrt(1 - e * e), rate = 1 / (1 - e * std::cos(E));
                y[0] = std::cos(E) - e, y[1] = b * std::sin(E);
                y[2] = -std::sin(E) * rate, y[3] = b * std::cos(E) * rate;
              }};
}

/// x' = a x (1 − y), y' = −c y (1 − x) with a = 2, c = 1 (paper, section 6), and the logarithm of its invariant.
inline Problem lotka_volterra() {
  return {
      .name = "lotka_volterra",
      .y0 = {1, 3},
      .tf = 50,
      .f = [](double, const double* y, double* out) { out[0] = 2 * y[0] * (1 - y[1]), out[1] = -y[1] * (1 - y[0]); },
      .m = 1,
      .g = [](double, const double* y, double* r) { r[0] = y[0] - std::log(y[0]) + 2 * (y[1] - std::log(y[1])); },
      .jacobian = [](double, const double* y, double* J) { J[0] = 1 - 1 / y[0], J[1] = 2 - 2 / y[1]; }};
}

/// Pendulum in Cartesian coordinates (paper, section 6) with its position and velocity constraints.
inline Problem pendulum() {
  return {.name = "pendulum",
          .y0 = {1, 0, 0, 0},
          .tf = 50,
          .f =
              [](double, const double* y, double* out) {
                const double lambda = (y[2] * y[2] + y[3] * y[3] - y[1]) / (y[0] * y[0] + y[1] * y[1]);
                out[0] = y[2], out[1] = y[3], out[2] = -lambda * y[0], out[3] = -lambda * y[1] - 1;
              },
          .m = 2,
          .g = [](double, const double* y,
                  double* r) { r[0] = y[0] * y[0] + y[1] * y[1] - 1, r[1] = y[0] * y[2] + y[1] * y[3]; },
          .jacobian =
              [](double, const double* y, double* J) {
                J[0] = 2 * y[0], J[1] = 2 * y[1], J[2] = 0, J[3] = 0;
                J[4] = y[2], J[5] = y[3], J[6] = y[0], J[7] = y[1];
              }};
}

/// Euler's equations of a free rigid body with two quadratic invariants. The solution is (sn, cn, dn), parameter 0.51.
inline Problem rigid_body() {
  return {.name = "rigid_body",
          .y0 = {0, 1, 1},
          .tf = 50,
          .f = [](double, const double* y,
                  double* out) { out[0] = y[1] * y[2], out[1] = -y[0] * y[2], out[2] = -0.51 * y[0] * y[1]; },
          .m = 2,
          .g = [](double, const double* y,
                  double* r) { r[0] = y[0] * y[0] + y[1] * y[1], r[1] = 0.51 * y[0] * y[0] + y[2] * y[2]; },
          .jacobian =
              [](double, const double* y, double* J) {
                J[0] = 2 * y[0], J[1] = 2 * y[1], J[2] = 0;
                J[3] = 1.02 * y[0], J[4] = 0, J[5] = 2 * y[2];
              },
          .solution = [](double t, const double*, double* y) {  // Abramowitz & Stegun 16.4
            constexpr int levels = 6;
            double a[levels + 1] = {1}, c[levels + 1] = {std::sqrt(0.51)}, b = std::sqrt(1 - 0.51);
            for (int k = 0; k < levels; ++k) {
              a[k + 1] = (a[k] + b) / 2, c[k + 1] = (a[k] - b) / 2;
              b = std::sqrt(a[k] * b);
            }
            double phi = std::ldexp(a[levels] * t, levels);
            for (int k = levels; k > 0; --k) phi = (phi + std::asin(c[k] * std::sin(phi) / a[k])) / 2;
            y[0] = std::sin(phi), y[1] = std::cos(phi), y[2] = std::sqrt(1 - 0.51 * y[0] * y[0]);
          }};
}

/// The same problem with one invariant more: the sum of all.
inline Problem with_redundant_invariant(Problem problem) {
  const std::size_t m = problem.m++, n = problem.y0.size();
  problem.g = [g = problem.g, m](double t, const double* y, double* r) {
    g(t, y, r);
    r[m] = 0;
    for (std::size_t i = 0; i < m; ++i) r[m] += r[i];
  };
  problem.jacobian = [jacobian = problem.jacobian, m, n](double t, const double* y, double* J) {
    jacobian(t, y, J);
    for (std::size_t j = 0; j < n; ++j) {
      J[m * n + j] = 0;
      for (std::size_t i = 0; i < m; ++i) J[m * n + j] += J[i * n + j];
    }
  };
  return problem;
}

/// y' = 1 from y = t: events are placed exactly.
inline Problem clock(double tf) {
  return {.name = "clock", .y0 = {0}, .tf = tf, .f = [](double, const double*, double* out) { out[0] = 1; }};
}

inline Problem scalar(const char* name, double y0, double tf, Function f) {
  return {.name = name, .y0 = {y0}, .tf = tf, .f = std::move(f)};
}

inline Problem without_invariants(Problem problem) {
  problem.m = 0;
  return problem;
}

// -------------------------------------------------------------------------------------------------- methods and runs

inline bool operator==(const Buffer<double>& a, const std::vector<double>& b) { return a.copy() == b; }

inline Jacobian differences(const Weights& weights) {
  return {{.kind = Jacobian::Kind::differences}, Matrix({.n = weights.size()}), weights};
}

/// A step of a method, as runs with invariants have it: with a Jacobian by differences where it takes one.
inline std::unique_ptr<Step> make_step(const Method& method, Callback& f, const Weights& weights,
                                       Fsal fsal = Fsal::reuse) {
  const Jacobian jacobian = differences(weights);
  return method.step(f, weights, {.fsal = fsal, .projected = true}, {.jacobian = &jacobian});
}

/// The methods of the registry that a law is about.
template <class Which>
std::vector<Method> methods_that(Which which) {
  std::vector<Method> chosen;
  std::ranges::copy_if(general_methods(), std::back_inserter(chosen), which);
  return chosen;
}
inline bool is(const Method& method, std::string_view name) { return method.name == name; }
/// Whether a step takes nothing but y from those before it, though perhaps the order that has proved best.
inline bool takes_one_step(const Method& m) { return m.min_order == m.order || is(m, "radau"); }
/// Pairs of one order, whose last stage is the first of the next step; those where it is part of the error estimate,
/// and those where it waits for y₁.
inline std::vector<Method> pairs() {
  return methods_that([](const Method& m) { return m.stages > 0; });
}
inline std::vector<Method> fsal_pairs() {
  return methods_that([](const Method& m) { return m.takes("fsal"); });
}
inline std::vector<Method> waiting_pairs() {
  return methods_that([](const Method& m) { return m.stages > 0 && !m.takes("fsal"); });
}
inline std::vector<Method> explicit_methods() {
  return methods_that([](const Method& m) { return !m.implicit(); });
}
inline const Method& named(std::string_view name) { return *find_method(name); }

struct Options {
  double rtol = 1e-3;
  double atol = 1e-6;
  Fsal fsal = Fsal::reuse;
  bool user_jacobian = true;
  std::vector<double> value = {};  // of the invariants; empty: those at y0
  Settings settings = {};          // tf and iterations come from problem and method; hmax 0: a tenth of the interval
  std::vector<EventFunction> events = {};
  Callback callback = {};
};

inline Invariants make_invariants(Problem& problem, const Weights& weights, bool user_jacobian,
                                  std::vector<double> value) {
  const bool held = value.empty();
  if (held) {
    value.resize(problem.m);
    problem.g(0, problem.y0.data(), value.data());
  }
  const Callback jacobian = user_jacobian ? as_callback(problem.jacobian) : Callback{};
  return {problem.y0.size(),
          {{.g = as_callback(problem.g), .jacobian = jacobian, .m = problem.m, .held = held}},
          std::move(value),
          weights};
}

/// A problem set up with a method, with everything that the integration refers to.
class Run {
 public:
  Run(const Method& method, Problem p, Options options = {})
      : problem(std::move(p)),
        weights(options.rtol, std::vector<double>(problem.y0.size(), options.atol / options.rtol), {}),
        f(as_callback(problem.f)),
        slope(f) {
    if (problem.m > 0) invariants.emplace(make_invariants(problem, weights, options.user_jacobian, options.value));
    Settings settings = options.settings;
    settings.tf = settings.tf != 0 ? settings.tf : problem.tf;
    settings.iterations = method.iterations;
    if (settings.hmax == 0) settings.hmax = std::abs(settings.tf - settings.t0) / 10;
    Invariants* g = invariants ? &*invariants : nullptr;
    integration.emplace(make_step(method, f, weights, options.fsal), weights,
                        ManifoldTerms{.steps = g, .between = g, .slope = &slope},
                        LoopFunctions{.f = f,
                                      .bounded_slope = nullptr,
                                      .events = std::move(options.events),
                                      .breakpoints = {},
                                      .piece = nullptr,
                                      .consistent = {},
                                      .callback = options.callback},
                        std::move(settings));
  }
  Run(const Run&) = delete;

  State start() { return integration->start(problem.y0.data()); }
  State run() { return start() == State::running ? integration->run() : integration->state(); }
  Integration* operator->() { return &*integration; }

  [[nodiscard]] std::size_t n() const { return problem.y0.size(); }
  [[nodiscard]] const double* last() const {
    return &integration->output().points.y.end()[-static_cast<std::ptrdiff_t>(n())];
  }

  Problem problem;
  Weights weights;
  Callback f;
  ExplicitSlope slope;
  std::optional<Invariants> invariants;
  std::optional<Integration> integration;
};

}  // namespace invariode::test
