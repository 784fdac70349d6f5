#pragma once
// The loop: one for all methods.

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "aim.hpp"
#include "breaks.hpp"
#include "composite_interface.hpp"
#include "delay_interface.hpp"
#include "delays/delays.hpp"
#include "detect/below_zero.hpp"
#include "detect/discontinuity.hpp"
#include "detect/stiffness.hpp"
#include "initial_checks.hpp"
#include "jumps.hpp"
#include "limits.hpp"
#include "linear/mass.hpp"
#include "manifold/bounds.hpp"
#include "manifold/manifold.hpp"
#include "output/emitter.hpp"
#include "output/events.hpp"
#include "output/interpolant.hpp"
#include "output/output.hpp"
#include "report.hpp"
#include "settings.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// The functions of a problem that the loop calls, or at whose changes it starts the method again.
struct LoopFunctions {
  Callback f;                                 ///< jumps of f are looked for in it
  BoundedSlope* bounded_slope = nullptr;      ///< what the method integrates within bounds; null: f itself
  std::optional<DifferentialRate> rate;       ///< y' of f, with a mass matrix
  std::optional<DifferentialRate> jump_rate;  ///< the same, for jumps of sensitivities that delays bring
  bool signed_states = false;                 ///< components may be negative: see `BelowZero`
  bool autonomous = false;                    ///< f does not depend on t: it brings no pulses
  std::vector<EventFunction> events;
  std::vector<RootVector> vectors;  ///< of which some events are components
  std::vector<Breakpoint> breakpoints;
  Landings landings;
  Delays* delays = nullptr;  ///< which f takes; null: none
  std::span<const double> history_jumps;
  int most_level = 0;      ///< of marks: of higher derivatives that jump the method sees nothing
  Piece* piece = nullptr;  ///< through which functions are called that may jump at breakpoints
  /// Moves y at t onto the algebraic equations. An empty function if M is regular.
  std::function<Consistency(double t, double* y)> consistent;
  /// Moves the sensitivities of such a y likewise. An empty function if there are no sensitivities, or M is regular.
  std::function<Status(double t, double* Y)> consistent_tangent;
  Callback callback;  ///< after each step; may be empty
};

/// Integrates one initial value problem with one method. `start` then `advance` by accepted steps, or `run` to the end;
/// both can be called again after `advance` returned `running`.
class Integration {
 public:
  /// The weights of the state and what the manifold refers to belong to the caller and outlive this. The step is one of
  /// the state, or of the state with its sensitivities.
  Integration(std::unique_ptr<Step> step, const Weights& weights, const ManifoldTerms& manifold,
              LoopFunctions functions, Settings settings);

  /// Ends the run after the first accepted step that finds the request true. The request belongs to the caller.
  void stop_on(const std::atomic<bool>& request) { limits_.stop_on(request); }
  /// Has `watch` called within long linear algebra. If it returns false, the run ends as if a user function had raised.
  void watch_by(std::function<bool()> watch) { watch_ = std::move(watch); }
  /// Gives up a proposal of the method, by throwing `Interruption`, if the run is to end: for `Lapack::poll`. Nothing
  /// else is given up: the start of the method, decisions about an attempt, what happens at jumps.
  void poll();

  State start(const double* y0);
  /// After `start`: see `Step::trust_first_step`.
  void trust_first_step() { step_->trust_first_step(); }
  /// Instead of `start`: goes on from the memory that `state` has read, as the run would have that wrote it. `anew`:
  /// the method is to start again, with `Settings::first_step` if it is given.
  State resume(bool anew);
  /// All that a run remembers between two steps, but what it has put out.
  void state(Archive& archive);
  /// The run is over, but for its memory and its results.
  void end_attempts() { step_->end_attempts(); }
  State advance();
  State run();

