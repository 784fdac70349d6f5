#pragma once
// The loop: one for all methods.

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "output/events.hpp"
#include "manifold/guard.hpp"
#include "output/interpolant.hpp"
#include "manifold/invariants.hpp"
#include "output/output.hpp"
#include "manifold/projection.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// What the run was asked for, beyond the problem and the method.
struct Settings {
  double t0 = 0;
  double tf = 0;
  double hmax = 0;               ///< infinite: no cap
  double first_step = 0;         ///< 0: chosen by the method
  int iterations = 1;            ///< of the projection in a step
  int refine = 1;                ///< points per step
  bool output_at_times = false;  ///< `times` instead of the steps
  std::vector<double> times;     ///< in the order of integration, inside the interval
  Interpolation interpolation = Interpolation::projected;
  bool dense = false;
  bool save_all = true;   ///< false: the final point only
  bool record = true;     ///< with save_all: a record of each step too
  bool check = true;      ///< the tests that may find an invariant to be none
  bool resumed = false;   ///< goes on from where another run ended: its start was inspected then
  double negligible = 0;  ///< candidates so close to the manifold, in units of rtol, are not projected
};

enum class State {
  created,
  running,
  reached_end,
  terminal_event,
  stopped_by_callback,
  interrupted,         ///< a user function raised
  event_undefined,     ///< an event function returned NaN
  action_undefined,    ///< an action returned NaN or infinity
  start_undefined,     ///< f is not finite at the start
  step_failed,         ///< an attempt failed at hmin
  invariant_refused,   ///< at the start; see the finding
  invariant_convicted  ///< during the run
};

/// Where and why a run ended, for whoever writes the message.
struct Report {
  double t = 0;
  double h = 0;
  Cause cause = Cause::error;
  int component = -1;          ///< of y, that is not finite, or that pure relative control cannot resolve
  bool pure_relative = false;  ///< y_i = 0 and atol_i = 0 made the error test fail
  LinearWork linear;           ///< of an implicit method, in the attempt that failed
  std::size_t event = 0;
  Finding finding;
};

struct Counts {
  std::int64_t steps = 0, failed = 0, projections = 0, skipped = 0;
};

/// What projection met in the accepted steps: of each invariant the largest residual before it, and as a distance in
/// units of rtol; of all together the largest correction, in units of rtol.
struct Drift {
  std::vector<double> residual, distance;
  double correction = 0;
};

/// A jump of the solution: from which row of the output on it holds, and the values that invariants have from there.
struct Jump {
  std::size_t row;
  double t;
  std::vector<double> value;
};

/// Integrates one initial value problem with one method. `start` then `advance` by accepted steps, or `run` to the end;
/// both can be called again after `advance` returned `running`.
class Integration {
 public:
  /// What the solution is kept on: `steps` by projection after each step, `between` in the output between them, `slope`
  /// is y' as a function, with which invariants are tested. Null: nothing.
  struct Manifold {
    Invariants* steps = nullptr;
    Invariants* between = nullptr;
    Callback slope;
  };

  /// The manifold's invariants and the callbacks belong to the caller and outlive this. `callback` may be empty.
  Integration(std::unique_ptr<Step> step, const Weights& weights, const Manifold& manifold,
              std::vector<EventFunction> events, Callback callback, Settings settings);

  State start(const double* y0);
  State advance();
  State run();

  [[nodiscard]] State state() const { return state_; }
  [[nodiscard]] const Report& report() const { return report_; }
  [[nodiscard]] const Counts& counts() const { return counts_; }
  [[nodiscard]] const Step& step() const { return *step_; }
  /// The point reached, which a terminal event moves back into the last step.
  [[nodiscard]] double t() const { return reached_t_; }
  [[nodiscard]] const double* y() const { return reached_y_; }
  /// The continuous solution over the step just accepted, on its own. Nothing: a user function has stopped the run.
  std::optional<DenseOutput> last_step();
  [[nodiscard]] const Guard* guard() const { return guard_ ? &*guard_ : nullptr; }
  [[nodiscard]] const Projector* projector() const { return projector_ ? &*projector_ : nullptr; }

  /// The results, to be moved out when the run has ended.
  Trajectory points;
  std::vector<Trajectory> occurrences;  ///< of each event
  Buffer<AcceptedStep> steps;
  std::optional<DenseOutput> dense;
  Drift drift;
  std::vector<Jump> jumps;

 private:
  enum class Verdict { accepted, rejected, ended };

  State end(State state);
  State refuse(const Finding& finding);
  State after(Events::Result result);
  State nothing_to_integrate();
  State inspect_start(double* y0);
  State start_memory(const double* y0);
  State start_method(const double* y0);
  void begin_step();
  Verdict attempt();
  Verdict project(const double* candidate);
  Verdict reject(Cause cause);
  Verdict oversized(const double* candidate);
  void explain_failure(Cause cause);
  State finish_step();
  State locate_events();
  State emit(double t, const double* y, bool jumps_there = false);
  State jump(double t);

  std::unique_ptr<Step> step_;
  const Weights& weights_;
  Invariants* invariants_;
  Settings settings_;
  Callback callback_;
  std::size_t n_;
  double forward_;
  std::optional<Projector> projector_;  // of the steps
  std::optional<Projector> between_;    // of points between steps
  std::optional<Guard> guard_;
  Events events_;
  StepInterpolant interpolant_;

  State state_ = State::created;
  Report report_;
  Counts counts_;
  double h_ = 0, t1_ = 0, hmin_ = 0;  // of the attempt; h_ is signed
  bool landing_ = false;              // t1_ is tf
  double error_ = 0;
  double correction_ = 0;         // max_i |y*_i − y₁_i| / w_i
  double oversized_[2] = {0, 0};  // sizes of the latest two corrections refused in this step
  int oversized_count_ = 0;       // how many were refused
  double reached_t_ = 0;
  const double* reached_y_ = nullptr;
  double t0_ = 0;                      // start of the step
  std::vector<double> y0_;             // y there
  std::vector<double> y1_;             // the projected candidate
  std::vector<double> point_;          // state at an event
  std::vector<double> between_point_;  // output between steps
  std::size_t next_time_ = 0;
};

}  // namespace invariode
