#pragma once
// Location of events: zeros of functions of (t, y) along the solution (docs/algorithms.md, 'Events').

#include <cassert>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include "callback.hpp"
#include "output/chebyshev.hpp"
#include "output/interpolant.hpp"
#include "output/turning_points.hpp"
#include "series.hpp"

namespace invariode {

/// Several events that are one function of (t, y), with one action for all that occur at a time.
struct RootVector {
  Callback function;      ///< g(t, y) -> (count,)
  std::size_t first = 0;  ///< the event that is its first component
  std::size_t count = 0;
  Callback
      action;  ///< (t, (y, d)) -> y from there on: d_i is the sign that component i takes on, 0: it does not change
};

struct EventFunction {
  static constexpr std::size_t alone = std::numeric_limits<std::size_t>::max();

  Callback function;          ///< e(t, y) -> (1,); empty: a component of `vector`
  std::int64_t terminal = 0;  ///< ends the run at this occurrence; 0: never
  int direction = 0;          ///< > 0: rising in the direction of integration, < 0: falling, 0: both
  Callback action;            ///< (t, y) -> y from there on, or empty
  Callback jump;              ///< (t, Y before, y after) -> S from there on, (k, n), where there are sensitivities
  bool rehold = true;         ///< after the action invariants are held at their new values
  /// Points inside a step at which it is evaluated, if these are more than the usual ones; or as many as it takes to
  /// separate its roots; 0: these only in steps where the usual ones leave room for more roots than they show.
  int samples = 0;
  static constexpr int adaptive = -1;
  std::optional<Series> series;  ///< along a polynomial y, for methods whose steps are such
  bool touching = false;         ///< there, zeros without a change of sign count too
  bool at_jumps = true;          ///< it occurs where a jump of y changes its sign
  std::size_t vector = alone;    ///< number of the `RootVector` that it belongs to

  /// Returns whether y jumps where it occurs.
  [[nodiscard]] bool acts() const { return static_cast<bool>(action) || vector != alone; }
};

/// An event that happened.
struct Occurrence {
  std::size_t event;
  double t;
  int direction = 0;  ///< the sign that the event takes on; 0: it has touched zero
};

/// Occurrences with an action that come closer and closer, up to the one after which the event stays on the side to
/// which it has crossed: a ball that bounces infinitely often in a finite time falls through the floor in the end.
struct Accumulation {
  std::size_t event = 0;
  double t = 0;            ///< of the last one
  double interval = 0;     ///< from the one before
  std::int64_t count = 0;  ///< so many there were

  void state(Archive& archive) { archive(event, t, interval, count); }
};

/// Watches the events from step to step. A sign change between successive points of a step (its ends and as many
/// interior ones as the degree, or 3, or those that an event requests, or where it turns if that is known) brackets a
/// root; where the values leave room for a pair of roots between two points, the event is resolved by interpolation.
/// Tangencies without a sign change are not events unless an event asks for them. An event that is exactly zero
/// sleeps until it has left zero, so that a zero at the start is not reported, and one at a step's end only once.
///
/// A jump of y at t is judged by `leave`, at the state before it, and `arrive`, at the state behind it: an event occurs
/// if its signs differ. One that has just occurred has the sign 0 until a jump moves it away from zero.
class Events {
 public:
  Events(std::vector<EventFunction> functions, std::vector<RootVector> vectors, std::size_t n, int max_degree);

  [[nodiscard]] bool empty() const { return functions_.empty(); }
  [[nodiscard]] std::size_t count() const { return functions_.size(); }

  /// Takes the signs at the start of the integration.
  Outcome start(double t, const double* y);

  /// Finds the roots in the accepted step from t0 to (t1, y1), in the order of integration, and counts them. The first
  /// one that is terminal or has an action ends the list, together with those that tie with it. `degree`: of the
  /// extension of this step.
  Outcome search(double t0, double t1, const double* y1, int degree, StepInterpolant& interpolant);

  /// Takes the signs at (t, y), where the method starts again without a jump. The events that have just occurred sleep
  /// until they have left zero.
  Outcome restart(double t, const double* y);

  /// The solution is about to jump at (t, y). `inside`: t is not the end of the step that was searched.
  Outcome leave(double t, const double* y, bool inside);
  /// It has jumped to y. Appends the events whose signs the jump has changed, in their order.
  Outcome arrive(double t, const double* y, std::vector<Occurrence>& crossed);
  /// Counts an occurrence by a jump. True: it ends the run.
  [[nodiscard]] bool counts_out(std::size_t event) { return ++times_seen_[event] == functions_[event].terminal; }
  /// All that occurs at t has been dealt with; events that no jump has moved away from zero stay asleep.
  void forget_occurrences();

  /// The state of an event between two steps.
  struct Watch {
    double last;               ///< its value
    int sign;                  ///< where it was last not zero; 0: asleep
    std::int64_t occurrences;  ///< so far
    double slope;              ///< see `slope_`
  };
  [[nodiscard]] Watch watch(std::size_t event) const {
    assert(event < count());
    return {last_[event], sign_[event], times_seen_[event], slope_[event]};
  }
  void go_on_from(std::size_t event, const Watch& watch) {
    assert(event < count());
    last_[event] = watch.last;
    sign_[event] = watch.sign;
    times_seen_[event] = watch.occurrences;
    slope_[event] = watch.slope;
  }

  void state(Archive& archive);
  /// Continues at (t, y) after the occurrences of the last search, which may have ended a run: the count that did so
  /// starts again.
  Outcome go_on(double t, const double* y);

