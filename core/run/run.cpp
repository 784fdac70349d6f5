#include "run/run.hpp"

#include <algorithm>
#include <limits>
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
          counts.clipped,
          ng,
          ngjac,
          ngdiff,
          switches,
          linear.products,
          linear.iterations,
          static_cast<std::int64_t>(dropped.size()),
          harm.component + 1,
          below_zero.index + 1,
          stiffness.found ? 1 : 0};
}

/// Makes the parts in this order: each refers to what the ones before have made.
Run::Run(const Solver& solver) : solver_(solver) {
  wrap_functions();
  f_ = problem().f;
  series_ = problem().series;
  copy_linear_terms();
  keep_within_bounds();
  derive_slope();
  bind_invariants();
  start_loop();
}

/// Functions that may be discontinuous at a breakpoint, f and g with their derivatives, are called by way of the piece.
/// Events are not: their signs continue through breakpoints. Within bounds f and its derivatives are called there only;
/// series are expanded at accepted points, which are within.
void Run::wrap_functions() {
  const Problem& all = solver_.problem();
  if (all.delays) {
    delays_.emplace(*all.delays, all.parameters, all.extent(), all.bounds ? &*all.bounds : nullptr,
                    solver_.settings().t0);
    Problem& delayed = wrapped_.emplace(all);
    delayed.f = delays_->within(all.f);
    if (delayed.linear) delayed.linear->source.function = delays_->within(all.linear->source.function);
    if (delayed.variations) delayed.variations->slope = delays_->augmented_within(all.variations->slope);
  }
  if (delays_ || !all.breakpoints.empty() || !all.landings.empty()) {
    if (!wrapped_) wrapped_.emplace(all);
    wrap_in_pieces(*wrapped_);
  }
  if (all.bounds) wrap_in_bounds(wrapped_ ? *wrapped_ : wrapped_.emplace(all));
}

void Run::wrap_in_pieces(Problem& problem) {
  problem.f = piece_.within(problem.f);
  if (problem.series) {
    problem.series->solution = piece_.within(problem.series->solution);
    problem.series->conditions = piece_.within(problem.series->conditions);
  }
  for (InvariantBlock& block : problem.invariants) {
    block.g = piece_.within(block.g);
    block.jacobian = piece_.within(block.jacobian);
    block.complex_g = piece_.within(block.complex_g);
    block.tangent = piece_.within(block.tangent);
  }
  if (problem.variations) problem.variations->slope = piece_.within(problem.variations->slope);
  if (!problem.linear) return;
  Jacobian::Source& source = problem.linear->source;
  source.function = piece_.within(source.function);
  source.complex_f = piece_.within(source.complex_f);
  source.rate = piece_.within(source.rate);
  source.product = piece_.within(source.product);
  if (std::optional<KrylovTerms>& krylov = problem.linear->krylov) {
    krylov->product = piece_.within(krylov->product);
    krylov->preconditioner = piece_.within(krylov->preconditioner);
  }
  if (problem.linear->mass) problem.linear->mass->wrap([this](const MatrixFunction& m) { return piece_.within(m); });
}

void Run::wrap_in_bounds(Problem& problem) {
  confined_.emplace(*solver_.problem().bounds, solver_.weights());
  users_f_ = problem.f;
  problem.f = confined_->within(problem.f);
  if (problem.variations)
    problem.variations->slope = confined_->augmented_within(problem.variations->slope, problem.size());
  if (!problem.linear) return;
  problem.linear->source = confined_->within(problem.linear->source);
  if (problem.linear->krylov)
    problem.linear->krylov->product = confined_->product_within(problem.linear->krylov->product);
}

void Run::copy_linear_terms() {
  if (!solver_.jacobian()) return;
  if (wrapped_)
    jacobian_.emplace(make_jacobian(*wrapped_, solver_.weights()));
  else
    jacobian_.emplace(*solver_.jacobian());
  mass_ = problem().linear->mass;
  lapack_ = problem().linear->lapack;
  if (lapack_) lapack_->poll = [this] { integration_->poll(); };
}

LinearAlgebra Run::linear_algebra() {
  if (!jacobian_) return {};
  const std::optional<KrylovTerms>& krylov = problem().linear->krylov;
  return {.jacobian = &*jacobian_,
          .mass = mass_ ? &*mass_ : nullptr,
          .lapack = lapack_ ? &*lapack_ : nullptr,
          .krylov = krylov ? &*krylov : nullptr,
          .blocks = blocks_ ? &*blocks_ : nullptr};
}

