#include "run/lanes/worker.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <string_view>

#include "methods/runge_kutta.hpp"
#include "methods/stability.hpp"

namespace invariode {
namespace {

constexpr double huge = std::numeric_limits<double>::max() / 16;  // as in integrate.cpp

/// f of one trajectory, whose parameters are where the function looks for them.
void evaluate_alone(void* context, const double* t, const double* y, double* out, const double* /*p*/) {
  if (auto& f = *static_cast<Callback*>(context); f(*t, y, out) == Status::stop)
    *out = std::numeric_limits<double>::quiet_NaN();  // the code for single runs finds out why
}

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

lanes::Job make_job(const Solver& solver, const Ensemble& ensemble, lanes::Function* f, void* context) {
  const Settings& settings = solver.settings();
  const Weights& weights = solver.weights();
  return {.f = f,
          .context = context,
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
          .scale = weights.scale().empty() ? nullptr : weights.scale().data()};
}

const lanes::Instructions& of_every_processor() { return *lanes::instructions().back(); }

}  // namespace

const char* obstacle_to_lanes(const Solver& solver) {
  const Problem& problem = solver.problem();
  const Settings& settings = solver.settings();
  if (of_every_processor().pair(solver.method().name) == nullptr) return "the method is no explicit Runge-Kutta pair";
  if (!problem.invariants.empty()) return "invariants are held";
  if (problem.bounds) return "there are bounds";
  if (!problem.events.empty()) return "there are events";
  if (!problem.breakpoints.empty()) return "there are breakpoints";
  if (problem.callback) return "there is a callback";
  if (settings.output_at_times) return "there is output at t_eval";
  if (problem.n == 0 || settings.t0 == settings.tf) return "there is nothing to integrate";
  if (!std::isfinite(settings.tf)) return "the interval is infinite";
  const auto bytes = static_cast<std::int64_t>((problem.n + 1) * sizeof(double));  // of the point that is kept
  const bool limited = settings.max_steps != Settings::unlimited ||
                       settings.time_limit < std::numeric_limits<double>::infinity() || settings.max_points <= 1 ||
                       settings.max_bytes <= bytes;
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
      job_(make_job(solver, ensemble, form.f, form.context)),
      job_alone_(make_job(solver, ensemble, evaluate_alone, &f_)),
      memory_(pair_.memory(job_)),
      memory_alone_(alone_.memory(job_alone_)),
      search_(f_, solver.weights()),
      end_(ensemble.n) {}

void LaneWorker::run() {
  pair_.run(job_, *this, memory_.get());
  result_.add_alone(left_);
}

bool LaneWorker::take(std::uint32_t& trajectory) {
  while (queue_.next(trajectory)) {
    if (all_finite(ensemble_.y0 + trajectory * ensemble_.n, ensemble_.n)) return true;
    leave(trajectory);
  }
  return false;
}

void LaneWorker::keep(const lanes::Ended& ended) {
  result_.keep(ended, job_.tf);
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
  for (std::size_t i = 0; i < end_.size(); ++i) end_[i] = suspicion.y1[i * suspicion.stride];
  const JumpSearch::Result result =
      search_.search(suspicion.t0, suspicion.y0, suspicion.t1, end_.data(), suspicion.latest);
  checks += search_.evaluations();
  return result != JumpSearch::Result::none;
}

}  // namespace invariode
