#include "breaks.hpp"

#include <algorithm>
#include <cassert>
#include <utility>

namespace invariode {

Breaks::Breaks(std::vector<Breakpoint> points, Piece* piece, double tf)
    : points_(std::move(points)), piece_(piece), tf_(tf), target_(tf) {
  assert(std::ranges::is_sorted(points_, {}, [this](const Breakpoint& one) { return -std::abs(tf_ - one.t); }));
}

void Breaks::start(double t) {
  start_ = t;
  from_break_ = false;
  enter(first_after(t));
}

void Breaks::begin_piece(double t) {
  const std::size_t next = first_after(t);
  from_break_ = next > 0 && same(points_[next - 1].t, t);
  start_ = from_break_ ? points_[next - 1].t : t;
  enter(next);
}

/// Functions see the piece up to the breakpoint `next`, to which steps lead from now on.
void Breaks::enter(std::size_t next) {
  const bool breaks = next < points_.size();
  target_ = breaks ? points_[next].t : tf_;
  if (piece_ != nullptr) piece_->enter(start_, from_break_, target_, breaks);
}

std::size_t Breaks::first_after(double t) const {
  std::size_t next = next_;
  while (next < points_.size() && same(points_[next].t, t)) ++next;
  return next;
}

}  // namespace invariode