void Run::keep_within_bounds() {
  const Problem& problem = solver_.problem();
  if (!problem.bounds) return;
  manifold_.bounds = &*problem.bounds;
  if (series_) series_->bounds = &*problem.bounds;
  std::optional<std::vector<double>> mass = mass_ ? mass_->diagonal() : std::vector<double>{};
  if (mass)
    bounded_slope_.emplace(f_, *problem.bounds, forward(), solver_.method().implicit(), std::move(*mass));
  else
    bounded_slope_.emplace(f_, *problem.bounds, forward(), *rate());
  if (series_) bounded_slope_->see_ends_alone();
  bounded_f_ = bounded_slope_->callback();
  method_f_ = &bounded_f_;
}

/// y' of f, as far as it follows from M alone; nothing without M.
std::optional<DifferentialRate> Run::rate() const {
  if (!mass_) return {};
  return DifferentialRate(*mass_, lapack_ ? &*lapack_ : nullptr);
}

/// y' as a function, by which invariants are tested.
void Run::derive_slope() {
  if (problem().invariants.empty() && !moves_off_algebraic_equations()) return;
  const Callback f = confined_ ? confined_->defined(users_f_) : f_;
  if (mass_)
    slope_ = std::make_unique<MassSlope>(f, linear_algebra());
  else
    slope_ = std::make_unique<ExplicitSlope>(f, problem().f_error);
  manifold_.slope = slope_.get();
}

Invariants* Run::invariants_everywhere() {
  constexpr double infinity = std::numeric_limits<double>::infinity();
  piece_.enter(-infinity, 0, infinity, 0);
  return users_invariants_;
}

double Run::forward() const { return solver_.settings().tf >= solver_.settings().t0 ? 1 : -1; }

void Run::bind_invariants() {
  const Problem& problem = this->problem();
  if (problem.invariants.empty()) {
    manifold_.off_bounds_only = moves_off_algebraic_equations();
    if (manifold_.off_bounds_only) manifold_.steps = &steps_.emplace(with_algebraic_equations());
    return;
  }
  if (mass_ && mass_->singular()) {
    users_invariants_ = &between_.emplace(bound(problem.invariants, problem.value));
    steps_.emplace(with_algebraic_equations());
  } else {
    users_invariants_ = &steps_.emplace(bound(problem.invariants, problem.value));
  }
  manifold_.steps = &*steps_;
  manifold_.between = users_invariants_;
}

/// A point that is moved onto bounds has to be projected onto the algebraic equations again.
bool Run::moves_off_algebraic_equations() const { return solver_.problem().bounds && mass_ && mass_->singular(); }

/// With a singular mass matrix the invariants are imposed together with the algebraic equations. If the invariants have
/// levels, the algebraic equations are the last level, which moves all components: the components that M leaves free
/// may hardly determine these equations by themselves.
Invariants Run::with_algebraic_equations() {
  const Problem& problem = this->problem();
  algebraic_.emplace(f_, *jacobian_, *mass_);
  InvariantBlock block;
  block.g = algebraic_->residual();
  block.jacobian = algebraic_->jacobian();
  if (const std::optional<Variations>& varied = problem.variations)
    block.tangent = algebraic_tangent_.emplace(varied->slope, *mass_, varied->k).callback();
  block.m = algebraic_->count();
  block.untested = true;
  std::vector<InvariantBlock> blocks = problem.invariants;
  if (Levels::told(blocks)) {
    const auto level = [](const InvariantBlock& one) { return one.level; };
    block.level = 1 + level(*std::ranges::max_element(blocks, {}, level));
  }
  blocks.push_back(block);
  std::vector<double> value = problem.value;
  value.resize(value.size() + algebraic_->count());
  return bound(std::move(blocks), std::move(value));
}

/// A function that never increases as t grows never decreases in a run backwards.
Invariants Run::bound(std::vector<InvariantBlock> blocks, std::vector<double> value) const {
  if (solver_.settings().tf < solver_.settings().t0)
    for (InvariantBlock& block : blocks) block.sense = -block.sense;
  Invariants invariants(problem().n, std::move(blocks), std::move(value), solver_.weights());
  invariants.keep_within(piece_);
  return invariants;
}

