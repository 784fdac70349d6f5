// A run as it is assembled from a problem, a method, tolerances and settings, without any Python.

#include "run/run.hpp"

#include <functional>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include "check.hpp"
#include "methods.hpp"
#include "run/names.hpp"
#include "run/points.hpp"
#include "run_problems.hpp"

namespace invariode::test_run::run_laws {

namespace {

bool refused(const std::function<void()>& misuse) {
  try {
    misuse();
  } catch (const std::invalid_argument& error) {
    return std::string(error.what()).size() > 10;
  }
  return false;
}

}  // namespace

TEST(a_run_of_each_method_keeps_its_invariant_and_reaches_the_end) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Oscillator oscillator;
    const Solver solver = oscillator.solver(method);
    const RunResult result = solve(solver, oscillator.y0.data());
    CHECK(result.state == State::reached_end && result.t_end == 20);
    CHECK_CLOSE(energy(result.end()), 0.5, 1e-9);
    CHECK(result.ng == oscillator.g_calls && result.nfev > result.counts.steps);
    CHECK(result.nfev + result.nfev_check == oscillator.calls);
    CHECK(result.derivatives.size() == 1 && result.derivatives[0] == Derivative::given);
    CHECK(result.counted()[0] == result.counts.steps);
    CHECK((result.linear.jacobians > 0) == (method.implicit() && !method.switches()));
    CHECK(result.switches == 0);
  }
}

TEST(out_of_memory_in_any_function_is_an_exception_of_the_run) {
  const auto throws = [](void*, double, const double*, double*) -> Status { throw std::bad_alloc(); };
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    for (const int which : {0, 1, 2, 3}) {
      Oscillator oscillator;
      oscillator.add_event(0);
      Problem problem = oscillator.problem();
      const Callback out_of_memory(throws, nullptr);
      (which == 0   ? problem.f
       : which == 1 ? problem.invariants[0].g
       : which == 2 ? problem.invariants[0].jacobian
                    : problem.events[0].function) = out_of_memory;
      bool thrown = false;
      try {
        const Solver solver(method, problem, oscillator.weights(), oscillator.settings(), {});
        solve(solver, oscillator.y0.data());
      } catch (const std::bad_alloc&) {
        thrown = true;
      }
      CHECK(thrown);
    }
  }
}

TEST(runs_of_one_solver_leave_no_trace_in_it) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Oscillator oscillator;
    oscillator.add_event(0);
    const Solver solver = oscillator.solver(method);
    const RunResult first = solve(solver, oscillator.y0.data()), second = solve(solver, oscillator.y0.data());
    CHECK(same(first, second));
    CHECK(!first.occurrences[0].t.empty());
  }
}

TEST(with_a_singular_mass_invariants_hold_together_with_the_algebraic_equations) {
  for (const Method& method : general_methods()) {
    if (method.mass != MassMatrices::any) continue;
    const check::Case label(method.name);
    for (const double off : {0.0, 0.25}) {  // the algebraic component at the start, as far off
      ConstrainedOscillator problem;
      const Weights weights = problem.weights();
      const double given[] = {1, 0, 1 + off};
      const auto start = consistent_start(problem.problem(), weights, 0, given);
      CHECK(start && start->verdict == (off == 0 ? Consistency::consistent : Consistency::corrected));
      CHECK_CLOSE(start->y0[2], 1, 1e-12);
      const Solver solver(method, problem.problem(), weights, problem.settings(), {});
      problem.g_calls = 0;
      const RunResult result = solve(solver, start->y0.data());
      CHECK(result.state == State::reached_end);
      CHECK_CLOSE(energy(result.end()), 0.5, 1e-9);
      CHECK_CLOSE(result.end()[2], result.end()[0] * result.end()[0], 1e-9);
      CHECK(result.derivatives.size() == 1);  // of the invariant only, not of the algebraic equations
      CHECK(result.ng == problem.g_calls);
    }
  }
}

TEST(where_no_start_is_consistent_the_verdict_says_so) {
  ConstrainedOscillator problem;
  problem.unsolvable = true;
  const double given[] = {1, 0, 1};
  const auto start = consistent_start(problem.problem(), problem.weights(), 0, given);
  CHECK(start && start->verdict == Consistency::undetermined);  // its Jacobian is from differences
}

TEST(preparing_holds_invariants_at_the_initial_value_of_the_run) {
  for (const Method& method : general_methods()) {
    Oscillator oscillator;
    const Solver solver = oscillator.solver(method);
    Run run(solver);
    double y0[] = {2, 0};
    CHECK(run.prepare(0, y0) == Consistency::consistent);
    CHECK(run.invariants()->value()[0] == 2);
    run.integration().start(y0);
    CHECK(run.integration().run() == State::reached_end);
    CHECK_CLOSE(energy(run.integration().y()), 2, 1e-8);
  }
}

