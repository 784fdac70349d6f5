#include "discontinuity.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

namespace invariode {
namespace {

constexpr double kept = 1.0 / 8;  // of the change, which a jump keeps: less is left of a smooth one after 3 halvings
constexpr double grown = 2;       // more than this times the change is a pole, which no breakpoint helps
constexpr double sharp =
    1e-3;  // of a step that failed: a change within this is a jump, though f may be smooth on a finer scale
constexpr double noise = 1000 * eps;  // of f, in units of its size: a smaller change tells nothing

}  // namespace

JumpSearch::Result JumpSearch::search(double t0, const double* y0, double t1, const double* y1, double resolved) {
  const std::size_t n = weights_.size();
  weight_.resize(n);
  weights_.fill(y0, y1, weight_.data());
  Point a{t0, {y0, y0 + n}, {}}, b{t1, {y1, y1 + n}, {}};
  if (!evaluate(a) || !evaluate(b)) return stopped_ ? Result::stop : Result::none;
  return narrow(a, b, resolved);
}

/// Goes on with the half in which f changes more, down to neighbouring doubles (of the larger |t|).
JumpSearch::Result JumpSearch::narrow(Point& a, Point& b, double resolved) {
  const double whole = change(a, b);
  const double size = max_norm(weight_.size(), [&](std::size_t i) { return b.f[i] / weight_[i]; });
  if (!(whole > noise * size)) return Result::none;
  const double narrowest = ulp(std::max(std::abs(a.t), std::abs(b.t)));
  for (bool beside_smooth = true;;) {
    t1_ = b.t;
    const double width = std::abs(b.t - a.t);
    if (width <= narrowest) return beside_smooth ? Result::found : Result::none;
    Point middle{std::midpoint(a.t, b.t), a.y, {}};
    for (std::size_t i = 0; i < middle.y.size(); ++i) middle.y[i] = std::midpoint(a.y[i], b.y[i]);
    if (!evaluate(middle)) return stopped_ ? Result::stop : Result::none;
    const double before = change(a, middle), after = change(middle, b), larger = std::max(before, after);
    beside_smooth = std::min(before, after) <= kept * larger;  // which a pole is not
    if (!(larger <= grown * whole)) return Result::none;
    if (larger < kept * whole) return width <= sharp * resolved ? Result::found : Result::none;
    (before > after ? b : a) = std::move(middle);
  }
}

double JumpSearch::change(const Point& a, const Point& b) const {
  return max_norm(weight_.size(), [&](std::size_t i) { return (b.f[i] - a.f[i]) / weight_[i]; });
}

/// f there; false: it is not finite, or asks to stop.
bool JumpSearch::evaluate(Point& point) {
  point.f.resize(point.y.size());
  stopped_ = f_(point.t, point.y.data(), point.f.data()) == Status::stop;
  return !stopped_ && all_finite(point.f.data(), point.f.size());
}

Status DiscontinuityDetector::look(double t0, const double* y0, double t1, const double* y1, std::int64_t attempts) {
  from_.resize(weights_.size());
  latest_.resize(weights_.size());
  const bool suspicious = series_.accept(t0, y0, 1, weights_.size(), t1, from_.data(), latest_.data());
  if (!suspicious || !may_search(attempts, evaluations_)) return Status::ok;
  return search(series_.from_t(), from_.data(), t1, y1, series_.latest());
}

/// In the attempt, then as far as the longest one of the series led: what a method has from there may outlive it.
Status DiscontinuityDetector::gave_up(double t0, const double* y0, const double* slope, double t1) {
  const double h = t1 - t0;
  const std::size_t before = found_.size();
  std::vector<double> y1(weights_.size());
  for (const double way : {h, std::copysign(series_.longest(), h)}) {
    for (std::size_t i = 0; i < y1.size(); ++i) y1[i] = y0[i] + way * slope[i];
    if (found_.size() > before || !all_finite(y1.data(), y1.size())) break;
    if (search(t0, y0, t0 + way, y1.data(), std::abs(h)) == Status::stop) return Status::stop;
  }
  return Status::ok;
}

Status DiscontinuityDetector::search(double t0, const double* y0, double t1, const double* y1, double resolved) {
  if (found_.size() >= most) return Status::ok;
  JumpSearch search(f_, weights_);
  const JumpSearch::Result result = search.search(t0, y0, t1, y1, resolved);
  evaluations_ += search.evaluations();
  if (result == JumpSearch::Result::found) found_.push_back(search.t());
  return result == JumpSearch::Result::stop ? Status::stop : Status::ok;
}

void DiscontinuityDetector::state(Archive& archive) {
  SeriesMemory m = series_.memory();
  archive(m.count, m.failed, m.stepped, m.longest, m.latest, m.beyond, m.latest_t, m.from_t, evaluations_);
  series_.go_on(m);
  for (std::vector<double>* one : {&from_, &latest_, &found_}) archive.resizable(*one);
}

}  // namespace invariode
