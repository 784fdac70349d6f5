#pragma once
// Does f jump where attempts fail one after the other? (docs/algorithms.md, 'Jumps of f')

#include <cstddef>
#include <cstdint>
#include <optional>
#include <vector>

#include "callback.hpp"
#include "detect/failed_series.hpp"
#include "report.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// Looks for a jump of f on a line between two points (t, y) of a solution, by halving it: of a smooth function each
/// half keeps half of the change, of a jump one half keeps all.
class JumpSearch {
 public:
  enum class Result { none, found, stop };

  JumpSearch(Callback f, const Weights& weights) : f_(f), weights_(weights), weight_(weights.size()) {}

  /// `resolved`: |h| of a step that would resolve f if it were smooth.
  Result search(double t0, const double* y0, double t1, const double* y1, double resolved);
  /// Searches only in the part of the line over which f changes most differently from its neighbours, until a step over
  /// the jump, or over what is left, would have an error of at most `most`: |h| times the change of f, in the weights.
  Result bracket(double t0, const double* y0, double t1, const double* y1, double most);
  /// The change of f, in the weights, over what the latest search has left, and where that begins.
  [[nodiscard]] double jump() const { return change(a_, b_); }
  [[nodiscard]] double before() const { return a_.t; }
  /// Finds out, after a jump, whether y decides on which side f is: f then jumps between these points at t0 too.
  Result decided_by_y(double t0);
  /// Returns, after a jump, `found` if from each side f leads, within a step of size h, to the other side or
  /// nowhere.
  Result attracts(double h);
  /// The time of the discontinuity: the first of the times with the new f.
  [[nodiscard]] double t() const { return t1_; }
  /// Evaluations of f in the latest search.
  [[nodiscard]] std::int64_t evaluations() const { return f_.calls() - calls_before_; }
  /// Evaluations of f in all searches.
  [[nodiscard]] std::int64_t calls() const { return f_.calls(); }

 private:
  struct Point {
    double t = 0;
    std::vector<double> y, f;
  };
  static constexpr std::size_t parts = 8;

  bool begin(double t0, const double* y0, double t1, const double* y1);
  bool enter_odd_part();
  bool halve();
  void move_to(Point& point, double t, const double* y) const;
  Result narrow(double resolved);
  [[nodiscard]] double change(const Point& a, const Point& b) const;
  [[nodiscard]] Result result_of_change() const;
  [[nodiscard]] bool evaluate(Point& point);

  Callback f_;
  const Weights& weights_;
  std::int64_t calls_before_ = 0;
  std::vector<double> weight_;
  Point a_, b_, middle_;  // kept, for the memory
  std::vector<Point> line_;
  double t1_ = 0;
  bool stopped_ = false;
};

/// Watches attempts fail. Where they suggest that f jumps, f is evaluated between the points around the place, at most
/// about 50 times; where none fails this costs nothing.
class DiscontinuityDetector {
 public:
  DiscontinuityDetector(Callback f, const Weights& weights) : f_(f), weights_(weights) {}

  /// The attempt that led to t1 by a step of signed size h failed.
  void failed(Cause cause, double t1, double h) {
    if (cause == Cause::error || cause == Cause::newton)
      series_.add(t1, h);
    else
      restart();
  }
  /// The step from (t0, y0) to (t1, y1) was accepted, after so many attempts in all. `stop`: a user function asks to.
  Status accepted(double t0, const double* y0, double t1, const double* y1, std::int64_t attempts) {
    return series_.any() ? look(t0, y0, t1, y1, attempts) : Status::ok;
  }
  /// The attempt from (t0, y0) to (t1, y1), one of `attempts`, has passed the error test of a pair. An estimate that is
  /// small by chance says nothing of the error of a step over a jump of f, which is up to |h| times the jump. Where a
  /// series of failures or the slopes (`bent`) suggest that there is one, `longest` becomes the |h| of an attempt up to
  /// it, or over it with a small error, if that is shorter.
  Status passes(double t0, const double* y0, double t1, const double* y1, bool bent, std::int64_t attempts,
                double& longest);
  /// The attempt from (t0, y0) to t1 failed, and none can be shorter. `slope`: y' at t0; f is not evaluated past
  /// `target`.
  Status gave_up(double t0, const double* y0, const double* slope, double t1, double target);
  /// The method starts again, where the solution or f may have jumped.
  void restart() { series_.forget(); }
  /// `steps` steps have been accepted since the last call, the last one to (t, y), where y' is `slope`. Where they have
  /// become short, attempts fail again and again, or stability limits the steps (`limited`), and what lies ahead is a
  /// jump of f that y decides on and that f leads onto from both sides, the solution sticks there.
  Status watch_pace(double t, const double* y, const double* slope, double target, std::int64_t steps,
                    const Counts& counts, bool limited);

