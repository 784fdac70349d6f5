#include "breaks.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
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
    margin_ = breakpoint_margin(start_);
  }
  const double before = t - forward_ * hmin_ulps * ulp(t);
  for (landing_ = landing_beyond(before); same(landing_, t); landing_ = landing_beyond(landing_)) {
    if (forward_ * (landing_ - start_) > 0) start_ = landing_;
    margin_ = landing_margin(landing_);
  }
  marks_.pass(t);
  enter(next);
}

void Breaks::resume_piece(double t) {
  landing_ = landing_after(start_);
  enter(at_breakpoint(t) ? next_ : first_after(t));
}

/// Functions see the piece up to the breakpoint `next` or to a landing before it, to which steps lead from now on.
void Breaks::enter(std::size_t next) {
  target_ = next < points_.size() ? points_[next].t : tf_;
  double margin = next < points_.size() ? breakpoint_margin(target_) : 0;
  if (forward_ * (target_ - landing_) > 0 || same(landing_, target_)) margin = landing_margin(landing_);
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
  double landing = landing_beyond(t);
  while (same(landing, t)) landing = landing_beyond(landing);
  return landing;
}

/// The first landing or mark beyond t. Marks are there in runs forward only.
double Breaks::landing_beyond(double t) const {
  const double landing = landings_.beyond(t, forward_);
  return marks_.empty() ? landing : std::min(landing, marks_.beyond(t));
}

/// Delayed arguments lie on the right side of what is at a mark, however they are rounded.
double Breaks::landing_margin(double t) const {
  constexpr double spacings = hmin_ulps / 2;
  const Mark* mark = marks_.empty() ? nullptr : marks_.at(t, 0);
  return spacings * (mark == nullptr ? ulp(t) : std::max(mark->spacing, ulp(t)));
}

const Mark* Breaks::only_mark(double t) const {
  if (marks_.empty() || at_breakpoint(t)) return nullptr;
  const double near = hmin_ulps * ulp(t);
  return same(landings_.beyond(t - forward_ * near, forward_), t) ? nullptr : marks_.at(t, near);
}

std::vector<double> Breaks::rates(double t) const {
  const Mark* mark = marks_.empty() ? nullptr : marks_.at(t, hmin_ulps * ulp(t));
  return mark == nullptr || mark->level > 1 ? std::vector<double>() : mark->rates;
}

int Breaks::level(double t) const {
  const Mark* mark = only_mark(t);
  return mark == nullptr ? 1 : mark->level;
}

}  // namespace invariode
