// The step contract: attempt proposes, accept alone commits, and what fails leaves no trace.

#include <array>
#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "check.hpp"
#include "methods/runge_kutta.hpp"
#include "problems.hpp"

namespace invariode::test::contract_laws {

namespace {

/// What a step shows of the point reached.
struct Snapshot {
  double t;
  std::vector<double> y;
  explicit Snapshot(const Step& step) : t(step.t()), y(step.y(), step.y() + step.n()) {}
  bool operator==(const Snapshot& other) const { return t == other.t && same_bits(y, other.y); }
};

std::vector<double> extension_of(Step& step) {
  std::vector<double> data(step.extension_size());
  CHECK(step.extension(data.data()) == Status::ok);
  return data;
}

/// A step of Kepler's problem at (t, y) = start, with f that can be told to fail.
struct Bench {
  /// The rtol makes h an honest rejection, and lets the Newton iteration of long implicit steps converge.
  explicit Bench(const Method& method, Fsal fsal = Fsal::reuse)
      : Bench(method, fsal,
              method.implicit() && takes_one_step(method) ? 1e-6
              : method.order >= 12                        ? 1e-14
                                                          : 1e-10) {}
  Bench(const Method& method, Fsal fsal, double rtol)
      : weights(rtol, std::vector<double>(4, 1e-3), {}), step(make_step(method, callback, weights, fsal)) {
    CHECK(step->start(0, problem.y0.data(), {.tf = 10, .hmax = 1, .hmin = 0}) == Outcome::ok);
  }

  Step::Attempt attempt(double h) { return step->attempt(h, step->t() + h); }
  std::vector<double> candidate(double h) {
    const Step::Attempt proposal = attempt(h);
    CHECK(proposal.outcome == Outcome::ok);
    return {proposal.y, proposal.y + step->n()};
  }

