#include "breaks.hpp"

#include <algorithm>
#include <cassert>
#include <limits>
#include <utility>

namespace invariode {

Breaks::Breaks(std::vector<Breakpoint> points, Landings landings, Piece* piece, double tf, double forward)
    : points_(std::move(points)),
      landings_(std::move(landings)),
      piece_(piece),
      tf_(tf),
      forward_(forward),
      landing_(forward * std::numeric_limits<double>::infinity()),
      target_(tf) {
  assert(std::ranges::is_sorted(points_, {}, [this](const Breakpoint& one) { return -std::abs(tf_ - one.t); }));
}

void Breaks::start(double t) {
  start_ = t;
  margin_ = 0;
  landing_ = landing_after(t);
  enter(first_after(t));
}

void Breaks::begin_piece(double t) {
  const std::size_t next = first_after(t);
  start_ = t;
  margin_ = 0;
  if (next > 0 && same(points_[next - 1].t, t)) {
    start_ = points_[next - 1].t;
    margin_ = breakpoint_margin;
  }
  const double before = t - forward_ * hmin_ulps * ulp(t);
  for (landing_ = landings_.beyond(before, forward_); same(landing_, t);
       landing_ = landings_.beyond(landing_, forward_)) {
    if (forward_ * (landing_ - start_) > 0) start_ = landing_;
    margin_ = landing_margin;
  }
  enter(next);
}

void Breaks::resume_piece(double t) {
  landing_ = landing_after(start_);
  enter(at_breakpoint(t) ? next_ : first_after(t));
}

/// Functions see the piece up to the breakpoint `next` or to a landing before it, to which steps lead from now on.
void Breaks::enter(std::size_t next) {
  target_ = next < points_.size() ? points_[next].t : tf_;
  double margin = next < points_.size() ? breakpoint_margin : 0;
  if (forward_ * (target_ - landing_) > 0 || same(landing_, target_)) margin = landing_margin;
  if (forward_ * (target_ - landing_) > 0) target_ = landing_;
  if (piece_ != nullptr) piece_->enter(start_, margin_, target_, margin);
}

std::size_t Breaks::first_after(double t) const {
  std::size_t next = next_;
  while (next < points_.size() && same(points_[next].t, t)) ++next;
  return next;
}

/// The first landing beyond t that a step from t can lead to.
double Breaks::landing_after(double t) const {
  double landing = landings_.beyond(t, forward_);
  while (same(landing, t)) landing = landings_.beyond(landing, forward_);
  return landing;
}

}  // namespace invariode
