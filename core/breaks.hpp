#pragma once
// Where a run is among its breakpoints (docs/algorithms.md, 'Breakpoints').

#include <cassert>
#include <cmath>
#include <cstddef>
#include <vector>

#include "aim.hpp"
#include "archive.hpp"
#include "callback.hpp"
#include "functions/piece.hpp"
#include "weights.hpp"

namespace invariode {

/// A time at which f, g or their derivatives may jump, and what the solution does there, if it does.
struct Breakpoint {
  double t;
  Callback action;  ///< (t, y) -> y from there on, or empty
  Callback jump;    ///< (t, Y before, y after) -> S from there on, (k, n), where there are sensitivities
};

/// The breakpoints that have been passed, and the piece of the interval between two of them. Breakpoints that no step
/// fits between are one, at the first of their times.
class Breaks {
 public:
  /// `points`: in the order of integration. `piece` learns where the run is; null: no function depends on it.
  Breaks(std::vector<Breakpoint> points, Piece* piece, double tf);

  [[nodiscard]] bool empty() const { return points_.empty(); }
  /// Is the next breakpoint at t, or so close to it that no step fits between?
  [[nodiscard]] bool at(double t) const { return next_ < points_.size() && same(points_[next_].t, t); }
  /// Does the attempt end at the next breakpoint?
  [[nodiscard]] bool at_end_of(const Aim& aim) const {
    return aim.lands() && next_ < points_.size() && points_[next_].t == aim.t1();
  }
  /// Was the breakpoint before the next one at t?
  [[nodiscard]] bool just_passed(double t) const { return next_ > 0 && same(points_[next_ - 1].t, t); }

  /// The run starts at t; functions see t itself, also where a breakpoint is.
  void start(double t);
  /// A piece begins at t; functions see it from beyond the last breakpoint there.
  void begin_piece(double t);
  /// Continues in the piece that was read from an archive, at t: before a breakpoint there, which has yet to be passed.
  void resume_piece(double t) { enter(at(t) ? next_ : first_after(t)); }
  /// Where the steps of the piece lead: the first breakpoint after its start, or the end of the interval.
  [[nodiscard]] double target() const { return target_; }

  [[nodiscard]] Breakpoint& next() {
    assert(next_ < points_.size());
    return points_[next_];
  }
  [[nodiscard]] std::size_t index() const { return next_; }  ///< of the next one
  void pass() { ++next_; }

  void state(Archive& archive) {
    archive(start_, from_break_, next_);
    archive.require(next_ <= points_.size());
  }

 private:
  static bool same(double breakpoint, double t) { return std::abs(breakpoint - t) < hmin_ulps * ulp(t); }
  [[nodiscard]] std::size_t first_after(double t) const;
  void enter(std::size_t next);

  std::vector<Breakpoint> points_;
  Piece* piece_;
  double tf_;
  std::size_t next_ = 0;
  double start_ = 0;         // of the piece: the last breakpoint at its start, or where the run began
  bool from_break_ = false;  // which is a breakpoint
  double target_;
};

}  // namespace invariode
