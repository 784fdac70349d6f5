// Events: every sign change once, in order, to a few ulp of t.

#include <algorithm>
#include <list>
#include <vector>

#include "check.hpp"
#include "problems.hpp"

namespace invariode::test::events_laws {

namespace {

/// Event functions, kept where the callbacks find them.
class Watch {
 public:
  Watch& add(Function function, std::int64_t terminal = 0, int direction = 0) {
    functions_.push_back(std::move(function));
    events_.push_back({as_callback(functions_.back()), terminal, direction});
    return *this;
  }
  /// The event 'time c'.
  Watch& at(double c, std::int64_t terminal = 0) {
    return add([c](double t, const double*, double* e) { e[0] = t - c; }, terminal);
  }
  operator const std::vector<EventFunction>&() const { return events_; }

 private:
  std::list<Function> functions_;
  std::vector<EventFunction> events_;
};

const Function sine = [](double, const double* y, double* e) { e[0] = y[1]; };  // −sin t of the harmonic oscillator

Options watching(const Watch& watch, Settings settings = {}, double rtol = 1e-3) {
  return {.rtol = rtol, .settings = std::move(settings), .events = watch};
}

}  // namespace

TEST(a_root_at_a_step_end_is_found_once_and_exactly) {
  for (const Method& method : general_methods())
    for (const double size : {1.0, -1.0}) {
      const check::Case label(method.name, ", direction ", size);
      Watch watch;
      watch.at(3 * size).at(7 * size);
      Settings settings{.tf = 10 * size, .hmax = 1, .first_step = 1};
      Run run(method, clock(0), watching(watch, settings));
      CHECK(run.run() == State::reached_end);
      CHECK(run->counts().steps == 10);
      CHECK(run->output().occurrences[0].t == std::vector<double>{3 * size});
      CHECK(run->output().occurrences[1].t == std::vector<double>{7 * size});
    }
}

TEST(a_root_at_the_very_end_is_found) {
  for (const Method& method : general_methods()) {
    Watch watch;
    watch.at(10, 1);
    Run run(method, clock(10), watching(watch));
    CHECK(run.run() == State::terminal_event);
    CHECK(run->output().occurrences[0].t == std::vector<double>{10});
    CHECK(run->output().points.t.back() == 10);
  }
}

TEST(the_roots_of_a_step_are_found_in_order) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Watch watch;
    watch.at(0.7).at(0.2).at(0.45);
    watch.add([](double t, const double*, double* e) { e[0] = (t - 0.1) * (t - 0.4) * (t - 0.9); });
    Run run(method, clock(1), watching(watch, {.hmax = infinity, .first_step = 1}));
    CHECK(run.run() == State::reached_end);
    CHECK(run->counts().steps == 1);
    for (int k = 0; k < 3; ++k) CHECK(run->output().occurrences[k].t.size() == 1);
    CHECK_CLOSE(run->output().occurrences[0].t.front(), 0.7, 2 * eps);
    CHECK_CLOSE(run->output().occurrences[1].t.front(), 0.2, 2 * eps);
    CHECK_CLOSE(run->output().occurrences[2].t.front(), 0.45, 2 * eps);
    const std::vector<double> several = run->output().occurrences[3].t.copy();
    const double expected[] = {0.1, 0.4, 0.9};
    CHECK(several.size() == 3 && std::is_sorted(several.begin(), several.end()));
    for (std::size_t i = 0; i < several.size(); ++i) CHECK_CLOSE(several[i], expected[i], 8 * eps);
  }
}

TEST(an_event_that_is_zero_at_the_start_sleeps_until_it_has_left_zero) {
  for (const Method& method : general_methods())
    for (const double tf : {10.0, -10.0}) {
      const check::Case label(method.name, ", tf ", tf);
      Watch watch;
      watch.add(sine, 0).add([](double, const double*, double* e) { e[0] = 0; });
      Run run(method, without_invariants(harmonic()), watching(watch, {.tf = tf}, 1e-6));
      CHECK(run.run() == State::reached_end);
      const std::vector<double> t = run->output().occurrences[0].t.copy();
      CHECK(t.size() == 3);
      for (std::size_t k = 0; k < t.size(); ++k)
        CHECK_CLOSE(t[k], (tf > 0 ? pi : -pi) * static_cast<double>(k + 1), method.order == 2 ? 1e-3 : 1e-4);
      CHECK(run->output().occurrences[1].t.empty());  // always zero: always asleep
    }
}

