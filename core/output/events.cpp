#include "output/events.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <functional>
#include <utility>

#include "output/polynomial.hpp"
#include "output/root.hpp"

namespace invariode {
namespace {

constexpr double location_ulps = 2;       // width of the final bracket, in ulp of t
constexpr double tie_ulps = 4;            // roots this close are one instant
constexpr int few_intervals = 3;          // that shrink do not yet accumulate
constexpr double resolution = 0x1p-26;    // √ε, of the step: roots that are closer are one
constexpr double of_touching = 64 * eps;  // what roundoff adds to an event, in units of what it is made of
constexpr double small_change = 0x1p-26;  // of y and t, to see what the event is made of
constexpr double straight = 1e-3;  // differences of slopes: it does not turn, but for the last 0.05 % of an interval
constexpr double noise_ulps = 16;  // of y between steps
constexpr std::size_t few_samples = 64;     // of a step that is scanned closely, for which there is room at once
constexpr std::size_t most_evaluated = 64;  // values of a vector that are kept

bool is_sign(int s) { return s >= -1 && s <= 1; }

}  // namespace

Events::Events(std::vector<EventFunction> functions, std::vector<RootVector> vectors, std::size_t n, int max_degree)
    : functions_(std::move(functions)),
      vectors_(std::move(vectors)),
      evaluated_(vectors_.size()),
      oldest_(vectors_.size()),
      n_(n),
      intervals_(intervals_of_step(static_cast<std::size_t>(max_degree))),
      last_(functions_.size()),
      sign_(functions_.size()),
      touched_(functions_.size(), std::numeric_limits<double>::quiet_NaN()),
      size_(functions_.size(), std::numeric_limits<double>::infinity()),
      slope_(functions_.size()),
      sign_before_(functions_.size()),
      root_(functions_.size(), std::numeric_limits<double>::quiet_NaN()),
      actions_(functions_.size()),
      times_seen_(functions_.size()),
      y_(functions_.empty() ? 0 : n) {
  if (empty()) return;
  for (std::vector<double>* const one : {&scan_.times, &scan_.values}) one->resize(intervals_ + 1);
  brackets_.reserve(intervals_);
  roots_.reserve(intervals_);
  occurrences_.reserve(functions_.size() * intervals_);
}

Outcome Events::evaluate(std::size_t event, double t, const double* y, double& value) {
  EventFunction& function = functions_[event];
  if (function.vector == EventFunction::alone) {
    if (function.function(t, y, &value) == Status::stop) return Outcome::stop;
  } else {
    const double* values = nullptr;
    if (evaluate_vector(function.vector, t, y, values) == Status::stop) return Outcome::stop;
    value = values[event - vectors_[function.vector].first];
  }
  if (!std::isnan(value)) return Outcome::ok;
  undefined_ = {event, t};
  return Outcome::not_finite;
}

/// All components at once: each asks for the values at the same points of a step, one after the other.
Status Events::evaluate_vector(std::size_t number, double t, const double* y, const double*& values) {
  std::vector<Evaluated>& known = evaluated_[number];
  for (const Evaluated& one : known)
    if (one.t == t && std::equal(y, y + n_, one.y.begin())) {
      values = one.values.data();
      return Status::ok;
    }
  if (known.size() < most_evaluated) {
    oldest_[number] = known.size();
    known.push_back({t, std::vector<double>(n_), std::vector<double>(vectors_[number].count)});
  }
  Evaluated& place = known[oldest_[number]];
  oldest_[number] = (oldest_[number] + 1) % most_evaluated;
  place.t = std::numeric_limits<double>::quiet_NaN();  // until the function has returned
  if (vectors_[number].function(t, y, place.values.data()) == Status::stop) return Status::stop;
  place.t = t;
  std::copy(y, y + n_, place.y.begin());
  values = place.values.data();
  return Status::ok;
}

/// An action may change what the functions remember by themselves.
void Events::forget_values() {
  for (std::vector<Evaluated>& known : evaluated_)
    for (Evaluated& one : known) one.t = std::numeric_limits<double>::quiet_NaN();
}

Outcome Events::start(double t, const double* y) {
  for (std::size_t e = 0; e < count(); ++e) {
    if (const Outcome outcome = evaluate(e, t, y, last_[e]); outcome != Outcome::ok) return outcome;
    sign_[e] = sign_of(last_[e]);
  }
  return Outcome::ok;
}

Outcome Events::restart(double t, const double* y) { return leave(t, y, true); }

Outcome Events::leave(double t, const double* y, bool inside) {
  if (inside) {
    forget_values();
    if (const Outcome outcome = start(t, y); outcome != Outcome::ok) return outcome;
  }
  if (inside || left_at_ != t) std::ranges::fill(root_, std::numeric_limits<double>::quiet_NaN());
  left_at_ = t;
  for (const Occurrence& occurrence : occurrences_)
    if (occurrence.t == t) {
      if (std::isnan(root_[occurrence.event])) root_[occurrence.event] = last_[occurrence.event];
      sign_[occurrence.event] = 0;
      last_[occurrence.event] = 0;
    }
  return Outcome::ok;
}

/// Arrives at (t, y) after a jump. If signs differ and the event is zero to roundoff on both sides, the one at the
/// start of the step decides: if it is the one before the jump, the event has just been carried over zero; if not, it
/// had crossed zero before, and `direction` has left that out.
Outcome Events::arrive(double t, const double* y, std::vector<Occurrence>& crossed) {
  forget_values();
  for (std::size_t e = 0; e < count(); ++e) {
    double value = 0;
    if (const Outcome outcome = evaluate(e, t, y, value); outcome != Outcome::ok) return outcome;
    const int before = sign_[e], after = sign_of(value);
    if (!std::isnan(root_[e])) {
      bool there = value == root_[e] || value == 0;
      if (!there)
        if (const Outcome outcome = is_roundoff(e, t, y, value, there); outcome != Outcome::ok) return outcome;
      if (there) continue;
      root_[e] = std::numeric_limits<double>::quiet_NaN();
    }
    bool crosses = before != 0 && after != before;
    if (crosses && before != sign_before_[e] && may_be_roundoff(e, last_[e])) {
      bool there = value == 0;
      if (!there)
        if (const Outcome outcome = is_roundoff(e, t, y, value, there); outcome != Outcome::ok) return outcome;
      crosses = !there;
    }
    if (before == 0 && after != 0 && functions_[e].acts()) note_waking(e, after);
    const int direction = after != 0 ? after : -before, asked = sign_of(functions_[e].direction);
    if (crosses && functions_[e].at_jumps && (asked == 0 || asked == direction)) crossed.push_back({e, t, direction});
    sign_[e] = after;
    last_[e] = value;
  }
  return Outcome::ok;
}

void Events::forget_occurrences() {
  const auto moved = [this](const Occurrence& one) { return std::isnan(root_[one.event]); };
  std::erase_if(occurrences_, moved);
  acts_ = terminal_ = false;
}

/// A value so small beside those of the last step.
bool Events::may_be_roundoff(std::size_t event, double value) const {
  return std::abs(value) <= resolution * size_[event];
}

/// Finds out whether the event is zero at (t, y), up to roundoff and the error of t at a root.
Outcome Events::is_roundoff(std::size_t event, double t, const double* y, double value, bool& so) {
  so = may_be_roundoff(event, value);
  if (!so) return Outcome::ok;
  const double moves = slope_[event] * tie_ulps * std::max(ulp(t), step_ulp());
  return within_roundoff(event, t, y, value, moves / of_touching, so);
}

Outcome Events::go_on(double t, const double* y) {
  for (std::size_t e = 0; e < count(); ++e)
    if (functions_[e].terminal > 0) times_seen_[e] %= functions_[e].terminal;
  return restart(t, y);
}

/// Archives the rest of a count: one of the start may have been taken off `terminal`.
void Events::state(Archive& archive) {
  archive(last_, sign_, touched_, size_, slope_, sign_before_);
  for (std::size_t e = 0; e < count(); ++e) {
    std::int64_t terminal = functions_[e].terminal, seen = times_seen_[e];
    archive(terminal, seen);
    times_seen_[e] = functions_[e].terminal - (terminal - seen);
  }
  for (Actions& all : actions_) {
    archive(all.t, all.interval, all.count, all.shorter, all.returned);
    archive.values(&all.crossed, 1);
    archive.require(is_sign(all.crossed));
  }
  archive(accumulation_);
  archive.require(!accumulation_ || accumulation_->event < count());
  std::vector<std::size_t> which;
  std::vector<double> when;
  std::vector<int> how;
  for (const Occurrence& occurrence : occurrences_) {
    which.push_back(occurrence.event);
    when.push_back(occurrence.t);
    how.push_back(occurrence.direction);
  }
  archive.resizable(which);
  archive.resizable(when);
  archive.resizable(how);
  if (!archive.reading()) return;
  archive.require(std::ranges::all_of(sign_, is_sign) && std::ranges::all_of(sign_before_, is_sign));
  archive.require(which.size() == when.size() && which.size() == how.size() && std::ranges::all_of(how, is_sign));
  occurrences_.clear();
  for (std::size_t k = 0; k < which.size(); ++k) {
    archive.require(which[k] < count());
    occurrences_.push_back({which[k], when[k], how[k]});
  }
}

Outcome Events::search(double t0, double t1, const double* y1, int degree, StepInterpolant& interpolant) {
  step_ = {t0, t1, y1, &interpolant};
  intervals_ = intervals_of_step(static_cast<std::size_t>(degree));
  assert(t0 != t1 && intervals_ < scan_.times.size());
  occurrences_.clear();
  terminal_ = acts_ = false;
  points_known_[0] = points_known_[1] = powers_known_ = false;
  forget_values();
  sign_before_ = sign_;
  const auto parts = static_cast<double>(intervals_);
  for (std::size_t j = 0; j < intervals_; ++j) scan_.times[j] = t0 + (t1 - t0) * (static_cast<double>(j) / parts);
  scan_.times[intervals_] = t1;

  for (std::size_t e = 0; e < count(); ++e)
    if (const Outcome outcome = find(e); outcome != Outcome::ok) return outcome;
  if (!occurrences_.empty()) settle();
  return Outcome::ok;
}

/// The occurrences of one event.
Outcome Events::find(std::size_t event) {
  const bool turns = by_turning_points(event);
  bool closely = turns || functions_[event].samples != 0;
  Outcome outcome = turns     ? scan_turning_points(event)
                    : closely ? scan_closely(event, functions_[event].samples)
                              : scan(event, false);
  if (outcome == Outcome::ok && !closely && leaves_room(event)) {
    closely = true;
    outcome = scan_closely(event, EventFunction::adaptive);
  }
  if (outcome == Outcome::ok && !closely && !brackets_.empty() && step_.interpolant->kind().projects())
    outcome = scan(event, true);  // decide on the values that will be returned
  if (outcome != Outcome::ok) return outcome;
  const Scan& scanned = closely ? close_scan_ : scan_;
  const std::vector<double>& values = scanned.values;
  const int asked = sign_of(functions_[event].direction);
  roots_.clear();
  for (const Bracket& bracket : brackets_) {
    const int direction = sign_of(values[bracket.b] == 0 ? -values[bracket.a] : values[bracket.b]);
    if (asked != 0 && asked != direction && !turns) continue;
    double root = scanned.times[bracket.b];
    outcome = locate(event, scanned, bracket, root);
    if (outcome != Outcome::ok) return outcome;
    roots_.push_back({event, root, direction});
  }
  if (turns) join_close_roots();
  if (turns && functions_[event].touching) {
    outcome = find_touching(event);
    if (outcome != Outcome::ok) return outcome;
  }
  for (const Occurrence& root : roots_)
    if (root.direction == 0 ? is_new_touching(root) : asked == 0 || asked == root.direction)
      occurrences_.push_back(root);
  if (woken_ != 0 && functions_[event].acts()) note_waking(event, woken_);
  last_[event] = closely ? values.back() : values[intervals_];
  if (closely) note_size(event);
  sign_[event] = sign_after_;
  return Outcome::ok;
}

/// y at the interior points of the scan, once for all events.
Outcome Events::points(bool projected) {
  if (std::exchange(points_known_[projected], true)) return Outcome::ok;
  points_[projected].resize((intervals_ - 1) * n_);
  for (std::size_t j = 1; j < intervals_; ++j) {
    double* y = points_[projected].data() + (j - 1) * n_;
    const Status status =
        projected ? step_.interpolant->value(scan_.times[j], y) : step_.interpolant->corrected(scan_.times[j], y);
    if (status == Status::stop) return Outcome::stop;
  }
  return Outcome::ok;
}

/// Values of the event along the step, and the brackets that they show.
Outcome Events::scan(std::size_t event, bool projected) {
  if (const Outcome outcome = points(projected); outcome != Outcome::ok) return outcome;
  scan_.values[0] = last_[event];
  for (std::size_t j = 1; j <= intervals_; ++j) {
    const double* y = j < intervals_ ? points_[projected].data() + (j - 1) * n_ : step_.y1;
    const Outcome outcome = evaluate(event, scan_.times[j], y, scan_.values[j]);
    if (outcome != Outcome::ok) return outcome;
  }
  find_brackets(event, scan_);
  return Outcome::ok;
}

/// Returns whether the values of the scan leave room for roots that they do not show: whether an event that is no more
/// than `room_between_points` times as steep as between any two neighbours, in this step or the one before, could reach
/// zero and return between two of them. Where it is as good as straight, it does not turn. Neighbours on two sides of
/// zero, or at zero, have one root between them, or it is left to its own: then it would have to be twice that steep. A
/// condition, ±1, shows nothing between its values.
bool Events::leaves_room(std::size_t event) {
  const std::vector<double>& values = scan_.values;
  const auto change = [&](std::size_t j) { return values[j] - values[j - 1]; };
  const auto alike = [&](std::size_t j, std::size_t k) {
    return k < 1 || k > intervals_ || std::abs(change(k) - change(j)) <= straight * std::abs(change(j));
  };
  double most = std::abs(values[0]), least = most, largest = 0;
  double apart = std::numeric_limits<double>::infinity(), across = apart;
  for (std::size_t j = 1; j <= intervals_; ++j) {
    const double a = values[j - 1], b = values[j], sum = std::abs(a) + std::abs(b);
    if (sign_of(a) * sign_of(b) <= 0)
      across = std::min(across, sum);
    else if (!alike(j, j - 1) || !alike(j, j + 1))
      apart = std::min(apart, sum);
    largest = std::max(largest, std::abs(change(j)));
    most = std::max(most, std::abs(b));
    least = std::min(least, std::abs(b));
  }
  const double width = std::abs(step_.t1 - step_.t0) / static_cast<double>(intervals_);
  const double reach = std::max(largest, slope_[event] * width);
  note_size(event, most, largest / width);
  if (most == 1 && least == 1) return false;
  return !std::isfinite(largest) || room_between_points * reach >= apart || reach > room_between_points * across;
}

/// Notes how large the event is in the step, and how steep.
void Events::note_size(std::size_t event, double size, double slope) {
  size_[event] = size;
  slope_[event] = std::isfinite(slope) ? slope : 0;
}

/// Notes the size of an event from the close scan.
void Events::note_size(std::size_t event) {
  const auto& [times, values] = close_scan_;
  if (functions_[event].samples == 0 && !by_turning_points(event)) return;  // `leaves_room` has
  double most = 0, slope = 0;
  for (std::size_t j = 1; j < times.size(); ++j) {
    most = std::max(most, std::abs(values[j]));
    if (times[j] != times[j - 1])
      slope = std::max(slope, std::abs((values[j] - values[j - 1]) / (times[j] - times[j - 1])));
  }
  note_size(event, most, slope);
}

/// Scans the step closely for an event, with samples of its own, on the values that will be returned.
Outcome Events::scan_closely(std::size_t event, int samples) {
  const double t0 = step_.t0, t1 = step_.t1;
  auto& [times, values] = close_scan_;
  if (!separator_) {  // many runs never look so closely
    separator_.emplace();
    for (std::vector<double>* const one : {&times, &values}) one->reserve(few_samples);
  }
  double start = last_[event], end = 0;
  Outcome outcome = evaluate(event, t1, step_.y1, end);
  if (outcome == Outcome::ok && start == 0)
    outcome = evaluate(event, t0, step_.interpolant->start_y(), start);  // asleep
  if (outcome != Outcome::ok) return outcome;
  const auto inside = [&](double t, double& value) {
    outcome = evaluate_inside(event, t, value);
    return outcome == Outcome::ok;
  };
  times.assign(1, t0);
  if (samples == EventFunction::adaptive) {
    const auto noise = [&](double& value) {
      outcome = roundoff_of(event, t1, step_.y1, end, value);
      return outcome == Outcome::ok;
    };
    if (!separator_->separate(std::ref(inside), std::ref(noise), {t0, start, t1, end}, sign_[event] == 0, times))
      return outcome;
  } else {
    const auto parts = std::max(intervals_, static_cast<std::size_t>(samples) + 1);
    for (std::size_t j = 1; j < parts; ++j)
      times.push_back(t0 + (t1 - t0) * (static_cast<double>(j) / static_cast<double>(parts)));
  }
  values.assign(1, last_[event]);
  for (std::size_t j = 1; j < times.size(); ++j)
    if (!inside(times[j], values.emplace_back())) return outcome;
  times.push_back(t1);
  values.push_back(end);
  find_brackets(event, close_scan_);
  return Outcome::ok;
}

/// About what roundoff of t and y makes of the event: y is moved as a whole, so that no terms cancel in both.
Outcome Events::roundoff_of(std::size_t event, double t, const double* y, double value, double& noise) {
  double size = 0, moved = 0;
  for (const double alternating : {1.0, -1.0}) {
    double sign = 1;
    for (std::size_t i = 0; i < n_; ++i, sign *= alternating) y_[i] = y[i] * (1 + sign * small_change);
    if (const Outcome outcome = evaluate(event, t, y_.data(), moved); outcome != Outcome::ok) return outcome;
    size = std::max(size, std::abs(moved - value));
  }
  if (const Outcome outcome = evaluate(event, t * (1 + small_change), y, moved); outcome != Outcome::ok) return outcome;
  size = std::max(size, std::abs(moved - value));
  noise = noise_ulps * eps * size / small_change;
  return Outcome::ok;
}

/// Returns whether the step is a polynomial, along which the event is expanded.
bool Events::by_turning_points(std::size_t event) const {
  const std::optional<Series>& series = functions_[event].series;
  return series && series->order() == step_.interpolant->order_of_powers();
}

/// Scans the step where the event turns: between these points it is monotonic.
Outcome Events::scan_turning_points(std::size_t event) {
  const double t0 = step_.t0, t1 = step_.t1;
  if (!std::exchange(powers_known_, true) && step_.interpolant->powers(powers_) == Status::stop) return Outcome::stop;
  if (turning_points_.find(*functions_[event].series, t0, t1 - t0, powers_.data(), n_, thetas_) == Status::stop)
    return Outcome::stop;
  auto& [times, values] = close_scan_;
  times.assign(1, t0);
  values.assign(1, last_[event]);
  for (const double theta : thetas_) {
    const double t = t0 + theta * (t1 - t0);
    if (t == times.back() || t == t1) continue;
    times.push_back(t);
    if (const Outcome outcome = evaluate_inside(event, t, values.emplace_back()); outcome != Outcome::ok)
      return outcome;
  }
  times.push_back(t1);
  if (const Outcome outcome = evaluate(event, t1, step_.y1, values.emplace_back()); outcome != Outcome::ok)
    return outcome;
  find_brackets(event, close_scan_);
  if (values.back() == 0 && turning_points_.turns_at_end() && !brackets_.empty() &&
      brackets_.back().b + 1 == times.size()) {
    const std::size_t a = brackets_.back().a;  // it touches zero there
    sign_after_ = a > 0 ? sign_of(values[a]) : sign_[event];
    brackets_.pop_back();
  }
  return Outcome::ok;
}

/// Takes pairs of roots that are closer than the resolution for one zero without a change of sign.
void Events::join_close_roots() {
  const double close = resolution * std::abs(step_.t1 - step_.t0);
  for (std::size_t k = 0; k + 1 < roots_.size();) {
    Occurrence &first = roots_[k], &second = roots_[k + 1];
    if (first.direction == 0 || second.direction == 0 || std::abs(second.t - first.t) > close) {
      ++k;
      continue;
    }
    first.t += 0.5 * (second.t - first.t);
    first.direction = 0;
    roots_.erase(roots_.begin() + static_cast<std::ptrdiff_t>(k) + 1);
  }
}

/// Adds the places where the event turns within roundoff of zero, on the side on which it was and stays. (Of
/// neighbours, between which it is monotonic, the one nearer to zero.)
Outcome Events::find_touching(std::size_t event) {
  const auto& [times, values] = close_scan_;
  const std::size_t end = times.size() - 1;
  const double small = resolution * turning_points_.size();
  std::size_t latest = 0;  // of those found
  int before = sign_[event];
  for (std::size_t j = 1; j <= end; ++j) {
    const int after = j < end ? sign_after(j) : before;
    const bool stays = before != 0 && after == before && sign_of(values[j]) != -before;
    bool touches = stays && std::abs(values[j]) <= small && (j < end || turning_points_.turns_at_end());
    if (touches) {
      if (step_.interpolant->value(times[j], y_.data()) == Status::stop) return Outcome::stop;
      const Outcome outcome = within_roundoff(event, times[j], y_.data(), values[j], turning_points_.size(), touches);
      if (outcome != Outcome::ok) return outcome;
    }
    if (touches && latest > 0 && latest + 1 == j) {
      if (std::abs(values[j]) < std::abs(values[latest])) roots_.back().t = times[j];
      latest = j;
    } else if (touches) {
      roots_.push_back({event, times[j], 0});
      latest = j;
    }
    if (values[j] != 0) before = sign_of(values[j]);
  }
  std::ranges::sort(roots_, {}, [this](const Occurrence& one) { return std::abs(one.t - step_.t0); });
  return Outcome::ok;
}

/// The sign that the event takes on after point j of the close scan; 0: none until the end of the step.
int Events::sign_after(std::size_t j) const {
  int sign = 0;
  for (std::size_t k = j + 1; k < close_scan_.values.size() && sign == 0; ++k) sign = sign_of(close_scan_.values[k]);
  return sign;
}

/// Returns whether touching zeros are requested, and this one is not that at the end of the step before.
bool Events::is_new_touching(const Occurrence& root) {
  const double before = std::exchange(touched_[root.event], root.t);
  const bool same = std::abs(root.t - before) <= resolution * std::abs(step_.t1 - step_.t0);
  return functions_[root.event].touching && !same;
}

/// Finds out whether |value|, of the event at (t, y), is no more than what roundoff of y and t makes of it, and of
/// terms of that `size`.
Outcome Events::within_roundoff(std::size_t event, double t, const double* y, double value, double size, bool& within) {
  if (y != y_.data()) std::copy(y, y + n_, y_.begin());
  double moved = 0;
  for (std::size_t i = 0; i <= n_; ++i) {
    double& x = i < n_ ? y_[i] : t;
    if (x == 0) continue;
    const double kept = std::exchange(x, x * (1 + small_change));
    if (const Outcome outcome = evaluate(event, t, y_.data(), moved); outcome != Outcome::ok) return outcome;
    x = kept;
    size += std::abs(moved - value) / small_change;
  }
  within = std::abs(value) <= of_touching * size;
  return Outcome::ok;
}

Outcome Events::evaluate_inside(std::size_t event, double t, double& value) {
  if (step_.interpolant->value(t, y_.data()) == Status::stop) return Outcome::stop;
  return evaluate(event, t, y_.data(), value);
}

void Events::find_brackets(std::size_t event, const Scan& scan) {
  const std::vector<double>& values = scan.values;
  const std::size_t intervals = &scan == &scan_ ? intervals_ : values.size() - 1;
  brackets_.clear();
  int sign = sign_[event];
  woken_ = 0;
  std::size_t a = 0;     // where the event was last not zero
  std::size_t zero = 0;  // first exact zero since, if any
  for (std::size_t j = 1; j <= intervals; ++j) {
    const int s = sign_of(values[j]);
    if (s == 0 && sign != 0 && zero == 0) zero = j;
    if (s == 0 && j < intervals) continue;          // crossing or tangency: the next nonzero value tells
    const bool rested = zero != 0 && zero + 1 < j;  // at zero, and returns: it occurs where that began
    if (sign != 0 && (s != sign || rested)) brackets_.push_back({a, zero != 0 ? zero : j});
    if (sign == 0) woken_ = s;
    sign = s;
    a = j;
    zero = 0;
  }
  sign_after_ = sign;
}

Outcome Events::locate(std::size_t event, const Scan& scan, const Bracket& bracket, double& root) {
  const auto& [times, values] = scan;
  assert(bracket.a <= bracket.b && bracket.b < times.size());
  if (values[bracket.b] == 0) return locate_first_zero(event, times[bracket.b - 1], times[bracket.b], root);
  Outcome outcome = Outcome::ok;
  const auto e = [&](double t, double& value) {
    outcome = evaluate_inside(event, t, value);
    return outcome == Outcome::ok;
  };
  const double width = location_ulps * step_ulp();
  find_root(e, times[bracket.a], values[bracket.a], times[bracket.b], values[bracket.b], width, root);
  return outcome;
}

/// The scan hit a zero, where the event may have been zero for some time: halves the interval down to where that began.
Outcome Events::locate_first_zero(std::size_t event, double before, double zero, double& root) {
  root = zero;
  const double beside = zero - resolution * (step_.t1 - step_.t0);
  if (std::abs(beside - before) >= std::abs(zero - before)) return Outcome::ok;
  double value = 0;
  if (const Outcome outcome = evaluate_inside(event, beside, value); outcome != Outcome::ok || value != 0)
    return outcome;
  root = beside;
  const double width = location_ulps * step_ulp();
  while (std::abs(root - before) > width) {
    const double middle = before + 0.5 * (root - before);
    if (const Outcome outcome = evaluate_inside(event, middle, value); outcome != Outcome::ok) return outcome;
    (value == 0 ? root : before) = middle;
  }
  return Outcome::ok;
}

/// The unit of time in the step, which also holds where t passes through 0.
double Events::step_ulp() const { return std::max(ulp(step_.t0), ulp(step_.t1)); }

/// Puts the occurrences into the order of integration and lets the first that is terminal or acts, with its ties, end
/// them.
void Events::settle() {
  const double forward = step_.t1 > step_.t0 ? 1 : -1;
  std::sort(occurrences_.begin(), occurrences_.end(), [forward](const Occurrence& a, const Occurrence& b) {
    return a.t == b.t ? a.event < b.event : forward * a.t < forward * b.t;
  });
  std::size_t kept = 0;
  double end = 0;
  for (; kept < occurrences_.size(); ++kept) {
    Occurrence& occurrence = occurrences_[kept];
    if (terminal_ || acts_) {
      if (std::abs(occurrence.t - end) > tie_ulps * step_ulp()) break;
      occurrence.t = end;
    }
    const EventFunction& function = functions_[occurrence.event];
    if (++times_seen_[occurrence.event] == function.terminal) terminal_ = true;
    if (function.acts()) acts_ = true;
    if (terminal_ || acts_) end = occurrence.t;
  }
  if (terminal_) acts_ = false;
  occurrences_.resize(kept);
  for (const Occurrence& occurrence : occurrences_)
    if (acts_ && functions_[occurrence.event].acts()) note_action(occurrence);
}

void Events::note_action(const Occurrence& occurrence) {
  Actions& all = actions_[occurrence.event];
  const double interval = all.count++ == 0 ? all.interval : std::abs(occurrence.t - all.t);
  all.shorter = interval < all.interval ? all.shorter + 1 : 0;
  all.interval = interval;
  all.t = occurrence.t;
  all.crossed = occurrence.direction;
}

/// The event has left zero after its action, in this direction. Events whose actions switch something go on to the
/// other side each time; one whose actions have sent it back does so when a whole flight is shorter than what a step
/// shows.
void Events::note_waking(std::size_t event, int sign) {
  Actions& all = actions_[event];
  if (all.crossed == 0) return;
  const bool through = sign == std::exchange(all.crossed, 0);
  if (through && all.returned && all.shorter > few_intervals && !accumulation_)
    accumulation_ = {.event = event, .t = all.t, .interval = all.interval, .count = all.count};
  all.returned = !through;
}

}  // namespace invariode
