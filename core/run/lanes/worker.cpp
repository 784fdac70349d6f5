#include "run/lanes/worker.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string_view>
#include <vector>

#include "discontinuity.hpp"
#include "manifold/guard.hpp"
#include "manifold/invariants.hpp"
#include "methods/runge_kutta.hpp"
#include "methods/stability.hpp"

namespace invariode {
namespace {

constexpr double huge = std::numeric_limits<double>::max() / 16;  // as in integrate.cpp

/// So many trajectories are looked at before the lanes are given up because they leave most of them.
constexpr std::size_t trial = 64;

/// A function of one trajectory, whose parameters are where it looks for them.
void evaluate_alone(void* context, const double* t, const double* y, double* out, const double* /*p*/) {
  if (auto& f = *static_cast<Callback*>(context); f(*t, y, out) == Status::stop)
    *out = std::numeric_limits<double>::quiet_NaN();  // the code for single runs finds out why
}

lanes::Called alone(Callback& function) { return {evaluate_alone, &function}; }

/// So many occurrences of events may a trajectory have at least, wherever the limit is.
constexpr std::size_t plenty = 100000;

const lanes::Pair& pair_of(const lanes::Instructions& instructions, const Solver& solver) {
  return *instructions.pair(solver.method().name);
}

/// How far the method is stable on the negative real axis.
template <const auto&... T>
double real_limit(std::string_view method, runge_kutta::Tableaux<T...> /*pairs*/) {
  double limit = 0;
  ((T.name == method ? void(limit = runge_kutta::real_limit<T>()) : void()), ...);
  return limit;
}

/// In which the Jacobians of invariants are compared with differences.
std::vector<double> directions(std::size_t n) {
  std::vector<double> direction(n);
  for (std::size_t j = 0; j < n; ++j) direction[j] = Guard::direction(j);
  return direction;
}

lanes::Invariant make_invariant(const Solver& solver, const lanes::Called& g, const lanes::Called& jacobian,
                                const std::vector<double>& direction) {
  const Settings& settings = solver.settings();
  const std::vector<InvariantBlock>& blocks = solver.problem().invariants;
  if (blocks.empty()) return {};
  return {.g = g,
          .jacobian = jacobian,
          .held = blocks.front().held,
          .value = solver.problem().value.front(),
          .iterations = settings.iterations,
          .tested = settings.check,
          .interval = std::abs(settings.tf - settings.t0),
          .increment = std::cbrt(eps),
          .direction = direction.data(),
          .time_increment = Invariants::time_increment};
}

std::vector<Callback> events_of(const Solver& solver) {
  const std::vector<EventFunction>& events = solver.problem().events;
  std::vector<Callback> functions(events.size());
  std::ranges::transform(events, functions.begin(), &EventFunction::function);
  return functions;
}

std::vector<lanes::Called> all_alone(std::vector<Callback>& functions) {
  std::vector<lanes::Called> called(functions.size());
  std::ranges::transform(functions, called.begin(), alone);
  return called;
}

lanes::Job make_job(const Solver& solver, const Ensemble& ensemble, const lanes::Called& f,
                    const lanes::Invariant& invariant, const std::vector<lanes::Called>& events) {
  const Settings& settings = solver.settings();
  const Weights& weights = solver.weights();
  return {.f = f,
          .n = ensemble.n,
          .parameters = ensemble.parameters,
          .y0 = ensemble.y0,
          .rows = ensemble.rows,
          .t0 = settings.t0,
          .tf = settings.tf,
          .hmax = std::min(settings.hmax, huge),
          .first_step = settings.first_step,
          .rtol = weights.rtol(),
          .real_limit = real_limit(solver.method().name, runge_kutta::Pairs()),
          .threshold = weights.threshold().data(),
          .scale = weights.scale().empty() ? nullptr : weights.scale().data(),
          .invariant = invariant.g.function != nullptr ? &invariant : nullptr,
          .times = settings.times.data(),
          .count_of_times = settings.output_at_times ? settings.times.size() : 0,
          .corrects = settings.interpolation != Interpolation::raw,
          .projects = settings.interpolation == Interpolation::projected && invariant.g.function != nullptr,
          .events = events.data(),
          .count_of_events = events.size()};
}

const lanes::Instructions& of_every_processor() { return *lanes::instructions().back(); }

const char* obstacle_of_invariants(const Solver& solver) {
  const Problem& problem = solver.problem();
  if (problem.invariants.empty()) return nullptr;
  if (problem.value.size() > 1) return "several invariants are held";
  const InvariantBlock& block = problem.invariants.front();
  if (block.sense != 0) return "what is held may rise or fall";
  if (!block.jacobian) return "the Jacobian of the invariant is made of differences: give jac";
  if (block.pattern) return "the Jacobian of the invariant is sparse";
  if (block.along_steps) return "corrections of the invariant are made of stages";
  if (block.level != 0 || !block.moves.empty() || block.metric) return "the invariant has a level, moves or a metric";
  if (solver.settings().negligible > 0) return "the invariant is held where that is needed only";
  return solver.options().fsal == Fsal::reuse ? nullptr : "f is evaluated again after each projection";
}

}  // namespace

const char* obstacle_to_lanes(const Solver& solver) {
  const Problem& problem = solver.problem();
  const Settings& settings = solver.settings();
  if (of_every_processor().pair(solver.method().name) == nullptr) return "the method is no explicit Runge-Kutta pair";
  if (const char* obstacle = obstacle_of_invariants(solver)) return obstacle;
  if (problem.bounds) return "there are bounds";
  for (const EventFunction& event : problem.events) {
    if (event.action) return "events have actions";
    if (event.samples != 0) return "events have samples of their own";
  }
  if (!problem.breakpoints.empty()) return "there are breakpoints";
  if (problem.callback) return "there is a callback";
  if (settings.output_at_times && settings.record) return "steps are recorded";
  if (problem.n == 0 || settings.t0 == settings.tf) return "there is nothing to integrate";
  if (!std::isfinite(settings.tf)) return "the interval is infinite";
  const std::size_t occurrences = problem.events.empty() ? 0 : plenty;
  const auto points = static_cast<std::int64_t>((settings.output_at_times ? settings.times.size() : 1) + occurrences);
  const auto bytes = static_cast<std::int64_t>((problem.n + 1) * sizeof(double));  // of a point that is kept
  const bool limited = settings.max_steps != Settings::unlimited ||
                       settings.time_limit < std::numeric_limits<double>::infinity() || settings.max_points <= points ||
                       settings.max_bytes / bytes <= points;
  return limited ? "runs are limited" : nullptr;
}

LaneWorker::Memory::Memory(std::size_t bytes) : bytes_(static_cast<std::byte*>(::operator new(bytes, alignment))) {}

LaneWorker::LaneWorker(const Solver& solver, const Ensemble& ensemble, const LaneForm& form, Queue& queue,
                       EnsembleResult& result)
    : solver_(solver),
      ensemble_(ensemble),
      queue_(queue),
      result_(result),
      pair_(pair_of(*form.instructions, solver)),
      alone_(pair_of(of_every_processor(), solver)),
      f_(solver.problem().f),
      g_(solver.problem().invariants.empty() ? Callback() : solver.problem().invariants.front().g),
      jacobian_(g_ ? solver.problem().invariants.front().jacobian : Callback()),
      watched_(events_of(solver)),
      direction_(directions(ensemble.n)),
      invariant_(make_invariant(solver, form.g, form.jacobian, direction_)),
      invariant_alone_(make_invariant(solver, alone(g_), alone(jacobian_), direction_)),
      events_(form.events),
      events_alone_(all_alone(watched_)),
      job_(make_job(solver, ensemble, form.f, invariant_, events_)),
      job_alone_(make_job(solver, ensemble, alone(f_), invariant_alone_, events_alone_)),
      memory_(pair_.memory(job_)),
      memory_alone_(alone_.memory(job_alone_)) {}

void LaneWorker::run() {
  if (!events_.empty()) search_.emplace(solver_, ensemble_);
  pair_.run(job_, *this, memory_.get());
  result_.add_alone(left_);
}

bool LaneWorker::take(std::uint32_t& trajectory) {
  while (queue_.next(trajectory)) {
    const bool worth_it = left_ < trial || left_ < kept_;
    if (worth_it && all_finite(ensemble_.y0 + trajectory * ensemble_.n, ensemble_.n)) return true;
    leave(trajectory);
  }
  return false;
}

lanes::Found LaneWorker::search(const lanes::Crossed& step) {
  set_parameters(step.trajectory);
  const auto [place, is_new] = occurrences_.try_emplace(step.trajectory);
  std::vector<Trajectory>& found = place->second;
  if (is_new) found.resize(events_.size());
  lanes::Found result = search_->search(step, found);
  std::size_t count = 0;
  for (const Trajectory& one : found) count += one.t.size();
  result.sound = result.sound && count < plenty;
  return result;
}

void LaneWorker::keep(const lanes::Ended& ended) {
  result_.keep(ended, solver_);
  if (const auto found = occurrences_.extract(ended.trajectory); !found.empty())
    result_.keep_occurrences(ended.trajectory, found.mapped());
  ++kept_;
  queue_.finish_one();
}

/// The functions look for these where the solver has its parameters.
void LaneWorker::set_parameters(std::uint32_t trajectory) {
  const double* row = ensemble_.rows + trajectory * ensemble_.parameters;
  std::copy(row, row + ensemble_.parameters, solver_.problem().parameters.begin());
}

void LaneWorker::leave(std::uint32_t trajectory) {
  occurrences_.erase(trajectory);
  integrate_one(solver_, ensemble_, trajectory, queue_.cancelled(), result_);
  ++left_;
  queue_.finish_one();
}

void LaneWorker::go_on(const lanes::Suspended& suspended) {
  if (cancelled()) return;
  set_parameters(suspended.trajectory);
  alone_.go_on(job_alone_, suspended, *this, memory_alone_.get());
}

bool LaneWorker::jumps(const lanes::Suspicion& suspicion, std::int64_t& checks) {
  if (!DiscontinuityDetector::may_search(suspicion.attempts, checks)) return false;
  const double* row = ensemble_.rows + suspicion.trajectory * ensemble_.parameters;
  std::copy(row, row + ensemble_.parameters, solver_.problem().parameters.begin());
  std::vector<double> y1(ensemble_.n);
  for (std::size_t i = 0; i < y1.size(); ++i) y1[i] = suspicion.y1[i * suspicion.stride];
  JumpSearch search(f_, solver_.weights());
  const JumpSearch::Result result =
      search.search(suspicion.t0, suspicion.y0, suspicion.t1, y1.data(), suspicion.latest);
  checks += search.evaluations();
  return result != JumpSearch::Result::none;
}

}  // namespace invariode