  [[nodiscard]] State state() const { return state_; }
  [[nodiscard]] const Report& report() const { return report_; }
  [[nodiscard]] const Counts& counts() const { return counts_; }
  [[nodiscard]] const Step& step() const { return *step_; }
  /// The number of switches from an explicit method to an implicit one, or back.
  [[nodiscard]] std::int64_t switches() const { return composite_ != nullptr ? composite_->switches() : 0; }
  /// The point reached, which a terminal event moves back into the last step.
  [[nodiscard]] double t() const { return reached_.t; }
  [[nodiscard]] double forward() const { return forward_; }  ///< 1, or −1: the run is backwards
  [[nodiscard]] const double* y() const { return reached_.y; }
  /// The results, to be moved out when the run has ended.
  [[nodiscard]] Output& output() { return emitter_.output; }
  [[nodiscard]] const Output& output() const { return emitter_.output; }
  /// From now on `last_step` also has a step at whose end the solution or f jumps: it is then put together
  /// before the method starts again, which may take evaluations of f.
  void keep_last_step() { keeps_last_ = looks_between_ = true; }
  /// The continuous solution over the step just accepted, on its own. Nothing: a user function has stopped the run.
  std::optional<DenseOutput> last_step();
  /// The maximum size, in bytes, of the continuous solution over a step.
  [[nodiscard]] std::size_t most_bytes_of_step() const;
  /// Returns whether the method's history is that of the point reached, and nothing is to happen there before the next
  /// step.
  [[nodiscard]] bool between_steps() const;
  [[nodiscard]] const Manifold& manifold() const { return manifold_; }
  [[nodiscard]] Stiffness stiffness() const { return stiffness_.found(); }
  [[nodiscard]] const DiscontinuityDetector& discontinuities() const { return discontinuities_; }
  /// A component that has fallen below 0 though f did not lead it there, and still is.
  [[nodiscard]] Component below_zero() const { return below_zero_.deepest(reached_.y); }
  /// Evaluations of f in search of its jumps, and by tests of components below 0.
  [[nodiscard]] std::int64_t evaluations_of_checks() const {
    return discontinuities_.evaluations() + below_zero_.evaluations();
  }
  /// The marks that the run has passed: t and level of one after the other.
  [[nodiscard]] const std::vector<double>& passed_marks() const { return passed_marks_; }
  [[nodiscard]] const std::optional<Accumulation>& accumulation() const { return events_.accumulation(); }

 private:
  /// The run goes on or has ended; if it has ended, `state_` holds the reason.
  enum class [[nodiscard]] Course { goes_on, ended };
  /// The outcome of an attempt; `ended`: the run has ended.
  enum class [[nodiscard]] Verdict { accepted, rejected, ended };
  /// The outcome of a remedy for attempts that fail however small h is. `none`: the remedy does not apply; `cured`: the
  /// step has started again with it; `ended`: the run has ended.
  enum class [[nodiscard]] Cure { none, cured, ended };
  /// The attempts of a step so far.
  struct Attempted {
    double error = 0;
    double refused[2] = {0, 0};  // sizes of the latest two corrections refused in this step
    int refusals = 0;            // how many were
    double landing = 1;          // the part of the last one after which a component is outside of its bounds
    int landings = 0;            // attempts that were to end at a bound
    bool reconciled = false;     // its start has been moved onto the algebraic equations
    bool disagrees = false;      // the last one does not agree with its own delayed values
  };

  /// A point where the solution may jump.
  struct Landing {
    bool acts, breaks;    // by the actions of events; at breakpoints
    bool inside = false;  // of the step that has been searched for events
    bool noted = false;   // the values of the invariants before it are known
  };

  static bool ended(Course course) { return course == Course::ended; }
  Course end(State state);
  Course refuse(const Finding& finding);
  Course pass(const InitialChecks::Result& check);
  Course unless_stopped(Status status) { return status == Status::ok ? Course::goes_on : end(State::interrupted); }
  void nothing_to_integrate();
  Course start_again();
  Course start_memory(double t, const double* y);
  Course resolve_first_step(double t, const double* y);
  Course watch_events(Outcome outcome);

