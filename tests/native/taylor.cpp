// Taylor series, with coefficients written by hand.

#include "methods/taylor.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <random>
#include <vector>

#include "check.hpp"
#include "methods.hpp"
#include "output/turning_points.hpp"
#include "problems.hpp"
#include "run/run.hpp"

namespace invariode::test::taylor_laws {

using invariode::Problem;
using invariode::Run;

namespace {

using Coefficients = std::function<void(double t, double unit, const double* in, double* out)>;

Series as_series(Coefficients& coefficients, int order) {
  const auto call = [](void* context, double t, double unit, const double* in, double* out) {
    (*static_cast<Coefficients*>(context))(t, unit, in, out);
    return Status::ok;
  };
  return {call, &coefficients, order};
}

/// Σ_{j ≤ k} a_j b_{k−j} of two columns of coefficients with these strides.
double product(const double* a, std::size_t da, const double* b, std::size_t db, std::size_t k) {
  double sum = 0;
  for (std::size_t j = 0; j <= k; ++j) sum += a[j * da] * b[(k - j) * db];
  return sum;
}

/// y' = f(t, y) with its Taylor coefficients, an invariant, and the solution.
struct System {
  std::size_t order;
  std::vector<double> y0;
  double tf;
  test::Function f;
  Coefficients series;
  std::function<void(double t, double* y)> solution = {};
  test::Function g = {}, gradient = {};
  std::size_t m = 0;
};

/// Two bodies, eccentricity 1/2, from the pericentre; energy and angular momentum.
System kepler(std::size_t order) {
  const test::Problem known = test::kepler(0.5);
  const auto series = [order](double, double unit, const double* y, double* out) {
    double r2[Taylor::highest_order], u[Taylor::highest_order];  // u = (r²)^{−3/2}
    std::copy(y, y + 4, out);
    for (std::size_t k = 0; k < order; ++k) {
      r2[k] = product(out, 4, out, 4, k) + product(out + 1, 4, out + 1, 4, k);
      double sum = 0;
      for (std::size_t j = 1; j <= k; ++j)
        sum -= (1.5 * static_cast<double>(j) + static_cast<double>(k - j)) * r2[j] * u[k - j];
      u[k] = k == 0 ? 1 / (r2[0] * std::sqrt(r2[0])) : sum / (static_cast<double>(k) * r2[0]);
      for (std::size_t i = 0; i < 2; ++i) {
        out[4 * (k + 1) + i] = unit * out[4 * k + 2 + i] / static_cast<double>(k + 1);
        out[4 * (k + 1) + 2 + i] = unit * -product(out + i, 4, u, 1, k) / static_cast<double>(k + 1);
      }
    }
  };
  return {order,   known.y0,       50,
          known.f, series,         [solution = known.solution](double t, double* y) { solution(t, y, y); },
          known.g, known.jacobian, 2};
}

/// x' = ω v, v' = −ω x
System oscillator(std::size_t order, double omega = 1) {
  return {order,
          {1, 0},
          20 / omega,
          [omega](double, const double* y, double* out) { out[0] = omega * y[1], out[1] = -omega * y[0]; },
          [order, omega](double, double unit, const double* y, double* out) {
            std::copy(y, y + 2, out);
            for (std::size_t k = 0; k < order; ++k, out += 2) {
              out[2] = unit * omega * out[1] / static_cast<double>(k + 1);
              out[3] = unit * -omega * out[0] / static_cast<double>(k + 1);
            }
          },
          [omega](double t, double* y) { y[0] = std::cos(omega * t), y[1] = -std::sin(omega * t); }};
}

/// y' = 1: y is t.
System clock(std::size_t order) {
  return {order,
          {0},
          1,
          [](double, const double*, double* out) { out[0] = 1; },
          [order](double, double unit, const double* y, double* out) {
            std::fill(out, out + order + 1, 0);
            out[0] = y[0], out[1] = unit;
          },
          [](double t, double* y) { y[0] = t; }};
}

/// A run with all that it refers to.
struct Bench {
  Bench(System one, double rtol, Settings settings = {}, std::vector<EventFunction> events = {})
      : system(std::move(one)) {
    const std::size_t n = system.y0.size();
    Problem problem;
    problem.n = n;
    problem.f = as_callback(system.f);
    problem.series.emplace(as_series(system.series, static_cast<int>(system.order)));
    problem.events = std::move(events);
    if (system.m > 0) {
      problem.invariants = {
          {.g = as_callback(system.g), .jacobian = as_callback(system.gradient), .m = system.m, .held = true}};
      problem.value.resize(system.m);
      system.g(0, system.y0.data(), problem.value.data());
    }
    settings.tf = settings.tf != 0 ? settings.tf : system.tf;
    settings.hmax = settings.hmax != 0 ? settings.hmax : settings.tf / 10;
    solver.emplace(*find_method("taylor"), std::move(problem), Weights(rtol, std::vector<double>(n, 1), {}), settings,
                   MethodOptions{});
    run.emplace(*solver);
  }
  State start() { return run->integration().start(system.y0.data()); }
  RunResult solve() {
    if (start() == State::running) run->integration().run();
    return run->take_result();
  }

