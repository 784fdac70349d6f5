#pragma once
// The loop: one for all methods.

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include "aim.hpp"
#include "discontinuity.hpp"
#include "linear/mass.hpp"
#include "manifold/active_set.hpp"
#include "manifold/bounds.hpp"
#include "manifold/guard.hpp"
#include "manifold/harm.hpp"
#include "manifold/one_sided.hpp"
#include "manifold/projection.hpp"
#include "manifold/restoration.hpp"
#include "output/events.hpp"
#include "output/interpolant.hpp"
#include "output/output.hpp"
#include "piece.hpp"
#include "report.hpp"
#include "settings.hpp"
#include "slope.hpp"
#include "step.hpp"
#include "stiffness.hpp"
#include "weights.hpp"

namespace invariode {

/// A time at which f, g or their derivatives may jump, and what the solution does there, if it does.
struct Breakpoint {
  double t;
  Callback action;  ///< (t, y) -> y from there on, or empty
};

/// Integrates one initial value problem with one method. `start` then `advance` by accepted steps, or `run` to the end;
/// both can be called again after `advance` returned `running`.
class Integration {
 public:
  /// What the solution is kept on: `steps` by projection after each step, `between` in the output between them; `slope`
  /// is y' as a function, with which invariants are tested. Null: no invariants. And within bounds, or null.
  struct Manifold {
    Invariants* steps = nullptr;
    Invariants* between = nullptr;
    Slope* slope = nullptr;
    const Bounds* bounds = nullptr;
    BoundedSlope* bounded_slope = nullptr;  // what the method integrates within them; null: f itself
    bool off_bounds_only = false;           // steps are projected only after they were moved onto bounds
  };

  /// Where the run starts anew, `piece` being told; `consistent` moves y at t onto the algebraic equations, where there
  /// are some.
  struct Breaks {
    std::vector<Breakpoint> points;
    Piece* piece = nullptr;
    std::function<Consistency(double t, double* y)> consistent;
  };

  /// The manifold and the callbacks belong to the caller and outlive this. `f`: what jumps are looked for in.
  /// `callback` may be empty.
  Integration(std::unique_ptr<Step> step, const Weights& weights, Callback f, const Manifold& manifold,
              std::vector<EventFunction> events, Breaks breaks, Callback callback, Settings settings);

  /// Ends the run after the first accepted step that finds the request true: whoever makes it keeps it meanwhile.
  void heed(const std::atomic<bool>& request) {
    request_ = &request;
    next_look_ = 0;
  }

  State start(const double* y0);
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
  /// The point reached, which a terminal event moves back into the last step.
  [[nodiscard]] double t() const { return reached_.t; }
  [[nodiscard]] const double* y() const { return reached_.y; }
  /// From now on `last_step` also knows a step at whose end the solution jumps or f does: it is then put together
  /// before the method starts again, which may take evaluations of f.
  void keep_last_step() { keeps_last_ = true; }
  /// The continuous solution over the step just accepted, on its own. Nothing: a user function has stopped the run.
  std::optional<DenseOutput> last_step();
  [[nodiscard]] const Guard* guard() const { return guard_ ? &*guard_ : nullptr; }
  /// What projections have done to the components of y, so far.
  [[nodiscard]] Harm harm() const { return harm_ ? harm_->harm(weights_.rtol()) : Harm{}; }
  [[nodiscard]] Stiffness stiffness() const { return stiffness_.found(); }
  [[nodiscard]] const DiscontinuityDetector& discontinuities() const { return discontinuities_; }
  [[nodiscard]] const std::optional<Accumulation>& accumulation() const { return events_.accumulation(); }
  [[nodiscard]] const Projector* projector() const { return projector_ ? &*projector_ : nullptr; }

  /// The results, to be moved out when the run has ended.
  Trajectory points;
  std::vector<Trajectory> occurrences;  ///< of each event
  Buffer<AcceptedStep> steps;
  std::optional<DenseOutput> dense;
  Drift drift;
  double clipped = 0;  ///< what moving candidates onto bounds has added to the sum of the components
  std::vector<Jump> jumps;

 private:
  enum class Verdict { accepted, rejected, ended };
  struct Point {
    double t;
    const double* y;
  };
  /// What is known of the attempts of a step, so far.
  struct Attempted {
    double error = 0;
    double correction = 0;       // max_i |y*_i − y₁_i| / w_i
    double refused[2] = {0, 0};  // sizes of the latest two corrections refused in this step
    int refusals = 0;            // how many were
    bool reconciled = false;     // its start has been moved onto the algebraic equations
  };
  /// The latest candidate and the bounds, if there are any.
  struct Outside {
    bool off_bounds = false;  // whether it was outside
    double clipped = 0;       // what moving it onto them added to the sum of its components
    int component = -1;       // for which the attempt was rejected
  };