void Run::start_loop() {
  if (problem().variations)
    blocks_.emplace(*method_f_, *problem().variations, solver_.weights(), solver_.iteration_weights(),
                    bounded_slope_ ? &*bounded_slope_ : nullptr);
  Callback& integrated = blocks_ ? blocks_->whole() : *method_f_;
  std::unique_ptr<Step> step = solver_.method().step(integrated, solver_.augmented_weights(), solver_.options(),
                                                     linear_algebra(), series_ ? &*series_ : nullptr);
  const Problem& all = solver_.problem();
  LoopFunctions functions{.f = f_,
                          .bounded_slope = bounded_slope_ ? &*bounded_slope_ : nullptr,
                          .rate = rate(),
                          .jump_rate = delays_ ? rate() : std::nullopt,
                          .signed_states = all.signed_states || all.complex || (mass_ && mass_->singular()),
                          .autonomous = all.autonomous,
                          .events = all.events,
                          .vectors = all.vectors,
                          .breakpoints = all.breakpoints,
                          .landings = all.landings,
                          .delays = delays_ ? &*delays_ : nullptr,
                          .history_jumps = {},
                          .most_level = solver_.method().order + 1,
                          .piece = &piece_,
                          .consistent = {},
                          .consistent_tangent = {},
                          .callback = all.callback};
  if (all.delays) functions.history_jumps = all.delays->jumps;
  if (mass_ && mass_->singular())
    functions.consistent = [this](double t, double* y) {
      Callback uncounted = f_;  // nfev is what the method evaluates
      return make_consistent(uncounted, linear_algebra(), solver_.weights(), t, y);
    };
  if (functions.consistent && blocks_)
    functions.consistent_tangent = [this](double t, double* Y) {
      if (bounded_slope_) bounded_slope_->release(Y);
      return make_tangent_consistent(linear_algebra(), t, Y);
    };
  manifold_.bounded_slope = functions.bounded_slope;
  integration_.emplace(std::move(step), solver_.weights(), manifold_, std::move(functions), solver_.settings());
  if (solver_.settings().sections) sections_.emplace(integration_->most_bytes_of_step());
}

State Run::advance() {
  const Integration& loop = *integration_;
  if (sections_ && loop.between_steps() && sections_->due(loop.counts().steps)) {
    const RunMemory all = memory(std::numeric_limits<std::size_t>::max());
    sections_->add({loop.counts().steps, loop.t(), all.copy()});
  }
  return integration_->advance();
}

State Run::run() {
  while (advance() == State::running) {
  }
  return integration_->state();
}

Consistency Run::prepare(double t0, double* y0) {
  prepared_ = evaluations_of_prepare();
  Consistency verdict = Consistency::consistent;
  Callback uncounted = f_;  // nfev is what the method evaluates
  if (mass_ && mass_->singular()) verdict = make_consistent(uncounted, linear_algebra(), solver_.weights(), t0, y0);
  if (steps_ && steps_->hold(t0, y0) == Status::stop) return Consistency::stop;
  if (between_ && between_->hold(t0, y0) == Status::stop) return Consistency::stop;
  return verdict;
}

std::int64_t Run::evaluations_of_prepare() const {
  const auto held = std::ranges::count_if(solver_.problem().invariants, &InvariantBlock::held);
  return static_cast<std::int64_t>((between_ ? 2 : 1) * held);
}

void Run::count_evaluations(RunResult& result) const {
  result.nfev = evaluations() + (bounded_slope_ ? bounded_slope_->evaluations() : 0) + result.linear.complex_calls;
  result.nfev_check = integration_->evaluations_of_checks() + result.linear.checks;
  if (!steps_) return;
  result.ng = -before_;
  result.nfev_check += slope_->evaluations();
  result.ng += steps_->calls();
  result.ngjac = steps_->jacobian_calls();
  result.ngdiff = steps_->derivative_calls();
  if (!algebraic_) return;
  const InvariantBlock& algebraic = steps_->blocks().back();  // none of the user's functions
  result.ng -= algebraic.g.calls();
  result.ngjac -= algebraic.jacobian.calls();
  if (!between_) return;
  result.ng += between_->calls();
  result.ngjac += between_->jacobian_calls();
}