  System system;
  std::optional<Solver> solver;
  std::optional<Run> run;
};

/// ⌈1 − ½ ln rtol⌉
std::size_t order_for(double rtol) { return static_cast<std::size_t>(std::ceil(1 - std::log(rtol) / 2)); }

/// Largest errors of `count` equal steps from t: at their ends, and inside.
struct Errors {
  double steps = 0, between = 0;
};
Errors march(System system, double t, double tf, int count) {
  const std::size_t n = system.y0.size();
  const Weights weights(1e-3, std::vector<double>(n, 1), {});
  Callback f = as_callback(system.f);
  SystemSeries series{as_series(system.series, static_cast<int>(system.order))};
  Taylor step(f, weights, series, false);
  std::vector<double> data(step.extension_size()), y(n), exact(n);
  Errors errors;
  system.solution(t, system.y0.data());
  CHECK(step.start(t, system.y0.data(), {tf, tf, 0}) == Outcome::ok);
  for (int k = 0; k < count; ++k) {
    const double t0 = step.t(), t1 = k + 1 == count ? tf : t0 + (tf - t) / count;
    const Step::Attempt proposal = step.attempt(t1 - t0, t1);
    CHECK(step.accept(proposal.y) == Outcome::ok);
    system.solution(t1, exact.data());
    errors.steps = std::max(errors.steps, distance(step.y(), exact.data(), n));
    CHECK(step.extension(data.data()) == Status::ok);
    for (const double theta : {0.3, 0.7}) {
      step.interpolate()(data.data(), data.size(), n, std::array{theta}, y.data());
      system.solution(t0 + theta * (t1 - t0), exact.data());
      errors.between = std::max(errors.between, distance(y.data(), exact.data(), n));
    }
  }
  return errors;
}

}  // namespace

TEST(errors_have_the_order_of_the_series_and_those_of_a_step_one_more) {
  for (const std::size_t order : {3U, 6U, 9U, 12U}) {
    const check::Case label("order ", order);
    const double p = static_cast<double>(order), h = order < 6 ? 0.02 : order < 9 ? 0.2 : 0.4;
    const Errors whole = march(kepler(order), 1, 1 + h, 1), half = march(kepler(order), 1, 1 + h / 2, 1);
    CHECK_CLOSE(std::log2(whole.steps / half.steps), p + 1, 0.6);
    CHECK_CLOSE(std::log2(whole.between / half.between), p + 1, 0.6);
    const int count = order < 6 ? 400 : order < 9 ? 200 : 90;
    const Errors coarse = march(kepler(order), 0, 6, count), fine = march(kepler(order), 0, 6, 2 * count);
    for (const double slope : {std::log2(coarse.steps / fine.steps), std::log2(coarse.between / fine.between)})
      CHECK(slope > p - 0.3 && slope < p + 1.3);  // where leading terms cancel over a period, almost one more
  }
}

TEST(steps_follow_the_tolerance_with_one_expansion_each) {
  for (const double rtol : {1e-4, 1e-8, 1e-12, 1e-18})
    for (const bool held : {false, true}) {
      const check::Case label("rtol ", rtol, held ? ", held" : "");
      System system = kepler(order_for(rtol));
      if (!held) system.m = 0;
      double exact[4];
      system.solution(system.tf, exact);
      const RunResult result = Bench(std::move(system), rtol).solve();
      CHECK(result.state == State::reached_end);
      CHECK(distance(result.end(), exact, 4) < 200 * rtol + 2000 * eps);
      CHECK(result.counts.failed <= result.counts.steps / 20);
      // f and an expansion at the start; then an expansion in each attempt, or f there and an expansion when it is
      // accepted.
      CHECK(result.nfev == 2 + (held ? 2 : 1) * result.counts.steps + result.counts.failed);
    }
}

TEST(the_unit_of_time_changes_no_bit) {
  const RunResult plain = Bench(oscillator(12), 1e-9).solve();
  for (const double scale : {0x1p-600, 0x1p40, 0x1p600}) {
    const RunResult scaled = Bench(oscillator(12, scale), 1e-9).solve();
    CHECK(scaled.counts.steps == plain.counts.steps && same_bits(scaled.points.y, plain.points.y));
  }
}

TEST(a_resumed_run_has_the_bits_of_one_that_was_not_interrupted) {
  Bench whole(kepler(15), 1e-12), first(kepler(15), 1e-12), second(kepler(15), 1e-12);
  const RunResult expected = whole.solve();
  CHECK(first.start() == State::running);
  for (int k = 0; k < 20; ++k) first.run->integration().advance();
  const RunMemory memory = first.run->memory(1000);
  CHECK(second.run->resume(std::span(memory.data(), memory.size()), false) == State::running);
  second.run->integration().run();
  const RunResult result = second.run->take_result();
  CHECK(same_bits(result.end(), expected.end(), 4) && result.counted() == expected.counted());
}

TEST(coefficients_that_are_not_finite_are_named_where_f_is) {
  System root = clock(8);  // y' = 1 + √y, whose derivative is not finite at 0
  root.f = [](double, const double* y, double* out) { out[0] = 1 + std::sqrt(y[0]); };
  root.series = [](double, double unit, const double* y, double* out) {
    std::fill(out, out + 9, test::infinity);
    out[0] = y[0], out[1] = unit * (1 + std::sqrt(y[0]));
  };
  const RunResult result = Bench(std::move(root), 1e-6).solve();
  CHECK(result.state == State::start_undefined && result.report.component == 0 && result.report.coefficient == 2);

  System undefined = clock(8);
  undefined.f = [](double, const double*, double* out) { out[0] = test::NaN; };
  const RunResult none = Bench(std::move(undefined), 1e-6).solve();
  CHECK(none.state == State::start_undefined && none.report.component == 0 && !none.report.coefficient);
}

TEST(coefficients_that_vanish_where_the_step_begins_do_not_make_it_too_long) {
  // y' = 4 t³ y²: y = 1 / (1 − t⁴), of which three coefficients of four are zero at t = 0.
  const std::size_t order = 11;
  System system = clock(order);
  system.y0 = {1};
  system.tf = 0.9;
  system.f = [](double t, const double* y, double* out) { out[0] = 4 * t * t * t * y[0] * y[0]; };
  system.series = [=](double t, double unit, const double* y, double* out) {
    double cube[order + 1] = {t * t * t, 3 * t * t * unit, 3 * t * unit * unit, unit * unit * unit}, square[order + 1];
    out[0] = y[0];
    for (std::size_t k = 0; k < order; ++k) {
      square[k] = product(out, 1, out, 1, k);
      out[k + 1] = unit * 4 * product(cube, 1, square, 1, k) / static_cast<double>(k + 1);
    }
  };
  const RunResult result = Bench(std::move(system), 1e-9).solve();
  CHECK(result.state == State::reached_end && result.counts.failed == 0);
  CHECK_CLOSE(*result.end(), 1 / (1 - std::pow(0.9, 4)), 1e-8);
}

TEST(the_acceptance_test_sees_a_pulse_that_no_coefficient_announces) {
  // y' = 1 + 1e3 where 0.5 < t < 0.6: its coefficients are those of a straight line on each side.
  System pulse = clock(8);
  const auto rate = [](double t) { return t > 0.5 && t < 0.6 ? 1e3 : 1; };
  pulse.f = [rate](double t, const double*, double* out) { out[0] = rate(t); };
  pulse.series = [rate](double t, double unit, const double* y, double* out) {
    std::fill(out, out + 9, 0);
    out[0] = y[0], out[1] = unit * rate(t);
  };
  const RunResult result = Bench(std::move(pulse), 1e-6, {.hmax = 0.07}).solve();
  CHECK(result.state == State::reached_end && result.counts.failed > 2);
  CHECK_CLOSE(*result.end(), 100.9, 1e-2);
}

TEST(what_fails_leaves_no_trace) {
  constexpr double h = 0.1;
  for (const bool projected : {false, true}) {
    const check::Case label(projected ? "projected" : "plain");
    System system = kepler(15);
    double spoil = 0;
    const Coefficients exact = system.series;
    system.series = [&](double t, double unit, const double* in, double* out) {
      exact(t, unit, in, out);
      for (std::size_t k = 1; k <= 15; ++k) out[4 * k + 2] += spoil;
    };
    const Weights weights(1e-10, std::vector<double>(4, 1e-3), {});
    Callback f = as_callback(system.f);
    SystemSeries series{as_series(system.series, 15)};
    Taylor step(f, weights, series, projected), plain(f, weights, series, projected);
    const auto candidate = [](Taylor& one) {
      const Step::Attempt proposal = one.attempt(h, one.t() + h);
      CHECK(proposal.outcome == Outcome::ok);
      return std::vector<double>(proposal.y, proposal.y + 4);
    };
    for (Taylor* one : {&step, &plain})
      CHECK(one->start(0, system.y0.data(), {.tf = 10, .hmax = 1, .hmin = 0}) == Outcome::ok);
    for (int k = 0; k < 3; ++k) {
      std::vector<double> expected = candidate(plain), reached(step.y(), step.y() + 4);
      CHECK(same_bits(candidate(step), expected));
      CHECK(step.reject(Cause::error, 0) && step.h() < h);
      (void)step.attempt(h / 7, step.t() + h / 7);
      CHECK(step.reject(Cause::projection, 0));
      CHECK(same_bits(candidate(step), expected));
      expected[1] += 1e-5;
      spoil = test::NaN;
      CHECK(step.accept(expected.data()) == Outcome::not_finite && step.undefined_component() == 2);
      CHECK(same_bits(step.y(), reached.data(), 4));
      spoil = 0;
      CHECK(step.reject(Cause::not_finite, 0) && same_bits(candidate(step), candidate(plain)));
      for (Taylor* one : {&step, &plain}) CHECK(one->accept(expected.data()) == Outcome::ok);
      std::vector<double> data(step.extension_size()), other(data.size()), end(4);
      CHECK(step.extension(data.data()) == Status::ok && plain.extension(other.data()) == Status::ok);
      CHECK(same_bits(data, other));
      step.interpolate()(data.data(), data.size(), 4, std::array{0.0}, end.data());
      CHECK(same_bits(end, reached));
      step.interpolate()(data.data(), data.size(), 4, std::array{1.0}, end.data());
      expected[1] -= 1e-5;
      CHECK_CLOSE(distance(end.data(), expected.data(), 4), 0, 20 * eps);
    }
  }
}

/// y' = a sign y, with y as its condition.
struct Switching {
  explicit Switching(double rate)
      : f([rate](double, const double* y, double* out) { out[0] = y[0] > 0   ? rate
                                                                  : y[0] < 0 ? -rate
                                                                             : 0; }),
        solution([this](double, double unit, const double* y, double* out) {
          std::fill(out, out + order + 1, 0);
          out[0] = y[0];
          f(0, y, out + 1);
          out[1] *= unit;
        }),
        condition([](double, double, const double* c, double* out) { std::copy(c, c + order + 1, out); }),
        series{as_series(solution, order), as_series(condition, order), 1} {}

