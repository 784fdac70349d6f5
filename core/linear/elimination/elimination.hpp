#pragma once
// Elimination with partial pivoting in blocks, by kernels for each instruction set. An entry takes the same operations
// in the same order as in `DenseLu`, whatever the blocks and the width of the registers: the factors are bit for bit
// those. Nothing is shared between threads, and no BLAS is called.

#include <cstddef>
#include <span>

namespace invariode::elimination {

/// A matrix by columns: entry (i, j) at [j · height + i]. From column n on there are right-hand sides, which become
/// solutions. The rows beyond n, up to the height, which is a multiple of `row_multiple`, hold nothing and may be
/// written. Of a complex one, the imaginary parts are in an array of their own.
struct Columns {
  std::size_t n, height;
  double *re, *im;  ///< im: null if it is real
};

inline constexpr std::size_t row_multiple = 8;

/// The routines compiled for one instruction set.
struct Kernel {
  /// P A = L U in the place of A; row k was exchanged with `exchanged_with[k]`. In the diagonal of U are the pivots, or
  /// their reciprocals if they are complex. False: a pivot is 0, or not finite.
  bool (*factor)(const Columns& a, std::size_t* exchanged_with);
  /// A⁻¹ B in the place of B, m columns from column n on, by the factors and exchanges of `factor`.
  void (*solve)(const Columns& a, const std::size_t* exchanged_with, std::size_t m);
};

extern const Kernel of_baseline, of_avx2, of_avx512;

/// The routines for each instruction set of this processor, the best one first.
[[nodiscard]] std::span<const Kernel* const> kernels();

}  // namespace invariode::elimination
