#include "invariants.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace invariode {
namespace {

const double cbrt_eps = std::cbrt(eps);    // optimal relative increment of a central difference
constexpr double roundoff_units = 10;      // of ε: what an evaluation of g may be off (docs/algorithms.md, 'impose')
constexpr double smallest_scale = 1e-300;  // |y_i| and thr_i below this tell no scale

}  // namespace

Invariants::Invariants(std::size_t n, std::vector<InvariantBlock> blocks, std::vector<double> value,
                       const Weights& weights)
    : n_(n),
      blocks_(std::move(blocks)),
      value_(std::move(value)),
      weights_(weights),
      point_(n),
      plus_(value_.size()),
      minus_(value_.size()) {
  for (const InvariantBlock& block : blocks_) {
    by_differences_.insert(by_differences_.end(), block.m, !block.jacobian);
    certain_.insert(certain_.end(), block.m, block.certain);
  }
}

std::int64_t Invariants::calls() const {
  std::int64_t sum = 0;
  for (const InvariantBlock& block : blocks_) sum += block.g.calls();
  return sum;
}

std::int64_t Invariants::jacobian_calls() const {
  std::int64_t sum = 0;
  for (const InvariantBlock& block : blocks_) sum += block.jacobian.calls();
  return sum;
}

bool Invariants::all_by_differences() const {
  return std::all_of(by_differences_.begin(), by_differences_.end(), [](char d) { return d != 0; });
}

Status Invariants::residual(double t, const double* y, double* r) {
  double* out = r;
  for (InvariantBlock& block : blocks_) {
    if (block.g(t, y, out) == Status::stop) return Status::stop;
    out += block.m;
  }
  for (std::size_t i = 0; i < m(); ++i) r[i] -= value_[i];
  return Status::ok;
}

Status Invariants::jacobian(double t, const double* y, double* J) {
  bool missing = false;
  double* rows = J;
  for (InvariantBlock& block : blocks_) {
    if (!block.jacobian)
      missing = true;
    else if (block.jacobian(t, y, rows) == Status::stop)
      return Status::stop;
    rows += block.m * n_;
  }
  return missing ? difference_jacobian(t, y, J, false) : Status::ok;
}

double Invariants::increment(std::size_t j, const double* y) const {
  double scale = weights_.at(j, y[j]);
  if (scale < smallest_scale) {  // pure relative control at y_j = 0
    for (std::size_t i = 0; i < n_; ++i) scale = std::max(scale, std::abs(y[i]));
    if (scale < smallest_scale) scale = 1;
  }
  return cbrt_eps * scale;
}

Status Invariants::difference_jacobian(double t, const double* y, double* J, bool all_rows, double factor) {
  std::copy(y, y + n_, point_.begin());
  std::size_t first = 0;
  for (InvariantBlock& block : blocks_) {
    if (all_rows || !block.jacobian)
      for (std::size_t j = 0; j < n_; ++j)
        if (difference_column(block, t, y, j, factor, J + first * n_ + j) == Status::stop) return Status::stop;
    first += block.m;
  }
  return Status::ok;
}

/// Column j of a block's Jacobian, into entries n apart. Where g is not defined that far away (log y_j, with y_j below
/// its thr_j), the increment is taken relative to y_j itself.
Status Invariants::difference_column(InvariantBlock& block, double t, const double* y, std::size_t j, double factor,
                                     double* column) {
  for (const double delta : {factor * increment(j, y), factor * cbrt_eps * std::abs(y[j])}) {
    if (delta == 0) break;
    const double up = y[j] + delta, down = y[j] - delta;
    point_[j] = up;
    if (block.g(t, point_.data(), plus_.data()) == Status::stop) return Status::stop;
    point_[j] = down;
    if (block.g(t, point_.data(), minus_.data()) == Status::stop) return Status::stop;
    point_[j] = y[j];
    for (std::size_t i = 0; i < block.m; ++i) column[i * n_] = (plus_[i] - minus_[i]) / (up - down);
    if (all_finite(plus_.data(), block.m) && all_finite(minus_.data(), block.m)) break;
  }
  return Status::ok;
}

Status Invariants::time_derivative(double t, double h, const double* y, const double* J, double* gt, double factor) {
  const double delta = factor * cbrt_eps * std::max(std::abs(t), std::abs(h));
  const double later = t + delta, earlier = t - delta;
  if (residual(later, y, plus_.data()) == Status::stop) return Status::stop;
  if (residual(earlier, y, minus_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m(); ++i) {
    const double change = plus_[i] - minus_[i];
    gt[i] = std::abs(change) <= 2 * roundoff(i, y, J) ? 0 : change / (later - earlier);
  }
  return Status::ok;
}

double Invariants::roundoff(std::size_t i, const double* y, const double* J) const {
  double size = std::abs(value_[i]);
  for (std::size_t j = 0; j < n_; ++j) size += std::abs(J[i * n_ + j] * y[j]);
  return roundoff_units * eps * size;
}

}  // namespace invariode
