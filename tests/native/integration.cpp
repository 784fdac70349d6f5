// The loop: where it lands, what it puts out, how it ends.

#include <algorithm>
#include <array>
#include <random>
#include <string_view>
#include <vector>

#include "aim.hpp"
#include "check.hpp"
#include "problems.hpp"

namespace invariode::test::integration_laws {

TEST(the_end_is_reached_exactly) {
  for (const Method& method : general_methods())
    for (const double tf : {1.0, 0.1, 1. / 3, 7.123456789, 1e-9, 1e4, -0.1, -7.123456789}) {
      const check::Case label(method.name, ", tf ", tf);
      Run run(method, scalar("decay", 1, tf, [](double t, const double*, double* out) { out[0] = std::cos(t); }));
      CHECK(run.run() == State::reached_end);
      CHECK(run->output().points.t.back() == tf && run->output().steps.back().t == tf && run->step().t() == tf);
      CHECK(run->output().points.t.front() == 0 && run->output().points.t.size() == run->output().steps.size() + 1);
      CHECK(static_cast<std::int64_t>(run->output().steps.size()) == run->counts().steps);
    }
}

TEST(the_end_is_assigned_and_not_added) {
  const double t0 = -1e5 / 3, tf = 0.1;
  CHECK(t0 + (tf - t0) != tf);
  for (const Method& method : general_methods()) {
    Run run(method, clock(0), {.settings = {.t0 = t0, .tf = tf, .hmax = infinity, .first_step = 1e6}});
    CHECK(run.run() == State::reached_end);
    CHECK(run->output().points.t.back() == tf && run->step().t() == tf && run->counts().steps == 1);
  }
}

TEST(backwards_is_the_mirror_image_of_forwards) {
  // (Not with difference Jacobians: their increments go the way of f.)
  for (const Method& method : explicit_methods()) {
    const check::Case label(method.name);
    Problem mirrored = kepler(0.5, -10);
    const Function f = mirrored.f;
    mirrored.f = [f](double t, const double* y, double* out) {
      f(t, y, out);
      for (int i = 0; i < 4; ++i) out[i] = -out[i];
    };
    Run forwards(method, kepler(0.5, 10)), backwards(method, mirrored);
    CHECK(forwards.run() == State::reached_end && backwards.run() == State::reached_end);
    CHECK(same_bits(forwards->output().points.y, backwards->output().points.y));
    std::vector<double> t = backwards->output().points.t.copy();
    for (double& at : t) at = 0 - at;
    CHECK(same_bits(forwards->output().points.t, t));
  }
}

TEST(no_step_is_longer_than_hmax_but_the_last_which_may_stretch) {
  for (const Method& method : general_methods())
    for (const double hmax : {0.5, 0.03}) {
      Run run(method, harmonic(), {.settings = {.tf = 10.01, .hmax = hmax, .first_step = 100}});
      CHECK(run.run() == State::reached_end);
      std::vector<double> h;
      for (const AcceptedStep& step : run->output().steps) h.push_back(step.h);
      CHECK(h.back() <= 1.1 * hmax);
      h.pop_back();
      CHECK(*std::max_element(h.begin(), h.end()) <= hmax * (1 + 1e-12));  // as t₁ − t
    }
}

TEST(an_attempt_keeps_hmin_hmax_and_the_target_whatever_a_method_proposes) {
  std::mt19937 random(1);
  std::uniform_real_distribution<double> part(0, 1);
  for (const double forward : {1.0, -1.0})
    for (int run = 0; run < 200; ++run) {
      const double target = forward * 10 * part(random), hmax = std::pow(10, -4 * part(random));
      Aim aim(forward, hmax);
      aim.at(target);
      double t = -forward * 10 * part(random), ulps = 1, hmin = 0;  // grows from step to step
      for (int attempt = 0; attempt < 50 && t != target; ++attempt) {
        const double distance = std::abs(target - t);
        const bool first = attempt % 3 == 0;
        const double proposed = std::pow(10, 20 * part(random) - 18);
        if (first) {
          hmin = ulps * ulp(t);
          ulps = std::min(hmin_ulps, growth_of_hmin * ulps);
          aim.begin(t, proposed);
        } else {
          aim.retry(t, proposed);
        }
        const double h = std::abs(aim.h());
        CHECK(aim.hmin() == hmin);
        CHECK(aim.lands() == (aim.t1() == target));
        CHECK(forward * (aim.t1() - t) > 0 && forward * (target - aim.t1()) >= 0);
        if (aim.lands())
          CHECK(h <= std::max(distance, hmin) && h <= stretch * std::max(hmin, hmax));
        else {
          const double size = std::max(hmin, std::min(hmax, proposed));
          CHECK_CLOSE(h, size, size < hmin_ulps * ulp(t) ? ulp(t) : 0);  // of few spacings of t, it is some
        }
        if (!first && aim.lands()) CHECK(std::max(hmin, proposed) >= distance - ulp(target));  // not stretched
        if (attempt % 3 == 2) t = aim.t1();
      }
    }
}

TEST(a_failed_attempt_is_retried_inside_hmax_and_the_interval) {
  // f is undefined once, at the projected value of an accepted step. (An implicit method does not ask there.)
  for (const Method& method : explicit_methods()) {
    const check::Case label(method.name);
    Problem problem = harmonic();
    bool spoilt = false;
    double latest = 0;
    problem.f = [&, f = problem.f](double t, const double* y, double* out) {
      f(t, y, out);
      latest = std::max(latest, t);
      const double energy = (y[0] * y[0] + y[1] * y[1]) / 2;
      if (t > 1.87 && std::abs(energy - 0.5) < 1e-12 && !std::exchange(spoilt, true)) out[0] = NaN;
    };
    Settings settings{.tf = 2, .hmax = 0.05, .check = false};
    Run run(method, problem, {.rtol = 1e-2, .fsal = Fsal::evaluate, .settings = settings});
    CHECK(run.start() == State::running);
    while (run->advance() == State::running && run->counts().steps < 100) {  // 40, and a few after the failure
    }
    CHECK(run->state() == State::reached_end);
    CHECK(spoilt && run->counts().failed == 1);
    CHECK(latest <= 2);
    for (const AcceptedStep& step : run->output().steps) CHECK(step.h <= 1.1 * 0.05);
  }
}

TEST(a_first_step_that_is_given_is_taken) {
  for (const Method& method : general_methods()) {
    Run run(method, harmonic(), {.settings = {.first_step = 0.001}});
    CHECK(run.run() == State::reached_end);
    CHECK(run->output().steps.front().h == 0.001);
  }
}

TEST(a_blow_up_ends_at_hmin_where_the_suite_ends) {
  // y' = (t + y)², y(0) = 1 has the solution tan(t + π/4) − t. MATLAB's ode45 prints t=7.853789e-01 and the smallest
  // step allowed, 1.776357e-15.
  const Problem problem =
      scalar("blow-up", 1, 1, [](double t, const double* y, double* out) { out[0] = (t + y[0]) * (t + y[0]); });
  for (const Method& method : pairs()) {
    const check::Case label(method.name);
    Run run(method, problem);
    CHECK(run.run() == State::step_failed);
    CHECK_CLOSE(run->report().t, pi / 4, 1e-3);
    CHECK(run->report().cause == Cause::error || run->report().cause == Cause::not_finite);
    CHECK(std::abs(run->report().h) <= 16 * ulp(run->report().t));
    CHECK(run->output().points.t.back() == run->report().t);
    if (method.order == 5) CHECK_CLOSE(run->report().t, 7.853789e-01, 0.5e-7);
    if (method.order == 5) CHECK_CLOSE(16 * ulp(run->report().t), 1.776357e-15, 0.5e-21);
  }
}

TEST(an_infinite_interval_ends_at_a_terminal_event) {
  Function at_five = [](double, const double* y, double* e) { e[0] = y[0] - 5; };
  const Problem problems[] = {
      scalar("y' = 1", 0, infinity, [](double, const double*, double* out) { out[0] = 1; }),
      scalar("y' = t, zero at the start", 0, infinity, [](double t, const double*, double* out) { out[0] = t; }),
      scalar("backwards", 0, -infinity, [](double, const double*, double* out) { out[0] = -1; }),
  };
  for (const Method& method : general_methods())
    for (const Problem& problem : problems) {
      const check::Case label(method.name, ", ", problem.name);
      Run run(method, problem, {.settings = {.hmax = infinity}, .events = {{as_callback(at_five), 1}}});
      CHECK(run.run() == State::terminal_event);
      CHECK_CLOSE(run.last()[0], 5, 1e-12);
    }
}

TEST(output_at_times_gives_those_times_and_no_others) {
  for (const Method& method : general_methods())
    for (const double forward : {1.0, -1.0}) {
      const check::Case label(method.name, ", direction ", forward);
      Settings settings{.tf = 5 * forward, .output_at_times = true};
      std::vector<double> times{0.0, 0.1, 0.1000001, 2.0, 4.99, 5.0};
      for (double& t : times) t *= forward;
      settings.times = Times(times);
      Run at_times(method, kepler(0.5), {.settings = settings});
      Run dense(method, kepler(0.5), {.settings = {.tf = 5 * forward, .dense = true}});
      CHECK(at_times.run() == State::reached_end && dense.run() == State::reached_end);
      CHECK(at_times->output().points.t == times);
      Projector projector(*dense.invariants, dense.weights, 1);
      std::vector<double> y(at_times->output().points.y.size());
      CHECK(dense->output().dense->evaluate(times.data(), times.size(), y.data(), &projector) == Status::ok);
      CHECK(same_bits(y, at_times->output().points.y));
      CHECK(at_times->counts().steps == dense->counts().steps);
    }
}

TEST(all_output_has_the_same_steps_which_only_methods_that_test_their_extensions_shorten_for_it) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Run plain(method, pendulum()), dense(method, pendulum(), {.settings = {.dense = true}}),
        refined(method, pendulum(), {.settings = {.refine = 7}}),
        end(method, pendulum(), {.settings = {.save_all = false}});
    for (Run* run : {&plain, &dense, &refined, &end}) CHECK(run->run() == State::reached_end);
    const std::size_t steps = dense->output().steps.size();
    CHECK(plain->output().points.t.size() == plain->output().steps.size() + 1);
    CHECK(refined->output().points.t.size() == 7 * steps + 1);
    CHECK(std::is_sorted(refined->output().points.t.begin(), refined->output().points.t.end()));
    for (std::size_t k = 0; k <= steps; ++k) CHECK(dense->output().points.t[k] == refined->output().points.t[7 * k]);
    CHECK(end->output().points.t.size() == 1 && end->output().points.t[0] == 50 && end->output().steps.empty());
    CHECK(same_bits(plain.last(), end.last(), 4));
    CHECK(same_bits(dense.last(), refined.last(), 4));
    const std::string_view name = method.name;
    if (name != "radau" && name != "ode23t" && name != "ode23tb") CHECK(same_bits(plain.last(), dense.last(), 4));
  }
}

