#include "detect/below_zero.hpp"

#include <algorithm>

namespace invariode {
namespace {

constexpr double unwatched = std::numeric_limits<double>::infinity();
// f leads a component below 0 if at y_i = 0 it accounts for this part of the descent in a step. The rest is growth of
// what was below 0 already, or roundoff of terms that cancel.
constexpr double part_of_descent = 1e-3;

/// Oscillating components fall again and again, and each is judged at its first fall: for some, that is not enough.
constexpr bool may_judge(std::int64_t attempts, std::int64_t evaluations) { return evaluations <= 64 + attempts / 4; }

}  // namespace

Status BelowZero::judge(const Step& step, double* watch, std::int64_t& evaluations) {
  const auto& [t0, t1, y0, y1, stride, attempts] = step;
  for (std::size_t i = 0; i < weights_.size(); ++i) {
    double& one = watch[i * stride];
    const double before = y0[i * stride], after = y1[i * stride];
    if (!falls(one, before, after)) continue;
    if (!may_judge(attempts, evaluations)) return Status::ok;
    const double least = part_of_descent * (before - after) / std::abs(t1 - t0);
    bool leads = false;
    for (const auto& [t, y] : {std::pair(t0, y0), std::pair(t1, y1)}) {
      if (leads) break;
      ++evaluations;
      if (lead_down(t, y, stride, i, least, leads) == Status::stop) return Status::stop;
    }
    one = leads ? unwatched : -std::abs(one);
  }
  return Status::ok;
}

/// Finds out whether f, near y, leads component i from 0 downwards.
Status BelowZero::lead_down(double t, const double* y, std::size_t stride, std::size_t i, double least, bool& leads) {
  const std::size_t n = weights_.size();
  work_.resize(2 * n);
  double *point = work_.data(), *slope = point + n;
  for (std::size_t j = 0; j < n; ++j) point[j] = y[j * stride];
  point[i] = 0;
  if (f_(t, point, slope) == Status::stop) return Status::stop;
  leads = true;  // as far as can be told
  if (rate_) {
    bool told = false;
    if (rate_->enter(t, told) == Status::stop) return Status::stop;
    if (!told || !all_finite(slope, n)) return Status::ok;
    rate_->solve(slope);
  }
  leads = !(forward_ * slope[i] >= -least);
  return Status::ok;
}

Component BelowZero::deepest(std::size_t n, const double* y, const double* watch, std::size_t stride) {
  Component found;
  double most = 1;
  for (std::size_t i = 0; i < n; ++i) {
    const double depth = y[i * stride] / watch[i * stride];  // both are below 0
    const bool deeper = watch[i * stride] < 0 && depth > most;
    if (!deeper) continue;
    most = depth;
    found = {static_cast<int>(i), y[i * stride], 0};
  }
  return found;
}

void BelowZero::start(const double* y, const std::vector<double>& lower) {
  watch_.assign(weights_.size(), unwatched);
  if (!watches_) return;
  for (std::size_t i = 0; i < watch_.size(); ++i)
    if (y[i] >= 0 && (lower.empty() || !std::isfinite(lower[i]))) watch_[i] = depth(weights_.absolute_tolerance(i));
}

void BelowZero::jump(const double* y) {
  for (std::size_t i = 0; i < watch_.size(); ++i)
    if (watch_[i] > 0 && y[i] < 0) watch_[i] = unwatched;
}

void BelowZero::state(Archive& archive) {
  watch_.resize(weights_.size(), unwatched);
  archive(watch_, evaluations_);
  if (!watches_) std::ranges::fill(watch_, unwatched);
}

}  // namespace invariode
