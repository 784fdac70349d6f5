#include "manifold/bounds.hpp"

#include <algorithm>
#include <array>
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
  range_.resize(bounds.intervals().size());
  slope_.resize(bounds.n());
  removed_.resize(bounds.n());
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

Status BoundedSlope::find_arrived(double t, std::span<const double> Y0, const double* Y1,
                                  std::vector<std::size_t>& arrived, bool& changed) {
  const std::size_t n = bounds_.n(), all = Y0.size();
  arrived.clear();
  changed = false;
  if (by_step_ && all == n) return Status::ok;        // `begin_step` sees it
  std::vector<std::pair<std::size_t, double>> there;  // with the sense of what leads out
  for (std::size_t k = 0; k < bounds_.intervals().size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    if (lower < Y1[i] && Y1[i] < upper) continue;
    bool rests = by_step_ && rests_[k] != 0;
    if (!by_step_) {  // a component that rests in a step with an explicit method, and its S, do not change
      rests = true;
      for (std::size_t at = i; at < all; at += n) rests = rests && Y0[at] == Y1[at];
    }
    if (!rests) there.emplace_back(i, Y1[i] <= lower ? -forward_ : forward_);
  }
  if (there.empty()) return Status::ok;
  if (evaluate_signs(t, Y1) == Status::stop) return Status::stop;
  for (const auto& [i, outward] : there) {
    if (!(outward * slope_[i] >= 0)) continue;
    arrived.push_back(i);
    changed = changed || slope_[i] != 0 || all > n;
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
    if (inside_[k] == 0 && Bounds::leads_out(one, y, forward_, slope)) held_.push_back(one.component);
  }
}

void BoundedSlope::Range::add(const Bounds::Interval& one, double y, double slope) {
  lowest = std::min(lowest, slope);
  highest = std::max(highest, slope);
  if (slope < 0) to_lower = std::min(to_lower, (one.lower - y) / slope);
  if (slope > 0) to_upper = std::min(to_upper, (one.upper - y) / slope);
}

void BoundedSlope::note(double t, const double* y, const double* slope) {
  times_.push_back(t);
  for (std::size_t k = 0; k < range_.size(); ++k) {
    const Bounds::Interval& one = bounds_.intervals()[k];
    const double m = mass(one.component);
    if (m != 0) range_[k].add(one, y[one.component], forward_ * slope[one.component] / m);
  }
}

void BoundedSlope::start_at(const double* y) {
  for (std::size_t k = 0; k < inside_.size(); ++k) {
    const auto& [i, lower, upper] = bounds_.intervals()[k];
    inside_[k] = lower < y[i] && y[i] < upper;
    range_[k] = {};
  }
  times_.clear();
  visited_ = {};
}

namespace {

constexpr double beside_end = 1e-6;  // θ at which a difference from an end of the step tells its slope
constexpr int halvings_to_landing = 40;
constexpr int halvings_to_way = 10;
constexpr int parabolas = 4;  // to a peak between points

/// A point b between a and c at which a function is largest, and the values there.
struct Peak {
  double a, b, c, ea, eb, ec;

  /// The parabola through the three: how far its vertex is from b, and above it.
  [[nodiscard]] std::array<double, 2> vertex() const {
    const double p = (b - a) * (eb - ec), q = (c - b) * (eb - ea), divisor = 2 * (p + q);
    if (!(divisor > 0)) return {0, 0};
    const double move = ((c - b) * q - (b - a) * p) / divisor;
    const double bend = ((eb - ea) / (b - a) + (eb - ec) / (c - b)) / (c - a);
    return {move, bend * move * move};
  }
  /// Returns whether the function may exceed a value there, though it is no parabola.
  [[nodiscard]] bool may_exceed(double value) const {
    constexpr double room = 4;
    return eb > value || eb + room * vertex()[1] > value;
  }
  /// Takes the vertex of the parabola as one of the points.
  template <class Function>
  void narrow(Function f) {
    const double x = b + vertex()[0];
    const bool between = a < x && x < c;
    if (!between || x == b) return;
    const double e = f(x);
    if (e >= eb) {
      (x > b ? a : c) = b, (x > b ? ea : ec) = eb;
      b = x, eb = e;
    } else {
      (x > b ? c : a) = x, (x > b ? ec : ea) = e;
    }
  }
};

/// Returns whether a component may get out and back within h: `before` and `after` are its distances inside at the
/// ends, `out` and `back` the largest speeds at which it moves.
bool may_be_outside(double before, double out, double after, double back, double h) {
  const double left = h - before / std::max(out, 0.0);
  return left > 0 && (after <= 0 || after < std::max(back, 0.0) * left);
}

}  // namespace

