#pragma once
// Forward sensitivities: how much a run integrates with them, and by which equations (docs/algorithms.md,
// 'Sensitivities').

#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

#include "callback.hpp"
#include "weights.hpp"

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

/// M S_j' = J S_j + f_pj for k parameters, behind the state. The tangents of invariants and of actions stand with them
/// (`InvariantBlock::tangent`, `EventFunction::jump`, `Breakpoint::jump`).
///
/// Or quadratures, S_j' = g_j(t, y): integrals of functions of the state, which the error test controls like it, and
/// which need no linear systems.
struct Variations {
  std::size_t k = 0;
  Callback slope;                 ///< (t, Y) -> J S_j + f_pj, or g_j, (k, n)
  std::vector<double> tolerance;  ///< absolute ones of S, (k, n)
  bool error_test = true;         ///< false: S has no part in the norm of the error test
  bool quadratures = false;       ///< the slope does not depend on S, whose mass matrix is the identity
};

/// The weights of Y: those of the state, then max(s_i |S_ij|, tolerance_ij / rtol), with the state's scales; infinite
/// where S does not count.
[[nodiscard]] inline Weights augmented(const Weights& state, const Variations& variations, bool counts) {
  std::vector<double> threshold = state.threshold(), scale;
  for (const double tolerance : variations.tolerance)
    threshold.push_back(counts ? tolerance / state.rtol() : std::numeric_limits<double>::infinity());
  if (!state.scale().empty())
    for (std::size_t block = 0; block <= variations.k; ++block)
      scale.insert(scale.end(), state.scale().begin(), state.scale().end());
  return {state.rtol(), std::move(threshold), std::move(scale)};
}

}  // namespace invariode
