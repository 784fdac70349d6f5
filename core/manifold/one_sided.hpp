#pragma once
// Functions that may only fall, or only rise, along a solution (docs/algorithms.md, 'Dissipation'; beyond the paper).

#include <cstddef>
#include <span>
#include <vector>

#include "manifold/active_set.hpp"
#include "manifold/bounds.hpp"
#include "manifold/projection.hpp"

namespace invariode {

/// Projection with some invariants that are one-sided: G never rises above its value, which is the least G of the steps
/// so far. (Or never falls; in the direction of integration.) Such an invariant takes part in the projection of those
/// steps only that would violate it, and is then imposed until roundoff is left.
class OneSided {
 public:
  /// `within`: projects within bounds, or null.
  OneSided(Projector& projector, ActiveSet* within);

  /// The values are those at (t, y), where the solution starts.
  Status start(double t, const double* y);
  /// It goes on from there: the values stay where they have not been reached.
  Status go_on(double t, const double* y);
  /// `Projector::project`; with `ActiveSet` within the bounds. Not finite as well where a violation remains.
  Projected project(double t, const double* from, double* y);
  /// Returns whether the latest projection had to impose any of the one-sided invariants.
  [[nodiscard]] bool engaged() const { return engaged_; }
  /// The step was accepted at the point that was projected last: there is no way back behind it.
  void commit();

 private:
  Projected project_once(double t, const double* from, double* y);
  void note(const Projected& did);
  bool find_violations(const double* y, bool& joined);
  void measure_correction(const double* y, Projected& did) const;

  Projector& projector_;
  ActiveSet* within_;
  bool engaged_ = false;
  std::vector<double> candidate_;
  std::vector<double> residual_, distance_;  // of the candidate
  std::vector<double> first_excess_;         // of those that were engaged, when they were
  std::vector<double> g_;                    // at y₁: residuals, then values
};

/// Projects a point between steps: `Projector::onto` (within the bounds, if there are any), with one-sided invariants
/// between their values g0 and g1 at the ends. `target` has residuals to be met by the others.
Outcome onto_between(Projector& projector, const Bounds* bounds, double t, const double* w, const double* g0,
                     const double* g1, std::span<double> target, double* y, int most);

}  // namespace invariode