/// A component that leaves the bound again between two times at which f was seen would, with the slope at the first of
/// them, have come to it before the second: a parabola that touches it takes twice as long.
bool BoundedSlope::may_visit(double t0, double h, const Weights& weights, const double* y0, const double* slope,
                             const double* y1) {
  const double length = std::abs(h);
  double gap = 0;  // between times at which f was seen
  for (std::size_t k = 0; k < range_.size(); ++k) {
    const Bounds::Interval& one = bounds_.intervals()[k];
    const std::size_t i = one.component;
    if (rests(k) || mass(i) == 0) continue;
    if (rates_ || ends_alone_) return true;
    Range range = range_[k];
    range.add(one, y0[i], forward_ * slope[i]);
    const double tolerance = weights.rtol() * weights.threshold()[i];
    const double lower = one.lower - tolerance, upper = one.upper + tolerance;
    const bool below = may_be_outside(y0[i] - lower, -range.lowest, y1[i] - lower, range.highest, length);
    const bool above = may_be_outside(upper - y0[i], range.highest, upper - y1[i], -range.lowest, length);
    if (!below && !above) continue;
    if (gap == 0) {
      times_.insert(times_.end(), {t0, t0 + h});
      std::ranges::sort(times_);
      for (std::size_t j = 1; j < times_.size(); ++j) gap = std::max(gap, times_[j] - times_[j - 1]);
    }
    if ((below && (y1[i] <= lower || range.to_lower < gap)) || (above && (y1[i] >= upper || range.to_upper < gap)))
      return true;
  }
  return false;
}

Status BoundedSlope::find_visit(const Extension& extension, const Weights& weights, const double* y0, double& landing) {
  landing = 1;
  const double rtol = weights.rtol();
  theta_.assign({0, beside_end});
  for (std::size_t j = 1; j < extension.parts; ++j)
    theta_.push_back(static_cast<double>(j) / static_cast<double>(extension.parts));
  theta_.insert(theta_.end(), {1 - beside_end, 1});
  const std::size_t last = theta_.size() - 1;
  values_.resize(theta_.size() * extension.size);
  point_.resize(extension.size);
  excess_.resize(theta_.size());
  extension.values(theta_, values_.data());
  std::copy(y0, y0 + extension.size, values_.begin());
  for (std::size_t k = 0; k < range_.size(); ++k) {
    const Bounds::Interval one = bounds_.intervals()[k];
    if (rests(k) || mass(one.component) == 0) continue;
    const auto outside = [&](const double* y) {
      const double value = y[one.component];
      return std::max(one.lower - value, value - one.upper) / weights.threshold()[one.component];
    };
    const auto at = [&](double x) {
      extension.values({&x, 1}, point_.data());
      return outside(point_.data());
    };
    // Returns the first x between a and b at which the component is outside by `size`, or one a little later.
    const auto first = [&](double a, double b, double size, int halvings) {
      for (int i = 0; i < halvings; ++i) {
        const double middle = (a + b) / 2;
        (at(middle) > size ? b : a) = middle;
      }
      return b;
    };
    for (std::size_t j = 0; j <= last; ++j) excess_[j] = outside(values_.data() + j * extension.size);
    double inside = 0;  // the last θ at which the component is inside
    for (std::size_t j = 1; j <= last; ++j) {
      double x = theta_[j], most = excess_[j];
      if (j < last && most >= excess_[j - 1] && most >= excess_[j + 1]) {
        Peak peak{theta_[j - 1], x, theta_[j + 1], excess_[j - 1], most, excess_[j + 1]};
        for (int i = 0; i < parabolas && peak.may_exceed(rtol); ++i) peak.narrow(at);
        x = peak.b, most = peak.eb;
      }
      if (most > rtol) {
        const double way = first(inside, x, (rtol + most) / 2, halvings_to_way);  // half as far outside
        at(way);
        if (evaluate_signs(extension.t0 + way * extension.h, point_.data()) == Status::stop) return Status::stop;
        if (Bounds::leads_out(one, point_.data(), forward_, slope_.data())) {
          if (j < last && most > visited_.size) visited_ = {most, static_cast<int>(one.component)};
          landing = std::min(landing, first(inside, x, rtol / 2, halvings_to_landing));
          break;
        }
      }
      if (excess_[j] <= rtol / 2) inside = theta_[j];
    }
  }
  return Status::ok;
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
  bounded.note(t, y, out);
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
  for (const std::size_t i : bounded.held_)
    bounded.removed_[i] = bounded.rates_ ? bounded.rate_[i] : out[i] / bounded.mass(i);
  bounded.rest(out);
  return status;
}

}  // namespace invariode
