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

lanes::Job make_job(const Solver& solver, const Ensemble& ensemble, const lanes::Called& f,
                    const lanes::Invariant& invariant) {
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
          .projects = settings.interpolation == Interpolation::projected && invariant.g.function != nullptr};
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
  if (!problem.events.empty()) return "there are events";
  if (!problem.breakpoints.empty()) return "there are breakpoints";
  if (problem.callback) return "there is a callback";
  if (settings.output_at_times && settings.record) return "steps are recorded";
  if (problem.n == 0 || settings.t0 == settings.tf) return "there is nothing to integrate";
  if (!std::isfinite(settings.tf)) return "the interval is infinite";
  const auto points = static_cast<std::int64_t>(settings.output_at_times ? settings.times.size() : 1);
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
      direction_(directions(ensemble.n)),
      invariant_(make_invariant(solver, form.g, form.jacobian, direction_)),
      invariant_alone_(make_invariant(solver, alone(g_), alone(jacobian_), direction_)),
      job_(make_job(solver, ensemble, form.f, invariant_)),
      job_alone_(make_job(solver, ensemble, alone(f_), invariant_alone_)),
      memory_(pair_.memory(job_)),
      memory_alone_(alone_.memory(job_alone_)) {}

void LaneWorker::run() {
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

void LaneWorker::keep(const lanes::Ended& ended) {
  result_.keep(ended, solver_);
  ++kept_;
  queue_.finish_one();
}

void LaneWorker::leave(std::uint32_t trajectory) {
  integrate_one(solver_, ensemble_, trajectory, queue_.cancelled(), result_);
  ++left_;
  queue_.finish_one();
}

void LaneWorker::go_on(const lanes::Suspended& suspended) {
  if (cancelled()) return;
  const std::span<double> parameters = solver_.problem().parameters;
  for (std::size_t i = 0; i < parameters.size(); ++i) parameters[i] = suspended.p[i * suspended.stride];
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
