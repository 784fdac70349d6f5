#include "run/ensemble.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <limits>
#include <string_view>
#include <utility>

#include "detect/below_zero.hpp"
#include "manifold/harm.hpp"
#include "manifold/thresholds.hpp"
#include "require.hpp"
#include "run/lanes/worker.hpp"
#include "run/threads.hpp"
#include "run/watch.hpp"

namespace invariode {
namespace {

/// About as long as it takes to start two threads and to wait for their end (measured: 60 µs).
constexpr std::chrono::microseconds thread_start(50);

constexpr double undefined = std::numeric_limits<double>::quiet_NaN();

bool failed(State state) {
  return state != State::reached_end && state != State::terminal_event && state != State::stopped_by_callback;
}

/// A single solve has in ng, before its run, each invariant once. The difference makes ng that of a single solve.
std::int64_t uncounted_starts(const Solver& solver, const Run& run) {
  return static_cast<std::int64_t>(solver.problem().invariants.size()) - run.evaluations_of_prepare();
}

void require_alike(std::span<Solver* const> solvers, const Ensemble& ensemble) {
  require(!solvers.empty(), "an ensemble needs at least one solver");
  require(ensemble.size < std::numeric_limits<std::uint32_t>::max(), "too many trajectories");
  const Problem& first = solvers.front()->problem();
  for (const Solver* solver : solvers) {
    const Problem& problem = solver->problem();
    require(problem.size() == ensemble.n, "rows of y0 are not of the size of the problem");
    require(problem.variations.has_value() == (ensemble.tolerances != nullptr),
            "rows of tolerances go with sensitivities");
    require(problem.parameters.size() == ensemble.parameters, "rows of parameters are not as long as the problem's");
    require(problem.value.size() == first.value.size() && problem.events.size() == first.events.size() &&
                solver->settings().times.size() == solvers.front()->settings().times.size(),
            "solvers of an ensemble must be of one problem");
  }
  std::vector<const double*> places;
  for (const Solver* solver : solvers) places.push_back(solver->problem().parameters.data());
  std::ranges::sort(places);
  require(ensemble.parameters == 0 || std::ranges::adjacent_find(places) == places.end(),
          "solvers of an ensemble must have parameters of their own");
}

bool is_complete(const LaneForm& form, const Problem& problem) {
  const bool expands = !problem.series || form.series.function != nullptr;
  const bool holds = problem.invariants.empty() || (form.g.function != nullptr && form.jacobian.function != nullptr);
  const bool varied = !problem.variations || (form.slope.function != nullptr &&
                                              (problem.invariants.empty() || form.tangent.function != nullptr));
  return form.f.function != nullptr && expands && holds && varied && form.events.size() == problem.events.size();
}

/// Trajectory i, on a thread that has the solver to itself. Once stopped() is true, it is left as if not begun.
template <class Stopped>
void integrate_until(Solver& solver, const Ensemble& ensemble, std::size_t i, Stopped stopped, EnsembleResult& result) {
  const double* row = ensemble.rows + i * ensemble.parameters;
  std::copy(row, row + ensemble.parameters, solver.problem().parameters.begin());
  const std::size_t varied = ensemble.n - solver.problem().n;
  if (varied > 0) solver.set_tolerances({ensemble.tolerances + i * varied, varied});
  const double t0 = solver.settings().t0;
  const double* given = ensemble.y0 + i * ensemble.n;
  if (!all_finite(given, ensemble.n)) return result.refuse(i, EnsembleResult::not_finite, t0, given);
  std::vector<double> y0(given, given + ensemble.n);
  Run run(solver);
  switch (run.prepare(t0, y0.data())) {
    case Consistency::not_found: return result.refuse(i, EnsembleResult::not_found, t0, given);
    case Consistency::index_too_high: return result.refuse(i, EnsembleResult::index_too_high, t0, given);
    case Consistency::undetermined: return result.refuse(i, EnsembleResult::undetermined, t0, given);
    case Consistency::consistent:
    case Consistency::corrected:
    case Consistency::undefined:  // the run says so
    case Consistency::stop: break;
  }
  result.hold(i, run);
  State state = run.integration().start(y0.data());
  while (state == State::running && !stopped()) state = run.integration().advance();
  if (state == State::running) return;
  result.keep(i, run, uncounted_starts(solver, run));
}

/// The first trajectories, on this thread, until threads are worth their start. How many were done.
std::size_t integrate_first(Solver& solver, const Ensemble& ensemble, EnsembleResult& result) {
  using Clock = std::chrono::steady_clock;
  const auto end = Clock::now() + thread_start;
  bool late = false;
  const auto stopped = [&] { return late = Clock::now() >= end; };
  std::size_t done = 0;
  while (done < ensemble.size && !late) {
    integrate_until(solver, ensemble, done, stopped, result);
    if (late) break;  // in the middle of it
    ++done;
    stopped();
  }
  return done;
}

}  // namespace

EnsembleResult::EnsembleResult(std::size_t size_, const Solver& solver)
    : size(size_),
      n(solver.problem().size()),
      parts(solver.problem().complex ? 2 : 1),
      m(solver.problem().value.size()),
      n_t(solver.settings().times.size()),
      t(size),
      y_end(size * n),
      y(size * n * n_t, undefined),
      value(size * m, undefined),
      before(size * m),
      after(size * m),
      correction(size),
      clipped(size),
      stiff_since(size, undefined),
      discontinuity(size, undefined),
      accumulation(size, undefined),
      count(size * counts),
      state(size, unsolved),
      occurrences(solver.problem().events.size()) {}

void EnsembleResult::refuse(std::size_t i, std::int8_t why, double t0, const double* y0) {
  state[i] = why;
  t[i] = t0;
  std::copy(y0, y0 + n, &y_end[i * n]);
}

void EnsembleResult::hold(std::size_t i, Run& run) {
  if (const Invariants* g = run.invariants()) std::ranges::copy(g->value(), &value[i * m]);
}

void EnsembleResult::keep(std::size_t i, Run& run, std::int64_t uncounted) {
  RunResult one = run.take_result();
  one.ng += uncounted;
  t[i] = one.t_end;
  clipped[i] = one.clipped;
  if (one.stiffness.found) stiff_since[i] = one.stiffness.since;
  if (!one.discontinuities.empty()) discontinuity[i] = one.discontinuities.front();
  if (one.sticks_since && one.discontinuities.empty()) discontinuity[i] = *one.sticks_since;
  if (one.accumulation) accumulation[i] = one.accumulation->t;
  std::copy(one.end(), one.end() + n, &y_end[i * n]);
  state[i] = static_cast<std::int8_t>(one.state);
  std::ranges::copy(one.counted(), &count[i * counts]);
  keep_outputs(i, one);
  if (m > 0) measure_drift(i, one, *run.invariants_everywhere(), run.forward());
  keep_happenings(i, one);
}

void EnsembleResult::keep(const lanes::Ended& ended, const Solver& solver) {
  using lanes::Rows;
  const lanes::Lane& lane = ended.lane;
  const std::size_t i = lane.trajectory;
  t[i] = lane[Rows::t];
  for (std::size_t c = 0; c < n; ++c) y_end[i * n + c] = lane[Rows::y + c];
  state[i] = static_cast<std::int8_t>(ended.by_event ? State::terminal_event : State::reached_end);
  count_of(i, "steps") = static_cast<std::int64_t>(lane[Rows::steps]);
  count_of(i, "failed") = static_cast<std::int64_t>(lane[Rows::failed]);
  count_of(i, "nfev") = ended.evaluations;
  count_of(i, "nfev_check") = ended.checks + static_cast<std::int64_t>(lane[Rows::falls]);
  const std::size_t states = solver.problem().n;
  count_of(i, "fallen") = BelowZero::deepest(states, &lane[Rows::y], &lane[lane.rows.watch], lane.stride).index + 1;
  if (m > 0) keep_held(lane, states, solver.weights().rtol());
}

/// Stores the values of the one invariant that was held in a lane, where each step was projected.
void EnsembleResult::keep_held(const lanes::Lane& lane, std::size_t states, double rtol) {
  using lanes::Rows;
  const std::size_t i = lane.trajectory;
  const auto of = [&lane](std::size_t row) -> double { return lane[lane.rows.invariant + row]; };
  const auto whole = [&of](std::size_t row) { return static_cast<std::int64_t>(of(row)); };
  value[i] = of(Rows::value);
  before[i] = of(Rows::before);
  after[i] = of(Rows::after);
  correction[i] = of(Rows::correction);
  std::vector<double> errors(states), corrections(states);
  for (std::size_t c = 0; c < states; ++c) {
    errors[c] = of(Rows::errors + c);
    corrections[c] = of(Rows::errors + states + c);
  }
  const auto steps = static_cast<std::int64_t>(lane[Rows::steps]);
  const std::int64_t looks = (steps + harm_period - 1) / harm_period;  // at the first step, too
  count_of(i, "projections") = steps;
  count_of(i, "nfev_check") += whole(Rows::checks);
  count_of(i, "ng") = whole(Rows::evaluations);
  count_of(i, "ngjac") = whole(Rows::jacobians);
  count_of(i, "harmed") = HarmDetector::harm(looks, errors, corrections, rtol).component + 1;
}

std::int64_t& EnsembleResult::count_of(std::size_t i, std::string_view name) {
  return count[i * counts +
               static_cast<std::size_t>(std::ranges::find(RunResult::count_names, name) - RunResult::count_names)];
}

void EnsembleResult::add_alone(const Left& left) {
  const std::scoped_lock lock(shared_);
  for (std::size_t why = 0; why < left.size(); ++why) alone[why] += left[why];
}

void EnsembleResult::keep_outputs(std::size_t i, const RunResult& run) {
  if (n_t == 0) return;
  for (std::size_t j = 0; j < run.points.t.size(); ++j) put_out(i, j, run.points.y.data() + j * n, 1);
}

/// Residuals at the outputs and at the end, with the values that the invariants have there: jumps may change them. At
/// the time of a jump the functions are those behind it, as the outputs are.
void EnsembleResult::measure_drift(std::size_t i, const RunResult& run, Invariants& invariants, double forward) {
  std::copy_n(run.drift.residual.begin(), m, &before[i * m]);
  correction[i] = run.drift.correction;
  std::vector<double> held(&value[i * m], &value[i * m] + m), g(m);
  double behind = std::numeric_limits<double>::quiet_NaN();  // the last jump
  const auto measure = [&](double at, const double* point) {
    if (at == behind) at = std::nextafter(at, forward * std::numeric_limits<double>::infinity());
    if (invariants.evaluate(at, point, g.data()) == Status::stop) return;
    for (std::size_t k = 0; k < m; ++k) {
      double& largest = after[i * m + k];
      const double residual = invariants.excess(k, g[k] - held[k]);
      if (invariants.sense(k) != 0 && !(residual > 0)) held[k] = g[k];
      if (residual > largest || std::isnan(residual)) largest = residual;  // NaN, where g was NaN, stays
    }
  };
  auto jump = run.jumps.begin();
  const auto pass_jumps = [&](std::size_t row) {
    for (; jump != run.jumps.end() && jump->row <= row; ++jump) {
      behind = jump->t;
      held.assign(jump->value.begin(), jump->value.begin() + static_cast<std::ptrdiff_t>(m));
    }
  };
  for (std::size_t j = 0; j < run.points.t.size() && n_t > 0; ++j) {
    pass_jumps(j);
    measure(run.points.t[j], &run.points.y[j * n]);
  }
  pass_jumps(std::numeric_limits<std::size_t>::max());
  measure(t[i], &y_end[i * n]);
}

void EnsembleResult::keep_happenings(std::size_t i, const RunResult& run) {
  const bool failure = failed(run.state);
  if (failure) {
    const std::scoped_lock lock(shared_);
    failures.push_back({i, run.state, run.report});
  }
  keep_occurrences(i, run.occurrences);
}

void EnsembleResult::keep_occurrences(std::size_t i, const std::vector<Trajectory>& found) {
  if (std::ranges::all_of(found, [](const Trajectory& one) { return one.t.empty(); })) return;
  const std::scoped_lock lock(shared_);
  for (std::size_t e = 0; e < found.size(); ++e) {
    const auto& [t_of, y_of] = found[e];
    occurrences[e].trajectory.insert(occurrences[e].trajectory.end(), t_of.size(), static_cast<std::int64_t>(i));
    occurrences[e].points.t.append(t_of.data(), t_of.size());
    occurrences[e].points.y.append(y_of.data(), y_of.size());
  }
}

void integrate_one(Solver& solver, const Ensemble& ensemble, std::size_t i, const std::atomic<bool>& cancelled,
                   EnsembleResult& result) {
  const auto stopped = [&] { return cancelled.load(std::memory_order_relaxed); };
  integrate_until(solver, ensemble, i, stopped, result);
}

std::unique_ptr<EnsembleResult> integrate_all(std::span<Solver* const> solvers, const Ensemble& ensemble,
                                              const std::function<bool(std::uint32_t done)>& watch,
                                              const std::optional<LaneForm>& form) {
  require_alike(solvers, ensemble);
  auto result = std::make_unique<EnsembleResult>(ensemble.size, *solvers.front());
  const bool in_lanes =
      form && is_complete(*form, solvers.front()->problem()) && obstacle_to_lanes(*solvers.front()) == nullptr;
  const std::size_t first = in_lanes ? 0 : integrate_first(*solvers.front(), ensemble, *result);
  const auto progress = [&](std::uint32_t done) { return watch(static_cast<std::uint32_t>(first) + done); };
  if (first == ensemble.size) {
    progress(0);
    return result;
  }
  const auto work = [&](std::size_t worker, Queue& queue) {
    Solver& solver = *solvers[worker];
    if (in_lanes) return LaneWorker(solver, ensemble, *form, queue, *result).run();
    for (std::uint32_t i; queue.next(i); queue.finish_one())
      integrate_one(solver, ensemble, first + i, queue.cancelled(), *result);
  };
  const auto left = static_cast<std::uint32_t>(ensemble.size - first);
  (void)on_workers(left, solvers.size(), watch_interval, work, progress);  // the states say what is not solved
  return result;
}

}  // namespace invariode
