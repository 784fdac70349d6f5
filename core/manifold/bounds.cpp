#include "manifold/bounds.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>

#include "require.hpp"

namespace invariode {

Bounds::Bounds(const std::vector<double>& lower, const std::vector<double>& upper) : n_(lower.size()) {
  require(upper.size() == n_, "lower and upper bounds differ in length");
  for (std::size_t i = 0; i < n_; ++i) {
    require(lower[i] <= upper[i], "a lower bound is above its upper bound, or NaN");
    if (std::isfinite(lower[i]) || std::isfinite(upper[i])) intervals_.push_back({i, lower[i], upper[i]});
  }
}

std::vector<double> Bounds::lower() const {
  std::vector<double> all(n_, -std::numeric_limits<double>::infinity());
  for (const Interval& one : intervals_) all[one.component] = one.lower;
  return all;
}

std::vector<double> Bounds::upper() const {
  std::vector<double> all(n_, std::numeric_limits<double>::infinity());
  for (const Interval& one : intervals_) all[one.component] = one.upper;
  return all;
}

bool Bounds::contain(const double* y) const {
  return std::all_of(intervals_.begin(), intervals_.end(), [y](const Interval& one) {
    return one.lower <= y[one.component] && y[one.component] <= one.upper;
  });
}

Bounds::Excess Bounds::excess(const double* y, const Weights& weights) const {
  assert(weights.size() == n_);
  Excess most;
  for (const auto& [i, lower, upper] : intervals_) {
    const double outside = std::max(lower - y[i], y[i] - upper);
    if (!(outside > 0)) continue;
    const double size = outside / weights.threshold()[i];
    if (size > most.size) most = {size, static_cast<int>(i)};
  }
  return most;
}

double Bounds::clip(double* y) const {
  double added = 0;
  for (const auto& [i, lower, upper] : intervals_) {
    const double inside = std::clamp(y[i], lower, upper);
    added += inside - y[i];
    y[i] = inside;
  }
  return added;
}

bool Bounds::settle(const Weights& weights, double forward, const double* slope, double shortest, double* y) const {
  bool any = false;
  for (const auto& [i, lower, upper] : intervals_) {
    const double end = forward * slope[i] < 0 ? lower : upper;
    const double near = std::max(roundoff_at_bound * weights.threshold()[i], shortest * std::abs(slope[i]));
    const bool there = y[i] != end && std::abs(y[i] - end) <= near;
    if (there) y[i] = end;
    any = any || there;
  }
  return any;
}

bool Bounds::leads_out(const Interval& one, const double* y, double forward, const double* slope) {
  const auto& [i, lower, upper] = one;
  const double s = forward * slope[i];  // NaN leads nowhere
  return (s < 0 && y[i] <= lower) || (s > 0 && y[i] >= upper);
}

BoundedSlope::BoundedSlope(const Callback& f, const Bounds& bounds, double forward, bool of_implicit_method,
                           std::vector<double> mass)
    : f_(f), bounds_(bounds), forward_(forward), by_step_(of_implicit_method), mass_(std::move(mass)) {
  inside_.resize(bounds.intervals().size());
  passed_.resize(bounds.intervals().size());
  slope_.resize(bounds.n());
  if (!by_step_) return;
  rests_.resize(bounds.intervals().size());
  at_bound_.assign(bounds.intervals().size(), 1);  // at the start nothing has come to a bound
}

BoundedSlope::BoundedSlope(const Callback& f, const Bounds& bounds, double forward, DifferentialRate rate)
    : BoundedSlope(f, bounds, forward, true) {
  rates_ = std::move(rate);
  rate_.resize(bounds.n());
}

/// f, and of an M that is not diagonal y', or 0 where M alone does not tell it.
Status BoundedSlope::evaluate(double t, const double* y, double* slope) {
  const Status status = f_(t, y, slope);
  if (status != Status::ok || !rates_ || !all_finite(slope, bounds_.n())) return status;
  bool told = false;
  if (rates_->enter(t, told) == Status::stop) return Status::stop;
  if (told)
    rates_->solve(slope);
  else
    std::fill_n(slope, bounds_.n(), 0);
  return status;
}

Status BoundedSlope::begin_step(double t, const double* y, bool& changed) {
  if (!by_step_) return Status::ok;
  rested_ = rests_;
  const Status status = look(t, y);
  changed = rests_ != rested_;
  return status;
}

/// Finds the components that rest at their bounds at (t, y).
Status BoundedSlope::look(double t, const double* y) {
  bool any = false;
  arrived_ = at_bound_;
  for (std::size_t k = 0; k < rests_.size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    // Which bound: −1, the lower; 1, the upper; of both at once, the lower.
    rests_[k] = y[i] <= lower ? -1 : y[i] >= upper ? 1 : 0;
    at_bound_[k] = rests_[k] != 0;
    arrived_[k] = at_bound_[k] != 0 && arrived_[k] == 0;
    any = any || rests_[k] != 0;
  }
  if (!any) return Status::ok;
  if (evaluate_signs(t, y) == Status::stop) return Status::stop;
  for (std::size_t k = 0; k < rests_.size(); ++k) {
    const Bounds::Interval& one = bounds_.intervals()[k];
    const bool stays = slope_[one.component] == 0 && (arrived_[k] != 0 || rested_[k] != 0);
    if (!stays && !Bounds::leads_out(one, y, forward_, slope_.data())) rests_[k] = 0;
  }
  return Status::ok;
}

/// The slopes of bounded components, but for positive factors.
Status BoundedSlope::evaluate_signs(double t, const double* y) {
  ++evaluations_;
  if (evaluate(t, y, slope_.data()) == Status::stop) return Status::stop;
  for (const Bounds::Interval& one : bounds_.intervals()) slope_[one.component] *= mass(one.component);
  return Status::ok;
}

Status BoundedSlope::find_arrived(double t, Extent extent, const double* Y0, const double* Y1,
                                  std::vector<std::size_t>& arrived, bool& changed) {
  arrived.clear();
  changed = false;
  if (by_step_ && extent.k == 0) return Status::ok;   // `begin_step` sees it
  std::vector<std::pair<std::size_t, double>> there;  // with the sense of what leads out
  for (std::size_t k = 0; k < bounds_.intervals().size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    if (lower < Y1[i] && Y1[i] < upper) continue;
    bool rests = by_step_ && rests_[k] != 0;
    if (!by_step_) {  // a component that rests in a step with an explicit method, and its S, do not change
      rests = true;
      for (std::size_t j = 0; j <= extent.k; ++j) rests = rests && Y0[j * extent.n + i] == Y1[j * extent.n + i];
    }
    if (!rests) there.emplace_back(i, Y1[i] <= lower ? -forward_ : forward_);
  }
  if (there.empty()) return Status::ok;
  if (evaluate_signs(t, Y1) == Status::stop) return Status::stop;
  for (const auto& [i, outward] : there) {
    if (!(outward * slope_[i] >= 0)) continue;
    arrived.push_back(i);
    changed = changed || slope_[i] != 0 || extent.k > 0;
  }
  return Status::ok;
}

void BoundedSlope::state(Archive& archive) {
  archive(rests_, at_bound_, evaluations_);
  archive.resizable(held_);
  for (const std::size_t i : held_) archive.require(i < bounds_.n());
}

/// The components that rest at a bound in this step, and that the slope would lead out.
void BoundedSlope::find_held(const double* slope) {
  held_.clear();
  for (std::size_t k = 0; k < rests_.size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    const double s = forward_ * slope[i] * mass(i);
    const bool leads_out = rests_[k] * s > 0 || lower == upper;
    if (rests_[k] != 0 && mass(i) != 0 && leads_out) held_.push_back(i);
  }
}

/// The components at or beyond a bound that the slope would lead out, but those that follow f there in this step.
void BoundedSlope::find_outward(const double* y, const double* slope) {
  for (std::size_t k = 0; k < inside_.size(); ++k) {
    const Bounds::Interval& one = bounds_.intervals()[k];
    if (!Bounds::leads_out(one, y, forward_, slope)) continue;
    const double value = y[one.component];
    if (inside_[k] != 0)
      passed_[k] = std::max({passed_[k], one.lower - value, value - one.upper});
    else
      held_.push_back(one.component);
  }
}

void BoundedSlope::start_at(const double* y) {
  for (std::size_t k = 0; k < inside_.size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    inside_[k] = lower < y[i] && y[i] < upper;
    passed_[k] = 0;
  }
}

Bounds::Excess BoundedSlope::passed(const Weights& weights) const {
  Bounds::Excess most;
  for (std::size_t k = 0; k < passed_.size(); ++k) {
    const std::size_t i = bounds_.intervals()[k].component;
    const double size = passed_[k] / weights.threshold()[i];
    if (size > most.size) most = {size, static_cast<int>(i)};
  }
  return most;
}

double BoundedSlope::settle_held(const Weights& weights, double* y) const {
  double most = 0;
  for (std::size_t k = 0; k < rests_.size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    if (rests_[k] == 0 || std::ranges::find(held_, i) == held_.end()) continue;
    const double end = rests_[k] < 0 ? lower : upper;
    const double distance = std::abs(y[i] - end) / weights.threshold()[i];
    if (!(distance <= weights.rtol())) continue;
    y[i] = end;
    most = std::max(most, distance);
  }
  return most;
}

void BoundedSlope::release(const double* y) {
  for (std::size_t k = 0; k < rests_.size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    if (lower < y[i] && y[i] < upper) rests_[k] = 0;
  }
}

void BoundedSlope::rest(double* f) {
  if (!rates_) {
    for (const std::size_t i : held_) f[i] = 0;
    return;
  }
  if (held_.empty()) return;
  std::vector<double> removed(rate_.size(), 0);
  std::copy_n(f, rate_.size(), rate_.data());
  rates_->solve(rate_.data());
  for (const std::size_t i : held_) removed[i] = rate_[i];
  rates_->subtract(removed.data(), f);
}

Status BoundedSlope::entry(void* self, double t, const double* y, double* out) {
  auto& bounded = *static_cast<BoundedSlope*>(self);
  const Status status = bounded.f_(t, y, out);
  if (status != Status::ok) return status;
  const bool any_rests = std::ranges::any_of(bounded.rests_, [](char side) { return side != 0; });
  bounded.held_.clear();
  if (bounded.rates_) {
    bool told = false;
    if (!any_rests || !all_finite(out, bounded.bounds_.n())) return status;
    if (bounded.rates_->enter(t, told) == Status::stop) return Status::stop;
    if (!told) return status;
    std::copy_n(out, bounded.rate_.size(), bounded.rate_.data());
    bounded.rates_->solve(bounded.rate_.data());
    bounded.find_held(bounded.rate_.data());
  } else if (bounded.by_step_) {
    if (any_rests) bounded.find_held(out);
  } else {
    bounded.find_outward(y, out);
  }
  bounded.rest(out);
  return status;
}

}  // namespace invariode
