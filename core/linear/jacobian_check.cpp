#include "linear/jacobian_check.hpp"

#include <algorithm>
#include <cmath>

#include "linear/scattered.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

constexpr double tolerated = 0.01;   // of a row: what Newton's iteration then loses in its rate hardly counts
constexpr double misleading = 0.8;   // of a row: Newton's iteration would converge at this rate, too slowly to be seen
constexpr double closer = 1.0 / 16;  // part of v for a second look, at which the curvature of f is that much smaller
constexpr double nearly_linear = 0.25;
constexpr double noise_of_f = 10;              // ε |f_i| and ε |J_ij y_j|: what an evaluation of f may be off,
constexpr double noise_of_entry = 4;           // and what that does to each entry by differences
constexpr std::size_t returned_n = 1U << 16U;  // vectors that an allocator returns to the system

}  // namespace

/// Every component moves by half of its reach at least, to the side of the sign that is chosen for (j, a random
/// number), unless that leads out of the box.
template <class Sign>
void JacobianCheck::aim(const double* y, const Matrix& J, const double* reach, std::size_t turn, const Box& box,
                        Sign sign) {
  for (std::vector<double>* one : {&direction_, &point_, &change_, &back_, &product_, &size_, &terms_, &entries_})
    one->resize(n_);
  for (std::size_t j = 0; j < n_; ++j) {
    const double part = 2 * scattered(j + n_ * turn) - 1, length = (1 + std::abs(part)) / 2 * reach[j];
    const double moved = y[j] + (sign(j, part) < 0 ? -length : length);
    direction_[j] = box.turned(j, y[j], moved - y[j]);
    product_[j] = size_[j] = terms_[j] = entries_[j] = 0;
  }
  J.for_each([&](std::size_t i, std::size_t j, double value) {
    product_[i] += value * direction_[j];
    size_[i] += std::abs(value * direction_[j]);
    terms_[i] += std::abs(value * y[j]);
    entries_[i] += 1;
  });
}

JacobianCheck::Verdict JacobianCheck::examine(Callback& f, double t, const double* y, const double* slope,
                                              const Matrix& J, const double* reach, std::size_t turn, const Box& box) {
  const std::size_t n = n_;
  if (!all_finite(slope, n)) return Verdict::right;
  aim(y, J, reach, turn, box, [](std::size_t, double part) { return part; });
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

double JacobianCheck::noise(std::size_t i, const double* slope) const {
  return eps * (noise_of_f + noise_of_entry * entries_[i]) * (std::abs(slope[i]) + terms_[i]);
}

bool JacobianCheck::agrees(const double* slope) const {
  for (std::size_t i = 0; i < change_.size(); ++i) {
    const double allowed = tolerated * std::max(size_[i], std::abs(change_[i])) + noise(i, slope);
    if (!(std::abs(change_[i] - product_[i]) <= allowed)) return false;
  }
  return true;
}

/// All components move to the side to which the differences move them: where f is not defined everywhere, it is there.
JacobianCheck::Fit JacobianCheck::fit(Callback& f, double t, const double* y, const double* slope, const Matrix& J,
                                      const double* reach, std::size_t turn, const Box& box, bool scattered) {
  const std::size_t n = n_;
  if (!all_finite(slope, n)) return Fit::good;
  aim(y, J, reach, turn, box, [=](std::size_t j, double part) { return scattered ? part : slope[j]; });
  if (!all_finite(size_.data(), n)) return Fit::good;
  if (move(f, t, y, slope, 1, change_.data()) == Status::stop) return Fit::stop;
  if (!all_finite(change_.data(), n) || !misleads(slope)) return Fit::good;
  if (move(f, t, y, slope, closer, back_.data()) == Status::stop) return Fit::stop;
  return all_finite(back_.data(), n) ? judge(slope) : Fit::good;
}

/// Returns whether the change of f_i along that part of v differs from the prediction of J, Σ J_ij v_j.
bool JacobianCheck::misleads(std::size_t i, double change, double part, const double* slope) const {
  const double allowed = misleading * std::max(part * size_[i], std::abs(change)) + noise(i, slope);
  return std::abs(change - part * product_[i]) > allowed;
}

bool JacobianCheck::misleads(const double* slope) const {
  for (std::size_t i = 0; i < change_.size(); ++i)
    if (misleads(i, change_[i], 1, slope)) return true;
  return false;
}

/// Returns whether J predicts less than half of the change of f_i, which costs steps only.
bool JacobianCheck::understates(std::size_t i) const { return std::abs(product_[i]) < 0.5 * std::abs(change_[i]); }

/// Judges by both looks. Of rows that do not fit, one that J overstates is taken, if there is one. (A J that is too
/// small where f bends, as that of y² is at 0, fails Newton's iteration visibly, if at all.)
JacobianCheck::Fit JacobianCheck::judge(const double* slope) {
  Fit fit = Fit::good;
  for (std::size_t i = 0; i < change_.size(); ++i) {
    if (!misleads(i, change_[i], 1, slope) || !misleads(i, back_[i], closer, slope)) continue;
    const double far = change_[i], near = back_[i] / closer;
    const bool linear = std::abs(far - near) <= nearly_linear * std::abs(far) + noise(i, slope) / closer;
    if (!linear && size_[i] > std::abs(far)) return Fit::bent;
    if (!linear || (fit == Fit::wrong && !understates(row_))) continue;
    fit = Fit::wrong;
    row_ = i;
  }
  return fit;
}

void JacobianCheck::rest() {
  if (n_ < returned_n) return;
  for (std::vector<double>* one : {&direction_, &point_, &change_, &back_, &product_, &size_, &terms_, &entries_})
    *one = std::vector<double>();
}

double JacobianCheck::size(const Matrix& J, const double* w) {
  size_.assign(n_, 0);
  J.for_each([&](std::size_t i, std::size_t j, double value) { size_[i] += std::abs(value) * w[j]; });
  return max_norm(size_.size(), [this, w](std::size_t i) { return size_[i] / w[i]; });
}

}  // namespace invariode