TEST(stepping_by_hand_is_running) {
  for (const Method& method : general_methods()) {
    Run by_hand(method, lotka_volterra()), at_once(method, lotka_volterra());
    CHECK(by_hand.start() == State::running);
    std::int64_t steps = 0;
    while (by_hand->advance() == State::running) CHECK(by_hand->counts().steps == ++steps);
    CHECK(at_once.run() == State::reached_end && by_hand->state() == State::reached_end);
    CHECK(same_bits(by_hand->output().points.y, at_once->output().points.y));
  }
}

TEST(the_callback_sees_every_step_and_can_stop) {
  for (const Method& method : general_methods()) {
    std::vector<double> seen;
    Function callback = [&](double t, const double*, double* flag) {
      seen.push_back(t);
      flag[0] = seen.size() == 5;
    };
    Run run(method, harmonic(), {.callback = as_callback(callback)});
    CHECK(run.run() == State::stopped_by_callback);
    CHECK(seen.size() == 5 && run->output().steps.size() == 5);
    for (std::size_t k = 0; k < seen.size(); ++k) CHECK(seen[k] == run->output().steps[k].t);
    CHECK(run->output().points.t.back() == seen.back());
  }
}

TEST(nothing_to_integrate_is_done_at_once) {
  for (const Method& method : general_methods()) {
    Problem here = kepler(0.5);
    here.tf = 0;
    Run still(method, here);
    CHECK(still.run() == State::reached_end);
    CHECK((still->output().points.t == std::vector<double>{0, 0}));
    CHECK(same_bits(still.last(), here.y0.data(), 4));
    Run empty(method, {.name = "empty", .y0 = {}, .tf = 1, .f = [](double, const double*, double*) {}});
    CHECK(empty.run() == State::reached_end);
    CHECK(empty->output().points.t.back() == 1);
  }
}

