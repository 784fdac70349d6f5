#include "linear/jacobian_check.hpp"

#include <algorithm>
#include <cmath>

#include "linear/scattered.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

constexpr double tolerated = 0.01;    // of a row: what Newton's iteration then loses in its rate hardly counts
constexpr double noise_of_f = 10;     // ε |f_i| and ε |J_ij y_j|: what an evaluation of f may be off,
constexpr double noise_of_entry = 4;  // and what that does to each entry by differences

}  // namespace

JacobianCheck::Verdict JacobianCheck::examine(Callback& f, double t, const double* y, const double* slope,
                                              const Matrix& J, const double* reach, std::size_t turn, const Box& box) {
  const std::size_t n = point_.size();
  if (!all_finite(slope, n)) return Verdict::right;
  for (std::size_t j = 0; j < n; ++j) {
    const double part = 2 * scattered(j + n * turn) - 1;
    const double moved = y[j] + (part < 0 ? part - 1 : part + 1) / 2 * reach[j];  // by half of it at least
    direction_[j] = box.turned(j, y[j], moved - y[j]);
    product_[j] = size_[j] = terms_[j] = entries_[j] = 0;
  }
  J.for_each([&](std::size_t i, std::size_t j, double value) {
    product_[i] += value * direction_[j];
    size_[i] += std::abs(value * direction_[j]);
    terms_[i] += std::abs(value * y[j]);
    entries_[i] += 1;
  });
  if (move(f, t, y, slope, 1, change_.data()) == Status::stop) return Verdict::stop;
  const bool ahead = all_finite(change_.data(), n);
  if (ahead && agrees(slope)) return Verdict::right;
  for (std::size_t j = 0; box && j < n; ++j)
    if (!box.contains(j, y[j] - direction_[j])) return Verdict::right;
  // Once more to the other side: of the mean of both the curvature of f is no part.
  if (move(f, t, y, slope, -1, back_.data()) == Status::stop) return Verdict::stop;
  if (!all_finite(back_.data(), n)) return Verdict::right;
  for (std::size_t i = 0; i < n; ++i) change_[i] = ahead ? (change_[i] - back_[i]) / 2 : -back_[i];
  return agrees(slope) ? Verdict::right : Verdict::wrong;
}

Status JacobianCheck::move(Callback& f, double t, const double* y, const double* slope, double side, double* change) {
  for (std::size_t j = 0; j < point_.size(); ++j) point_[j] = y[j] + side * direction_[j];
  if (f(t, point_.data(), change) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < point_.size(); ++i) change[i] -= slope[i];
  return Status::ok;
}

bool JacobianCheck::agrees(const double* slope) const {
  for (std::size_t i = 0; i < change_.size(); ++i) {
    const double noise = eps * (noise_of_f + noise_of_entry * entries_[i]) * (std::abs(slope[i]) + terms_[i]);
    const double allowed = tolerated * std::max(size_[i], std::abs(change_[i])) + noise;
    if (!(std::abs(change_[i] - product_[i]) <= allowed)) return false;
  }
  return true;
}

}  // namespace invariode
