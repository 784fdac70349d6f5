#include "manifold/bounds.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>

namespace invariode {

Bounds::Bounds(const std::vector<double>& lower, const std::vector<double>& upper) : n_(lower.size()) {
  if (upper.size() != n_) throw std::invalid_argument("lower and upper bounds differ in length");
  for (std::size_t i = 0; i < n_; ++i) {
    if (!(lower[i] <= upper[i])) throw std::invalid_argument("a lower bound is above its upper bound, or NaN");
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

void Bounds::remove_outward(const double* y, double forward, double* slope) const {
  for (const auto& [i, lower, upper] : intervals_) {
    const bool leaves = forward * slope[i] < 0 ? y[i] <= lower : y[i] >= upper;
    if (leaves && slope[i] != 0) slope[i] = 0;  // NaN stays: neither comparison holds for it
  }
}

Status BoundedSlope::entry(void* self, double t, const double* y, double* out) {
  auto& bounded = *static_cast<BoundedSlope*>(self);
  const Status status = bounded.f_(t, y, out);
  if (status == Status::ok) bounded.bounds_.remove_outward(y, bounded.forward_, out);
  return status;
}

}  // namespace invariode