TEST(a_tangency_without_a_sign_change_is_no_event) {
  for (const Method& method : general_methods()) {
    Watch watch;
    for (const double root : {2.5, 3.1, 4.75})  // where the scan finds an exact zero, and where not
      watch.add([root](double t, const double*, double* e) { e[0] = (t - root) * (t - root); });
    Run run(method, clock(10), watching(watch, {.hmax = 1, .first_step = 1}));
    CHECK(run.run() == State::reached_end);
    for (const Trajectory& found : run->output().occurrences) CHECK(found.t.empty());
  }
}

TEST(the_direction_is_that_of_the_integration) {
  for (const Method& method : general_methods())
    for (const double forward : {1.0, -1.0}) {
      const check::Case label(method.name, ", direction ", forward);
      // cos t falls through its first zero after the start, whichever way.
      const Function cosine = [](double, const double* y, double* e) { e[0] = y[0]; };
      Watch watch;
      watch.add(cosine, 0, 0).add(cosine, 0, 1).add(cosine, 0, -1);
      Run run(method, without_invariants(harmonic()), watching(watch, {.tf = 12 * forward}, 1e-6));
      CHECK(run.run() == State::reached_end);
      const std::vector<double> all = run->output().occurrences[0].t.copy();
      const std::vector<double> rising = run->output().occurrences[1].t.copy();
      const std::vector<double> falling = run->output().occurrences[2].t.copy();
      CHECK(all.size() == 4 && rising.size() == 2 && falling.size() == 2);
      for (std::size_t k = 0; k < 4; ++k) CHECK(all[k] == (k % 2 == 0 ? falling : rising)[k / 2]);
    }
}

TEST(a_terminal_event_ends_the_run_at_its_count) {
  for (const Method& method : general_methods())
    for (std::int64_t count = 1; count <= 3; ++count) {
      const check::Case label(method.name, ", count ", count);
      Watch watch;
      watch.add(sine, count).at(2.5 * pi);
      Run run(method, harmonic(), watching(watch, {.dense = true}, 1e-6));
      CHECK(run.run() == State::terminal_event);
      const Trajectory& found = run->output().occurrences[0];
      CHECK(static_cast<std::int64_t>(found.t.size()) == count);
      CHECK(run->output().occurrences[1].t.size() == (count == 3 ? 1u : 0u));
      CHECK(run->output().points.t.back() == found.t.back());
      CHECK(run->output().steps.back().t == found.t.back());
      CHECK(run->output().dense->knots().back() == found.t.back());
      CHECK(same_bits(run.last(), &found.y.end()[-2], 2));
      CHECK(run->advance() == State::terminal_event);  // and it stays ended
    }
}

TEST(ties_with_the_terminal_event_are_reported_and_later_events_are_dropped) {
  for (const Method& method : general_methods())
    for (const double forward : {1.0, -1.0})
      for (const bool terminal_first : {true, false}) {
        const check::Case label(method.name, ", direction ", forward, ", terminal first ", terminal_first);
        const double end = 0.6 * forward;
        Watch watch;
        if (terminal_first) watch.at(end, 1);
        watch.add([end](double t, const double*, double* e) { e[0] = std::sin(t - end); });
        watch.add([end](double t, const double*, double* e) { e[0] = std::exp(t) - std::exp(end); });
        watch.at(0.61 * forward).at(0.3 * forward);
        if (!terminal_first) watch.at(end, 1);
        Run run(method, clock(forward), watching(watch, {.hmax = infinity, .first_step = 1}));
        CHECK(run.run() == State::terminal_event);
        std::size_t at_end = 0, before = 0;
        for (const Trajectory& found : run->output().occurrences)
          for (const double t : found.t) {
            CHECK_CLOSE(t, (std::abs(t) < 0.5 ? 0.3 : 0.6) * forward, 4 * eps);
            CHECK(forward * t <= forward * run->output().points.t.back());
            (std::abs(t) < 0.5 ? before : at_end) += 1;
          }
        CHECK(before == 1 && at_end == 3);
      }
}