  Problem problem = kepler(0.5);
  Weights weights;
  double spoil = 0;  // added to f: NaN and infinity make it undefined
  Status status = Status::ok;
  Function f = [this](double t, const double* y, double* out) {
    problem.f(t, y, out);
    out[2] += spoil;
  };
  std::function<Status(double, const double*, double*)> guarded = [this](double t, const double* y, double* out) {
    f(t, y, out);
    return status;
  };
  Callback callback = as_callback(guarded);
  std::unique_ptr<Step> step;
};

constexpr double h = 0.1;

/// What three steps of a pair show, of n equations, f of one of which is not a number at the end of the second step.
std::vector<double> shown(runge_kutta::MakeStep make, std::size_t n, std::size_t undefined, bool scaled) {
  Function f = [&](double t, const double* y, double* out) {
    for (std::size_t i = 0; i < n; ++i) out[i] = y[(i + 1) % n] - 0.3 * y[i] * y[i] + 0.1 * t;
    if (t == 2 * h && undefined < n) out[undefined] = std::numeric_limits<double>::quiet_NaN();
  };
  Callback callback = as_callback(f);
  std::vector<double> y0(n), threshold(n), scale(scaled ? n : 0), seen, extension;
  for (std::size_t i = 0; i < n; ++i) {
    y0[i] = std::sin(static_cast<double>(i * i + 1));
    threshold[i] = i % 3 == 0 ? 2 : 1e-3;
    if (scaled) scale[i] = 1 + static_cast<double>(i % 5);
  }
  const Weights weights(1e-6, threshold, scale);
  const auto step = make(callback, weights, Fsal::reuse);
  CHECK(step->start(0, y0.data(), {.tf = 10, .hmax = 1, .hmin = 0}) == Outcome::ok);
  for (int k = 1; k <= 3; ++k) {
    const Step::Attempt proposal = step->attempt(h, k * h);
    seen.insert(seen.end(), proposal.y, proposal.y + n);
    seen.push_back(static_cast<double>(step->trust()));
    seen.push_back(std::isnan(proposal.error) ? -1 : proposal.error);
    if (proposal.outcome != Outcome::ok || step->accept(proposal.y) != Outcome::ok) break;
    if (std::isnan(proposal.error)) break;
    extension = extension_of(*step);
    seen.insert(seen.end(), extension.begin(), extension.end());
    seen.push_back(step->stability());
    seen.push_back(step->h());
  }
  return seen;
}

}  // namespace

TEST(an_attempt_that_is_rejected_leaves_t_and_y_as_they_were) {
  for (const Method& method : methods_of_second_order())
    for (const Cause cause : {Cause::error, Cause::projection, Cause::not_finite}) {
      const check::Case label(method.name, ", cause ", static_cast<int>(cause));
      Bench bench(method);
      CHECK(bench.step->accept(bench.candidate(h).data()) == Outcome::ok);
      const Snapshot before(*bench.step);
      for (int failure = 0; failure < 3; ++failure) {
        (void)bench.attempt(h);
        CHECK(before == Snapshot(*bench.step));
        CHECK(bench.step->reject(cause, 0));
        CHECK(before == Snapshot(*bench.step));
        CHECK(bench.step->h() < h);
      }
    }
}

TEST(steps_in_vector_instructions_have_the_bits_of_those_without) {
  using namespace runge_kutta;
  std::vector<std::size_t> sizes{127, 128, 129, 400};
  for (std::size_t n = 1; n <= 70; ++n) sizes.push_back(n);
  for (std::size_t pair = 0; pair < Pairs::count; ++pair)
    for (const std::size_t n : sizes)
      for (const bool scaled : {false, true})
        for (const std::size_t undefined : {n, n / 2, n - 1}) {
          const check::Case label("pair ", pair, ", n = ", n, ", undefined ", undefined);
          const std::vector<double> plain = shown(steps_of_small_systems[pair], n, undefined, scaled);
          CHECK(plain.size() > 2 * n);
          CHECK(same_bits(plain, shown(steps_of_any_system[pair], n, undefined, scaled)));
        }
}

TEST(an_extension_gives_at_each_theta_what_it_gives_at_that_alone) {
  for (const Method& method : methods_of_second_order()) {
    const check::Case label(method.name);
    Bench bench(method, Fsal::reuse);
    CHECK(bench.step->accept(bench.candidate(h).data()) == Outcome::ok);
    const std::vector<double> data = extension_of(*bench.step);
    std::array<double, 37> theta;
    for (std::size_t p = 0; p < theta.size(); ++p) theta[p] = static_cast<double>(p) / (theta.size() - 1);
    std::array<double, 4 * theta.size()> together;
    bench.step->interpolate()(data.data(), data.size(), 4, theta, together.data());
    for (std::size_t p = 0; p < theta.size(); ++p) {
      double alone[4];
      bench.step->interpolate()(data.data(), data.size(), 4, std::array{theta[p]}, alone);
      CHECK(same_bits(alone, &together[4 * p], 4));
    }
  }
}

TEST(an_accepted_step_stays_interpolable_until_the_next_attempt) {
  for (const Method& method : methods_of_second_order())
    for (const Fsal fsal : {Fsal::reuse, Fsal::evaluate}) {
      const check::Case label(method.name);
      Bench bench(method, fsal);
      std::vector<double> y1 = bench.candidate(h);
      y1[0] += 1e-4;  // as a projection would
      CHECK(bench.step->accept(y1.data()) == Outcome::ok);
      const std::vector<double> data = extension_of(*bench.step);
      bench.step->set_h(h / 3);
      CHECK(same_bits(data, extension_of(*bench.step)));
      CHECK(bench.step->extension_size() <= bench.step->max_extension_size());
      double y[4];
      const bool one_step = takes_one_step(method);
      bench.step->interpolate()(data.data(), data.size(), 4, std::array{0.0}, y);
      if (one_step)
        CHECK(same_bits(y, bench.problem.y0.data(), 4));
      else  // Adams: as far as the formula goes; NDF: to roundoff
        CHECK_CLOSE(distance(y, bench.problem.y0.data(), 4), 0,
                    is(method, "ode113") || method.switches() ? 1e-1 : 20 * eps);
      bench.step->interpolate()(data.data(), data.size(), 4, std::array{1.0}, y);
      if (one_step)
        y1[0] -= 1e-4;  // the raw extension of a Runge-Kutta pair ends at y*, that of a multistep method at y1
      CHECK_CLOSE(distance(y, y1.data(), 4), 0, 20 * eps);
    }
}

TEST(a_retry_with_the_same_h_gives_bitwise_the_same_step) {
  for (const Method& method : pairs())
    for (const Fsal fsal : {Fsal::reuse, Fsal::evaluate}) {
      const check::Case label(method.name);
      Bench bench(method, fsal), plain(method, fsal);
      for (int step = 0; step < 3; ++step) {
        std::vector<double> expected = plain.candidate(h);
        CHECK(same_bits(bench.candidate(h), expected));
        CHECK(bench.step->reject(Cause::error, 0));
        (void)bench.attempt(h / 7);
        CHECK(bench.step->reject(Cause::projection, 0));
        CHECK(same_bits(bench.candidate(h), expected));
        expected[1] += 1e-5;
        CHECK(plain.step->accept(expected.data()) == Outcome::ok);
        CHECK(bench.step->accept(expected.data()) == Outcome::ok);
        CHECK(Snapshot(*bench.step) == Snapshot(*plain.step));
        CHECK(same_bits(extension_of(*bench.step), extension_of(*plain.step)));
      }
    }
}

TEST(after_a_projection_the_next_step_starts_with_the_slope_that_fsal_says) {
  for (const Method& method : fsal_pairs())
    for (const Fsal fsal : {Fsal::reuse, Fsal::evaluate}) {
      const check::Case label(method.name, fsal == Fsal::reuse ? ", reuse" : ", evaluate");
      Bench bench(method, fsal);
      const std::vector<double> candidate = bench.candidate(h);
      std::vector<double> y1 = candidate;
      y1[0] += 1e-2;
      CHECK(bench.step->accept(y1.data()) == Outcome::ok);
      const std::int64_t calls = bench.callback.calls();
      CHECK(bench.step->accept(bench.candidate(h).data()) == Outcome::ok);  // not projected: nothing to evaluate
      CHECK(bench.callback.calls() - calls == method.stages);
      // The derivative of the extension at 0, the sum of its first two coefficients, is h k₁.
      const std::vector<double> data = extension_of(*bench.step);
      double slope[4];
      bench.problem.f(h, fsal == Fsal::reuse ? candidate.data() : y1.data(), slope);
      for (int i = 0; i < 4; ++i)
        CHECK_CLOSE(data[4 + i] + data[8 + i], h * slope[i], 100 * eps * h * std::abs(slope[i]));
    }
}

TEST(an_accept_that_fails_commits_nothing) {
  for (const Method& method : pairs())
    for (const Outcome failure : {Outcome::not_finite, Outcome::stop}) {
      const check::Case label(method.name, ", outcome ", static_cast<int>(failure));
      Bench bench(method, Fsal::evaluate), plain(method, Fsal::evaluate);
      for (Bench* b : {&bench, &plain}) CHECK(b->step->accept(b->candidate(h).data()) == Outcome::ok);
      const Snapshot before(*bench.step);
      std::vector<double> y1 = bench.candidate(h);
      y1[3] -= 1e-4;
      bench.spoil = failure == Outcome::not_finite ? NaN : 0;
      bench.status = failure == Outcome::stop ? Status::stop : Status::ok;
      CHECK(bench.step->accept(y1.data()) == failure);
      CHECK(before == Snapshot(*bench.step));
      bench.spoil = 0;
      bench.status = Status::ok;
      CHECK(bench.step->reject(Cause::not_finite, 0));
      for (int step = 0; step < 2; ++step) {
        y1 = plain.candidate(h);
        CHECK(same_bits(bench.candidate(h), y1));
        y1[3] -= 1e-4;
        for (Bench* b : {&bench, &plain}) CHECK(b->step->accept(y1.data()) == Outcome::ok);
        CHECK(Snapshot(*bench.step) == Snapshot(*plain.step));
        CHECK(same_bits(extension_of(*bench.step), extension_of(*plain.step)));
      }
    }
}

TEST(an_accept_that_fails_is_retried_with_a_smaller_step_and_names_the_component) {
  for (const Method& method : explicit_methods())
    for (const double size : {h, h / 50}) {  // with an error that is close to the tolerance, and one far below
      const check::Case label(method.name, ", h ", size);
      Bench bench(method, Fsal::evaluate, 1e-3);
      std::vector<double> y1 = bench.candidate(size);
      y1[3] -= 1e-4;
      bench.spoil = NaN;
      CHECK(bench.step->accept(y1.data()) == Outcome::not_finite);
      CHECK(bench.step->undefined_component() == 2);
      CHECK(bench.step->reject(Cause::not_finite, 0));
      CHECK(bench.step->h() < size);
    }
}

TEST(a_value_of_f_that_is_not_finite_fails_the_attempt_whichever_stage_it_is) {
  for (const Method& method : pairs())
    for (const double bad : {NaN, infinity, -infinity}) {
      Bench counter(method);
      const std::int64_t before = counter.callback.calls();
      (void)counter.attempt(h);
      const std::int64_t stages = counter.callback.calls() - before;
      CHECK(stages == (method.extra > 0 ? method.stages - 1 : method.stages));
      for (std::int64_t k = 0; k < stages; ++k) {
        const check::Case label(method.name, ", stage ", k + 1, " is ", bad);
        Bench bench(method);
        std::int64_t call = 0;
        bench.f = [&](double t, const double* y, double* out) {
          bench.problem.f(t, y, out);
          if (call++ == k) out[3] = bad;
        };
        const Step::Attempt proposal = bench.attempt(h);
        CHECK(proposal.outcome == Outcome::not_finite || !std::isfinite(proposal.error));
        CHECK(bench.step->undefined_component() == 3);
        CHECK(bench.step->reject(Cause::not_finite, 0));
        CHECK(same_bits(bench.candidate(h), Bench(method).candidate(h)));
      }
    }
}

TEST(f_is_never_asked_at_a_point_that_is_not_finite) {
  const auto run = [](const Method& method, Problem problem, double first_step) {
    const check::Case label(method.name, ", ", problem.name);
    bool asked = false;
    const Function f = problem.f;
    problem.f = [&asked, f, n = problem.y0.size()](double t, const double* y, double* out) {
      asked = asked || !all_finite(y, n) || !std::isfinite(t);
      f(t, y, out);
    };
    Options options;
    options.settings.first_step = first_step;
    options.settings.hmax = infinity;
    Run r(method, problem, options);
    (void)r.run();
    CHECK(!asked);
    CHECK(r->counts().failed > 0);
  };
  const Problem square = scalar("y' = y^2", 1, 2, [](double, const double* y, double* out) { out[0] = y[0] * y[0]; });
  const Problem exponential =
      scalar("y' = exp(y)", 1, 2, [](double, const double* y, double* out) { out[0] = std::exp(y[0]); });
  const Problem root =
      scalar("y' = -1 / sqrt(y)", 1, 2, [](double, const double* y, double* out) { out[0] = -1 / std::sqrt(y[0]); });
  for (const Method& method : general_methods()) {
    run(method, square, 2);
    run(method, square, 1e200);
    run(method, exponential, 2);
    run(method, root, 2);
    run(method, lotka_volterra(), 40);  // logarithms of negative numbers
  }
}

namespace {

/// Kepler's problem with all kinds of user functions, which count their calls together; call number `last` stops.
struct Stoppable {
  using Counted = std::function<Status(double, const double*, double*)>;