  /// The occurrences of the last search.
  [[nodiscard]] const std::vector<Occurrence>& occurrences() const { return occurrences_; }
  [[nodiscard]] bool terminal() const { return terminal_; }
  /// Returns whether an action is to be taken at the last occurrence.
  [[nodiscard]] bool acts() const { return acts_; }
  [[nodiscard]] EventFunction& function(std::size_t event) { return functions_[event]; }
  [[nodiscard]] RootVector& vector(std::size_t number) { return vectors_[number]; }
  /// The first one in the run.
  [[nodiscard]] const std::optional<Accumulation>& accumulation() const { return accumulation_; }
  /// The event that was NaN in an outcome `not_finite`, and where.
  [[nodiscard]] const Occurrence& undefined() const { return undefined_; }

 private:
  struct SearchedStep {
    double t0, t1;
    const double* y1;
    StepInterpolant* interpolant;
  };
  struct Scan {
    std::vector<double> times;   // both ends of the step included
    std::vector<double> values;  // of one event
  };
  struct Bracket {
    std::size_t a, b;  // indices into the scan; the event may be exactly zero at b
  };
  /// Values of a vector of events at a point of the step in work.
  struct Evaluated {
    double t;
    std::vector<double> y, values;
  };

  /// The history of the actions of an event.
  struct Actions {
    double t = 0;  // of the last one
    double interval = std::numeric_limits<double>::infinity();
    std::int64_t count = 0;
    std::int64_t shorter = 0;  // so many intervals in a row were each shorter than the one before
    int crossed = 0;           // the sign to which the event has just changed; 0: it is awake
    bool returned = false;     // after the action before, the event was back on the side where it came from
  };
  void note_action(const Occurrence& occurrence);
  void note_waking(std::size_t event, int sign);

  Outcome evaluate(std::size_t event, double t, const double* y, double& value);
  Status evaluate_vector(std::size_t number, double t, const double* y, const double*& values);
  void forget_values();
  [[nodiscard]] bool leaves_room(std::size_t event);
  [[nodiscard]] bool may_be_roundoff(std::size_t event, double value) const;
  Outcome is_roundoff(std::size_t event, double t, const double* y, double value, bool& so);
  Outcome points(bool projected);
  Outcome find(std::size_t event);
  Outcome scan(std::size_t event, bool projected);
  Outcome scan_closely(std::size_t event, int samples);
  Outcome roundoff_of(std::size_t event, double t, const double* y, double value, double& noise);
  void note_size(std::size_t event, double size, double slope);
  void note_size(std::size_t event);
  [[nodiscard]] bool by_turning_points(std::size_t event) const;
  Outcome scan_turning_points(std::size_t event);
  void join_close_roots();
  Outcome find_touching(std::size_t event);
  [[nodiscard]] int sign_after(std::size_t j) const;
  Outcome within_roundoff(std::size_t event, double t, const double* y, double value, double size, bool& within);
  bool is_new_touching(const Occurrence& root);
  Outcome evaluate_inside(std::size_t event, double t, double& value);
  void find_brackets(std::size_t event, const Scan& scan);
  Outcome locate(std::size_t event, const Scan& scan, const Bracket& bracket, double& root);
  Outcome locate_first_zero(std::size_t event, double before, double zero, double& root);
  void settle();
  [[nodiscard]] double step_ulp() const;

  std::vector<EventFunction> functions_;
  std::vector<RootVector> vectors_;
  std::vector<std::vector<Evaluated>> evaluated_;  // of each vector, the latest
  std::vector<std::size_t> oldest_;                // of these, the one that is overwritten next
  std::size_t n_;
  std::size_t intervals_;
  SearchedStep step_{};
  Scan scan_;        // at intervals + 1 times, the same for all events
  Scan close_scan_;  // of an event with samples of its own
  std::optional<RootSeparator> separator_;
  TurningPoints turning_points_;
  std::vector<double> powers_, thetas_;  // of the step, if it is a polynomial; where an event turns
  bool powers_known_ = false;
  std::vector<double> points_[2];  // y at the interior times: corrected, projected
  bool points_known_[2] = {false, false};
  std::vector<Bracket> brackets_;  // of one event in the step,
  std::vector<Occurrence> roots_;  // and its zeros
  std::vector<double> last_;       // value of each event at the end of the last step
  std::vector<int> sign_;          // of each event where it was last not zero; 0: asleep
  int sign_after_ = 0;             // what it becomes with the step
  int woken_ = 0;                  // the first one that it takes on in the step, if it was asleep
  std::vector<double> touched_;    // t at which each has touched zero; NaN: nowhere
  std::vector<double> size_;       // largest |e| among the points of the last step; infinite: not known
  std::vector<double> slope_;      // largest |Δe / Δt| between neighbours among them
  std::vector<int> sign_before_;   // of each event at the start of the last step
  std::vector<double> root_;       // a jump: the value of an event at its root, from which it has not been moved; NaN:
                                   // it is none
  double left_at_ = std::numeric_limits<double>::quiet_NaN();  // the time of that jump
  std::vector<Actions> actions_;
  std::optional<Accumulation> accumulation_;
  std::vector<std::int64_t> times_seen_;
  std::vector<double> y_;
  std::vector<Occurrence> occurrences_;
  bool terminal_ = false;
  bool acts_ = false;
  Occurrence undefined_{};
};

}  // namespace invariode
