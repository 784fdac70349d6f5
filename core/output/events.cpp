#include "output/events.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace invariode {
namespace {

constexpr double location_ulps = 2;  // width of the final bracket, in ulp of t
constexpr int fewest_points = 3;     // inside a step: an event need not be linear in y
constexpr double tie_ulps = 4;       // roots this close are one instant

int sign_of(double v) { return (v > 0) - (v < 0); }

/// Shrinks [a, b], on which e changes sign, to `width` by Chandrupatla's method (Adv. Eng. Software 28 (1997) 145):
/// inverse quadratic interpolation where the three latest points are in a shape that makes it converge, else bisection.
/// e(t, value) returns false to give up. The end with the smaller |e| is the root.
template <class E>
bool find_root(E&& e, double a, double ea, double b, double eb, double width, double& root) {
  double c = a, ec = ea;
  double fraction = 0.5;
  for (;;) {
    const double x = a + fraction * (b - a);
    double ex = 0;
    if (!e(x, ex)) return false;
    if (sign_of(ex) == sign_of(ea)) {
      c = a, ec = ea;
    } else {
      c = b, ec = eb;
      b = a, eb = ea;
    }
    a = x, ea = ex;
    root = std::abs(ea) < std::abs(eb) ? a : b;
    const double least = 0.5 * width / std::abs(b - a);
    if (least > 0.5 || ea == 0 || eb == 0 || x == b || x == c) return true;
    const double xi = (a - b) / (c - b), phi = (ea - eb) / (ec - eb);
    fraction = 0.5;
    if (phi * phi < xi && (1 - phi) * (1 - phi) < 1 - xi)
      fraction = ea / (eb - ea) * ec / (eb - ec) + (c - a) / (b - a) * ea / (ec - ea) * eb / (ec - eb);
    fraction = std::isnan(fraction) ? 0.5 : std::clamp(fraction, least, 1 - least);
  }
}

}  // namespace

Events::Events(std::vector<EventFunction> functions, std::size_t n, int max_degree)
    : functions_(std::move(functions)),
      n_(n),
      intervals_(static_cast<std::size_t>(std::max(max_degree, fewest_points)) + 1),
      times_(intervals_ + 1),
      values_(intervals_ + 1),
      last_(functions_.size()),
      sign_(functions_.size()),
      times_seen_(functions_.size()),
      y_(functions_.empty() ? 0 : n) {
  if (empty()) return;
  for (std::size_t e = 0; e < count(); ++e) times_seen_[e] = functions_[e].seen;
  for (std::vector<double>& p : points_) p.resize((intervals_ - 1) * n);
  brackets_.reserve(intervals_);
  occurrences_.reserve(functions_.size() * intervals_);
}

Outcome Events::evaluate(std::size_t event, double t, const double* y, double& value) {
  if (functions_[event].function(t, y, &value) == Status::stop) return Outcome::stop;
  if (!std::isnan(value)) return Outcome::ok;
  undefined_ = {event, t};
  return Outcome::not_finite;
}

Outcome Events::start(double t, const double* y) {
  for (std::size_t e = 0; e < count(); ++e) {
    if (const Outcome outcome = evaluate(e, t, y, last_[e]); outcome != Outcome::ok) return outcome;
    if (std::exchange(functions_[e].asleep, false)) last_[e] = 0;
    sign_[e] = sign_of(last_[e]);
  }
  return Outcome::ok;
}

Outcome Events::restart(double t, const double* y) {
  if (const Outcome outcome = start(t, y); outcome != Outcome::ok) return outcome;
  for (const Occurrence& occurrence : occurrences_)
    if (occurrence.t == t) {
      sign_[occurrence.event] = 0;
      last_[occurrence.event] = 0;
    }
  return Outcome::ok;
}

