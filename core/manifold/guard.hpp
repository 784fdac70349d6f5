#pragma once
// Finds invariants that are none, without ever accusing a right one (docs/algorithms.md, 'Guard'; beyond the paper).

#include <cstddef>
#include <cstdint>
#include <vector>

#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "slope.hpp"

namespace invariode {

/// What speaks against the invariants.
struct Finding {
  enum class Kind { none, stop, undefined, off_value, wrong_jacobian, not_conserved };
  Kind kind = Kind::none;
  int invariant = -1;
  int component = -1;  ///< wrong_jacobian: the column
  double t = 0;
  double size = 0;      ///< off_value: residual; wrong_jacobian: the entry given; not_conserved: d/dt of the invariant
  double distance = 0;  ///< off_value: in units of rtol; wrong_jacobian: the difference quotient; not_conserved: ρ
};

/// The tests, in the order in which the loop asks for them: `start_value`, `start_jacobian`, `start_rate`; then after
/// each accepted step `rate` and `corrected`, and `confirm` where corrections stay too large to be accepted. A
/// suspicion is confirmed on the manifold before it convicts.
class Guard {
 public:
  Guard(Invariants& invariants, const Weights& weights, Slope& slope);

  /// The residual at (t0, y0): not finite is `undefined`, farther off a demanded value than rtol is `off_value`;
  /// closer, y0 is projected in place. Takes the linearization that the other two tests of the start use.
  Finding start_value(double t, double* y);
  /// The users' Jacobians at (t0, y0) against a directional difference; where that fails, entry by entry.
  Finding start_jacobian(double t, const double* y);
  /// The rate of change of the invariants at (t0, y0), where the slope is f and the first step h.
  Finding start_rate(double t, const double* y, const double* f, double h);

  /// The same after accepted step number `steps`, with the linearization of its projection and the method's slope f.
  /// (Where that is no more than what Newton's iteration left, suspicions are frequent, and rarely looked at.)
  Finding rate(const Linearization& at, double t, const double* f, double h, std::int64_t steps);
  /// What the size of the correction of that step, (t, y) being its end, says.
  Finding corrected(double correction, double t, const double* y, double h, std::int64_t steps);
  /// Projects (t, y) to roundoff, evaluates f there and tests again. `none` also where that cannot be done.
  Finding confirm(double t, const double* y, double h);

  /// How one invariant stands at a point.
  struct Examination {
    double residual;  ///< g − value, as given
    double distance;  ///< of the point from the level set, in units of rtol
    double gradient;  ///< ‖J_i W‖; 0: the invariant is stationary here
    double rate;      ///< d/dt of the invariant along f, on the manifold
    double angle;     ///< that in units of the size of its terms
    bool redundant;   ///< dependent on the others
    bool conserved;   ///< as far as can be told
  };
  /// All of them at (t, y), which is projected to roundoff for the rate. Not finite: g, J or f is not.
  Outcome examine(double t, const double* y, double h, std::vector<Examination>& result);

  [[nodiscard]] bool projected_start() const { return projected_start_; }

 private:
  Outcome detect_time_dependence(double t, const double* y, double h);
  [[nodiscard]] bool changes_with_time() const;
  Finding suspect(const Linearization& at, double t, const double* f, double h, bool formed);
  Finding worst_entry(double t, const double* y);
  Finding unless_uncertain(const Finding& finding, double t, double h);
  [[nodiscard]] Finding undefined(double t) const;

  Invariants& invariants_;
  const Weights& weights_;
  Slope& slope_;
  Projector projector_;  // of its own: that of the steps keeps its linearization
  std::vector<double> point_, f_value_, gt_, plus_, minus_, differences_, halved_;
  bool time_dependent_ = false;
  bool projected_start_ = false;
  std::int64_t quiet_until_ = 0;      // step before which `rate` does not ask again
  std::int64_t unworried_until_ = 0;  // and `corrected`
  std::int64_t next_look_ = 1;        // step in which g_t is formed although it has been 0
};

}  // namespace invariode
