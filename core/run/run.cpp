#include "run/run.hpp"

#include <memory>
#include <utility>

namespace invariode {

std::array<std::int64_t, RunResult::count_size> RunResult::counted() const {
  return {counts.steps,
          counts.failed,
          nfev,
          nfev_check,
          linear.jacobians,
          linear.factorizations,
          linear.solves,
          counts.projections,
          counts.skipped,
          ng,
          ngjac,
          ngdiff,
          static_cast<std::int64_t>(dropped.size())};
}

/// In this order: each refers to what the ones before have made.
Run::Run(const Solver& solver) : solver_(solver), f_(solver.problem().f) {
  copy_linear_terms();
  derive_slope();
  bind_invariants();
  start_loop();
}

void Run::copy_linear_terms() {
  if (!solver_.jacobian()) return;
  jacobian_.emplace(*solver_.jacobian());
  mass_ = solver_.problem().linear->mass;
}

LinearAlgebra Run::linear_algebra() {
  if (!jacobian_) return {};
  const std::optional<Lapack>& lapack = solver_.problem().linear->lapack;
  return {.jacobian = &*jacobian_, .mass = mass_ ? &*mass_ : nullptr, .lapack = lapack ? &*lapack : nullptr};
}

/// y' as a function, by which invariants are tested.
void Run::derive_slope() {
  if (solver_.problem().invariants.empty()) return;
  if (mass_)
    slope_ = std::make_unique<MassSlope>(f_, linear_algebra(), solver_.weights());
  else
    slope_ = std::make_unique<ExplicitSlope>(f_);
  manifold_.slope = slope_.get();
}

void Run::bind_invariants() {
  const Problem& problem = solver_.problem();
  if (problem.invariants.empty()) return;
  if (mass_ && mass_->singular()) {
    users_invariants_ = &between_.emplace(problem.n, problem.invariants, problem.value, solver_.weights());
    steps_.emplace(with_algebraic_equations());
  } else {
    users_invariants_ = &steps_.emplace(problem.n, problem.invariants, problem.value, solver_.weights());
  }
  manifold_.steps = &*steps_;
  manifold_.between = users_invariants_;
}

/// With a singular mass matrix the invariants are imposed together with the algebraic equations.
Invariants Run::with_algebraic_equations() {
  const Problem& problem = solver_.problem();
  algebraic_.emplace(f_, *jacobian_, *mass_);
  InvariantBlock block;
  block.g = algebraic_->residual();
  block.jacobian = algebraic_->jacobian();
  block.m = algebraic_->count();
  block.certain = true;
  std::vector<InvariantBlock> blocks = problem.invariants;
  blocks.push_back(block);
  std::vector<double> value = problem.value;
  value.resize(value.size() + algebraic_->count());
  return {problem.n, std::move(blocks), std::move(value), solver_.weights()};
}

void Run::start_loop() {
  std::unique_ptr<Step> step = solver_.method().step(f_, solver_.weights(), solver_.options(), linear_algebra());
  integration_.emplace(std::move(step), solver_.weights(), manifold_, solver_.problem().events,
                       solver_.problem().callback, solver_.settings());
}

Consistency Run::prepare(double t0, double* y0) {
  Consistency verdict = Consistency::consistent;
  Callback uncounted = f_;  // nfev is what the method evaluates
  if (mass_ && mass_->singular()) verdict = make_consistent(uncounted, linear_algebra(), solver_.weights(), t0, y0);
  if (steps_ && steps_->hold(t0, y0) == Status::stop) return Consistency::stop;
  if (between_ && between_->hold(t0, y0) == Status::stop) return Consistency::stop;
  return verdict;
}

void Run::count_evaluations(RunResult& result) const {
  result.nfev = f_.calls();
  if (!steps_) return;
  result.nfev_check = slope_->evaluations();
  result.ng = steps_->calls();
  result.ngjac = steps_->jacobian_calls();
  result.ngdiff = steps_->derivative_calls();
  if (!between_) return;
  const InvariantBlock& algebraic = steps_->blocks().back();  // none of the user's functions
  result.ng += between_->calls() - algebraic.g.calls();
  result.ngjac += between_->jacobian_calls() - algebraic.jacobian.calls();
}

void Run::describe_invariants(RunResult& result) const {
  if (!steps_) return;
  for (const InvariantBlock& block : steps_->blocks())
    if (!block.certain) result.derivatives.push_back(block.derivative);
  result.projected_start = integration_->guard()->projected_start();
  const Projector& projector = *integration_->projector();
  const std::vector<char> dropped = projector.dropped();
  for (std::size_t i = 0; i < dropped.size(); ++i)
    if (dropped[i] != 0) result.dropped.push_back(static_cast<int>(i));
  result.dropped_at = projector.dropped_at();
  result.harm = integration_->harm();
}

RunResult Run::take_result() {
  Integration& loop = *integration_;
  RunResult result;
  result.n = loop.step().n();
  result.points = std::move(loop.points);
  result.occurrences = std::move(loop.occurrences);
  result.record = std::move(loop.steps);
  result.drift = std::move(loop.drift);
  result.jumps = std::move(loop.jumps);
  result.dense = std::move(loop.dense);
  result.state = loop.state();
  result.report = loop.report();
  result.counts = loop.counts();
  result.stiffness = loop.stiffness();
  result.linear = loop.step().linear_work();
  count_evaluations(result);
  describe_invariants(result);
  result.t_end = loop.t();
  if (solver_.settings().output_at_times || result.points.t.empty())
    result.y_end.emplace(loop.y(), loop.y() + result.n);
  result.next_h = loop.step().h();
  return result;
}

}  // namespace invariode
