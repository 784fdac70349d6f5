#pragma once
// Finds functions that are not conserved, without ever accusing a right invariant (docs/algorithms.md, 'Guard'; beyond
// the paper).

#include <cstddef>
#include <cstdint>
#include <vector>

#include "manifold/finding.hpp"
#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "manifold/slope.hpp"

namespace invariode {

/// The tests, in the order in which the loop asks for them: `start_value`, `start_jacobian`, `start_rate`; then after
/// each accepted step `rate` and `corrected`, and `confirm` where corrections stay too large to be accepted. A
/// suspicion is confirmed on the manifold before it convicts.
class Guard {
 public:
  /// `steps`: the projector of the invariants, in whose memory the guard's own works. `interval`: of the integration,
  /// may be infinite.
  Guard(const Projector& steps, const Weights& weights, Slope& slope, double interval);

  /// Direction of the test of a Jacobian: no component is 0 and no two are equal, so that errors do not cancel by
  /// symmetry.
  static double direction(std::size_t j);

  /// The residual at (t0, y0): not finite is `undefined`, farther off a demanded value than rtol is `off_value`;
  /// closer, y0 is projected in place. Takes the linearization that the other two tests of the start use.
  Finding start_value(double t, double* y);
  /// The users' Jacobians at (t0, y0) against a directional difference; where that fails, entry by entry.
  Finding start_jacobian(double t, const double* y);
  /// The rate of change of the invariants at (t0, y0), where the slope is f and the first step h.
  Finding start_rate(double t, const double* y, const double* f, double h);

  /// Tests the rate of change after accepted step number `steps`, with the linearization of its projection and the
  /// method's slope f. (Where that is no more than Newton's iteration left, suspected violations are frequent, and
  /// rarely examined.)
  Finding rate(const Linearization& at, double t, const double* f, double h, std::int64_t steps);
  /// Tests the size of the correction of that step, whose end is (t, y).
  Finding corrected(double correction, double t, const double* y, double h, std::int64_t steps);
  /// A step from (t, y) has violated what may only rise or fall: does f do that?
  Finding violated(double t, const double* y, double h, std::int64_t steps);
  /// Projects (t, y) to roundoff, or as far as that goes, evaluates f there and tests again.
  Finding confirm(double t, const double* y, double h);

  /// The state of one invariant at a point.
  struct Examination {
    double residual;    ///< g − value, as given
    double distance;    ///< of the point from the level set, in units of rtol
    double gradient;    ///< ‖J_i W‖; 0: the invariant is stationary here
    double rate;        ///< d/dt of the invariant along f, on the manifold
    double angle;       ///< that in units of the size of its terms
    double detectable;  ///< the smallest such angle that is told from roundoff
    bool redundant;     ///< dependent on the others
    bool conserved;     ///< as far as can be told
  };
  /// All of them at (t, y), which is projected to roundoff for the rate. Not finite: g, J or f is not.
  Outcome examine(double t, const double* y, std::vector<Examination>& result);

  [[nodiscard]] bool projected_start() const { return projected_start_; }
  void state(Archive& archive) {
    archive(gt_, time_dependent_, projected_start_, next_flow_, next_look_);
    for (Pause* one : {&of_rates_, &of_corrections_, &of_violations_}) archive(one->until, one->acquitted);
  }

 private:
  /// Steps without looks at one kind of suspicion after it was acquitted.
  struct Pause {
    std::int64_t until = 0;  // this step
    double acquitted = 0;    // the size of that suspicion
    /// Returns whether one of this size is to be tested in step number `steps`.
    [[nodiscard]] bool asks(std::int64_t steps, double size) const;
    void begin(std::int64_t steps, double size);
  };

  Outcome detect_time_dependence(double t, const double* y, double h);
  [[nodiscard]] bool changes_with_time() const;
  Finding suspect(const Linearization& at, double t, const double* f, double h);
  [[nodiscard]] double noise_in_time(const Linearization& at, std::size_t i, double t, double h) const;
  [[nodiscard]] double limit(std::size_t i) const;
  [[nodiscard]] bool drifts(const Linearization& at, std::size_t i, double rate, double h) const;
  bool blind(const Linearization& at, std::size_t i, double t, const double* f, double h);
  Finding suspect_along_flow(const Linearization& at, double t, double h);
  Finding look_along_flow(const Linearization& at, double t, const double* f, double h, std::int64_t steps);
  Finding acquitted_here(const Linearization& at, double t, double h, bool& acquitted);
  Finding confirm_at_point(double t, double h);
  Finding worst_entry(double t, const double* y);
  Finding worst_entry(double t, const double* y, double factor);
  Finding unless_uncertain(const Finding& finding, double t, double h);
  Outcome evaluate_rates(double t, double h);
  [[nodiscard]] double rate_here(std::size_t i) const;
  [[nodiscard]] double scale_of_time(double t, const double* y, const double* f);

  /// d/ds g_i(t + s, y + s f) at s = 0, which is g_t + J_i f without any Jacobian, and what it may be off.
  struct FlowRate {
    Outcome outcome;
    double rate = 0, error = 0;
  };
  FlowRate flow_rate(std::size_t i, double t, const double* y, const double* J, const double* f, double h);
  Outcome flow_difference(std::size_t i, double t, const double* y, const double* f, const Invariants::Reach& s,
                          double& quotient);
  Outcome persists(std::size_t i, double t, double h, double rate, bool& persistent);
  [[nodiscard]] Finding undefined(double t) const;

  double interval_;
  Invariants& invariants_;
  const Weights& weights_;
  Slope& slope_;
  Projector projector_;  // with a linearization of its own: that of the steps stays
  std::vector<double> point_, original_, nearby_, moved_, f_value_, gt_, plus_, minus_, differences_, halved_;
  bool time_dependent_ = false;
  bool projected_start_ = false;
  Pause of_rates_, of_corrections_, of_violations_;
  std::int64_t next_flow_ = 1;  // step in which derivatives that are blind are made up for
  std::int64_t next_look_ = 1;  // step in which g_t is formed although it has been 0
};

}  // namespace invariode