TEST(a_run_goes_on_from_where_another_ended) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Oscillator oscillator;
    oscillator.add_event(3);  // ends at the third zero of x
    Solver solver = oscillator.solver(method);
    const RunResult whole = solve(solver, oscillator.y0.data());
    CHECK(whole.state == State::terminal_event && whole.occurrences[0].t.size() == 3);
    Run first(solver);
    first.integration().start(oscillator.y0.data());
    for (int step = 0; step < 7; ++step) CHECK(first.integration().advance() == State::running);
    const RunMemory memory = first.memory(1000), light = first.memory(0);
    const std::size_t seen = first.integration().output().occurrences[0].t.size();
    const std::span<const std::byte> bytes(memory.data(), memory.size());
    Run then(solver);
    CHECK(then.resume(bytes, false) == State::running && then.integration().run() == State::terminal_event);
    const RunResult rest = then.take_result();
    CHECK(rest.t_end == whole.t_end && rest.counted() == whole.counted());
    CHECK(rest.occurrences[0].t.size() + seen == whole.occurrences[0].t.size());
    // Without the Jacobian, if there is one: the method starts anew.
    Run anew(solver);
    CHECK(anew.resume({light.data(), light.size()}, false) == State::running);
    CHECK(anew.integration().run() == State::terminal_event);
    CHECK_CLOSE(anew.integration().t(), whole.t_end, 1e-3);
    for (const std::size_t size : {bytes.size() - 1, bytes.size() / 2, std::size_t{3}})
      CHECK(refused([&] { Run(solver).resume(bytes.first(size), false); }));
  }
}

TEST(what_stops_a_run_is_its_state) {
  for (const Method& method : general_methods()) {
    const check::Case label(method.name);
    Oscillator interrupted, undefined;
    interrupted.stop_after = 30;
    undefined.undefined_after = 30;
    const Solver stops = interrupted.solver(method), fails = undefined.solver(method);
    CHECK(solve(stops, interrupted.y0.data()).state == State::interrupted);
    const RunResult result = solve(fails, undefined.y0.data());
    CHECK(result.state == State::step_failed || result.state == State::start_undefined);
  }
}

TEST(sizes_that_do_not_match_are_refused) {
  Oscillator oscillator;
  const Method& method = *find_method("ode45");
  const auto with = [&](auto change) {
    return refused([&] {
      Problem problem = oscillator.problem();
      Weights weights = oscillator.weights();
      Settings settings = oscillator.settings();
      change(problem, weights, settings);
      const Solver solver(method, problem, weights, settings, {});
    });
  };
  CHECK(!with([](Problem&, Weights&, Settings&) {}));
  CHECK(with([](Problem& p, Weights&, Settings&) { p.n = 3; }));
  CHECK(with([](Problem& p, Weights&, Settings&) { p.f = {}; }));
  CHECK(with([](Problem& p, Weights&, Settings&) { p.value.clear(); }));
  CHECK(with([](Problem& p, Weights&, Settings&) { p.invariants[0].m = 2; }));
  CHECK(with([](Problem& p, Weights&, Settings&) { p.linear.emplace(LinearTerms{.jacobian = Matrix({.n = 3})}); }));
  CHECK(with([](Problem& p, Weights& w, Settings&) {
    w = Weights(1e-3, {1, 1, 1}, {});
    p.n = 3, p.complex = true;
  }));
  CHECK(with([](Problem&, Weights& w, Settings&) { w = Weights(1e-3, {1, 1}, {1}); }));
  CHECK(with([](Problem&, Weights&, Settings& s) { s.refine = 0; }));
  CHECK(with([](Problem&, Weights&, Settings& s) { s.hmax = 0; }));
  CHECK(refused([&] {
    Problem problem = oscillator.problem();
    problem.linear.reset();
    const Solver solver(*find_method("ode15s"), problem, oscillator.weights(), oscillator.settings(), {});
  }));
}

TEST(given_points_are_measured_and_projected) {
  Oscillator oscillator;
  const Problem problem = oscillator.problem();
  const Weights weights = oscillator.weights();
  const double t[] = {0, 1, 2}, y[] = {1, 0, 1.001, 0, 0, 0};
  const Points points{t, y, 3};
  const auto r = residuals(problem, points), d = distances(problem, weights, points);
  CHECK(r && r->size() == 3 && (*r)[0] == 0 && (*r)[2] == -0.5);
  CHECK_CLOSE((*r)[1], energy(y + 2) - 0.5, 0);
  CHECK(d && (*d)[0] == 0 && (*d)[1] > 1 && (*d)[2] == 0);  // the gradient is zero at the last
  const auto imposed = impose(problem, weights, points);
  CHECK(imposed && imposed->converged[0] == 1 && imposed->converged[1] == 1 && imposed->converged[2] == 0);
  CHECK_CLOSE(energy(&imposed->y[2]), 0.5, 1e-14);
  CHECK(imposed->y[4] == 0 && imposed->y[5] == 0);
  const auto examined = examine(problem, weights, 0, y);
  CHECK(examined && examined->finite && examined->invariants.size() == 1 && examined->invariants[0].conserved);
  CHECK(examined->jacobian.kind == Finding::Kind::none);
  CHECK(refused([&] { (void)impose(problem, Weights(1e-3, {1}, {}), points); }));
}

TEST(every_name_is_found_and_no_other) {
  for (const auto& [name, state] : state_names) CHECK(find_in(state_names, name) == state && name_of(state) == name);
  CHECK(!find_in(state_names, "elsewhere") && !find_in(fsal_names, ""));
  for (const Method& method : methods()) CHECK(find_method(method.name) == &method);
  CHECK(find_method("ode999") == nullptr);
}

}  // namespace invariode::test_run::run_laws