TEST(a_span_of_one_ulp_is_one_step) {
  for (const Method& method : general_methods())
    for (const double beyond : {infinity, -infinity}) {
      const double tf = std::nextafter(1.0, beyond);
      Run run(method, harmonic(), {.settings = {.t0 = 1, .tf = tf}});  // hmax, a tenth of that, would not move t
      CHECK(run.start() == State::running);
      CHECK(run->advance() == State::reached_end);
      CHECK(run->counts().steps == 1 && run->output().points.t.back() == tf);
    }
}

TEST(f_that_is_not_finite_at_the_start_is_reported_with_its_component) {
  for (const Method& method : general_methods())
    for (int component = 0; component < 4; ++component) {
      Problem problem = without_invariants(kepler(0.5));
      problem.f = [=](double, const double*, double* out) {
        for (int i = 0; i < 4; ++i) out[i] = i == component ? NaN : 1;
      };
      Run run(method, problem);
      CHECK(run.run() == State::start_undefined);
      CHECK(run->report().component == component);
    }
}

TEST(f_that_stays_undefined_ends_the_run_there_with_the_component) {
  for (const Method& method : general_methods()) {
    Problem problem = without_invariants(harmonic());
    const Function f = problem.f;
    problem.f = [f](double t, const double* y, double* out) {
      f(t, y, out);
      if (t > 2) out[1] = NaN;
    };
    Run run(method, problem);
    CHECK(run.run() == State::step_failed);
    const bool iterates = method.implicit() && !method.switches() && !is(method, "ode23s");
    CHECK(run->report().cause == (iterates ? Cause::newton : Cause::not_finite));
    CHECK(run->report().component == 1);
    CHECK_CLOSE(run->report().t, 2, 100 * eps);
  }
}

