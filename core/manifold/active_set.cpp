#include "manifold/active_set.hpp"

#include <algorithm>
#include <cmath>

#include "linear/index.hpp"
#include "linear/saddle.hpp"

namespace invariode {
namespace {

constexpr double roundoff_of_multiplier = 1e-10;  // relative to the two terms that it is the difference of
constexpr double least_gain = 0.5;                // of the residual of an invariant that depends on the others
constexpr int rounds_of_all = 10;                 // in which all components change that are wrong, then one by one
constexpr int most_rounds = 100;                  // then none is released any more
constexpr int output_rounds = 4;                  // between steps: as in the steps at their ends, mostly

using Vector = Eigen::Map<const Eigen::VectorXd>;

/// Returns whether y_i is not inside its bounds: at or beyond one.
bool at_bound(const Bounds::Interval& one, const double* y) {
  return y[one.component] <= one.lower || y[one.component] >= one.upper;
}

bool outside(const Bounds::Interval& one, const double* y) {
  return y[one.component] < one.lower || y[one.component] > one.upper;
}

}  // namespace

ActiveSet::ActiveSet(Projector& projector, const Bounds& bounds)
    : projector_(projector),
      bounds_(bounds),
      candidate_(bounds.n()),
      place_(bounds.n()),
      residual_(projector.invariants().m()) {}

Projected ActiveSet::project(double t, const double* from, double* y) {
  std::copy(y, y + candidate_.size(), candidate_.begin());
  projector_.release_all();
  for (const Bounds::Interval& one : bounds_.intervals())
    if (at_bound(one, y)) change(one, y);
  Projected did;
  for (int round = 0;; ++round) {
    std::copy(candidate_.begin(), candidate_.end(), y);
    for (const Bounds::Interval& one : bounds_.intervals())
      if (projector_.fixed(one.component)) y[one.component] = place_[one.component];
    active_ = projector_.any_fixed();
    did = projector_.project(t, from, y);
    if (did.outcome != Outcome::ok) break;
    wrong_.clear();
    note_outside(y);
    if (active_ && !did.skipped && round < most_rounds) note_unwilling(y);
    if (wrong_.empty()) break;
    std::sort(wrong_.begin(), wrong_.end());
    if (round >= rounds_of_all && round < most_rounds) wrong_.resize(1);
    for (const Bounds::Interval* one : wrong_) change(*one, y);
  }
  if (did.outcome == Outcome::ok && active_ && !did.skipped) did.outcome = judge_left_out(t, y, did.residual);
  projector_.release_all();
  return did;
}

/// Releases a component that is fixed; fixes one that is not, at the bound that y is at or beyond.
void ActiveSet::change(const Bounds::Interval& one, const double* y) {
  if (projector_.fixed(one.component)) return projector_.release(one.component);
  place_[one.component] = y[one.component] <= one.lower ? one.lower : one.upper;
  projector_.fix(one.component);
}

/// The components that the projection has taken out of their bounds.
void ActiveSet::note_outside(const double* y) {
  for (const Bounds::Interval& one : bounds_.intervals())
    if (outside(one, y) && !projector_.fixed(one.component)) wrong_.push_back(&one);
}

/// The fixed components that the nearest point has inside, as their multiplier tells. With b = W⁻¹(y − y*) the free
/// components of b + W Jᵀλ vanish, which determines λ; what the fixed ones leave, divided by w, is the multiplier of
/// the bound: at a lower one it is not negative. It is how far, in units of the weights, the component would rather be
/// inside, and roundoff of the others is no reason to move.
void ActiveSet::note_unwilling(const double* y) {
  const Linearization& at = projector_.linearization();
  const std::size_t n = at.n(), m = at.m();
  const Vector w(at.w.data(), index(n));
  const Eigen::VectorXd b = (Vector(y, index(n)) - Vector(candidate_.data(), index(n))).cwiseQuotient(w);
  Eigen::MatrixXd scaled = Eigen::MatrixXd::Zero(index(n), index(m));  // W Jᵀ
  for (std::size_t i = 0; i < m; ++i)
    if (!projector_.idle(i) && !projector_.left_out(i))
      at.gradient(i).for_each([&](std::size_t j, double value) { scaled(index(j), index(i)) = value * w[index(j)]; });
  Eigen::MatrixXd columns = scaled;
  Eigen::VectorXd wanted = -b;
  for (std::size_t j = 0; j < n; ++j) {
    if (!projector_.fixed(j)) continue;
    columns.row(index(j)).setZero();
    wanted[index(j)] = 0;
  }
  const Eigen::VectorXd lambda = least_squares(columns, wanted);
  const Eigen::VectorXd force = scaled * lambda;
  for (const Bounds::Interval& one : bounds_.intervals()) {
    const auto& [i, lower, upper] = one;
    if (!projector_.fixed(i) || lower == upper) continue;
    const double multiplier = b[index(i)] + force[index(i)];
    const double inwards = y[i] <= lower ? -multiplier : multiplier;
    const double terms = std::abs(b[index(i)]) + std::abs(force[index(i)]);
    if (inwards > std::max(roundoff_of_multiplier * terms, roundoff_at_bound)) wrong_.push_back(&one);
  }
}

/// Checks that the invariants that were left out, some perhaps since the fixed components leave nothing to correct them
/// with, are nearer than they were `before`; if they are not, returns `not_finite`.
Outcome ActiveSet::judge_left_out(double t, const double* y, std::span<const double> before) {
  bool any = false;
  for (std::size_t i = 0; i < residual_.size(); ++i) any = any || projector_.left_out(i);
  if (!any) return Outcome::ok;
  if (projector_.invariants().residual(t, y, residual_.data()) == Status::stop) return Outcome::stop;
  for (std::size_t i = 0; i < residual_.size(); ++i)
    if (projector_.left_out(i) &&
        !(std::abs(residual_[i]) <= std::max(projector_.roundoff(i, y), least_gain * std::abs(before[i]))))
      return Outcome::not_finite;
  return Outcome::ok;
}

Outcome onto_within(Projector& projector, const Bounds& bounds, double t, const double* w, const double* target,
                    double* y, int most) {
  projector.release_all();
  Outcome outcome = Outcome::ok;
  for (int round = 0; round < output_rounds; ++round) {
    for (const Bounds::Interval& one : bounds.intervals())
      if (round > 0 ? outside(one, y) : at_bound(one, y)) projector.fix(one.component);
    bounds.clip(y);
    outcome = projector.onto(t, w, target, y, most);
    if (outcome != Outcome::ok || bounds.contain(y)) break;
  }
  bounds.clip(y);
  projector.release_all();
  return outcome;
}

}  // namespace invariode
