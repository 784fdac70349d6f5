#pragma once
// How much a run integrates: a state, and its sensitivities behind it.

#include <cstddef>

namespace invariode {

/// Y = (y, S_1, …, S_k): a state y of n doubles and S_j = ∂y/∂p_j, n doubles each. The state is a prefix of Y: whatever
/// concerns the state alone gets the same pointer and reads n doubles.
struct Extent {
  std::size_t n = 0;
  std::size_t k = 0;

  Extent() = default;
  explicit Extent(std::size_t n_, std::size_t k_ = 0) : n(n_), k(k_) {}
  /// Returns the extent of a state of n doubles in a Y of so many.
  static Extent within(std::size_t n, std::size_t all) { return Extent(n, n == 0 ? 0 : all / n - 1); }

  [[nodiscard]] std::size_t size() const { return n * (1 + k); }
  bool operator==(const Extent&) const = default;
};

}  // namespace invariode
