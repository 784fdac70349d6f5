#pragma once
// Functions that may only fall, or only rise, along a solution (docs/algorithms.md, 'Dissipation'; beyond the paper).

#include <cstddef>
#include <span>
#include <vector>

#include "archive.hpp"
#include "manifold/active_set.hpp"
#include "manifold/bounds.hpp"
#include "manifold/projection.hpp"

namespace invariode {

/// An accepted step, or an attempt of one, from (t0, y0) by h to (t1, y1).
struct StepEnds {
  double t0, t1, h;
  const double *y0, *y1;
};

/// Projection with some invariants that are one-sided: G never rises above its value, which is the least G of the steps
/// so far. (Or never falls; in the direction of integration.) Such an invariant takes part in the projection of those
/// steps only that would violate it, and is then imposed until roundoff is left.
///
/// Errors of both signs change G. If those that raise it were taken away and those that lower it stayed, these would
/// add up. So a rise that was taken away is owed, and falls that f does not account for repay it. Let Q be the sum of
/// all changes of G by steps, before they are corrected. If all falls repaid, G would be the least Q so far, and never
/// further from the solution's than Q has been; the debt is Q − G.
class OneSided {
 public:
  /// `within`: projects within bounds, or null.
  OneSided(Projector& projector, ActiveSet* within, double rtol);

  /// The values are those at (t, y), where the solution starts.
  Status start(double t, const double* y);
  /// It goes on from there: the values stay where they have not been reached.
  Status go_on(double t, const double* y);
  /// `Projector::project`; with `ActiveSet` within the bounds. Not finite as well where a violation remains.
  /// `slope`: y' at the start of the step.
  Projected project(const StepEnds& ends, const double* slope, double* y);
  /// Returns whether the latest projection had to impose any of the one-sided invariants.
  [[nodiscard]] bool engaged() const { return engaged_; }
  /// The step was accepted at the point that was projected last: there is no way back behind it.
  void commit();
  void state(Archive& archive) { archive(debt_); }

 private:
  Projected project_in_rounds(const StepEnds& ends, const double* slope, double* y);
  Status repay(const StepEnds& ends, const double* slope, bool& any);
  Status change_by_slope(const StepEnds& ends, const double* slope);
  bool repay_less(std::span<const double> distance);
  Projected project_once(double t, const double* from, double* y);
  void note(const Projected& did);
  bool find_violations(const double* y, bool& joined);
  void measure_correction(const double* y, Projected& did) const;

  Projector& projector_;
  ActiveSet* within_;
  double rtol_;
  bool engaged_ = false;
  std::vector<double> candidate_;
  std::vector<double> residual_, distance_;  // of the candidate
  std::vector<double> first_excess_;         // of those that were engaged, when they were
  std::vector<double> g_;                    // at y₁: residuals, then values
  std::vector<double> candidate_g_;          // residuals of the candidate, on the other invariants
  std::vector<double> limit_;                // values that are not exceeded, while others are aimed at
  std::vector<double> debt_;                 // not negative
  std::vector<double> by_slope_;             // changes in the step at the rate of its start
};

/// Projects a point between steps: `Projector::onto` (within the bounds, if there are any), with one-sided invariants
/// between their values g0 and g1 at the ends. `target` has residuals to be met by the others.
Outcome onto_between(Projector& projector, const Bounds* bounds, double t, const double* w, const double* g0,
                     const double* g1, std::span<double> target, double* y, int most);

}  // namespace invariode
