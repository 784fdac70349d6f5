#pragma once
// The loop: one for all methods.

#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "manifold/guard.hpp"
#include "manifold/harm.hpp"
#include "manifold/projection.hpp"
#include "output/events.hpp"
#include "output/interpolant.hpp"
#include "output/output.hpp"
#include "report.hpp"
#include "settings.hpp"
#include "slope.hpp"
#include "step.hpp"
#include "stiffness.hpp"
#include "weights.hpp"

namespace invariode {

/// Integrates one initial value problem with one method. `start` then `advance` by accepted steps, or `run` to the end;
/// both can be called again after `advance` returned `running`.
class Integration {
 public:
  /// What the solution is kept on: `steps` by projection after each step, `between` in the output between them; `slope`
  /// is y' as a function, with which invariants are tested. Null: no invariants.
  struct Manifold {
    Invariants* steps = nullptr;
    Invariants* between = nullptr;
    Slope* slope = nullptr;
  };

  /// The manifold and the callbacks belong to the caller and outlive this. `callback` may be empty.
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
  [[nodiscard]] double t() const { return reached_.t; }
  [[nodiscard]] const double* y() const { return reached_.y; }
  /// The continuous solution over the step just accepted, on its own. Nothing: a user function has stopped the run.
  std::optional<DenseOutput> last_step();
  [[nodiscard]] const Guard* guard() const { return guard_ ? &*guard_ : nullptr; }
  /// What projections have done to the components of y, so far.
  [[nodiscard]] Harm harm() const { return harm_ ? harm_->harm(weights_.rtol()) : Harm{}; }
  [[nodiscard]] Stiffness stiffness() const { return stiffness_.found(); }
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
  struct Point {
    double t;
    const double* y;
  };
  /// An attempt in work.
  struct Attempted {
    double h = 0, t1 = 0;  // h is signed
    double hmin = 0;
    bool landing = false;  // t1 is tf
    double error = 0;
    double correction = 0;       // max_i |y*_i − y₁_i| / w_i
    double refused[2] = {0, 0};  // sizes of the latest two corrections refused in this step
    int refusals = 0;            // how many were
  };

  // What returns bool says whether the run goes on.
  bool end(State state);
  bool refuse(const Finding& finding);
  bool nothing_to_integrate();
  bool inspect_start();
  bool start_memory(double t, const double* y);
  bool start_rate(double t, const double* y);
  bool watch_events(Outcome outcome);

  void begin_step();
  Verdict attempt();
  Verdict project(const double* candidate);
  Verdict oversized(const double* candidate);
  Verdict reject(Cause cause);
  Verdict ended(State state);
  void explain_failure(Cause cause);
  [[nodiscard]] double roundoff_of_correction() const;

  State finish_step();
  void note_drift();
  bool judge_invariants();
  bool find_events();
  bool record();
  bool emit(bool jumps_here);
  bool emit_times(bool jumps_here);
  bool emit_inside(double t);
  bool conclude();
  bool jump();
  bool take_actions(bool& rehold);

  std::unique_ptr<Step> step_;
  const Weights& weights_;
  Invariants* invariants_;
  Settings settings_;
  Callback callback_;
  std::size_t n_;
  double forward_;
  std::optional<Projector> projector_;         // of the steps
  std::optional<Projector> output_projector_;  // of points between steps
  std::optional<Guard> guard_;
  std::optional<HarmDetector> harm_;
  StiffnessDetector stiffness_;
  Events events_;
  std::optional<StepInterpolant> interpolant_;

  State state_ = State::created;
  Report report_;
  Counts counts_;
  Attempted attempt_;
  Projected projected_;           // of the accepted candidate
  Point reached_{0, nullptr};     // the step, or the event that has cut it
  std::vector<double> y1_;        // the projected candidate
  std::vector<double> event_y_;   // state at an event
  std::vector<double> inside_y_;  // output inside a step
  std::size_t next_time_ = 0;
};

}  // namespace invariode
