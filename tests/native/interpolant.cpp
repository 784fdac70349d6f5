// The continuous solution meets the stored values, is continuous, and keeps the invariants between steps.

#include <algorithm>
#include <vector>

#include "check.hpp"
#include "problems.hpp"

namespace invariode::test::interpolant_laws {

namespace {

constexpr Interpolation modes[] = {Interpolation::projected, Interpolation::corrected, Interpolation::raw};

/// The dense output of a finished run.
struct Dense {
  explicit Dense(Run& r) : run(r), projector(*r.invariants, r.weights, 1), y(r.n()) {}
  const std::vector<double>& operator()(double t) {
    CHECK(run->output().dense->evaluate(&t, 1, y.data(), &projector) == Status::ok);
    return y;
  }
  Run& run;
  Projector projector;
  std::vector<double> y;
};

/// Runs all methods in a mode on problems with invariants, forwards and backwards, then looks.
template <class Look>
void for_runs(std::initializer_list<Interpolation> wanted, Look look) {
  for (const Method& method : general_methods())
    for (const Interpolation mode : wanted)
      for (const double forward : {1.0, -1.0})
        for (Problem problem : {kepler(0.5, 10), lotka_volterra(), pendulum(), moving()}) {
          const check::Case label(method.name, ", ", problem.name, ", mode ", static_cast<int>(mode), ", to ", forward);
          Settings settings{.tf = 5 * forward, .refine = 4, .interpolation = mode, .dense = true};
          Run run(method, std::move(problem), {.rtol = 1e-4, .settings = settings});
          CHECK(run.run() == State::reached_end);
          look(run);
        }
}

}  // namespace

TEST(at_the_steps_the_stored_values_are_returned) {
  for_runs({modes[0], modes[1], modes[2]}, [](Run& run) {
    Dense dense(run);
    const std::vector<double> knots = run->output().dense->knots().copy();
    CHECK(knots.size() == run->output().steps.size() + 1);
    for (std::size_t k = 0; k < knots.size(); ++k) {
      CHECK(knots[k] == run->output().points.t[4 * k]);  // refine = 4
      CHECK(same_bits(dense(knots[k]).data(), &run->output().points.y[4 * k * run.n()], run.n()));
    }
  });
}

TEST(the_solution_is_continuous_across_steps) {
  // One ulp of t beside a knot the value moves by |y'| ulp(t); each of the up to 5 + 2 terms of size |y| and 1 adds a
  // roundoff.
  for_runs({Interpolation::projected, Interpolation::corrected}, [](Run& run) {
    Dense dense(run);
    const std::vector<double> knots = run->output().dense->knots().copy();
    double slope[4];
    for (std::size_t k = 0; k < knots.size(); ++k) {
      const double* stored = &run->output().points.y[4 * k * run.n()];
      run.problem.f(knots[k], stored, slope);
      for (const double beyond : {-infinity, infinity}) {
        const double t = std::nextafter(knots[k], beyond);
        if ((t - knots.front()) * (t - knots.back()) > 0) continue;
        const std::vector<double>& y = dense(t);
        for (std::size_t i = 0; i < run.n(); ++i)
          CHECK_CLOSE(y[i], stored[i], 2 * std::abs(slope[i]) * ulp(t) + 16 * eps * (1 + std::abs(stored[i])));
      }
    }
  });
}

TEST(dense_output_and_output_in_the_loop_are_the_same) {
  for_runs({modes[0], modes[1], modes[2]}, [](Run& run) {
    Projector projector(*run.invariants, run.weights, 1);
    const Trajectory& points = run->output().points;
    std::vector<double> y(points.y.size());
    CHECK(run->output().dense->evaluate(points.t.data(), points.t.size(), y.data(), &projector) == Status::ok);
    CHECK(same_bits(y, points.y));
  });
}

TEST(between_steps_the_residual_is_the_blend_of_those_at_the_ends) {
  for_runs({Interpolation::projected}, [](Run& run) {
    Dense dense(run);
    const std::vector<double> knots = run->output().dense->knots().copy();
    const std::size_t m = run.problem.m, n = run.n();
    std::vector<double> r0(m), r1(m), r(m), J(m * n);
    for (std::size_t k = 0; k + 1 < knots.size(); ++k) {
      const double* y0 = &run->output().points.y[4 * k * n];
      CHECK(run.invariants->residual(knots[k], y0, r0.data()) == Status::ok);
      CHECK(run.invariants->residual(knots[k + 1], y0 + 4 * n, r1.data()) == Status::ok);
      for (const double theta : {0.1, 0.35, 0.5, 0.9}) {
        const double t = knots[k] + theta * (knots[k + 1] - knots[k]);
        const double* y = dense(t).data();
        CHECK(run.invariants->residual(t, y, r.data()) == Status::ok);
        CHECK(run.invariants->jacobian(t, y, J.data()) == Status::ok);
        for (std::size_t i = 0; i < m; ++i)
          CHECK_CLOSE(r[i], (1 - theta) * r0[i] + theta * r1[i], run.invariants->roundoff(i, y, J.data()) + 1e-14);
      }
    }
  });
}

TEST(projected_values_between_steps_are_as_accurate_as_corrected_ones) {
  for (const Method& method : general_methods())
    for (const double rtol : {1e-4, 1e-7}) {
      const check::Case label(method.name, ", rtol ", rtol);
      double error[2] = {0, 0};
      for (const Interpolation mode : {Interpolation::projected, Interpolation::corrected}) {
        Run run(method, kepler(0.3, 6), {.rtol = rtol, .settings = {.interpolation = mode, .dense = true}});
        CHECK(run.run() == State::reached_end);
        Dense dense(run);
        double exact[4];
        for (double t = 0.01; t < 6; t += 0.01) {
          run.problem.solution(t, nullptr, exact);
          double& worst = error[mode == Interpolation::corrected];
          worst = std::max(worst, distance(dense(t).data(), exact, 4));
        }
      }
      CHECK(error[0] <= 2 * error[1]);
    }
}

TEST(without_invariants_projected_and_corrected_are_the_raw_extension) {
  for (const Method& method : general_methods()) {
    std::vector<double> results[3];
    for (int k = 0; k < 3; ++k) {
      Run run(method, without_invariants(kepler(0.5, 10)), {.settings = {.refine = 3, .interpolation = modes[k]}});
      CHECK(run.run() == State::reached_end);
      results[k] = run->output().points.y.copy();
    }
    CHECK(same_bits(results[0], results[1]));
    CHECK(results[0].size() == results[2].size());
    // e₁ is roundoff of P(1); the Adams extension misses its start by some rtol
    const double expected = is(method, "ode113") || method.switches() ? 1e-2 : 1e-13;
    CHECK_CLOSE(distance(results[0].data(), results[2].data(), results[0].size()), 0, expected);
  }
}

TEST(a_run_with_a_terminal_event_has_the_same_continuous_solution_up_to_it) {
  Function event = [](double t, const double*, double* e) { e[0] = t - 3.1; };
  for (const Method& method : general_methods()) {
    Run whole(method, kepler(0.5, 10), {.settings = {.dense = true}});
    Run cut(method, kepler(0.5, 10), {.settings = {.dense = true}, .events = {{as_callback(event), 1}}});
    CHECK(whole.run() == State::reached_end && cut.run() == State::terminal_event);
    Dense a(whole), b(cut);
    for (double t = 0.05; t < 3.1; t += 0.1) CHECK(same_bits(a(t), b(t)));
  }
}

}  // namespace invariode::test::interpolant_laws