  static constexpr std::size_t order = 8;
  test::Function f;
  Coefficients solution, condition;
  SystemSeries series;
};

TEST(a_step_ends_just_beyond_the_root_of_a_condition_and_longer_attempts_fail_without_a_trace) {
  for (const double start : {1.0, -1.0}) {
    const check::Case label("from ", start);
    Switching system(-1);
    const Weights weights(1e-8, {1.0}, {});
    Callback f = as_callback(system.f);
    Taylor step(f, weights, system.series, false);
    CHECK(step.start(0, &start, {.tf = 20, .hmax = 20, .hmin = 0}) == Outcome::ok);
    const double root = 1, h = step.h();
    CHECK(h > root && h < root + 100 * eps);
    const std::int64_t calls = system.series.solution.calls();
    CHECK(step.attempt(2, 2).error > weights.rtol());
    CHECK(step.reject(Cause::error, 0) && step.h() == h && system.series.solution.calls() == calls);
    const Step::Attempt proposal = step.attempt(h, h);
    CHECK(proposal.outcome == Outcome::ok && proposal.error <= weights.rtol());
    CHECK(start * proposal.y[0] < 0);
    CHECK(step.accept(proposal.y) == Outcome::ok && step.t() == h);
    CHECK_CLOSE(start * step.slope()[0], 1, 0);  // of the other branch
  }
}

TEST(where_the_solution_slides_along_a_condition_the_acceptance_test_limits_steps) {
  Switching system(-1);
  Problem problem;
  problem.n = 1;
  problem.f = as_callback(system.f);
  problem.series.emplace(system.series);
  const Weights weights(1e-3, {1.0}, {});
  Settings settings;
  settings.tf = 1.5;
  settings.hmax = 1;
  settings.max_steps = 100000;
  const Solver solver(*find_method("taylor"), std::move(problem), weights, settings, MethodOptions{});
  Run run(solver);
  const double start = 1;
  CHECK(run.integration().start(&start) == State::running);
  CHECK(run.integration().run() == State::reached_end);
  const RunResult result = run.take_result();
  CHECK(std::abs(*result.end()) < 0.1);
  CHECK(result.counts.steps < 20000);
}

TEST(each_linear_law_of_f_vanishes_on_the_directions_and_errors_are_given_by_component) {
  System sum = oscillator(9);  // of the oscillator and a copy that mirrors it: the sums are zero
  sum.y0 = {1, 0, -1, 0};
  sum.f = [](double, const double* y, double* out) { out[0] = y[1], out[1] = -y[0], out[2] = -y[1], out[3] = y[0]; };
  sum.series = [](double, double unit, const double* y, double* out) {
    std::copy(y, y + 4, out);
    for (std::size_t k = 0; k < 9; ++k, out += 4) {
      out[4] = unit * out[1] / static_cast<double>(k + 1), out[5] = unit * -out[0] / static_cast<double>(k + 1);
      out[6] = -out[4], out[7] = -out[5];
    }
  };
  const Weights weights(1e-6, std::vector<double>(4, 1), {});
  Callback f = as_callback(sum.f);
  SystemSeries series{as_series(sum.series, 9)};
  Taylor step(f, weights, series, true);
  CHECK(step.start(0, sum.y0.data(), {.tf = 10, .hmax = 1, .hmin = 0}) == Outcome::ok);
  const Step::Attempt proposal = step.attempt(1, 1);
  const double* directions[9];
  CHECK(step.directions(directions) == step.max_directions() && step.max_directions() == 9);
  for (const double* one : directions) CHECK(one[0] + one[2] == 0 && one[1] + one[3] == 0);
  double errors[4];
  CHECK(step.errors(errors));
  CHECK_CLOSE(std::max(std::abs(errors[0]), std::abs(errors[1])), proposal.error, 10 * eps);
  CHECK_CLOSE(errors[0], std::cos(1.0) - proposal.y[0], 0.3 * std::abs(errors[0]));
}

// -------------------------------------------------------------------------------------------------------------- events

namespace {

/// Π (y − r) as an event, with its coefficients along a polynomial y.
struct Product {
  std::vector<double> roots;
  std::size_t order;

