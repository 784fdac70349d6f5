#include "detect/discontinuity.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>

namespace invariode {
namespace {

constexpr double left_of_jump = 1.0 / 8;  // of the change: less is left of a smooth one after 3 halvings
constexpr double grown = 2;               // more than this times the change is a pole, which no breakpoint helps
// Of a step that failed: a change within this is a jump, though f may be smooth on a finer scale.
constexpr double sharp = 1e-3;
// Steps of which the rest of the interval would take so many, or so much shorter than the longest, may be those of a
// solution that sticks (docs/algorithms.md, 'Jumps of f'); once f has been seen to jump, or was suspected to in a step
// that passed its error test, those that are shorter, or of which attempts fail, too.
constexpr double very_many = 1e5, much_shorter = 300, shorter = 8;
constexpr double failing = 1.0 / 16;  // of the steps
constexpr int meetings = 2;           // one after the other, with a jump that f leads onto
constexpr int pause = 8;              // looks after one that has found nothing
constexpr double most_of_jump = 5;    // tolerances of error that a step over a jump may have
constexpr double overshoot = 0.25;    // of a step, by which its stages may lead beyond its end
constexpr int fewest_halvings = 6;    // of a part, that tell a jump from a smooth change
constexpr double odd = 0.25;          // of the largest change over a part: parts of a smooth f differ by less
constexpr double at_rest = 1e-3;      // of a jump: with a smaller f a solution stays where it is
constexpr double noise = 1000 * eps;  // of f, in units of its size: a smaller change tells nothing

}  // namespace

JumpSearch::Result JumpSearch::search(double t0, const double* y0, double t1, const double* y1, double resolved) {
  if (!begin(t0, y0, t1, y1)) return stopped_ ? Result::stop : Result::none;
  return narrow(resolved);
}

JumpSearch::Result JumpSearch::bracket(double t0, const double* y0, double t1, const double* y1, double most) {
  if (!begin(t0, y0, t1, y1)) return stopped_ ? Result::stop : Result::none;
  if (!enter_odd_part()) return stopped_ ? Result::stop : Result::none;
  double whole = jump(), width = std::abs(b_.t - a_.t);
  const double narrowest = ulp(std::max(std::abs(t0), std::abs(t1)));
  int halvings = 0;
  while (width > narrowest && (halvings < fewest_halvings || width * whole > most)) {
    if (!halve()) return stopped_ ? Result::stop : Result::none;
    const double before = change(a_, middle_), after = change(middle_, b_), larger = std::max(before, after);
    whole = std::max(whole, larger);  // two jumps may cancel
    if (larger < left_of_jump * whole) return Result::none;
    std::swap(before > after ? b_ : a_, middle_);
    width = std::abs(b_.t - a_.t);
    ++halvings;
  }
  return Result::found;
}

/// f at the ends of the line. False: it is not finite, or asks to stop.
bool JumpSearch::begin(double t0, const double* y0, double t1, const double* y1) {
  calls_before_ = f_.calls();
  weights_.fill(y0, y1, weight_.data());
  move_to(a_, t0, y0);
  move_to(b_, t1, y1);
  middle_ = a_;
  return evaluate(a_) && evaluate(b_);
}

/// Narrows the line to the part over which f changes most differently from the two nearest parts; if none differs
/// enough, to the part over which f changes most. (The part with the largest change may be one where f is smooth: over
/// a part with two jumps f may change by little.) False: as `begin`.
bool JumpSearch::enter_odd_part() {
  line_.resize(parts + 1);
  line_.front() = a_;
  line_.back() = b_;
  for (std::size_t k = 1; k < parts; ++k) {
    const double part = static_cast<double>(k) / parts;
    Point& point = line_[k];
    point = a_;
    point.t += part * (b_.t - a_.t);
    for (std::size_t i = 0; i < point.y.size(); ++i) point.y[i] += part * (b_.y[i] - a_.y[i]);
    if (!evaluate(point)) return false;
  }
  const auto differ = [this](std::size_t k, std::size_t j) {  // the changes over these parts
    return max_norm(weight_.size(), [&](std::size_t i) {
      return (line_[k + 1].f[i] - line_[k].f[i] - (line_[j + 1].f[i] - line_[j].f[i])) / weight_[i];
    });
  };
  std::size_t oddest = 0, steepest = 0;
  double most = -1, largest = 0;
  for (std::size_t k = 0; k < parts; ++k) {
    const std::size_t before = k == 0 ? 2 : k - 1, after = k + 1 == parts ? parts - 3 : k + 1;
    const double size = std::min(differ(k, before), differ(k, after));
    if (size > most) oddest = k;
    most = std::max(most, size);
    const double whole = change(line_[k], line_[k + 1]);
    if (whole > largest) steepest = k;
    largest = std::max(largest, whole);
  }
  if (!(most > odd * largest)) oddest = steepest;  // jumps may follow each other at equal distances
  a_ = line_[oddest];
  b_ = line_[oddest + 1];
  return true;
}

/// f in the middle. False: as `begin`.
bool JumpSearch::halve() {
  middle_.t = std::midpoint(a_.t, b_.t);
  for (std::size_t i = 0; i < middle_.y.size(); ++i) middle_.y[i] = std::midpoint(a_.y[i], b_.y[i]);
  return evaluate(middle_);
}

void JumpSearch::move_to(Point& point, double t, const double* y) const {
  point.t = t;
  point.y.assign(y, y + weights_.size());
}

/// Goes on with the half in which f changes more, down to neighbouring doubles (of the larger |t|).
JumpSearch::Result JumpSearch::narrow(double resolved) {
  const double whole = change(a_, b_);
  const double size = max_norm(weight_.size(), [&](std::size_t i) { return b_.f[i] / weight_[i]; });
  if (!(whole > noise * size)) return Result::none;
  const double narrowest = ulp(std::max(std::abs(a_.t), std::abs(b_.t)));
  for (bool beside_smooth = true;;) {
    t1_ = b_.t;
    const double width = std::abs(b_.t - a_.t);
    if (width <= narrowest) return beside_smooth ? result_of_change() : Result::none;
    if (!halve()) return stopped_ ? Result::stop : Result::none;
    const double before = change(a_, middle_), after = change(middle_, b_), larger = std::max(before, after);
    beside_smooth = std::min(before, after) <= left_of_jump * larger;  // which a pole is not
    if (!(larger <= grown * whole)) return Result::none;
    if (larger < left_of_jump * whole) return width <= sharp * resolved ? result_of_change() : Result::none;
    std::swap(before > after ? b_ : a_, middle_);
  }
}

double JumpSearch::change(const Point& a, const Point& b) const {
  return max_norm(weight_.size(), [&](std::size_t i) { return (b.f[i] - a.f[i]) / weight_[i]; });
}

/// A change between points that the tolerances tell apart is not a jump: that f is only steep, as at a blow-up, where y
/// changes much within a spacing of t.
JumpSearch::Result JumpSearch::result_of_change() const {
  const double apart = max_norm(weight_.size(), [&](std::size_t i) { return (b_.y[i] - a_.y[i]) / weight_[i]; });
  return apart <= weights_.rtol() ? Result::found : Result::none;
}

/// f there; false: it is not finite, or asks to stop.
bool JumpSearch::evaluate(Point& point) {
  point.f.resize(point.y.size());
  stopped_ = f_(point.t, point.y.data(), point.f.data()) == Status::stop;
  return !stopped_ && all_finite(point.f.data(), point.f.size());
}

JumpSearch::Result JumpSearch::decided_by_y(double t0) {
  const double whole = change(a_, b_);
  a_.t = b_.t = t0;
  if (!evaluate(a_) || !evaluate(b_)) return stopped_ ? Result::stop : Result::none;
  return change(a_, b_) > left_of_jump * whole ? Result::found : Result::none;
}

JumpSearch::Result JumpSearch::attracts(double h) {
  for (const auto& [from, to] : {std::pair(&a_, &b_), std::pair(&b_, &a_)}) {
    middle_ = *from;
    for (std::size_t i = 0; i < middle_.y.size(); ++i) middle_.y[i] += h * from->f[i];
    if (!evaluate(middle_)) return stopped_ ? Result::stop : Result::none;
    const double moved = max_norm(weight_.size(), [&](std::size_t i) { return from->f[i] / weight_[i]; });
    if (moved > at_rest * change(a_, b_) && change(*to, middle_) > change(*from, middle_)) return Result::none;
  }
  return Result::found;
}

Status DiscontinuityDetector::watch_pace(double t, const double* y, const double* slope, double target,
                                         std::int64_t steps, const Counts& counts, bool limited) {
  const double way = std::abs(t - std::exchange(pace_t_, t)), h = way / static_cast<double>(steps);
  fastest_ = std::max(fastest_, way);
  const double rest = std::abs(target - t);
  const bool suspected = !found_.empty() || evaluations_passing_ > 0;
  const bool fails = static_cast<double>(counts.failed) > failing * static_cast<double>(counts.steps);
  const bool slow = limited || (suspected ? fails || shorter * way < fastest_ : much_shorter * way < fastest_) ||
                    (std::isfinite(rest) && very_many * h < rest);
  endless_ = sticks_since_ && std::isfinite(rest) && endless_from * h < rest;
  if (sticks_since_ || !slow) meetings_ = 0;
  if (sticks_since_ || !slow || pause_-- > 0 || !may_search(counts.steps + counts.failed, evaluations_ahead_))
    return Status::ok;
  pause_ = 0;
  const double length = std::copysign(std::min(way, rest), target - t);
  make_room();
  const std::int64_t before = search_->calls();
  JumpSearch::Result result = JumpSearch::Result::none;
  for (const double* direction : {slope, static_cast<const double*>(slope_.data())}) {
    if (direction == slope_.data()) {  // to an implicit method the solution lies between the sides, and y' is not f
      ++evaluations_ahead_;
      if (f_(t, y, slope_.data()) == Status::stop) return Status::stop;
    }
    for (std::size_t i = 0; i < ahead_.size(); ++i) ahead_[i] = y[i] + length * direction[i];
    if (!all_finite(ahead_.data(), ahead_.size())) break;
    result = search_->search(t, y, t + length, ahead_.data(), std::abs(length));
    if (result == JumpSearch::Result::found) result = search_->decided_by_y(t);
    if (result == JumpSearch::Result::found) result = search_->attracts(std::copysign(h, length));
    if (result != JumpSearch::Result::none) break;
  }
  evaluations_ahead_ += search_->calls() - before;
  if (result == JumpSearch::Result::stop) return Status::stop;
  if (result == JumpSearch::Result::none) {
    meetings_ = 0;
    pause_ = pause;
    return Status::ok;
  }
  if (meetings_++ == 0) first_meeting_ = t;
  if (meetings_ == meetings) sticks_since_ = first_meeting_;
  return Status::ok;
}

Status DiscontinuityDetector::look(double t0, const double* y0, double t1, const double* y1, std::int64_t attempts) {
  from_.resize(weights_.size());
  latest_.resize(weights_.size());
  const bool suspicious = series_.accept(t0, y0, 1, weights_.size(), t1, from_.data(), latest_.data());
  if (!suspicious || !may_search(attempts, evaluations_)) return Status::ok;
  return search(series_.from_t(), from_.data(), t1, y1, series_.latest());
}

Status DiscontinuityDetector::passes(double t0, const double* y0, double t1, const double* y1, bool bent,
                                     std::int64_t attempts, double& longest) {
  const double h = std::abs(t1 - t0), harmless = most_of_jump * weights_.rtol();
  if ((!bent && !series_.suspicious(h)) || !may_pass(attempts, evaluations_passing_)) return Status::ok;
  make_room();
  for (std::size_t i = 0; i < ahead_.size(); ++i)  // stages may lead beyond the jump though y1 does not
    ahead_[i] = y1[i] + overshoot * (y1[i] - y0[i]);
  const JumpSearch::Result result = search_->bracket(t0, y0, t1, ahead_.data(), harmless);
  evaluations_passing_ += search_->evaluations();
  if (result == JumpSearch::Result::stop) return Status::stop;
  if (result == JumpSearch::Result::found && h * search_->jump() > harmless)
    longest = std::max(std::abs(search_->before() - t0), harmless / search_->jump());
  return Status::ok;
}

/// Searches the attempt, then as far as the longest one of the series led: what a method keeps from there may outlive
/// it.
Status DiscontinuityDetector::gave_up(double t0, const double* y0, const double* slope, double t1, double target) {
  const double h = t1 - t0;
  const double longest = std::min(series_.longest(), std::abs(target - t0));
  const std::size_t before = found_.size();
  std::vector<double> y1(weights_.size());
  for (const double way : {h, std::copysign(longest, h)}) {
    for (std::size_t i = 0; i < y1.size(); ++i) y1[i] = y0[i] + way * slope[i];
    if (found_.size() > before || !all_finite(y1.data(), y1.size())) break;
    if (search(t0, y0, t0 + way, y1.data(), std::abs(h)) == Status::stop) return Status::stop;
  }
  return Status::ok;
}

/// Most runs never search.
void DiscontinuityDetector::make_room() {
  if (search_) return;
  search_.emplace(f_, weights_);
  ahead_.resize(weights_.size());
  slope_.resize(weights_.size());
}

Status DiscontinuityDetector::search(double t0, const double* y0, double t1, const double* y1, double resolved) {
  if (found_.size() >= most) return Status::ok;
  make_room();
  const JumpSearch::Result result = search_->search(t0, y0, t1, y1, resolved);
  evaluations_ += search_->evaluations();
  if (result == JumpSearch::Result::found) found_.push_back(search_->t());
  return result == JumpSearch::Result::stop ? Status::stop : Status::ok;
}

void DiscontinuityDetector::state(Archive& archive) {
  SeriesState m = series_.state();
  bool sticks = sticks_since_.has_value();
  double since = sticks_since_.value_or(0);
  archive(pace_t_, fastest_, meetings_, first_meeting_, pause_, evaluations_ahead_, evaluations_passing_, sticks,
          since);
  if (sticks) sticks_since_ = since;
  archive(m.count, m.failed, m.stepped, m.longest, m.latest, m.beyond, m.latest_t, m.from_t, evaluations_);
  series_.go_on(m);
  for (std::vector<double>* one : {&from_, &latest_, &found_}) archive.resizable(*one);
  for (const std::vector<double>* one : {&from_, &latest_})
    archive.require(one->empty() || one->size() == weights_.size());
  archive.require(found_.size() <= most);
}

Status DiscontinuityDetector::undefined_below_zero(double t, const double* y, const double* slope, double forward,
                                                   double reach, const std::vector<double>& lower, int& component) {
  constexpr std::size_t most_tried = 8;
  const std::size_t n = weights_.size();
  std::vector<double> moved(y, y + n), f(n);
  const auto finite = [&](bool& is) {
    ++evaluations_ahead_;
    const Status status = f_(t, moved.data(), f.data());
    is = all_finite(f.data(), n);
    return status;
  };
  bool defined = false;
  if (finite(defined) == Status::stop) return Status::stop;
  std::vector<std::pair<double, std::size_t>> near;
  for (std::size_t i = 0; i < n; ++i) {
    const bool unbounded = lower.empty() || lower[i] < 0;
    const bool falls = y[i] >= 0 && forward * slope[i] < 0 && y[i] <= reach * std::abs(slope[i]);
    if (unbounded && (defined ? falls : y[i] < 0))
      near.emplace_back(std::abs(y[i]) / (defined ? std::abs(slope[i]) : weights_.at(i, y[i])), i);
  }
  std::sort(near.begin(), near.end());
  near.resize(std::min(near.size(), most_tried));
  for (const auto& [distance, i] : near) {
    moved[i] = -std::copysign(std::max(std::abs(y[i]), weights_.rtol() * weights_.at(i, y[i])), y[i]);
    bool there = false;
    if (finite(there) == Status::stop) return Status::stop;
    if (there != defined) {
      component = static_cast<int>(i);
      break;
    }
    moved[i] = y[i];
  }
  return Status::ok;
}

Status DiscontinuityDetector::changes_at_once(double t, const double* y, const double* slope, double forward,
                                              double tolerances, bool& changes) {
  constexpr double part = 0.5;  // of f: by less, a step of one spacing is as good as any
  const std::size_t n = weights_.size();
  std::vector<double> before(n), after(n), moved(y, y + n);
  const double h = forward * ulp(t);
  for (std::size_t i = 0; i < n; ++i) moved[i] += h * slope[i];
  evaluations_ahead_ += 2;
  if (f_(t, y, before.data()) == Status::stop) return Status::stop;
  const bool defined = all_finite(moved.data(), n);
  if (defined && f_(t + h, moved.data(), after.data()) == Status::stop) return Status::stop;
  changes = !defined || !all_finite(after.data(), n);
  for (std::size_t i = 0; i < n && !changes; ++i) {
    const double change = std::abs(after[i] - before[i]), size = std::max(std::abs(after[i]), std::abs(before[i]));
    const double tolerance = weights_.rtol() * weights_.at(i, y[i], moved[i]);
    changes = change > part * size && std::abs(h) * change > tolerances * tolerance;
  }
  return Status::ok;
}

}  // namespace invariode