TEST(ties_are_ties_at_time_zero_too) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Watch watch;
    for (const double rate : {1.0, 2.0, 3.0})
      watch.add([rate](double t, const double*, double* e) { e[0] = std::expm1(rate * t); }, 1);
    Run run(method, clock(1), watching(watch, {.t0 = -0.9, .hmax = infinity, .first_step = 2}));
    CHECK(run.run() == State::terminal_event);
    CHECK_CLOSE(run->output().points.t.back(), 0, 2 * eps);
    for (const Trajectory& found : run->output().occurrences)
      CHECK(found.t == std::vector<double>{run->output().points.t.back()});
  }
}

TEST(an_event_that_is_nan_ends_the_run_and_is_named) {
  for (const Method& method : general_methods())
    for (const double from : {0.0, 0.5, 3.3}) {
      const check::Case label(method.name, ", NaN from ", from);
      Watch watch;
      watch.at(20).add([from](double t, const double*, double* e) { e[0] = t < from ? 1 : NaN; });
      Run run(method, clock(10), watching(watch, {.hmax = 1, .first_step = 1}));
      CHECK(run.run() == State::event_undefined);
      CHECK(run->report().event == 1);
      CHECK(run->report().t >= from && run->report().t <= from + 1);
    }
}

TEST(roots_are_located_to_a_few_ulp_of_t) {
  // What the event function sees at a root may be off by the roundoff of its own terms: a few ulp more.
  const struct {
    const char* name;
    Function e;
    double root;
  } examples[] = {
      {"t - 1/3", [](double t, const double*, double* e) { e[0] = t - 1. / 3; }, 1. / 3},
      {"sin 3t", [](double t, const double*, double* e) { e[0] = std::sin(3 * t); }, pi / 3},
      {"exp t - 2", [](double t, const double*, double* e) { e[0] = std::exp(t) - 2; }, std::log(2)},
      {"t^9 - 1/2", [](double t, const double*, double* e) { e[0] = std::pow(t, 9) - 0.5; }, std::pow(0.5, 1. / 9)},
      {"cube root", [](double t, const double*, double* e) { e[0] = std::cbrt(t - 0.7); }, 0.7},
      {"jump", [](double t, const double*, double* e) { e[0] = t < 0.7 ? -1 : 1; }, 0.7},
      {"steep", [](double t, const double*, double* e) { e[0] = std::tanh(1e6 * (t - 0.7)); }, 0.7},
      {"huge", [](double t, const double*, double* e) { e[0] = 1e300 * (t - 0.7); }, 0.7},
      {"infinite", [](double t, const double*, double* e) { e[0] = t < 0.7 ? -infinity : infinity; }, 0.7},
      {"tiny", [](double t, const double*, double* e) { e[0] = 1e-300 * (t - 0.7); }, 0.7},
  };
  for (const Method& method : general_methods())
    for (const auto& example : examples)
      for (const bool long_steps : {false, true}) {
        const check::Case label(method.name, ", ", example.name);
        Watch watch;
        watch.add(example.e, 1);
        Run run(method, clock(1.2), watching(watch, {.hmax = long_steps ? infinity : 0.1, .first_step = 1}));
        CHECK(run.run() == State::terminal_event);
        CHECK_CLOSE(run->output().points.t.back(), example.root, 4 * ulp(example.root) + (long_steps ? 2 : 1) * eps);
      }
}

TEST(locating_a_root_takes_few_evaluations) {
  // Bisection of a step down to 2 ulp takes some 50, superlinear convergence some 10; where the values leave room for a
  // pair of roots, an interpolant of degree 16, which is tested at two more points, rules it out.
  for (const Method& method : general_methods()) {
    std::int64_t calls = 0;
    Watch watch;
    watch.add([&calls](double t, const double*, double* e) { e[0] = std::exp(t) - 2, ++calls; }, 1);
    Run run(method, clock(1), watching(watch, {.hmax = infinity, .first_step = 1}));
    CHECK(run.run() == State::terminal_event);
    CHECK(calls <= 40);
  }
}