TEST(pure_relative_control_at_zero_is_named_as_the_reason) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    // The error relative to y₁ ~ (t − 1)^{k+1} is that of the quadrature formula, whatever h.
    Problem problem{.name = "leaves zero", .y0 = {1, 0}, .tf = 2, .f = [](double t, const double*, double* out) {
                      out[0] = 0, out[1] = std::pow(t - 1, 16);
                    }};
    Run run(method, problem, {.atol = 0, .settings = {.t0 = 1}});
    if (!is(method, "ode23s")) {  // whose difference for f_t is larger than f here
      CHECK(run.run() == State::step_failed);
      CHECK(run->report().pure_relative && run->report().component == 1);
    }
    problem.f = [](double, const double* y, double* out) { out[0] = -y[0], out[1] = 0; };
    Run stays(method, problem, {.atol = 0});
    CHECK(stays.run() == State::reached_end);
    CHECK(stays.last()[1] == 0);
  }
}

TEST(the_counts_are_those_of_the_calls) {
  for (const Method& method : fsal_pairs()) {
    Run plain(method, without_invariants(lotka_volterra())), projected(method, lotka_volterra()),
        evaluated(method, lotka_volterra(), {.fsal = Fsal::evaluate});
    for (Run* run : {&plain, &projected, &evaluated}) {
      CHECK(run->run() == State::reached_end);
      const Counts& counts = (*run)->counts();
      const std::int64_t again = run == &evaluated ? counts.steps : 0;
      CHECK(run->f.calls() == 1 + method.stages * (counts.steps + counts.failed) + again);
    }
    CHECK(plain->counts().projections == 0);
    CHECK(projected->counts().projections == projected->counts().steps);
  }
}

