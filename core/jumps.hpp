#pragma once
// What happens where y jumps (docs/algorithms.md, 'Jumps').

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <vector>

#include "breaks.hpp"
#include "delays/delays.hpp"
#include "initial_checks.hpp"
#include "linear/mass.hpp"
#include "manifold/manifold.hpp"
#include "output/events.hpp"
#include "output/output.hpp"
#include "report.hpp"
#include "sensitivity/variations.hpp"

namespace invariode {

/// Carries Y = (y, S) over all that moves it at one time: actions of events and of breakpoints, algebraic equations,
/// constraints, bounds.
///
///   y⁺ = h(t, y⁻), moved onto the algebraic equations; S⁺ follows it. Then each event is judged at y⁺: those whose
///   sign the jump has changed occur, and their actions are taken after those that are due already. When none is due, y
///   is put back onto constraints and within bounds, and judged once more.
///
/// Each method returns `running` if the solution goes on from Y; else the state in which the run ends: at a terminal
/// event, Y is the state behind the jump that it occurred by.
class Jumps {
 public:
  /// All of these belong to the loop.
  struct Parts {
    Events& events;
    Breaks& breaks;
    Manifold& manifold;
    InitialChecks& checks;
    std::vector<Trajectory>& occurrences;  ///< of each event, those of the run
    Delays* delays;                        ///< null: f takes no earlier values
  };
  Jumps(const Parts& parts, std::function<Consistency(double t, double* y)> consistent,
        std::function<Status(double t, double* Y)> consistent_tangent, Callback f, std::optional<DifferentialRate> rate,
        std::size_t n, std::size_t size);

  /// The actions of the events of the last search that occurred at t. `inside`: t is not the end of that step.
  [[nodiscard]] State at_events(double t, double* Y, bool inside);
  /// The actions at the breakpoints at t, after those of events there, if there were any.
  [[nodiscard]] State at_breakpoints(double t, double* Y, bool inside);
  /// The sensitivities behind a landing, whose time depends on parameters; y goes on.
  [[nodiscard]] State at_landing(double t, double* Y);
  /// Takes the delayed values at t, for the jumps there: those before what delays bring to t, which comes last.
  [[nodiscard]] Status note_past(double t);
  /// The sensitivities behind what each delay brings to t, at times that depend on parameters: S⁺ = S⁻ + (y'⁻ − y'⁺)
  /// ∂t/∂p for one delay after the other. `rates`: (delays, k).
  [[nodiscard]] Status at_moving_mark(double t, std::span<const double> rates, double* Y);
  /// ∂t/∂p of the latest jump of y, (k,), of a run with delays and sensitivities.
  [[nodiscard]] const std::vector<double>& rates() const { return rates_; }
  /// Tells the sensitivities of an event that occurs without an action, at (t, Y).
  [[nodiscard]] Status note_occurrence(Callback& jump, double t, const double* Y);
  /// Moves Y onto the algebraic equations, without any action; and only S onto their tangent.
  [[nodiscard]] State onto_equations(double t, double* Y);
  [[nodiscard]] State follow_equations(double t, double* Y);

  /// Details for the report of a run that ends by a jump.
  struct Remarks {
    std::size_t event = 0;            ///< the event that is not finite, or whose action was taken last
    std::optional<double> t;          ///< the time at which it is not finite
    std::vector<std::size_t> circle;  ///< events whose actions set each other off
    Finding finding = {};
    int component = -1;  ///< the one outside its bounds
  };
  [[nodiscard]] const Remarks& remarks() const { return remarks_; }

  /// `acted` and `moved`: the latest call of `at_events` or `at_breakpoints` has taken an action, or changed Y.
  [[nodiscard]] bool acted() const { return acted_; }
  [[nodiscard]] bool moved() const { return moved_; }
  /// Returns whether invariants have other values there, without an action.
  [[nodiscard]] bool others() const { return others_; }

 private:
  /// An event whose action has yet to be taken.
  struct Due {
    std::size_t event;
    int direction;
    int depth;    ///< so many jumps, each of which caused the next, led to it; 0: it is a root
    bool listed;  ///< its occurrence is known, but not yet with the state before its action
  };

  Status slope_with(std::span<const double> past, double t, const double* y, double* out);
  Status call(Callback& jump, double t, const double* y);
  State begin(double t, const double* Y, bool inside);
  State undefined_event(double t);
  State work(double t, double* Y);
  State take_next(double t, double* Y);
  State take(Callback& action, const double* given, Callback& jump, double t, double* Y);
  State follow(Callback& jump, double t, double* Y);
  State without_action(double t, double* Y, bool inside);
  State solve_equations(double t, double* y);
  State judge(double t, const double* y, int depth);
  State restore(double t, double* y);
  State ended_by(double t, double* y);
  void list(const Due& due, double t, const double* Y);

  Parts parts_;
  Remarks remarks_;
  std::function<Consistency(double t, double* y)> consistent_;
  std::function<Status(double t, double* Y)> consistent_tangent_;
  Callback f_;
  std::optional<DifferentialRate> rate_;
  std::vector<double> slope_, slope_behind_;  // y' before a mark, and behind it
  std::vector<double> past_;                  // the delayed values before what delays bring, (delays, n)
  std::vector<double> past_behind_;           // and behind it
  std::vector<double> jumped_;                // (2 k, n): S behind a jump, then rows that begin with ∂t/∂p_j
  std::vector<double> rates_;
  Extent extent_;
  std::vector<Due> due_;
  std::vector<Occurrence> crossed_;
  std::vector<double> before_;  // Y before an action, and behind it the state after it
  std::vector<double> told_;    // y before the action of a vector, and the direction of each of its functions, or 0
  std::vector<double> raw_;     // y before it is put back onto constraints
  bool rehold_ = true;          // every event that has acted asks for it
  std::size_t occurred_ = 0;    // so many events by jumps, at this time
  bool acted_ = false, moved_ = false, others_ = false, terminal_ = false;
};

}  // namespace invariode
