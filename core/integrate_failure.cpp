// Why attempts fail however small h is.

#include <algorithm>
#include <cmath>

#include "integrate.hpp"

namespace invariode {

/// Finds the reason why attempts fail however small h is. `ended`: a user function has stopped the run meanwhile.
Integration::Course Integration::explain_failure(Cause cause) {
  report_.t = t0_;
  report_.h = aim_.h();
  report_.cause = cause;
  report_.linear = step_->linear_work();
  if (cause == Cause::not_finite || cause == Cause::newton) {
    report_.component = step_->undefined_component();
    report_.coefficient = step_->undefined_coefficient();
  }
  if (cause == Cause::projection && manifold_.undefined() >= 0)
    report_.finding = {.kind = Finding::Kind::undefined, .invariant = manifold_.undefined(), .t = aim_.t1()};
  if (cause == Cause::bounds) report_.component = manifold_.outside_component();
  if (report_.linear.unsolved != Unsolved::none) return Course::goes_on;
  note_fastest();
  const bool undefined = cause == Cause::not_finite ||
                         (cause == Cause::newton && (report_.component >= 0 || report_.linear.undefined_jacobian));
  if (undefined) return find_undefined_below_zero();
  if (cause != Cause::error && cause != Cause::newton) return Course::goes_on;
  if (cause == Cause::error) note_pure_relative();
  if (aim_.hmin() < hmin_ulps * ulp(t0_)) {  // the method has just started
    bool changes = false;
    if (ended(unless_stopped(discontinuities_.changes_at_once(t0_, y0_.data(), step_->slope(), forward_, 0, changes))))
      return Course::ended;
    if (changes) report_.cause = Cause::spacing;
    if (changes) return Course::goes_on;
  }
  return unless_stopped(discontinuities_.gave_up(t0_, y0_.data(), step_->slope(), aim_.t1(), aim_.target()));
}

/// Reports a component for whose negative values f is not finite.
Integration::Course Integration::find_undefined_below_zero() {
  constexpr double near = 0.1;  // of the time since the start: the solution is about to get there
  const std::vector<double> lower = lower_bounds();
  const double reach = std::max(near * std::abs(t0_ - settings_.t0), aim_.hmin());
  int found = -1;
  if (ended(unless_stopped(
          discontinuities_.undefined_below_zero(t0_, y0_.data(), step_->slope(), forward_, reach, lower, found))))
    return Course::ended;
  if (found >= 0) {
    const auto i = static_cast<std::size_t>(found);
    report_.undefined_below_zero = {found, y0_[i], step_->slope()[i]};
  }
  return Course::goes_on;
}

std::vector<double> Integration::lower_bounds() const {
  return manifold_.bounds() == nullptr ? std::vector<double>{} : manifold_.bounds()->lower();
}

/// Reports the component of y that changes most within the smallest step, in units of its tolerance.
void Integration::note_fastest() {
  const double h = std::abs(aim_.hmin());
  double most = 1;
  for (std::size_t i = 0; i < weights_.size(); ++i) {
    const double rate = step_->slope()[i], change = h * std::abs(rate) / (weights_.rtol() * weights_.at(i, y0_[i]));
    if (!(change > most)) continue;
    most = change;
    report_.fastest = {static_cast<int>(i), y0_[i], rate};
  }
}

/// Reports the first component that is zero and has no absolute tolerance: no error of it is small enough.
void Integration::note_pure_relative() {
  for (std::size_t i = 0; i < weights_.size() && !report_.pure_relative; ++i)
    if (weights_.pure_relative(i) && y0_[i] == 0) {
      report_.pure_relative = true;
      report_.component = static_cast<int>(i);
    }
}

}  // namespace invariode