  static Status value(void* self, double, const double* y, double* out) {
    out[0] = 1;
    for (const double root : static_cast<Product*>(self)->roots) out[0] *= y[0] - root;
    return Status::ok;
  }
  static Status series(void* self, double, double, const double* c, double* out) {
    const auto& [roots, order] = *static_cast<Product*>(self);
    std::fill(out, out + order + 1, 0);
    out[0] = 1;
    for (const double root : roots)
      for (std::size_t k = order + 1; k-- > 0;) {
        double sum = out[k] * (c[0] - root);
        for (std::size_t j = 1; j <= k; ++j) sum += out[k - j] * c[j];
        out[k] = sum;
      }
    return Status::ok;
  }
  EventFunction event(bool touching) {
    return {.function = {value, this}, .series = Series(series, this, static_cast<int>(order)), .touching = touching};
  }
};

bool all_close(const std::vector<double>& found, std::vector<double> expected, double tolerance) {
  std::ranges::sort(expected);
  return std::ranges::equal(found, expected, [&](double a, double b) { return std::abs(a - b) <= tolerance; });
}
std::vector<double> times_of(const Trajectory& occurrences) { return {occurrences.t.begin(), occurrences.t.end()}; }

}  // namespace

TEST(no_crossing_inside_a_step_is_missed_and_none_invented) {
  constexpr std::size_t order = 8;
  constexpr double h = 0.1;
  std::mt19937 random(1);
  std::uniform_real_distribution<double> anywhere(0.01, 0.99), exponent(std::log2(0x1.1p-26 * h), -10);
  for (int trial = 0; trial < 1500; ++trial) {
    const double pair = anywhere(random), gap = std::exp2(exponent(random)), touched = anywhere(random);
    std::vector<double> crossed = {anywhere(random), anywhere(random), anywhere(random), pair, pair + gap},
                        all = crossed;
    all.push_back(touched);
    Product product{all, order};
    product.roots.push_back(touched);
    const RunResult result =
        Bench(clock(order), 1e-6, {.hmax = h}, {product.event(false), product.event(true)}).solve();
    const check::Case label("trial ", trial, ", gap ", gap, " at ", pair, ", touched ", touched);
    CHECK(result.state == State::reached_end);
    CHECK(all_close(times_of(result.occurrences[0]), crossed, 8 * eps));
    CHECK(all_close(times_of(result.occurrences[1]), all, 0x1p-30));
  }
}

TEST(zero_that_is_touched_at_the_end_of_a_step_is_reported_once) {
  constexpr std::size_t order = 8;
  const RunResult plain = Bench(clock(order), 1e-6).solve();
  CHECK(plain.points.t.size() > 5);
  for (std::size_t k = 1; k < plain.points.t.size(); ++k)
    for (const double beside : {0.0, 0x1p-50, -0x1p-50, 0x1p-40, -0x1p-40}) {
      const double touched = plain.points.t[k] + beside;
      if (touched > 1) continue;
      const check::Case label(touched, " beside ", plain.points.t[k]);
      Product product{{touched, touched}, order};
      const RunResult result = Bench(clock(order), 1e-6, {}, {product.event(false), product.event(true)}).solve();
      CHECK(result.occurrences[0].t.size() == 0);
      CHECK(all_close(times_of(result.occurrences[1]), {touched}, 0x1p-30));
    }
}

TEST(roots_closer_than_the_resolution_are_one_that_touches) {
  Product product{{0.537, 0.537 + 0x1p-32}, 8};
  const RunResult result = Bench(clock(8), 1e-6, {}, {product.event(false), product.event(true)}).solve();
  CHECK(result.occurrences[0].t.size() == 0);
  CHECK(all_close(times_of(result.occurrences[1]), {0.537}, 0x1p-30));
}

TEST(events_of_projected_steps_are_found_on_the_values_returned) {
  // r · v rises through zero at every pericentre.
  System system = kepler(15);
  const auto radial = [](void*, double, const double* y, double* out) {
    out[0] = y[0] * y[2] + y[1] * y[3];
    return Status::ok;
  };
  const auto series = [](void*, double, double, const double* c, double* out) {
    for (std::size_t k = 0; k <= 15; ++k) out[k] = product(c, 4, c + 2, 4, k) + product(c + 1, 4, c + 3, 4, k);
    return Status::ok;
  };
  const EventFunction pericentre{
      .function = {radial, nullptr}, .direction = 1, .series = Series(series, nullptr, 15), .touching = false};
  const RunResult result = Bench(std::move(system), 1e-12, {}, {pericentre}).solve();
  std::vector<double> expected;
  for (int k = 1; k * 2 * test::pi < 50; ++k) expected.push_back(k * 2 * test::pi);
  CHECK(all_close(times_of(result.occurrences[0]), expected, 1e-9));
  for (std::size_t k = 0; k < expected.size(); ++k) {
    double value = 0, g[2];
    CHECK(radial(nullptr, 0, &result.occurrences[0].y[4 * k], &value) == Status::ok);
    CHECK_CLOSE(value, 0, 20 * eps);
    test::kepler(0.5).g(0, &result.occurrences[0].y[4 * k], g);
    CHECK_CLOSE(g[0], -0.5, 10 * eps);
  }
}

}  // namespace invariode::test::taylor_laws