  Counted counted(Function function) {
    return [this, function = std::move(function)](double t, const double* y, double* out) {
      function(t, y, out);
      return ++calls == last ? Status::stop : Status::ok;
    };
  }

  State run(const Method& method, Fsal fsal, bool user_jacobian, std::int64_t stop_at) {
    calls = 0;
    last = stop_at;
    Callback rhs = as_callback(f);
    Invariants invariants(
        4, {{.g = as_callback(g), .jacobian = user_jacobian ? as_callback(jacobian) : Callback{}, .m = 2}}, value,
        weights);
    Settings settings;
    settings.tf = problem.tf;
    settings.hmax = 1;
    settings.iterations = method.iterations;
    settings.refine = 2;
    settings.dense = true;
    ExplicitSlope slope(rhs);
    Integration integration(make_step(method, rhs, weights, fsal), weights,
                            {.steps = &invariants, .between = &invariants, .slope = &slope},
                            {.f = rhs, .events = {{as_callback(event)}}, .callback = as_callback(callback)}, settings);
    (void)integration.start(problem.y0.data());
    return integration.run();
  }

  std::int64_t calls = 0, last = 0;
  Problem problem = kepler(0.3, 3);
  std::vector<double> value = {-0.5, std::sqrt(1 - 0.09)};
  Weights weights{1e-2, std::vector<double>(4, 1e-2), {}};
  Counted f = counted(problem.f), g = counted(problem.g), jacobian = counted(problem.jacobian);
  Counted event = counted([](double, const double* y, double* e) { e[0] = y[1] - 0.5; });
  Counted callback = counted([](double, const double*, double* flag) { flag[0] = 0; });
};

}  // namespace

TEST(a_user_function_that_stops_ends_the_run_at_once_whichever_call_it_is) {
  for (const Method& method : methods_of_second_order())
    for (const Fsal fsal : {Fsal::reuse, Fsal::evaluate})
      for (const bool user_jacobian : {true, false}) {
        Stoppable functions;
        CHECK(functions.run(method, fsal, user_jacobian, 0) == State::reached_end);
        const std::int64_t all = functions.calls;
        CHECK(all > 50);
        for (std::int64_t k = 1; k <= all; k += 1 + all / 500) {  // each run repeats all calls before
          const check::Case label(method.name, ", call ", k, " of ", all);
          CHECK(functions.run(method, fsal, user_jacobian, k) == State::interrupted);
          CHECK(functions.calls == k);
        }
      }
}

}  // namespace invariode::test::contract_laws