TEST(an_event_is_where_the_values_returned_are_zero) {
  // The state stored with an event is the continuous solution there, and the event function vanishes at it to roundoff;
  // except where a raw extension, which does not meet the projected end of its step, jumps over zero there.
  for (const Method& method : general_methods())
    for (const Interpolation interpolation : {Interpolation::projected, Interpolation::corrected, Interpolation::raw}) {
      const check::Case label(method.name, ", interpolation ", static_cast<int>(interpolation));
      Watch watch;
      watch.add([](double, const double* y, double* e) { e[0] = y[0] - 0.25; });
      Run run(method, kepler(0.5), watching(watch, {.interpolation = interpolation, .dense = true}));
      CHECK(run.run() == State::reached_end);
      const Trajectory& found = run->output().occurrences[0];
      CHECK(found.t.size() >= 10);
      std::vector<double> y(found.y.size());
      Projector projector(*run.invariants, run.weights, 1);
      CHECK(run->output().dense->evaluate(found.t.data(), found.t.size(), y.data(), &projector) == Status::ok);
      CHECK(same_bits(y, found.y));
      const auto& knots = run->output().dense->knots();
      for (std::size_t k = 0; k < found.t.size(); ++k) {
        const double speed = std::abs(found.y[4 * k + 2]);
        if (interpolation == Interpolation::raw && std::find(knots.begin(), knots.end(), found.t[k]) != knots.end())
          continue;
        CHECK_CLOSE(found.y[4 * k], 0.25, (2 + speed) * 4 * ulp(found.t[k]) + 8 * eps);
      }
    }
}

TEST(an_action_restarts_the_solution_with_both_values_at_one_time) {
  // A ball at constant gravity that loses a fifth of its speed: impacts at 1, 1 + 2·0.8, 1 + 2·0.8 + 2·0.64, …
  Function bounce = [](double, const double* y, double* out) { out[0] = 0, out[1] = -0.8 * y[1]; };
  Function floor = [](double, const double* y, double* e) { e[0] = y[0]; };
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Problem ball{.name = "ball",
                 .y0 = {1, 0},
                 .tf = 4.5,
                 .f = [](double, const double* y, double* out) { out[0] = y[1], out[1] = -2; },
                 .m = 1,
                 .g = [](double, const double* y, double* r) { r[0] = y[1] * y[1] / 4 + y[0]; },
                 .jacobian = [](double, const double* y, double* J) { J[0] = 1, J[1] = y[1] / 2; }};
    EventFunction hit{as_callback(floor)};
    hit.direction = -1;
    hit.action = as_callback(bounce);
    Options options{.rtol = 1e-6, .settings = {.dense = true}, .events = {hit}};
    Run run(method, ball, options);
    // What is held is re-held: the block of the test has no demanded value.
    CHECK(run.run() == State::reached_end);
    const std::vector<double> t = run->output().occurrences[0].t.copy();
    const double expected[] = {1, 2.6, 3.88};
    CHECK(t.size() == 3 && run->output().jumps.size() == 3);
    for (std::size_t k = 0; k < std::min<std::size_t>(t.size(), 3); ++k) {
      CHECK_CLOSE(t[k], expected[k], 1e-4);
      const std::size_t row = run->output().jumps[k].row;
      CHECK(run->output().points.t[row] == t[k] && run->output().points.t[row - 1] == t[k]);
      CHECK_CLOSE(run->output().points.y[2 * row + 1], -0.8 * run->output().points.y[2 * row - 1], 4 * eps);
      double y[2];
      CHECK(run->output().dense->evaluate(&t[k], 1, y, nullptr) == Status::ok);
      CHECK(y[1] > 0);  // the later value
    }
  }
}

}  // namespace invariode::test::events_laws
