#include "manifold/manifold.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "manifold/thresholds.hpp"

namespace invariode {
namespace {

constexpr int start_iterations = 5;  // of the projection of the start within bounds: Newton's is at roundoff then

}  // namespace

Manifold::Manifold(const ManifoldTerms& terms, const Weights& weights, const Settings& settings, const Step& step,
                   bool with_events)
    : invariants_(terms.steps),
      bounds_(terms.bounds),
      bounded_slope_(terms.bounded_slope),
      off_bounds_only_(terms.off_bounds_only),
      check_(settings.check),
      weights_(weights),
      size_(step.n()) {
  if (invariants_ != nullptr) {
    projector_.emplace(*invariants_, weights, settings.iterations, settings.negligible);
    guard_.emplace(*projector_, weights, *terms.slope, std::abs(settings.tf - settings.t0));
    if (Restoration::determines(*invariants_) || (with_events && Restoration::needed(*invariants_)))
      restoration_.emplace(*invariants_, weights);
    harm_.emplace(weights.size(), size_);
    if (size_ > weights.size()) tangent_.emplace(*invariants_, weights, size_, bounds_);
    if (invariants_->along_steps()) {
      directions_.resize(step.max_directions());
      if (directions_.empty())
        throw std::invalid_argument("this method does not tell what its steps are made of: use direction='gradient'");
    }
    drift.residual.resize(invariants_->m());
    drift.distance.resize(invariants_->m());
    taken_.resize(invariants_->m());
    if (bounds_ != nullptr) active_set_.emplace(*projector_, *bounds_);
    if (invariants_->any_one_sided())
      one_sided_.emplace(*projector_, active_set_ ? &*active_set_ : nullptr, weights.rtol());
  }
  if (any()) y1_.resize(size_);
  if (terms.between == nullptr) return;
  output_projector_.emplace(*terms.between, weights, 1, 0, terms.between == terms.steps ? &*projector_ : nullptr);
  if (size_ > weights.size()) output_tangent_.emplace(*terms.between, weights, size_, bounds_);
}

// ---------------------------------------------------------------------------------------------- where a solution
// starts

Status Manifold::start(double t, double* y) {
  if (one_sided_ && one_sided_->start(t, y) == Status::stop) return Status::stop;
  return start_tangent(t, y, true);
}

/// Moves S onto the tangent. Where that is not defined S stays: the method will report what is wrong.
Status Manifold::start_tangent(double t, double* y, bool rehold) {
  if (!tangent_) return Status::ok;
  if (rehold && tangent_->hold(t, y) == Status::stop) return Status::stop;
  return tangent_->settle(t, y) == Outcome::stop ? Status::stop : Status::ok;
}

Outcome Manifold::project_start(double t, double* y) {
  assert(active_set_);
  for (int i = 0; i < start_iterations; ++i) {
    std::copy(y, y + weights_.size(), y1_.begin());
    const Outcome outcome = active_set_->project(t, y1_.data(), y).outcome;
    if (outcome != Outcome::ok) return outcome;
  }
  return Outcome::ok;
}

Finding Manifold::restart(double t, double* y, bool rehold, bool acted) {
  constexpr Finding stop{.kind = Finding::Kind::stop};
  if (invariants_ == nullptr) return {};
  if (rehold) std::ranges::fill(taken_, 0);
  if (rehold && restoration_ && restoration_->restore(t, y, acted) == Status::stop) return stop;
  if (rehold && invariants_->hold(t, y) == Status::stop) return stop;
  if (const Finding finding = guard_->start_value(t, y); finding.kind != Finding::Kind::none) return finding;
  if (one_sided_ && one_sided_->go_on(t, y) == Status::stop) return stop;
  if (start_tangent(t, y, rehold) == Status::stop) return stop;
  return {};
}

Status Manifold::note_values(double t, const double* y) {
  if (invariants_ == nullptr) return Status::ok;
  before_.resize(invariants_->m());
  after_.resize(invariants_->m());
  return invariants_->evaluate(t, y, before_.data());
}

/// The gradients are those of the last step; where they are not known, roundoff counts as a jump, which does no harm.
Status Manifold::compare_values(double t, const double* y, bool& differ) {
  differ = false;
  if (invariants_ == nullptr) return Status::ok;
  if (invariants_->evaluate(t, y, after_.data()) == Status::stop) return Status::stop;
  const double* J = projector_->linearization().J.data();
  for (std::size_t i = 0; i < after_.size(); ++i)
    if (std::abs(after_[i] - before_[i]) > invariants_->roundoff(i, y, J)) differ = true;
  return Status::ok;
}

void Manifold::forget() {
  if (projector_) projector_->forget();
}

// ------------------------------------------------------------------------------------------------------- the candidate

Manifold::Placement Manifold::place(Step& step, StepEnds& ends, std::int64_t steps) {
  assert(any() && ends.t0 != ends.t1);
  correction_ = 0;
  const double moved = bounded_slope_ != nullptr ? settle(ends) : 0;
  const double* candidate = ends.y1;
  if (bounds_ != nullptr && !move_onto_bounds(step, ends)) return {Placed::outside};
  if (!projector_ || (off_bounds_only_ && !outside_.off_bounds && moved <= roundoff_at_bound))
    return {Placed::accepted};
  ends.y1 = candidate;
  const Placed placed = project(step, ends, steps);
  return {placed, !projected_.skipped, projected_.skipped};
}

/// Moves resting components of a candidate to their bounds. Returns the largest move, in units of thr.
double Manifold::settle(StepEnds& ends) {
  if (bounded_slope_->held().empty()) return 0;
  settled_.assign(ends.y1, ends.y1 + size_);
  const double moved = bounded_slope_->settle_held(weights_, settled_.data());
  if (moved == 0) return 0;
  forget_at_bounds(*bounds_, bounded_slope_->held(), settled_);
  ends.y1 = settled_.data();
  return moved;
}

/// Returns false if the candidate is outside the bounds by more than the tolerance.
bool Manifold::move_onto_bounds(Step& step, StepEnds& ends) {
  Bounds::Excess outside = bounds_->excess(ends.y1, weights_);
  if (bounded_slope_ != nullptr && bounded_slope_->visited().size > outside.size) outside = bounded_slope_->visited();
  outside_ = {.off_bounds = outside.component >= 0, .component = outside.component};
  step.moved_onto_bounds(outside_.off_bounds);
  projected_ = {};
  projected_.skipped = true;  // until it is projected
  if (!outside_.off_bounds) return true;
  if (outside.size > weights_.rtol()) return false;
  std::copy(ends.y1, ends.y1 + size_, y1_.begin());
  outside_.clipped = bounds_->clip(y1_.data());
  ends.y1 = y1_.data();
  return true;
}

/// Takes y₁ from the candidate y*. A correction that is too large fails the attempt.
Manifold::Placed Manifold::project(const Step& step, StepEnds& ends, std::int64_t steps) {
  const double* candidate = ends.y1;
  std::copy(candidate, candidate + size_, y1_.begin());
  if (!directions_.empty()) choose_directions(step);
  projected_ = one_sided_    ? one_sided_->project(ends, step.slope(), y1_.data())
               : active_set_ ? active_set_->project(ends.t1, ends.y0, y1_.data())
                             : projector_->project(ends.t1, ends.y0, y1_.data());
  if (projected_.outcome == Outcome::stop) return Placed::stop;
  const bool defined = projected_.outcome == Outcome::ok;
  correction_ = defined ? projected_.correction : std::numeric_limits<double>::infinity();
  const bool large = correction_ > largest_correction * weights_.rtol();
  if (large && (!defined || !(correction_ <= roundoff_of_correction()))) return Placed::too_far;
  switch (follow_tangent(ends.t1)) {
    case Outcome::stop: return Placed::stop;
    case Outcome::not_finite: return Placed::undefined;
    case Outcome::ok: break;
  }
  if (check_ && !at_bounds()) harm_->note(step, steps, candidate, y1_.data(), projector_->linearization().w.data());
  ends.y1 = y1_.data();
  return Placed::accepted;
}

/// Takes the sensitivities of y₁ from those of the candidate.
Outcome Manifold::follow_tangent(double t) {
  if (!tangent_) return Outcome::ok;
  return projected_.skipped ? tangent_->settle(t, y1_.data()) : tangent_->follow(*projector_, t, y1_.data());
}

/// Seeks corrections among the directions that the step is made of.
void Manifold::choose_directions(const Step& step) {
  const std::size_t count = step.directions(directions_.data());
  projector_->seek_along({directions_.data(), count});
}

/// Returns the error of a correction by roundoff in g.
double Manifold::roundoff_of_correction() const {
  const Linearization& at = projector_->linearization();
  double largest = 0;
  for (std::size_t i = 0; i < at.m(); ++i)
    if (at.norm[i] > 0) largest = std::max(largest, invariants_->roundoff(i, at.y.data(), at.J.data()) / at.norm[i]);
  return largest;
}

double Manifold::unresolved(std::size_t i) const {
  const Linearization& at = projector_->linearization();
  if (invariants_->untested(i) || !(at.norm[i] > 0)) return 0;
  const double roundoff = invariants_->roundoff(i, at.y.data(), at.J.data()) / roundoff_of_g;
  return roundoff / at.norm[i] / weights_.rtol();
}

int Manifold::undefined() const {
  return projector_ && projected_.outcome == Outcome::not_finite ? projector_->undefined() : -1;
}

// ---------------------------------------------------------------------------------------------------- an accepted step

bool Manifold::note(double h) {
  assert(projected_.residual.size() <= drift.residual.size());
  for (std::size_t i = 0; i < projected_.residual.size(); ++i) {
    drift.residual[i] = std::max(drift.residual[i], std::abs(projected_.residual[i]));
    drift.distance[i] = std::max(drift.distance[i], projected_.distance[i] / weights_.rtol());
  }
  drift.correction = std::max(drift.correction, correction_ / weights_.rtol());
  if (bounds_ == nullptr) return false;
  double held = 0;
  if (bounded_slope_ != nullptr)
    for (const std::size_t i : bounded_slope_->held()) held -= h * bounded_slope_->removed(i);
  clipped += outside_.clipped + held;
  return outside_.off_bounds || held != 0;
}

/// Finds an invariant that f conserves only together with components that are held at bounds: the projection takes from
/// others what f would have taken from these, step after step.
Finding Manifold::contradicted(double t, double h) {
  if (bounded_slope_ == nullptr || bounded_slope_->held().empty()) return {};
  const Linearization& at = projector_->linearization();
  for (std::size_t i = 0; i < at.m(); ++i) {
    if (invariants_->untested(i) || invariants_->sense(i) != 0 || !(at.norm[i] > 0)) continue;
    const Row gradient = at.gradient(i);
    double rate = 0, most = 0;
    std::size_t component = 0;
    for (const std::size_t k : bounded_slope_->held()) {
      const double part = gradient.entry(k) * bounded_slope_->removed(k);
      rate -= part;
      if (std::abs(part) > most) most = std::abs(part), component = k;
    }
    taken_[i] += h * rate / at.norm[i];
    const double distance = std::abs(taken_[i]) / weights_.rtol();
    if (most > 0 && distance > largest_correction)
      return {.kind = Finding::Kind::held,
              .invariant = static_cast<int>(i),
              .component = static_cast<int>(component),
              .t = t,
              .size = rate,
              .distance = distance};
  }
  return {};
}

/// A function that increases over a step increases at one of its ends, unless its rate changes sign twice within.
Finding Manifold::judge(const StepEnds& ends, const Step& step, std::int64_t number, bool at_break, bool after_break) {
  if (!guard_ || !check_ || projected_.skipped) return {};
  if (one_sided_ && one_sided_->engaged() && !after_break)
    if (const Finding finding = guard_->violated(ends.t0, ends.y0, ends.h, number); finding.kind != Finding::Kind::none)
      return finding;
  if (const Finding finding = contradicted(ends.t1, ends.h); finding.kind != Finding::Kind::none) return finding;
  if (at_break) return {};
  const Finding finding = guard_->rate(projector_->linearization(), ends.t1, step.slope(), ends.h, number);
  if (finding.kind != Finding::Kind::none || at_bounds()) return finding;
  return guard_->corrected(correction_, ends.t1, ends.y1, ends.h, number);
}

void Manifold::commit() {
  if (one_sided_) one_sided_->commit();
}

void Manifold::state(Archive& archive) {
  if (projector_) projector_->state(archive);
  if (tangent_) tangent_->state(archive);
  if (guard_) guard_->state(archive);
  if (restoration_) restoration_->state(archive);
  if (one_sided_) one_sided_->state(archive);
  if (harm_) harm_->state(archive);
  archive(taken_);
}

}  // namespace invariode