void Run::describe_invariants(RunResult& result) const {
  if (!steps_) return;
  for (const InvariantBlock& block : steps_->blocks())
    if (!block.untested) result.derivatives.push_back(block.derivative);
  result.projected_start = integration_->manifold().guard()->projected_start();
  const Projector& projector = *integration_->manifold().projector();
  const std::vector<char> dropped = projector.dropped();
  for (std::size_t i = 0; i < dropped.size(); ++i)
    if (dropped[i] != 0) result.dropped.push_back(static_cast<int>(i));
  result.dropped_at = projector.dropped_at();
  for (std::size_t i = 0; i < dropped.size(); ++i) result.unresolved.push_back(integration_->manifold().unresolved(i));
  result.harm = integration_->manifold().harm();
}

/// All but the arrays.
void Run::describe(RunResult& result) const {
  const Integration& loop = *integration_;
  result.n = loop.step().n();
  result.drift = loop.manifold().drift;
  result.state = loop.state();
  result.report = loop.report();
  result.counts = loop.counts();
  result.below_zero = loop.below_zero();
  result.stiffness = loop.stiffness();
  result.discontinuities = loop.discontinuities().found();
  result.marks = loop.passed_marks();
  result.sticks_since = loop.discontinuities().sticks_since();
  result.accumulation = loop.accumulation();
  result.switches = loop.switches();
  result.linear = loop.step().linear_work();
  count_evaluations(result);
  describe_invariants(result);
  result.clipped = loop.manifold().clipped;
  result.t_end = loop.t();
  result.next_h = loop.step().h();
}

RunResult Run::take_result() {
  Integration& loop = *integration_;
  RunResult result;
  describe(result);
  Output& output = loop.output();
  result.points = std::move(output.points);
  result.occurrences = std::move(output.occurrences);
  result.record = std::move(output.steps);
  result.jumps = std::move(output.jumps);
  result.dense = std::move(output.dense);
  if (sections_) result.sections = sections_->take();
  if (solver_.settings().output_at_times || result.points.t.empty())
    result.y_end.emplace(loop.y(), loop.y() + result.n);
  return result;
}

RunResult Run::result_since(Marks& marks) const {
  const Integration& loop = *integration_;
  const Output& output = loop.output();
  RunResult result;
  describe(result);
  result.y_end.emplace(loop.y(), loop.y() + result.n);
  if (solver_.settings().save_all) result.points = output.points.from(marks.points, result.n);
  result.record.append(output.steps.data() + marks.steps, output.steps.size() - marks.steps);
  marks.occurrences.resize(output.occurrences.size());
  for (std::size_t e = 0; e < output.occurrences.size(); ++e) {
    result.occurrences.push_back(output.occurrences[e].from(marks.occurrences[e], result.n));
    marks.occurrences[e] = output.occurrences[e].t.size();
  }
  for (; marks.jumps < output.jumps.size(); ++marks.jumps) {
    Jump& jump = result.jumps.emplace_back(output.jumps[marks.jumps]);
    jump.row -= solver_.settings().save_all ? marks.points : 0;
  }
  marks.points = output.points.t.size();
  marks.steps = output.steps.size();
  if (output.dense) {
    result.dense.emplace(output.dense->from(marks.knots));
    marks.knots = output.dense->knots().size() - 1;
  }
  return result;
}

void Run::archive_prepared(Archive& archive) {
  std::int64_t both = prepared_ + before_;
  archive(both);
  if (archive.reading()) before_ = both;
}

void Run::state(Archive& archive) {
  archive_prepared(archive);
  f_.state(archive);
  bounded_f_.state(archive);
  if (blocks_) blocks_->whole().state(archive);
  if (series_) series_->solution.state(archive);
  if (bounded_slope_) bounded_slope_->state(archive);
  if (slope_) slope_->state(archive);
  if (algebraic_) algebraic_->state(archive);
  for (std::optional<Invariants>* one : {&steps_, &between_})
    if (*one) (*one)->state(archive);
  integration_->state(archive);
}

RunMemory Run::memory(std::size_t most_values) {
  Archive archive(most_values);
  state(archive);
  return archive.take();
}

State Run::resume(std::span<const std::byte> memory, bool anew) {
  Archive archive(memory);
  state(archive);
  archive.require(archive.exhausted());
  return integration_->resume(anew);
}

}  // namespace invariode
