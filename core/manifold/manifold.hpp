#pragma once
// What a run keeps its solution on: the invariants and the bounds, with all that imposes and tests them.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "archive.hpp"
#include "manifold/active_set.hpp"
#include "manifold/bounds.hpp"
#include "manifold/finding.hpp"
#include "manifold/guard.hpp"
#include "manifold/harm.hpp"
#include "manifold/invariants.hpp"
#include "manifold/one_sided.hpp"
#include "manifold/projection.hpp"
#include "manifold/restoration.hpp"
#include "manifold/slope.hpp"
#include "report.hpp"
#include "sensitivity/tangent.hpp"
#include "settings.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// The functions that the solution is projected onto: `steps` after each step, `between` in the output between them;
/// `slope` is y' as a function, with which invariants are tested. Null: no invariants. The solution may also be kept
/// within bounds, or null. All belong to the caller.
struct ManifoldTerms {
  Invariants* steps = nullptr;
  Invariants* between = nullptr;
  Slope* slope = nullptr;
  const Bounds* bounds = nullptr;
  const BoundedSlope* bounded_slope = nullptr;  ///< what the method integrates within bounds
  bool off_bounds_only = false;                 ///< steps are projected only after they were moved onto bounds
};

class Manifold {
 public:
  /// `with_events`: whose actions may make the solution jump.
  Manifold(const ManifoldTerms& terms, const Weights& weights, const Settings& settings, const Step& step,
           bool with_events);
  Manifold(const Manifold&) = delete;
  Manifold& operator=(const Manifold&) = delete;

  /// There is something to keep the solution on.
  [[nodiscard]] bool any() const { return projector_ || bounds_ != nullptr; }
  [[nodiscard]] const Bounds* bounds() const { return bounds_; }
  [[nodiscard]] const Invariants* invariants() const { return invariants_; }
  [[nodiscard]] const Projector* projector() const { return projector_ ? &*projector_ : nullptr; }
  [[nodiscard]] Projector* output_projector() { return output_projector_ ? &*output_projector_ : nullptr; }
  /// Moves sensitivities to the tangent between steps; null without them.
  [[nodiscard]] TangentProjector* output_tangent() { return output_tangent_ ? &*output_tangent_ : nullptr; }
  [[nodiscard]] Guard* guard() { return guard_ ? &*guard_ : nullptr; }
  [[nodiscard]] const Guard* guard() const { return guard_ ? &*guard_ : nullptr; }
  /// How many tolerances the roundoff of invariant i, as one with an offset of 10¹⁴ has it, moves a solution that is
  /// projected onto it: an invariant is not imposed more accurately than that.
  [[nodiscard]] double unresolved(std::size_t i) const;
  [[nodiscard]] Harm harm() const { return harm_ ? harm_->harm(weights_.rtol()) : Harm{}; }

  /// The solution starts at (t, y), where the state has been moved onto the manifold: sensitivities are moved to its
  /// tangent.
  Status start(double t, double* y);
  /// Restarts after a jump. `rehold`: projects onto the invariants that an impact conserves, with new values of the
  /// others. `acted`: an action has moved y, and may contradict demanded values.
  Finding restart(double t, double* y, bool rehold, bool acted);
  /// Notes the values of the invariants at (t, y), as functions of the piece that ends there.
  Status note_values(double t, const double* y);
  /// Compares the invariants at (t, y), as functions of the piece that begins there; `differ`: by more than roundoff.
  Status compare_values(double t, const double* y, bool& differ);
  /// Demanded invariants leave y no direction to move in: it follows from them where they jump.
  [[nodiscard]] bool determines_state() const { return restoration_ && restoration_->determines(); }
  /// Forgets the gradients, which are not valid where the solution continues.
  void forget();
  /// The start, which is within bounds, onto the manifold within them. Not finite: there is no such point near it.
  Outcome project_start(double t, double* y);

  /// The outcome of `place`: `outside` of the bounds by more than the tolerance; moved too far by the projection, or
  /// not projected; the tangent is `undefined` there; `stop`: a user function asks to.
  enum class [[nodiscard]] Placed { accepted, outside, too_far, undefined, stop };
  /// `projected`: a projection was tried; `skipped`: the candidate was near enough to the manifold.
  struct Placement {
    Placed placed;
    bool projected = false, skipped = false;
  };
  /// y₁ from the candidate y*, both in `ends.y1`: moved onto bounds and manifold, after so many accepted steps.
  Placement place(Step& step, StepEnds& ends, std::int64_t steps);
  /// max_i |y*_i − y₁_i| / w_i; infinite where y* could not be projected.
  [[nodiscard]] double correction() const { return correction_; }
  /// The component for which the candidate was `outside`.
  [[nodiscard]] int outside_component() const { return outside_.component; }
  /// The invariant that could not be projected, since it is not finite at the candidate; -1: none.
  [[nodiscard]] int undefined() const;

  /// The candidate was accepted. Returns whether it was outside the bounds, or f leads components out that are held.
  bool note(double h);
  /// Does f keep the invariants in accepted step number `number`? `at_break`, `after_break`: it ends, or starts, at a
  /// breakpoint, where there is no room for differences.
  Finding judge(const StepEnds& ends, const Step& step, std::int64_t number, bool at_break, bool after_break);
  /// The step stands: there is no way back behind it.
  void commit();

  void state(Archive& archive);
  void archive_drift(Archive& archive) { archive(clipped, drift.residual, drift.distance, drift.correction); }

  Drift drift;
  double clipped = 0;  ///< what bounds have added to the sum of the components

 private:
  /// The latest candidate and the bounds, if there are any.
  struct Outside {
    bool off_bounds = false;  // whether it was outside
    double clipped = 0;       // what moving it onto them added to the sum of its components
    int component = -1;       // the farthest
  };

  Status start_tangent(double t, double* y, bool rehold);
  double settle(StepEnds& ends);
  bool move_onto_bounds(Step& step, StepEnds& ends);
  Outcome follow_tangent(double t);
  Finding contradicted(double t, double h);
  Placed project(const Step& step, StepEnds& ends, std::int64_t steps);
  void choose_directions(const Step& step);
  [[nodiscard]] double roundoff_of_correction() const;
  /// The correction belongs to the bounds as well: it says nothing about the invariants.
  [[nodiscard]] bool at_bounds() const { return active_set_ && active_set_->active(); }

  Invariants* invariants_;
  const Bounds* bounds_;
  const BoundedSlope* bounded_slope_;
  bool off_bounds_only_, check_;
  const Weights& weights_;
  std::size_t size_;                           // doubles of Y: of the state, and of its sensitivities
  std::optional<Projector> projector_;         // of the steps
  std::optional<Projector> output_projector_;  // of points between steps
  std::optional<TangentProjector> tangent_, output_tangent_;
  std::optional<ActiveSet> active_set_;  // projects steps where there are bounds
  std::optional<OneSided> one_sided_;    // and where some invariants may only rise or fall
  std::optional<Guard> guard_;
  std::optional<Restoration> restoration_;  // after jumps
  std::optional<HarmDetector> harm_;
  Outside outside_;
  Projected projected_;                    // of the accepted candidate
  double correction_ = 0;                  // of the latest candidate
  std::vector<double> taken_;              // what bounds have added to each invariant since it was held, as a distance
  std::vector<double> settled_;            // the candidate, with components that rest at their bounds
  std::vector<double> y1_;                 // the projected candidate
  std::vector<double> before_, after_;     // the values of the invariants on the two sides of a breakpoint
  std::vector<const double*> directions_;  // of corrections, where they are those of the step
};

}  // namespace invariode