TEST(a_pair_whose_last_stage_waits_for_y1_evaluates_it_once_per_step_and_its_extension_only_when_asked) {
  for (const Method& method : waiting_pairs())
    for (const Problem& problem : {without_invariants(lotka_volterra()), lotka_volterra()}) {
      const check::Case label(method.name);
      Run plain(method, problem), looked_into(method, problem, {.settings = {.refine = 2}});
      for (Run* run : {&plain, &looked_into}) {
        CHECK(run->run() == State::reached_end);
        const Counts& counts = (*run)->counts();
        CHECK(counts.failed > 0);
        const int in_extension = run == &looked_into ? method.extra : 0;
        CHECK(run->f.calls() ==
              1 + method.stages * (counts.steps + counts.failed) - counts.failed + in_extension * counts.steps);
      }
      CHECK(same_bits(plain.last(), looked_into.last(), 2));
    }
}

TEST(where_f_is_not_defined_at_a_stage_of_the_extension_the_cubic_takes_its_place) {
  for (const Method& method : waiting_pairs()) {
    const check::Case label(method.name);
    // NaN at the times of the further stages only
    Problem problem = harmonic();
    const Function f = problem.f;
    int calls = 0;
    problem.f = [&](double t, const double* y, double* out) {
      f(t, y, out);
      if (++calls > 1 + method.stages) out[0] = NaN;
    };
    Run run(method, problem, {.settings = {.first_step = 0.1}});
    CHECK(run.start() == State::running);
    CHECK(run->advance() == State::running);
    Step& step = const_cast<Step&>(run->step());
    std::vector<double> data(step.extension_size()), y(2), start(2), exact(2);
    CHECK(step.extension(data.data()) == Status::ok);
    for (const double theta : {0.0, 0.5, 1.0}) {
      step.interpolate()(data.data(), data.size(), 2, std::array{theta}, y.data());
      problem.solution(0.1 * theta, nullptr, exact.data());
      CHECK_CLOSE(distance(y.data(), exact.data(), 2), 0, theta == 0.5 ? 1e-6 : 1e-12);
    }
  }
}

TEST(the_papers_residuals_on_lotka_volterra_are_reproduced) {
  // Paper, section 6: x^{-c} e^{cx} y^{-a} e^{ay}, ode23, default tolerances: off by 9.12, projected by 8.80e-5.
  Problem problem = lotka_volterra();
  problem.g = [](double, const double* y, double* r) { r[0] = std::exp(y[0] + 2 * y[1]) / (y[0] * y[1] * y[1]); };
  problem.jacobian = [](double, const double* y, double* J) {
    const double g = std::exp(y[0] + 2 * y[1]) / (y[0] * y[1] * y[1]);
    J[0] = g * (1 - 1 / y[0]), J[1] = g * (2 - 2 / y[1]);
  };
  const auto residual = [&](Run& run) {
    double worst = 0, r = 0, r0 = 0;
    problem.g(0, problem.y0.data(), &r0);
    for (std::size_t k = 0; k < run->output().points.t.size(); ++k) {
      problem.g(0, &run->output().points.y[2 * k], &r);
      worst = std::max(worst, std::abs(r - r0));
    }
    return worst;
  };
  Run plain(named("ode23"), without_invariants(problem)), projected(named("ode23"), problem);
  CHECK(plain.run() == State::reached_end && projected.run() == State::reached_end);
  CHECK(plain->counts().steps == 391 && plain->counts().failed == 27 && plain.f.calls() == 1255);
  CHECK(projected->counts().steps == 389 && projected->counts().failed == 26 && projected.f.calls() == 1246);
  CHECK_CLOSE(residual(plain), 9.12, 0.005);
  CHECK_CLOSE(residual(projected), 8.80e-5, 0.005e-5);
}

}  // namespace invariode::test::integration_laws
