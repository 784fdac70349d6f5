#pragma once
// Back onto the constraints after a jump: what an impact is in mechanics (docs/algorithms.md, 'Jumps').

#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "weights.hpp"

namespace invariode {

/// The demanded invariants of a run that has some in later levels, such as φ̇ = 0 after φ = 0. An action may
/// break those, for example a blow that acts on one of several bodies: they are imposed again by corrections of their
/// levels. What is held at its own value, such as the energy, is not imposed: it gets a new value.
class Restoration {
 public:
  /// Returns whether there is anything to restore.
  [[nodiscard]] static bool needed(const Invariants& invariants);

  Restoration(const Invariants& invariants, const Weights& weights);
  /// Leaves y alone where the invariants of level 0 are off by more than the tolerance, or no point is found.
  Status restore(double t, double* y);
  void state(Archive& archive) {
    demanded_.state(archive);
    projector_.state(archive);
  }

 private:
  const Weights& weights_;
  Invariants demanded_;
  Projector projector_;
};

}  // namespace invariode