  /// Finds out whether f changes by more than half of itself over one spacing of t along y' = `slope`, and moves a
  /// component by more than `tolerances` tolerances with that; for starts whose first step is shorter than t can
  /// represent.
  Status changes_at_once(double t, const double* y, const double* slope, double forward, double tolerances,
                         bool& changes);

  /// Looks for a component y_i below 0 of which f is not finite, as √y_i and log y_i are, where attempts fail since f
  /// is undefined: the sign of y_i decides whether f is finite at (t, y). y_i is below 0, or goes there along y' =
  /// `slope` and would be at 0 within `reach`; `lower`: bounds, which keep it from that where they are 0 or more;
  /// empty if y is not bounded. At most 8 components are tried, the nearest to 0 first. `component` becomes −1 if none
  /// of them decides.
  Status undefined_below_zero(double t, const double* y, const double* slope, double forward, double reach,
                              const std::vector<double>& lower, int& component);

  /// Times at which f is discontinuous, as far as they were seen: at most `most`.
  [[nodiscard]] const std::vector<double>& found() const { return found_; }
  /// The time from which the solution sticks where f is discontinuous.
  [[nodiscard]] const std::optional<double>& sticks_since() const { return sticks_since_; }
  /// Returns whether it would take more than `endless_from` steps to follow such a solution to the end.
  [[nodiscard]] bool endless() const { return endless_; }
  static constexpr double endless_from = 1e6;
  [[nodiscard]] std::int64_t evaluations() const { return evaluations_ + evaluations_ahead_ + evaluations_passing_; }

  void state(Archive& archive);

  static constexpr std::size_t most = 64;
  /// Returns whether there may be another search after so many attempts and evaluations in search of discontinuities:
  /// where f is discontinuous all the time, as in sliding friction, these stay few.
  static constexpr bool may_search(std::int64_t attempts, std::int64_t evaluations) {
    return evaluations <= 256 + attempts / 4;
  }

  /// Returns whether f may be evaluated again to keep a step over a jump accurate. That is worth one evaluation for
  /// each attempt, beside a first allowance.
  static constexpr bool may_pass(std::int64_t attempts, std::int64_t evaluations) {
    return evaluations <= 4096 + attempts;
  }

 private:
  void make_room();
  Status look(double t0, const double* y0, double t1, const double* y1, std::int64_t attempts);
  Status search(double t0, const double* y0, double t1, const double* y1, double resolved);

  Callback f_;
  const Weights& weights_;
  FailedSeries<void> series_;
  std::optional<JumpSearch> search_;   // once there was one
  std::vector<double> ahead_, slope_;  // a trial point, and f there
  std::vector<double> from_, latest_;  // of the series; empty: it has not needed them yet
  std::vector<double> found_;
  double pace_t_ = 0, fastest_ = 0;  // where the latest call of `watch_pace` was, and the longest way between two
  int meetings_ = 0;                 // so often in a row there was such a jump ahead,
  double first_meeting_ = 0;         // at first here
  int pause_ = 0;                    // calls that do not look
  std::int64_t evaluations_ahead_ = 0;
  std::optional<double> sticks_since_;
  bool endless_ = false;  // as the latest call of `watch_pace` found
  std::int64_t evaluations_ = 0, evaluations_passing_ = 0;
};

}  // namespace invariode
