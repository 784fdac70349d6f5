#pragma once
// How a run ended, and what it did on the way.

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "linear/work.hpp"
#include "manifold/finding.hpp"
#include "step.hpp"

namespace invariode {

enum class State {
  created,
  running,
  reached_end,
  terminal_event,
  stopped_by_callback,
  stopped_by_request,    ///< from outside: see `Integration::stop_on`
  restart_inconsistent,  ///< after a breakpoint or an action the algebraic equations have no solution that was found
  limit_reached,         ///< one of the settings; see `Report::limit`
  interrupted,           ///< a user function raised
  event_undefined,       ///< an event function returned NaN
  action_undefined,      ///< an action returned NaN or infinity
  start_undefined,       ///< f is not finite at the start
  step_failed,           ///< an attempt failed at hmin
  invariant_refused,     ///< at the start; see the finding
  invariant_convicted,   ///< during the run
  start_out_of_bounds,   ///< y0 is outside the bounds by more than the tolerance
  start_contradicts,     ///< there is no point near y0 within the bounds on which the invariants have their values
  action_out_of_bounds,  ///< an action returned a point outside the bounds by more than the tolerance
  events_endless,        ///< actions at one time set each other off; see `Report::circle`
  marks_endless          ///< delays bring discontinuities to too many times
};

/// The limits that may stop a run early (settings.hpp).
enum class Limit { steps, time, points, memory, sticking };

/// A component of y that shows why steps fail, at the start of the last one.
struct Component {
  int index = -1;  ///< −1: none
  double y = 0, slope = 0;
};

/// The place and the reason of a run's end, for whoever writes the message.
struct Report {
  double t = 0;
  double h = 0;
  Cause cause = Cause::error;
  int component = -1;              ///< of y, that is not finite, or that pure relative control cannot resolve
  std::optional<int> coefficient;  ///< f is finite, but not this Taylor coefficient of the component
  bool pure_relative = false;      ///< y_i = 0 and atol_i = 0 made the error test fail
  Component fastest;               ///< one that changes by more than its tolerance within the smallest step
  Component undefined_below_zero;  ///< one below whose 0 f is not finite
  LinearWork linear;               ///< of an implicit method, in the attempt that failed
  std::size_t event = 0;
  std::vector<std::size_t> circle;  ///< events whose actions set each other off
  Finding finding;
  Limit limit = Limit::steps;
  std::int64_t steps = 0;  ///< accepted until the limit
  double seconds = 0;      ///< from the start to the limit
};

struct Counts {
  std::int64_t steps = 0, failed = 0, projections = 0, skipped = 0;
  /// Steps that ended outside the bounds by less than the tolerance, were moved to one (√y), or are held at one.
  std::int64_t clipped = 0;
};

/// Largest values in the accepted steps: for each invariant the largest residual before projection, also as a distance
/// in units of rtol; for all together the largest correction, in units of rtol.
struct Drift {
  std::vector<double> residual, distance;
  double correction = 0;
};

/// The harm of corrections: the component of y that projections have moved most, in units of its own estimated
/// errors.
struct Harm {
  int component = -1;  ///< none
  double ratio = 0;    ///< of the sum of its corrections to that of its estimated errors
};

/// A finding that stability, not accuracy, has limited the steps of an explicit method, and from which t on.
struct Stiffness {
  bool found = false;
  double since = 0;
};

}  // namespace invariode
