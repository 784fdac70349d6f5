#pragma once
// The initial value of a run: is it within the bounds and on the manifold, and does f keep the invariants there?

#include "manifold/manifold.hpp"
#include "report.hpp"
#include "settings.hpp"
#include "weights.hpp"

namespace invariode {

class InitialChecks {
 public:
  /// `created` if the run may start; otherwise the state in which it ends, with the finding or component to report.
  struct [[nodiscard]] Result {
    State state = State::created;
    Finding finding = {};
    int component = -1;
  };

  /// All of these belong to the loop.
  InitialChecks(Manifold& manifold, const Weights& weights, const Settings& settings)
      : manifold_(manifold), weights_(weights), settings_(settings) {}

  /// Moves y0 onto the bounds and the manifold, if it is off by less than the tolerance, and tests the Jacobians there.
  Result inspect(double* y0);
  /// Moves y onto bounds that it exceeds by less than the tolerance, and returns −1. If a component exceeds its bound
  /// by more, returns that component and leaves y unchanged.
  [[nodiscard]] int move_within_bounds(double* y);
  /// Tests the rates of the invariants, with y' and the first step of signed size h.
  Result inspect_rates(const double* y0, const double* slope, double h);

 private:
  Result project_within_bounds(double* y0);
  static Result judged(const Finding& finding);

  Manifold& manifold_;
  const Weights& weights_;
  const Settings& settings_;
};

}  // namespace invariode