  // What returns bool says whether the run goes on.
  bool end(State state);
  bool refuse(const Finding& finding);
  bool nothing_to_integrate();
  [[nodiscard]] bool between_steps() const;
  bool start_again();
  bool inspect_start();
  bool start_within_bounds();
  bool project_start_within_bounds();
  bool start_memory(double t, const double* y);
  bool start_rate(double t, const double* y);
  bool watch_events(Outcome outcome);

  bool begin_step();
  bool meet_bounds();
  Verdict attempt();
  Verdict stay_within_bounds(const double*& y1);
  Verdict project(const double* candidate);
  void tell_directions();
  Verdict oversized(const double* candidate);
  Verdict reject(Cause cause);
  Verdict ended(State state);
  bool explain_failure(Cause cause);
  bool reconcile();
  bool settle_at_bounds();
  bool start_step_anew(const double* y);
  [[nodiscard]] double roundoff_of_correction() const;
  /// The correction belongs to the bounds as well: it tells nothing of the invariants.
  [[nodiscard]] bool at_bounds() const { return active_set_ && active_set_->active(); }

  State finish_step();
  void note_drift();
  bool judge_invariants();
  bool judge_start_of_step();
  bool find_events();
  bool record();
  [[nodiscard]] bool jumps_here() const;
  bool emit(bool jumps_here);
  bool emit_times(bool jumps_here);
  bool emit_before_end();
  bool emit_inside(double t);
  bool conclude();
  bool keep_step_left();
  void leave_step(const double* y);
  bool jump();
  bool take_actions(bool& rehold);
  bool take(Callback& action);
  /// Does the step end at a breakpoint?
  [[nodiscard]] bool at_breakpoint() const { return aim_.lands() && break_t_ == aim_.t1(); }
  /// Is the point reached a breakpoint that has not been passed?
  [[nodiscard]] bool breaks_here() const { return here(break_t_, reached_.t); }
  /// Is a breakpoint at t, or so close to it that no step fits between?
  [[nodiscard]] static bool here(double breakpoint, double t);
  [[nodiscard]] std::size_t next_piece() const;
  void pass_breakpoints(std::size_t count);
  void begin_piece();
  void enter_piece();
  bool pass_breakpoint();
  bool make_consistent(bool& moved);
  bool go_on_from_jump(bool rehold);
  bool goes_on();
  [[nodiscard]] std::int64_t steps_to_spare() const;
  [[nodiscard]] bool limited_in_time() const;
  [[nodiscard]] bool out_of_time() const;
  [[nodiscard]] double seconds() const;
  [[nodiscard]] std::int64_t kept_points() const;
  [[nodiscard]] std::int64_t kept_bytes() const;
  bool reach(Limit limit);

  std::unique_ptr<Step> step_;
  const Weights& weights_;
  Invariants* invariants_;
  const Bounds* bounds_;
  BoundedSlope* bounded_slope_;
  bool off_bounds_only_;
  Settings settings_;
  Callback callback_;
  std::size_t n_;
  double forward_;
  Aim aim_;                                    // of the attempt in work
  std::optional<Projector> projector_;         // of the steps
  std::optional<Projector> output_projector_;  // of points between steps
  std::optional<ActiveSet> active_set_;        // projects steps where there are bounds
  std::optional<OneSided> one_sided_;          // and where some invariants may only rise or fall
  std::optional<Guard> guard_;
  std::optional<Restoration> restoration_;  // after jumps
  std::optional<HarmDetector> harm_;
  StiffnessDetector stiffness_;
  DiscontinuityDetector discontinuities_;
  Events events_;
  std::optional<StepInterpolant> interpolant_;

  State state_ = State::created;
  Report report_;
  Counts counts_;
  Attempted attempt_;
  Outside outside_;
  Projected projected_;                    // of the accepted candidate
  Point reached_{0, nullptr};              // the step, or the event that has cut it
  std::vector<double> y1_;                 // the projected candidate
  std::vector<const double*> directions_;  // of corrections, where they are those of the step
  std::vector<double> event_y_;            // state at an event
  std::vector<double> inside_y_;           // output inside a step
  std::size_t next_time_ = 0;
  Breaks breaks_;
  std::size_t next_break_ = 0;
  double break_t_;                 // of the next one; NaN after the last
  double piece_start_ = 0;         // of the present piece: the last breakpoint at its start, or where the run began
  bool piece_from_break_ = false;  // which is a breakpoint
  bool keeps_last_ = false;        // see `keep_last_step`
  std::optional<DenseOutput> left_step_;  // the last step, if the method has started again at its end
  bool left_ = false;                     // the method's memory is not that of the point reached
  bool in_step_ = false;                  // a limit was reached between two attempts
  bool anew_ = false;                     // the memory that was read is not enough: the method starts again
  std::int64_t steps_before_ = 0;         // of the run that goes on here
  const std::atomic<bool>* request_ = nullptr;
  std::int64_t next_look_ = 0;  // at the limits: after so many steps
  std::chrono::steady_clock::time_point started_;
};

}  // namespace invariode
