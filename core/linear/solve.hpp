#pragma once
// Small linear systems with any number of right-hand sides, for generated code to call.

#include <cstdint>

namespace invariode {

/// A X = B by elimination with row pivots. `numbers`: A (k, k) by rows, which is lost, then B (k, m) by rows, which
/// becomes X: NaN if A is singular or not finite.
void solve_in_place(std::int64_t k, std::int64_t m, double* numbers) noexcept;

}  // namespace invariode
