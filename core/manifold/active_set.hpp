#pragma once
// The nearest point of {g = c, lower ≤ y ≤ upper} (docs/algorithms.md, 'Bounds together with invariants').

#include <cstddef>
#include <span>
#include <vector>

#include "manifold/bounds.hpp"
#include "manifold/projection.hpp"

namespace invariode {

/// Projection with components fixed at their bounds: those at or beyond a bound to begin with. After each round those
/// join that it took out, and those leave that the nearest point would rather have inside, since their multiplier has
/// the wrong sign. All change at once, which mostly takes two or three rounds; where that cycles, the first alone
/// (block pivoting, and the rule of the least index; Júdice and Pires, Comput. Oper. Res. 21 (1994) 587–596).
class ActiveSet {
 public:
  ActiveSet(Projector& projector, const Bounds& bounds);

  /// `Projector::project` within the bounds, which the candidate may be off. Not finite where no point within the
  /// bounds was found on the manifold.
  Projected project(double t, const double* from, double* y);
  /// Returns whether the latest projection fixed any component: its correction then says nothing about the invariants.
  [[nodiscard]] bool active() const { return active_; }

 private:
  void change(const Bounds::Interval& one, const double* y);
  void note_outside(const double* y);
  void note_unwilling(const double* y);
  Outcome judge_left_out(double t, const double* y, std::span<const double> before);

  Projector& projector_;
  const Bounds& bounds_;
  std::vector<double> candidate_;
  std::vector<double> place_;  // where fixed components are
  std::vector<double> residual_;
  std::vector<const Bounds::Interval*> wrong_;  // what is to change
  bool active_ = false;
};

/// Projects a point between steps, as `Projector::onto`, within the bounds. Components that no correction brings inside
/// are clipped.
Outcome onto_within(Projector& projector, const Bounds& bounds, double t, const double* w, const double* target,
                    double* y, int most);

}  // namespace invariode
