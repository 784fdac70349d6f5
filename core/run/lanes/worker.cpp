#include "run/lanes/worker.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "aim.hpp"
#include "manifold/guard.hpp"
#include "manifold/invariants.hpp"

namespace invariode {
namespace {

/// The number of trajectories after which the lanes are given up if they leave most of them.
constexpr std::size_t trial = 64;

/// The number of occurrences of events that a trajectory may always have, wherever the limit is.
constexpr std::size_t plenty = 100000;

const lanes::Instructions& of_every_processor() { return *lanes::instructions().back(); }

/// A function of one trajectory, whose parameters are where it looks for them.
void evaluate_alone(void* context, const double* t, const double* y, double* out, const double* /*p*/) {
  if (auto& f = *static_cast<Callback*>(context); f(*t, y, out) == Status::stop)
    *out = std::numeric_limits<double>::quiet_NaN();  // the code for single runs finds out why
}

/// The functions of one trajectory: f, the slope of its sensitivities, the events, and of the invariant g, its Jacobian
/// and its tangent. What there is not is empty.
std::vector<Callback> functions_of(const Problem& problem) {
  std::vector<Callback> functions{problem.f, problem.variations ? problem.variations->slope : Callback()};
  for (const EventFunction& event : problem.events) functions.push_back(event.function);
  for (const InvariantBlock& block : problem.invariants)
    functions.insert(functions.end(), {block.g, block.jacobian, block.tangent});
  return functions;
}

/// Makes the form of the functions for one lane.
LaneForm form_alone(std::vector<Callback>& functions, std::size_t events) {
  LaneForm form;
  const auto called = [&functions](std::size_t i) { return lanes::Called{evaluate_alone, &functions[i]}; };
  form.instructions = &of_every_processor();
  form.f = called(0);
  form.slope = called(1);
  std::size_t next = 2;
  for (; next < events + 2; ++next) form.events.push_back(called(next));
  if (functions.size() > next) form.g = called(next), form.jacobian = called(next + 1), form.tangent = called(next + 2);
  return form;
}

/// Returns the directions in which the Jacobians of invariants are compared with differences.
std::vector<double> directions(std::size_t n) {
  std::vector<double> direction(n);
  for (std::size_t j = 0; j < n; ++j) direction[j] = Guard::direction(j);
  return direction;
}

lanes::Invariant invariant_of(const Solver& solver, const LaneForm& form, const std::vector<double>& direction) {
  const std::vector<InvariantBlock>& blocks = solver.problem().invariants;
  if (blocks.empty()) return {};
  return {.g = form.g,
          .jacobian = form.jacobian,
          .held = blocks.front().held,
          .value = solver.problem().value.front(),
          .iterations = solver.settings().iterations,
          .tested = solver.settings().check,
          .direction = direction.data(),
          .time_increment = Invariants::time_increment,
          .tangent = form.tangent};
}

lanes::Sensitivities sensitivities_of(const Problem& problem, const Ensemble& ensemble, const LaneForm& form) {
  if (!problem.variations) return {};
  return {.k = problem.variations->k,
          .slope = form.slope,
          .tolerances = ensemble.tolerances,
          .counts = problem.variations->error_test};
}

/// Returns the depths below 0 at which components are judged: infinite, if components may be negative.
std::vector<double> notable_depths(const Solver& solver) {
  const Problem& problem = solver.problem();
  std::vector<double> depth(problem.n, std::numeric_limits<double>::infinity());
  for (std::size_t i = 0; i < problem.n && !problem.signed_states && !problem.complex; ++i)
    depth[i] = BelowZero::depth(solver.weights().absolute_tolerance(i));
  return depth;
}

lanes::Job job_of(const Solver& solver, const Ensemble& ensemble, const LaneForm& form,
                  const lanes::Invariant& invariant, const std::vector<double>& scale,
                  const std::vector<double>& notable) {
  const Settings& settings = solver.settings();
  const Weights& weights = solver.weights();
  const std::optional<SystemSeries>& series = solver.problem().series;
  const bool holds = invariant.g.function != nullptr, limited = settings.max_steps != Settings::unlimited;
  return {.f = form.f,
          .series = form.series,
          .order = series ? static_cast<std::size_t>(series->solution.order()) : 0,
          .n = solver.problem().n,
          .varied = sensitivities_of(solver.problem(), ensemble, form),
          .all = ensemble.n,
          .parameters = ensemble.parameters,
          .memory = 2 + ensemble.n,
          .y0 = ensemble.y0,
          .rows = ensemble.rows,
          .t0 = settings.t0,
          .tf = settings.tf,
          .hmax = std::min(settings.hmax, huge),
          .first_step = settings.first_step,
          .rtol = weights.rtol(),
          .max_steps = limited ? static_cast<double>(settings.max_steps) : std::numeric_limits<double>::infinity(),
          .threshold = weights.threshold().data(),
          .notable = notable.data(),
          .scale = scale.empty() ? nullptr : scale.data(),
          .invariant = holds ? &invariant : nullptr,
          .times = settings.times.data(),
          .count_of_times = settings.output_at_times ? settings.times.size() : 0,
          .corrects = settings.interpolation != Interpolation::raw,
          .projects = settings.interpolation == Interpolation::projected && holds,
          .events = form.events.data(),
          .count_of_events = form.events.size()};
}

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
  if (of_every_processor().kernel(solver.method().name) == nullptr)
    return "the method is no explicit Runge-Kutta pair, nor taylor";
  if (problem.series && problem.series->count > 0) return "steps end where f changes its branch";
  if (problem.series && !problem.events.empty()) return "events are searched along Taylor polynomials";
  if (const char* obstacle = obstacle_of_invariants(solver)) return obstacle;
  if (problem.bounds) return "there are bounds";
  if (problem.delays) return "there are delays";
  if (problem.variations && problem.series) return "sensitivities are expanded in series";
  if (problem.variations && !problem.events.empty()) return "there are events and sensitivities";
  for (const EventFunction& event : problem.events) {
    if (event.acts()) return "events have actions";
    if (event.samples != 0) return "events have samples of their own";
  }
  if (!problem.breakpoints.empty()) return "there are breakpoints";
  if (!problem.landings.empty()) return "f changes its branch at known times, where steps end";
  if (problem.callback) return "there is a callback";
  if (settings.output_at_times && settings.record) return "steps are recorded";
  if (problem.n == 0 || settings.t0 == settings.tf) return "there is nothing to integrate";
  if (!std::isfinite(settings.tf)) return "the interval is infinite";
  const std::size_t occurrences = problem.events.empty() ? 0 : plenty;
  const auto points = static_cast<std::int64_t>((settings.output_at_times ? settings.times.size() : 1) + occurrences);
  const auto bytes = static_cast<std::int64_t>((problem.size() + 1) * sizeof(double));  // of a point that is kept
  const bool limited = settings.time_limit < std::numeric_limits<double>::infinity() || settings.max_points <= points ||
                       settings.max_bytes / bytes <= points;
  return limited ? "runs are limited" : nullptr;
}

LaneWorker::Order::Order(const Solver& solver, const Ensemble& ensemble, LaneForm functions,
                         const std::vector<double>& direction)
    : form(std::move(functions)),
      kernel(*form.instructions->kernel(solver.method().name)),
      invariant(invariant_of(solver, form, direction)),
      scale(solver.augmented_weights().scale()),
      notable(notable_depths(solver)),
      job(job_of(solver, ensemble, form, invariant, scale, notable)) {}

LaneWorker::LaneWorker(Solver& solver, const Ensemble& ensemble, const LaneForm& form, Queue& queue,
                       EnsembleResult& result)
    : solver_(solver),
      ensemble_(ensemble),
      queue_(queue),
      result_(result),
      functions_(functions_of(solver.problem())),
      direction_(directions(solver.problem().n)),
      order_(solver, ensemble, form, direction_),
      alone_(solver, ensemble, form_alone(functions_, form.events.size()), direction_),
      jump_search_(solver.problem().f, solver.weights()),
      below_zero_(solver.problem().f, solver.weights(), order_.job.forward(), {}, true),
      end_(solver.problem().n) {}

void LaneWorker::run() {
  if (order_.job.count_of_events > 0) search_.emplace(solver_);
  order_.kernel.run(order_.job, *this);
  result_.add_alone(left_why_);
}

bool LaneWorker::take(std::uint32_t& trajectory) {
  while (queue_.next(trajectory)) {
    const bool worth_it = left_ < trial || left_ < kept_;
    if (worth_it && all_finite(ensemble_.y0 + trajectory * ensemble_.n, ensemble_.n)) return true;
    leave(trajectory, worth_it ? lanes::Why::undefined : lanes::Why::others);
  }
  return false;
}

lanes::Found LaneWorker::search(const lanes::Crossed& step) {
  set_parameters(step.lane.trajectory);
  const auto [place, is_new] = occurrences_.try_emplace(step.lane.trajectory);
  std::vector<Trajectory>& found = place->second;
  if (is_new) found.resize(order_.job.count_of_events);
  lanes::Found result = search_->search(step, found);
  std::size_t count = 0;
  for (const Trajectory& one : found) count += one.t.size();
  result.sound = result.sound && count < plenty;
  return result;
}

void LaneWorker::keep(const lanes::Ended& ended) {
  result_.keep(ended, solver_);
  if (const auto found = occurrences_.extract(ended.lane.trajectory); !found.empty())
    result_.keep_occurrences(ended.lane.trajectory, found.mapped());
  ++kept_;
  queue_.finish_one();
}

/// The functions look for these where the solver has its parameters.
void LaneWorker::set_parameters(std::uint32_t trajectory) {
  const double* row = ensemble_.rows + trajectory * ensemble_.parameters;
  std::copy(row, row + ensemble_.parameters, solver_.problem().parameters.begin());
}

void LaneWorker::leave(std::uint32_t trajectory, lanes::Why why) {
  occurrences_.erase(trajectory);
  integrate_one(solver_, ensemble_, trajectory, queue_.cancelled(), result_);
  ++left_;
  ++left_why_[static_cast<std::size_t>(why)];
  queue_.finish_one();
}

void LaneWorker::go_on(const lanes::Suspended& suspended) {
  if (cancelled()) return;
  set_parameters(suspended.lane.trajectory);
  alone_.kernel.go_on(alone_.job, suspended, *this);
}

/// Piece after piece of as few allocations as possible: what a kernel reads together stands together.
void* LaneWorker::allocate(std::size_t bytes) {
  const std::size_t size = (bytes + alignment - 1) / alignment * alignment;
  if (memory_.empty() || size > left_in_memory_) {
    left_in_memory_ = std::max(size, least_memory);
    memory_.emplace_back(static_cast<std::byte*>(::operator new(left_in_memory_, std::align_val_t{alignment})));
    next_memory_ = memory_.back().get();
  }
  left_in_memory_ -= size;
  return std::exchange(next_memory_, next_memory_ + size);
}

bool LaneWorker::judge(const lanes::Fallen& step) {
  using lanes::Rows;
  const lanes::Lane& lane = step.lane;
  set_parameters(lane.trajectory);
  auto evaluations = static_cast<std::int64_t>(lane[Rows::falls]);
  const Status status = below_zero_.judge({.t0 = lane[Rows::t],
                                           .t1 = step.t1,
                                           .y0 = &lane[Rows::y],
                                           .y1 = step.y1,
                                           .stride = lane.stride,
                                           .attempts = step.attempts},
                                          &lane[lane.rows.watch], evaluations);
  lane[Rows::falls] = static_cast<double>(evaluations);
  return status == Status::ok;
}

bool LaneWorker::jumps(const lanes::Suspicion& suspicion, std::int64_t& checks) {
  if (!DiscontinuityDetector::may_search(suspicion.attempts, checks)) return false;
  set_parameters(suspicion.trajectory);
  for (std::size_t i = 0; i < end_.size(); ++i) end_[i] = suspicion.y1[i * suspicion.stride];
  const JumpSearch::Result result =
      jump_search_.search(suspicion.t0, suspicion.y0, suspicion.t1, end_.data(), suspicion.latest);
  checks += jump_search_.evaluations();
  return result != JumpSearch::Result::none;
}

}  // namespace invariode