  Course begin_step();
  Course meet_bounds();
  Verdict attempt();
  Verdict attempt_or_give_up();
  Step::Attempt propose();
  Verdict test(const Step::Attempt& proposal);
  Verdict pass_jump(const double* candidate);
  Verdict place(StepEnds& ends);
  Course find_visit();
  Verdict land_on_bound();
  Verdict oversized(const double* candidate);
  Verdict reject(Cause cause);
  Verdict end_attempt(State state);
  Course explain_failure(Cause cause);
  Cure reconcile();
  Cure settle_at_bounds();
  Course start_step_anew(const double* y);

  State finish_step();
  Course judge_invariants();
  Course find_discontinuities();
  Course find_events();
  Course find_arrived();
  Course rest();
  Course record();
  Course begin_past(const double* y);
  Course mark_images(double t, int level, std::span<const double> rates = {});
  [[nodiscard]] bool has_sensitivities() const { return n_ > weights_.size(); }
  [[nodiscard]] bool goes_smoothly_on(double t) const;
  Course pass_mark();
  Course emit(bool jumps_here);
  [[nodiscard]] bool jumps_here() const;
  Course conclude();
  Course keep_step_before_jump();
  Course find_undefined_below_zero();
  [[nodiscard]] std::vector<double> lower_bounds() const;  // empty: none
  void note_fastest();
  void note_pure_relative();
  void move_start(double t, const double* y);
  void discard_step(const double* y);
  Course land(const Landing& at);
  void report_jump();
  Course take_back();
  void begin_piece();
  Course note_values();
  Course go_on_from_jump();
  Course hold_other_values();
  void begin_output();
  void look_at_limits();
  void reach(Limit limit);
  [[nodiscard]] DenseOutput no_steps() const;

  std::unique_ptr<Step> step_;
  CompositeInterface* composite_;  // null: the method is one
  Delays* delays_;                 // null: f takes no earlier values
  DelayInterface* delayed_;        // the method as one that takes such an f; null without delays
  std::vector<double> history_jumps_;
  int most_level_;
  std::vector<double> passed_marks_;
  const Weights& weights_;
  const Settings settings_;
  BoundedSlope* bounded_slope_;
  std::function<Consistency(double t, double* y)> consistent_;
  Callback callback_;
  std::size_t n_;  // doubles of Y: of the state, and of its sensitivities
  double forward_;

  State state_ = State::created;
  Report report_;
  Counts counts_;

  Aim aim_;  // of the attempt in work
  Manifold manifold_;
  InitialChecks initial_checks_;
  Breaks breaks_;
  Limits limits_;
  StiffnessDetector stiffness_;
  DiscontinuityDetector discontinuities_;
  BelowZero below_zero_;
  Events events_;
  StepInterpolant interpolant_;
  Emitter emitter_;
  Jumps jumps_;

  Attempted attempt_;
  std::vector<double> extension_;  // of an attempt, within bounds
  double t0_ = 0;                  // where the step starts
  std::vector<double> y0_;
  Reached reached_{0, nullptr};          // its end, or the event that has cut it
  std::vector<double> event_y_;          // state at an event
  std::vector<std::size_t> arrived_;     // components that the step has brought to rest at their bounds
  std::vector<double> rested_;           // Y after that, where their sensitivities have jumped to 0
  std::vector<double> left_;             // Y where it jumps, before all actions
  bool due_ = false;                     // the run that is continued ended before the actions of events
  bool keeps_last_ = false;              // see `keep_last_step`
  bool looks_between_ = false;           // values between steps are used, and are under error control
  double gap_;                           // between times at which f is seen, at most; infinite: no limit
  std::optional<DenseOutput> last_one_;  // the last step, if the method has started again at its end
  bool memory_outdated_ = false;         // the method's memory is not that of the point reached
  bool in_step_ = false;                 // a limit was reached between two attempts
  bool proposing_ = false;               // the method is making a proposal, which can be given up
  std::function<bool()> watch_;          // may be empty
  bool anew_ = false;                    // the memory that was read is not enough: the method starts again
};

}  // namespace invariode
