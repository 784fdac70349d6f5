#pragma once
// LU factors of a banded matrix by rows, with partial pivoting. LAPACK calls the BLAS several times for each column,
// and in a narrow band a call takes longer than its work.

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <complex>
#include <cstddef>
#include <type_traits>
#include <vector>

#include "linear/side_by_side.hpp"

namespace invariode {

template <class Scalar>
class NarrowBand {
 public:
  NarrowBand(std::size_t n, std::size_t lower, std::size_t upper)
      : n_(n),
        lower_(lower),
        width_(lower + upper + 1),
        rows_(n * width_),
        multipliers_(n * lower),
        inverse_(n),
        pivots_(n) {}

  /// All entries become 0.
  void clear() { std::fill(rows_.begin(), rows_.end(), Scalar(0)); }
  /// The entries, until they are factorised.
  [[nodiscard]] const std::vector<Scalar>& entries() const { return rows_; }
  /// A(i, j), of a matrix that is not factorised yet. Row i begins at column i − lower.
  Scalar& at(std::size_t i, std::size_t j) {
    assert(i < n_ && i <= j + lower_ && j + lower_ - i < width_);
    return row(i)[j + lower_ - i];
  }

  /// Replaces A by its factors. False: it is singular, or not finite.
  [[nodiscard]] bool factor() {
    for (std::size_t i = 0; i < std::min(lower_, n_); ++i) {  // these begin at column 0, too
      const std::size_t outside = lower_ - i;
      std::copy(row(i) + outside, row(i) + width_, row(i));
      std::fill(row(i) + width_ - outside, row(i) + width_, Scalar(0));
    }
    for (std::size_t k = 0; k < n_; ++k) {
      const std::size_t end = std::min(k + lower_ + 1, n_);  // rows k … end − 1 begin at column k
      std::size_t p = k;
      for (std::size_t i = k + 1; i < end; ++i)
        if (size(*row(i)) > size(*row(p))) p = i;
      pivots_[k] = p;
      const double largest = size(*row(p));
      if (p != k) std::swap_ranges(row(k), row(k) + width_, row(p));
      inverse_[k] = Scalar(1) / *row(k);
      if (!std::isfinite(largest) || !std::isfinite(size(inverse_[k]))) return false;
      for (std::size_t i = k + 1; i < end; ++i)
        multipliers_[k * lower_ + (i - k - 1)] = eliminate(row(k), inverse_[k], row(i));
      for (std::size_t j = 1; j < width_; ++j) row(k)[j] *= inverse_[k];
    }
    return true;
  }

  /// B becomes A⁻¹ B, m columns of n numbers one behind the other: complex ones one by one, whose products leave no
  /// time to wait.
  void solve(Scalar* b, std::size_t m) const {
    if (n_ == 0) return;
    if constexpr (std::is_same_v<Scalar, double>)
      side_by_side(m, [&]<std::size_t C>(std::size_t j, Count<C>) { solve<C>(b + j * n_); });
    else
      for (std::size_t j = 0; j < m; ++j) solve<1>(b + j * n_);
  }

 private:
  static double size(double a) { return std::abs(a); }
  static double size(const std::complex<double>& a) { return std::abs(a.real()) + std::abs(a.imag()); }

  /// b becomes A⁻¹ b for C columns. Each component waits for the one before it, which is therefore kept at hand, and is
  /// not on its way through memory.
  template <std::size_t C>
  void solve(Scalar* b) const {
    std::array<Scalar, C> last;
    for (std::size_t c = 0; c < C; ++c) last[c] = b[c * n_];
    for (std::size_t k = 0; k + 1 < n_; ++k) {
      const std::size_t p = pivots_[k], below = std::min(lower_, n_ - 1 - k);
      const Scalar* multiplier = multipliers_.data() + k * lower_;
      for (std::size_t c = 0; c < C; ++c) {
        Scalar* x = b + c * n_;
        if (p != k) {
          x[k] = last[c];
          std::swap(x[k], x[p]);
          last[c] = x[k];
        }
        x[k] = last[c] * inverse_[k];
        for (std::size_t i = 1; i < below; ++i) x[k + 1 + i] -= multiplier[i] * last[c];
        last[c] = lower_ > 0 ? x[k + 1] - multiplier[0] * last[c] : x[k + 1];
      }
    }
    for (std::size_t c = 0; c < C; ++c) b[c * n_ + n_ - 1] = last[c] = last[c] * inverse_[n_ - 1];
    for (std::size_t k = n_ - 1; k-- > 0;) {
      const Scalar* U = rows_.data() + k * width_;
      for (std::size_t c = 0; c < C; ++c) {
        Scalar* x = b + c * n_;
        Scalar sum = x[k];
        for (std::size_t j = std::min(width_, n_ - k); j-- > 2;) sum -= U[j] * x[k + j];
        x[k] = last[c] = width_ > 1 ? sum - U[1] * last[c] : sum;
      }
    }
  }

  Scalar* row(std::size_t i) { return rows_.data() + i * width_; }

  /// Removes the first entry of a row and moves the rest to the left. Returns the multiple of the pivot row that it
  /// took.
  Scalar eliminate(const Scalar* pivot_row, Scalar inverse, Scalar* of) const {
    const Scalar multiplier = of[0] * inverse;
    for (std::size_t j = 1; j < width_; ++j) of[j - 1] = of[j] - multiplier * pivot_row[j];
    of[width_ - 1] = 0;
    return multiplier;
  }

  std::size_t n_, lower_, width_;
  std::vector<Scalar> rows_;         // of U, each from its diagonal on and divided by it
  std::vector<Scalar> multipliers_;  // of L: `lower` of each column
  std::vector<Scalar> inverse_;      // of the pivots
  std::vector<std::size_t> pivots_;  // rows with which rows were exchanged
};

}  // namespace invariode
