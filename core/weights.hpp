#pragma once
// Tolerances, the weights they define, and the norm of the error test (docs/algorithms.md, 'Tolerances').

#include <algorithm>
#include <bit>
#include <cassert>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

namespace invariode {

inline constexpr double eps = std::numeric_limits<double>::epsilon();
inline constexpr double cbrt_eps =
    6.0554544523933395e-06;  // ε^{1/3}: the best relative increment of central differences

/// |y_i| and tolerances below this give no scale for increments: 1e-40 of it, a complex step, must not underflow.
inline constexpr double smallest_scale = 1e-250;

/// Spacing of doubles at |t|. (The next one has the next bits.)
inline double ulp(double t) {
  const double a = std::abs(t);
  return std::bit_cast<double>(std::bit_cast<std::uint64_t>(a) + 1) - a;
}

/// Returns whether all n values are finite: 0 · x is 0 for those, NaN for the others. (Four sums, so that none waits
/// for the one before.)
inline bool all_finite(const double* v, std::size_t n) {
  double sum[4] = {0, 0, 0, 0};
  std::size_t i = 0;
  for (; i + 4 <= n; i += 4)
    for (std::size_t j = 0; j < 4; ++j) sum[j] += 0 * v[i + j];
  for (; i < n; ++i) sum[0] += 0 * v[i];
  return sum[0] + sum[1] + sum[2] + sum[3] == 0;
}

/// Max of |values| that lets NaN through: the bits of numbers without a sign are in their order, with NaN last.
class MaxNorm {
 public:
  void add(double a) { bits_ = std::max(bits_, std::bit_cast<std::uint64_t>(std::abs(a))); }
  [[nodiscard]] double value() const { return std::bit_cast<double>(bits_); }

 private:
  std::uint64_t bits_ = 0;
};

/// The terms that `add_blocks` takes at a time.
inline constexpr std::size_t block_of_norm = 64;

/// Adds term(i) to `norm` block by block, up to the returned i ≤ n: terms are formed in a loop that does nothing else,
/// which becomes vector instructions, and no maximum waits for the one before.
template <class Term>
[[gnu::noinline]] std::size_t add_blocks(std::size_t n, const Term& term, MaxNorm& norm) {
  constexpr std::size_t lanes = 4;
  MaxNorm part[lanes];
  std::size_t i = 0;
  for (; i + block_of_norm <= n; i += block_of_norm) {
    double values[block_of_norm];
    for (std::size_t j = 0; j < block_of_norm; ++j) values[j] = term(i + j);
    for (std::size_t j = 0; j < block_of_norm; j += lanes)
      for (std::size_t lane = 0; lane < lanes; ++lane) part[lane].add(values[j + lane]);
  }
  for (const MaxNorm& one : part) norm.add(one.value());
  return i;
}

/// The MaxNorm of term(i), i < n. A short one needs no memory for blocks, and is inlined.
template <class Term>
double max_norm(std::size_t n, const Term& term) {
  MaxNorm norm;
  for (std::size_t i = n < block_of_norm ? 0 : add_blocks(n, term, norm); i < n; ++i) norm.add(term(i));
  return norm.value();
}

/// w_i = max(s_i |y_i|, s_i |ŷ_i|, thr_i). With scalar rtol all s_i are 1 and thr = atol / rtol; a vector rtol enters
/// as s_i = rtol_i / min rtol, thr_i = atol_i / min rtol. thr is never below the smallest normal number, so that under
/// pure relative control (atol_i = 0) at y_i = 0 a zero error counts as 0 and any other fails.
class Weights {
 public:
  Weights(double rtol, std::vector<double> threshold, std::vector<double> scale)
      : rtol_(rtol), threshold_(std::move(threshold)), scale_(std::move(scale)) {
    assert(rtol_ > 0);
    for (double& thr : threshold_) thr = std::max(thr, std::numeric_limits<double>::min());
  }

  [[nodiscard]] double rtol() const { return rtol_; }
  [[nodiscard]] std::size_t size() const { return threshold_.size(); }
  [[nodiscard]] const std::vector<double>& threshold() const { return threshold_; }
  [[nodiscard]] const std::vector<double>& scale() const { return scale_; }
  [[nodiscard]] double absolute_tolerance(std::size_t i) const { return rtol_ * threshold_[i]; }
  [[nodiscard]] bool pure_relative(std::size_t i) const { return threshold_[i] == std::numeric_limits<double>::min(); }

  [[nodiscard]] double at(std::size_t i, double y) const {
    assert(i < size());
    const double a = std::abs(y);
    return std::max(scale_.empty() ? a : scale_[i] * a, threshold_[i]);
  }
  [[nodiscard]] double at(std::size_t i, double y, double yhat) const {
    return at(i, std::max(std::abs(y), std::abs(yhat)));
  }
  void fill(const double* y, double* w) const {
    for (std::size_t i = 0; i < size(); ++i) w[i] = at(i, y[i]);
  }
  void fill(const double* y, const double* yhat, double* w) const {
    for (std::size_t i = 0; i < size(); ++i) w[i] = at(i, y[i], yhat[i]);
  }

 private:
  double rtol_;
  std::vector<double> threshold_;
  std::vector<double> scale_;  // empty: all 1
};

}  // namespace invariode
