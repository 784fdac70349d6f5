#pragma once
// Problems for whole runs: their functions are plain, so that any number of threads may call them.

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <utility>
#include <vector>

#include "run/problem.hpp"
#include "run/run.hpp"

namespace invariode::test_run {

inline double energy(const double* y) { return (y[0] * y[0] + y[1] * y[1]) / 2; }

/// x' = v, v' = −k x with k = p[0], its energy where k = 1, and the zeros of x as events.
struct Oscillator {
  std::vector<double> p{1};
  std::vector<double> y0{1, 0};
  std::int64_t stop_after = 0;       // calls of f, from which on it says stop; 0: never
  std::int64_t undefined_after = 0;  // from which on it is NaN
  std::atomic<std::int64_t> calls = 0, g_calls = 0;
  std::vector<EventFunction> events;

  static Status f(void* context, double, const double* y, double* out) noexcept {
    auto& me = *static_cast<Oscillator*>(context);
    const std::int64_t call = me.calls.fetch_add(1, std::memory_order_relaxed);
    if (me.stop_after > 0 && call >= me.stop_after) return Status::stop;
    out[0] = y[1];
    out[1] = me.undefined_after > 0 && call >= me.undefined_after ? std::numeric_limits<double>::quiet_NaN()
                                                                  : -me.p[0] * y[0];
    return Status::ok;
  }
  static Status g(void* context, double, const double* y, double* out) noexcept {
    static_cast<Oscillator*>(context)->g_calls.fetch_add(1, std::memory_order_relaxed);
    out[0] = energy(y);
    return Status::ok;
  }
  static Status gjac(void*, double, const double* y, double* out) noexcept {
    out[0] = y[0], out[1] = y[1];
    return Status::ok;
  }
  static Status zero_of_x(void*, double, const double* y, double* out) noexcept {
    out[0] = y[0];
    return Status::ok;
  }

  void add_event(std::int64_t terminal) { events.push_back({.function = {zero_of_x, this}, .terminal = terminal}); }

  Problem problem() {
    Problem problem;
    problem.n = 2;
    problem.f = {f, this};
    problem.events = events;
    problem.invariants = {{.g = {g, this}, .jacobian = {gjac, this}, .m = 1, .held = true}};
    problem.value = {0.5};
    problem.linear.emplace(LinearTerms{.jacobian = Matrix({.n = 2})});
    problem.parameters = p;
    return problem;
  }
  static Weights weights() { return {1e-4, {1e-2, 1e-2}, {}}; }
  static Settings settings() { return {.tf = 20, .hmax = 2}; }

  Solver solver(const Method& method) { return {method, problem(), weights(), settings(), {}}; }
};

/// The same with z = x² as an algebraic equation: M = diag(1, 1, 0).
struct ConstrainedOscillator {
  bool unsolvable = false;  // then the equation does not have z in it
  std::int64_t g_calls = 0;

  static Status f(void* context, double, const double* y, double* out) noexcept {
    out[0] = y[1], out[1] = -y[0];
    out[2] = y[0] * y[0] - (static_cast<ConstrainedOscillator*>(context)->unsolvable ? 1 : y[2]);
    return Status::ok;
  }
  static Status g(void* context, double, const double* y, double* out) noexcept {
    ++static_cast<ConstrainedOscillator*>(context)->g_calls;
    out[0] = energy(y);
    return Status::ok;
  }
  static Status gjac(void*, double, const double* y, double* out) noexcept {
    out[0] = y[0], out[1] = y[1], out[2] = 0;
    return Status::ok;
  }

  Problem problem() {
    Problem problem;
    problem.n = 3;
    problem.f = {f, this};
    problem.invariants = {{.g = {g, this}, .jacobian = {gjac, this}, .m = 1, .held = true}};
    problem.value = {0.5};
    LinearTerms& linear = problem.linear.emplace(LinearTerms{.jacobian = Matrix({.n = 3})});
    Matrix mass({.n = 3});
    mass.values[0] = mass.values[4] = 1;
    Mass::Basis basis(3, 1);
    basis.insert(2, 0) = 1;
    basis.makeCompressed();
    linear.mass.emplace(std::move(mass), MatrixFunction(), basis);
    return problem;
  }
  static Weights weights() { return {1e-4, {1e-2, 1e-2, 1e-2}, {}}; }
  static Settings settings() { return {.tf = 20, .hmax = 2}; }
};

inline RunResult solve(const Solver& solver, const double* y0) {
  Run run(solver);
  if (run.integration().start(y0) == State::running) run.integration().run();
  return run.take_result();
}

inline bool same_bits(const double* a, const double* b, std::size_t count) {
  return count == 0 || std::memcmp(a, b, count * sizeof(double)) == 0;
}
inline bool same(const Trajectory& a, const Trajectory& b) {
  return a.t.size() == b.t.size() && a.y.size() == b.y.size() && same_bits(a.t.data(), b.t.data(), a.t.size()) &&
         same_bits(a.y.data(), b.y.data(), a.y.size());
}
/// The same points, events and counts, to the last bit.
inline bool same(const RunResult& a, const RunResult& b) {
  return a.state == b.state && a.t_end == b.t_end && same_bits(a.end(), b.end(), a.n) && same(a.points, b.points) &&
         a.counted() == b.counted() &&
         std::ranges::equal(a.occurrences, b.occurrences, [](const auto& x, const auto& y) { return same(x, y); });
}

}  // namespace invariode::test_run
