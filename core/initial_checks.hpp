#pragma once
// The initial value of a run: is it within the bounds and on the manifold, and does f keep the invariants there?

#include "manifold/manifold.hpp"
#include "report.hpp"
#include "settings.hpp"
#include "weights.hpp"

namespace invariode {

/// Each test returns `created` if the run may start, or else the state in which it ends, with what the report says of
/// it.
class InitialChecks {
 public:
  /// All of these belong to the loop.
  InitialChecks(Manifold& manifold, const Weights& weights, const Settings& settings, Report& report)
      : manifold_(manifold), weights_(weights), settings_(settings), report_(report) {}

  /// Moves y0 onto the bounds and the manifold, if it is off by less than the tolerance, and tests the Jacobians there.
  [[nodiscard]] State inspect(double* y0);
  /// Moves y onto the bounds that it is outside of by less than the tolerance. False: there is a component that is
  /// outside by more, and that the report names.
  [[nodiscard]] bool move_within_bounds(double* y);
  /// Tests the rates of the invariants, with y' and the first step of signed size h.
  [[nodiscard]] State inspect_rates(const double* y0, const double* slope, double h);

 private:
  [[nodiscard]] State project_within_bounds(double* y0);
  [[nodiscard]] State judged(const Finding& finding);

  Manifold& manifold_;
  const Weights& weights_;
  const Settings& settings_;
  Report& report_;
};

}  // namespace invariode
