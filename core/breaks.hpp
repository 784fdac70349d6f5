#pragma once
// Where a run is among its breakpoints and landings (docs/algorithms.md, 'Breakpoints', 'Switching times').

#include <cassert>
#include <cmath>
#include <cstddef>
#include <vector>

#include "aim.hpp"
#include "archive.hpp"
#include "callback.hpp"
#include "delays/marks.hpp"
#include "functions/piece.hpp"
#include "landings.hpp"
#include "weights.hpp"

namespace invariode {

/// A time at which f, g or their derivatives may jump, and what the solution does there, if it does.
struct Breakpoint {
  double t;
  Callback action;  ///< (t, y) -> y from there on, or empty
  Callback jump;    ///< (t, Y before, y after) -> S from there on, (k, n), where there are sensitivities
};

/// The breakpoints and landings that have been passed, and the piece of the interval between two of them. Those that no
/// step fits between are one, at the first of their times.
class Breaks {
 public:
  /// `points`: in the order of integration. `piece` learns where the run is; null: no function depends on it.
  Breaks(std::vector<Breakpoint> points, Landings landings, Piece* piece, double tf, double forward);

  [[nodiscard]] bool empty() const { return points_.empty() && landings_.empty() && marks_.empty(); }
  /// A landing where nothing is known to happen but a jump of a derivative, which a delay has brought there. It is seen
  /// from the next piece on.
  void add(const Mark& mark) { marks_.add(mark); }
  [[nodiscard]] std::size_t marks() const { return marks_.size(); }
  /// The mark at t, if nothing else is there; null: there is something else, or nothing.
  [[nodiscard]] const Mark* only_mark(double t) const;
  /// The order of the derivative that jumps at t, if the solution goes on: that of the mark, or 1.
  [[nodiscard]] int level(double t) const;
  /// ∂t/∂p of what each delay brings to t, (delays, k); empty: f does not jump there by a delay.
  [[nodiscard]] std::vector<double> rates(double t) const;
  /// Returns whether the next breakpoint or landing is at t, or so close to it that no step fits between.
  [[nodiscard]] bool at(double t) const { return at_breakpoint(t) || at_landing(t); }
  [[nodiscard]] bool at_breakpoint(double t) const { return next_ < points_.size() && same(points_[next_].t, t); }
  [[nodiscard]] bool at_landing(double t) const { return same(landing_, t); }
  /// Returns whether the attempt ends at the next breakpoint or landing.
  [[nodiscard]] bool at_end_of(const Aim& aim) const {
    return aim.lands() && (landing_ == aim.t1() || (next_ < points_.size() && points_[next_].t == aim.t1()));
  }
  /// Was the breakpoint before the next one, or the landing before it, at t?
  [[nodiscard]] bool just_passed(double t) const {
    return (next_ > 0 && same(points_[next_ - 1].t, t)) || (margin_ > breakpoint_margin(start_) && same(start_, t));
  }

  /// The run starts at t; functions see t itself, also where a breakpoint is.
  void start(double t);
  /// A piece begins at t; functions see it from beyond the last breakpoint or landing there.
  void begin_piece(double t);
  /// Continues in the piece that was read from an archive, at t: before a breakpoint there, which has yet to be passed.
  void resume_piece(double t);
  /// The time to which the steps of the piece lead: the first breakpoint or landing after its start, or the end of the
  /// interval.
  [[nodiscard]] double target() const { return target_; }
  /// The time that functions see at t: inside of the piece.
  [[nodiscard]] double inside(double t) const { return piece_ == nullptr ? t : piece_->inside(t); }
  /// The callback that changes sensitivities at a landing.
  [[nodiscard]] Callback& landing_jump() { return landings_.jump; }

  [[nodiscard]] Breakpoint& next() {
    assert(next_ < points_.size());
    return points_[next_];
  }
  [[nodiscard]] std::size_t index() const { return next_; }  ///< of the next one
  void pass() { ++next_; }

  void state(Archive& archive) {
    archive(start_, margin_, next_, marks_);
    archive.require(next_ <= points_.size() && std::isfinite(start_));
    archive.require(std::isfinite(margin_) && margin_ >= 0);
  }

 private:
  // How far from a breakpoint, or from a landing, functions are called at least. A breakpoint is a double that the user
  // gives; where f changes its branch, as it is computed, depends on the roundoff of a few operations.
  static double breakpoint_margin(double t) { return ulp(t); }
  [[nodiscard]] double landing_margin(double t) const;

  static bool same(double breakpoint, double t) { return std::abs(breakpoint - t) < hmin_ulps * ulp(t); }
  [[nodiscard]] std::size_t first_after(double t) const;
  [[nodiscard]] double landing_after(double t) const;
  [[nodiscard]] double landing_beyond(double t) const;
  void enter(std::size_t next);

  std::vector<Breakpoint> points_;
  Landings landings_;
  Marks marks_;  // landings too
  Piece* piece_;
  double tf_, forward_;
  std::size_t next_ = 0;
  double start_ = 0;   // of the piece: the last breakpoint or landing at its start, or where the run began
  double margin_ = 0;  // there; 0: it is neither
  double landing_;     // the first one after the start
  double target_;
};

}  // namespace invariode
