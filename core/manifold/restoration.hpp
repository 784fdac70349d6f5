#pragma once
// Back onto the constraints after a jump: what an impact is in mechanics (docs/algorithms.md, 'Jumps').

#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "weights.hpp"

namespace invariode {

/// The demanded invariants of a run that has some in later levels, such as φ̇ = 0 after φ = 0. An action may
/// break those, for example a blow that acts on one of several bodies: they are imposed again by corrections of their
/// levels. What is held at its own value, such as the energy, is not imposed: it gets a new value.
/// Demanded invariants that determine all of y tell where it is behind any jump.
class Restoration {
 public:
  /// Returns whether an action may break anything that is restored.
  [[nodiscard]] static bool needed(const Invariants& invariants);
  /// Returns whether there are as many demanded invariants as components.
  [[nodiscard]] static bool determines(const Invariants& invariants);

  Restoration(const Invariants& invariants, const Weights& weights);
  [[nodiscard]] bool determines() const { return determines_; }
  /// Leaves y alone where no point is found, or where the invariants of level 0 are off by more than the tolerance and
  /// do not determine y, or where an action of the user's has `acted`, which contradicts them.
  Status restore(double t, double* y, bool acted);
  void state(Archive& archive) { demanded_.state(archive); }

 private:
  const Weights& weights_;
  Invariants demanded_;
  Projector projector_;
  bool determines_;
};

}  // namespace invariode