Outcome Events::search(double t0, double t1, const double* y1, int degree, StepInterpolant& interpolant) {
  step_ = {t0, t1, y1, &interpolant};
  intervals_ = static_cast<std::size_t>(std::max(degree, fewest_points)) + 1;
  occurrences_.clear();
  terminal_ = acts_ = false;
  points_known_[0] = points_known_[1] = false;
  const auto parts = static_cast<double>(intervals_);
  for (std::size_t j = 0; j < intervals_; ++j) times_[j] = t0 + (t1 - t0) * (static_cast<double>(j) / parts);
  times_[intervals_] = t1;

  for (std::size_t e = 0; e < count(); ++e) {
    if (const Outcome outcome = scan(e, false); outcome != Outcome::ok) return outcome;
    if (!brackets_.empty() && interpolant.projects())  // decide on the values that will be returned
      if (const Outcome outcome = scan(e, true); outcome != Outcome::ok) return outcome;
    for (const Bracket& bracket : brackets_) {
      const int direction = sign_of(values_[bracket.b] == 0 ? -values_[bracket.a] : values_[bracket.b]);
      if (functions_[e].direction != 0 && sign_of(functions_[e].direction) != direction) continue;
      double root = times_[bracket.b];
      if (const Outcome outcome = locate(e, bracket, root); outcome != Outcome::ok) return outcome;
      occurrences_.push_back({e, root});
    }
    last_[e] = values_[intervals_];
    sign_[e] = sign_after_;
  }
  if (!occurrences_.empty()) settle();
  return Outcome::ok;
}

/// y at the interior points of the scan, once for all events.
Outcome Events::points(bool projected) {
  if (std::exchange(points_known_[projected], true)) return Outcome::ok;
  for (std::size_t j = 1; j < intervals_; ++j) {
    double* y = points_[projected].data() + (j - 1) * n_;
    const Status status =
        projected ? step_.interpolant->value(times_[j], y) : step_.interpolant->corrected(times_[j], y);
    if (status == Status::stop) return Outcome::stop;
  }
  return Outcome::ok;
}

/// Values of the event along the step, and the brackets that they show.
Outcome Events::scan(std::size_t event, bool projected) {
  if (const Outcome outcome = points(projected); outcome != Outcome::ok) return outcome;
  values_[0] = last_[event];
  for (std::size_t j = 1; j <= intervals_; ++j) {
    const double* y = j < intervals_ ? points_[projected].data() + (j - 1) * n_ : step_.y1;
    if (const Outcome outcome = evaluate(event, times_[j], y, values_[j]); outcome != Outcome::ok) return outcome;
  }
  find_brackets(event);
  return Outcome::ok;
}

void Events::find_brackets(std::size_t event) {
  brackets_.clear();
  int sign = sign_[event];
  std::size_t a = 0;     // where the event was last not zero
  std::size_t zero = 0;  // first exact zero since, if any
  for (std::size_t j = 1; j <= intervals_; ++j) {
    const int s = sign_of(values_[j]);
    if (s == 0 && sign != 0 && zero == 0) zero = j;
    if (s == 0 && j < intervals_) continue;  // crossing or tangency: the next nonzero value tells
    if (sign != 0 && s != sign) brackets_.push_back({a, zero != 0 ? zero : j});
    sign = s;
    a = j;
    zero = 0;
  }
  sign_after_ = sign;
}

Outcome Events::locate(std::size_t event, const Bracket& bracket, double& root) {
  if (values_[bracket.b] == 0) return Outcome::ok;  // the scan hit it
  Outcome outcome = Outcome::ok;
  const auto e = [&](double t, double& value) {
    if (step_.interpolant->value(t, y_.data()) == Status::stop)
      outcome = Outcome::stop;
    else
      outcome = evaluate(event, t, y_.data(), value);
    return outcome == Outcome::ok;
  };
  const double width = location_ulps * step_ulp();
  find_root(e, times_[bracket.a], values_[bracket.a], times_[bracket.b], values_[bracket.b], width, root);
  return outcome;
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
    if (function.action) acts_ = true;
    if (terminal_ || acts_) end = occurrence.t;
  }
  if (terminal_) acts_ = false;
  occurrences_.resize(kept);
}

}  // namespace invariode
