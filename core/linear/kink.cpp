#include "linear/kink.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <utility>

#include "weights.hpp"

namespace invariode {
namespace {

constexpr double part_kept = 1.0 / 8;  // of the change, which a jump keeps,
constexpr int halvings = 4;            // while a derivative that is linear along the line leaves 1/16

}  // namespace

KinkSearch::Verdict KinkSearch::search(Callback& f, double t0, const double* y0, double t1, const double* y1,
                                       const double* e, std::span<const double> w, const double* roundoff) {
  const Line line{&f, t0, t1, y0, y1, e};
  const auto change = [&](const Point& a, const Point& b) {
    return max_norm(w.size(), [&](std::size_t i) {
      return std::max(0.0, std::abs(b.difference[i] - a.difference[i]) - 2 * roundoff[i]) / w[i];
    });
  };
  y_.resize(w.size());
  f_.resize(w.size());
  end_.assign(w.size(), std::numeric_limits<double>::infinity());
  a_.theta = 0;
  b_.theta = 1;
  if (!evaluate(line, a_) || !evaluate(line, b_)) return stopped_ ? Verdict::stop : Verdict::smooth;
  end_ = b_.difference;
  const double whole = change(a_, b_);
  if (!(whole > part_kept * max_norm(w.size(), [&](std::size_t i) { return a_.difference[i] / w[i]; })))
    return Verdict::smooth;
  for (int k = 0; k < halvings; ++k) {
    middle_.theta = std::midpoint(a_.theta, b_.theta);
    if (!evaluate(line, middle_)) return stopped_ ? Verdict::stop : Verdict::smooth;
    const double before = change(a_, middle_), after = change(middle_, b_);
    if (!(std::max(before, after) > part_kept * whole)) return Verdict::smooth;
    std::swap(before > after ? b_ : a_, middle_);
  }
  return Verdict::kink;
}

/// f(t, y + e) − f(t, y) there; false: it is not finite, or f asks to stop.
bool KinkSearch::evaluate(const Line& line, Point& point) {
  const std::size_t n = y_.size();
  const double t = line.t0 + point.theta * (line.t1 - line.t0);
  std::vector<double>& difference = point.difference;
  difference.resize(n);
  for (std::size_t i = 0; i < n; ++i) y_[i] = line.y0[i] + point.theta * (line.y1[i] - line.y0[i]);
  stopped_ = (*line.f)(t, y_.data(), f_.data()) == Status::stop;
  if (stopped_) return false;
  for (std::size_t i = 0; i < n; ++i) y_[i] += line.e[i];
  stopped_ = (*line.f)(t, y_.data(), difference.data()) == Status::stop;
  for (std::size_t i = 0; i < n; ++i) difference[i] -= f_[i];
  return !stopped_ && all_finite(difference.data(), n);
}

}  // namespace invariode
