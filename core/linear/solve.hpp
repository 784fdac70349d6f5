#pragma once
// Small linear systems with any number of right-hand sides, for generated code to call.

#include <cstdint>

namespace invariode {

/// A X = B by elimination with row pivots. `numbers`: A (k, k) by rows, which is lost, then B (k, m) by rows, which
/// becomes X: NaN if A is singular or not finite.
void solve_in_place(std::int64_t k, std::int64_t m, double* numbers) noexcept;

/// Solves A X = B with sparse factors. `numbers`: the entries of A at `places` i k + j, ascending, then B, which
/// becomes X. Each thread keeps the orderings of the latest patterns.
void solve_sparse_in_place(std::int64_t k, std::int64_t m, std::int64_t entries, const std::int64_t* places,
                           double* numbers) noexcept;

}  // namespace invariode
