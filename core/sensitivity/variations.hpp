#pragma once
// Forward sensitivities: the equations of S_j = ∂y/∂p_j, and the one system that methods integrate
// (docs/algorithms.md, 'Sensitivities').

#include <cstddef>
#include <vector>

#include "callback.hpp"
#include "manifold/bounds.hpp"
#include "sensitivity/extent.hpp"
#include "weights.hpp"

namespace invariode {

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
[[nodiscard]] Weights augmented(const Weights& state, const Variations& variations, bool counts);

/// Y' as methods integrate it: f, then the slopes of S. Of components that f would lead out of their bounds, and that
/// rest there, S rests too.
class AugmentedSlope {
 public:
  /// `f` is copied. `bounded`: whose slope f is, or null.
  AugmentedSlope(const Callback& f, Callback slope, Extent extent, BoundedSlope* bounded)
      : f_(f), slope_(slope), extent_(extent), bounded_(bounded) {}
  AugmentedSlope(const AugmentedSlope&) = delete;
  AugmentedSlope& operator=(const AugmentedSlope&) = delete;

  /// Refers to this object.
  Callback callback() { return {&whole_entry, this}; }
  /// The slopes of S alone, (k, n), after f was evaluated at the same t and y.
  Callback of_sensitivities() { return {&sensitivities_entry, this}; }

 private:
  static Status whole_entry(void* self, double t, const double* Y, double* out);
  static Status sensitivities_entry(void* self, double t, const double* Y, double* out);
  const double* at_rest(const double* Y);

  Callback f_, slope_;
  Extent extent_;
  BoundedSlope* bounded_;
  std::vector<double> at_rest_;
};

}  // namespace invariode
