#include "jumps.hpp"

#include <algorithm>
#include <cassert>
#include <utility>

#include "weights.hpp"

namespace invariode {
namespace {

constexpr int longest_cascade = 100;  // jumps in a row, each caused by the one before
constexpr int listed_from = 50;       // of these: the events that occur by them go round in a circle

}  // namespace

Jumps::Jumps(const Parts& parts, std::function<Consistency(double t, double* y)> consistent,
             std::function<Status(double t, double* Y)> consistent_tangent, Callback f,
             std::optional<DifferentialRate> rate, std::size_t n, std::size_t size)
    : parts_(parts),
      consistent_(std::move(consistent)),
      consistent_tangent_(std::move(consistent_tangent)),
      f_(f),
      rate_(std::move(rate)),
      extent_(Extent::within(n, size)) {
  jumped_.resize(extent_.k * extent_.n);
  if (parts_.delays == nullptr || extent_.k == 0) return;
  past_.resize(parts_.delays->lags().size() * extent_.n);
  past_behind_.resize(past_.size());
  slope_.resize(extent_.n);
  slope_behind_.resize(extent_.n);
  jumped_.resize(2 * jumped_.size());
  rates_.resize(extent_.k);
}

State Jumps::at_events(double t, double* Y, bool inside) {
  if (const State state = begin(t, Y, inside); state != State::running) return state;
  for (const Occurrence& one : parts_.events.occurrences())
    if (one.t == t && parts_.events.function(one.event).acts()) due_.push_back({one.event, one.direction, 0, true});
  const State state = work(t, Y);
  parts_.events.forget_occurrences();
  return state;
}

State Jumps::at_landing(double t, double* Y) {
  before_.assign(Y, Y + extent_.size());
  return follow(parts_.breaks.landing_jump(), t, Y);
}

Status Jumps::note_past(double t) {
  std::ranges::fill(rates_, 0);
  return parts_.delays->values(parts_.breaks.inside(t), past_.data());
}

Status Jumps::at_moving_mark(double t, std::span<const double> rates, double* Y) {
  const std::size_t n = extent_.n, k = extent_.k;
  if (parts_.delays->values(parts_.breaks.inside(t), past_behind_.data()) == Status::stop) return Status::stop;
  for (std::size_t d = 0; d < past_.size() / n; ++d) {
    const std::span<const double> moved = rates.subspan(d * k, k);
    const bool moves = std::ranges::any_of(moved, [](double one) { return one != 0; });
    if (moves && slope_with(past_, t, Y, slope_.data()) == Status::stop) return Status::stop;
    std::copy_n(past_behind_.data() + d * n, n, past_.data() + d * n);
    if (!moves) continue;
    if (slope_with(past_, t, Y, slope_behind_.data()) == Status::stop) return Status::stop;
    for (std::size_t j = 0; j < k; ++j)
      for (std::size_t i = 0; i < n; ++i) Y[(1 + j) * n + i] += (slope_[i] - slope_behind_[i]) * moved[j];
  }
  return Status::ok;
}

/// y' at (t, y) with these delayed values; 0 of components that rest at a bound.
Status Jumps::slope_with(std::span<const double> past, double t, const double* y, double* out) {
  parts_.delays->hold(past);
  const Status status = f_(t, y, out);
  parts_.delays->hold({});
  bool told = true;
  if (status == Status::stop || (rate_ && rate_->enter(t, told) == Status::stop)) return Status::stop;
  if (rate_ && told) rate_->solve(out);
  if (parts_.manifold.bounds() == nullptr) return Status::ok;
  const std::vector<double> lower = parts_.manifold.bounds()->lower(), upper = parts_.manifold.bounds()->upper();
  for (std::size_t i = 0; i < extent_.n; ++i)
    if ((y[i] <= lower[i] && out[i] < 0) || (y[i] >= upper[i] && out[i] > 0)) out[i] = 0;
  return Status::ok;
}

Status Jumps::note_occurrence(Callback& jump, double t, const double* Y) {
  if (note_past(t) == Status::stop) return Status::stop;
  before_.assign(Y, Y + extent_.size());
  return call(jump, t, Y);
}

/// Calls the jump of the sensitivities from `before_` to y, into `jumped_`.
Status Jumps::call(Callback& jump, double t, const double* y) {
  before_.insert(before_.end(), y, y + extent_.n);
  before_.insert(before_.end(), past_.begin(), past_.end());
  return jump(t, before_.data(), jumped_.data());
}

State Jumps::at_breakpoints(double t, double* Y, bool inside) {
  Breaks& breaks = parts_.breaks;
  acted_ = moved_ = others_ = false;
  for (; breaks.at_breakpoint(t); breaks.pass()) {
    Breakpoint& point = breaks.next();
    if (!point.action) continue;
    if (!acted_)
      if (const State state = begin(t, Y, inside); state != State::running) return state;
    remarks_.event = parts_.events.count() + breaks.index();
    before_.assign(Y, Y + extent_.size());
    State state = take(point.action, before_.data(), point.jump, t, Y);
    if (state == State::running) state = judge(t, Y, 0);
    while (state == State::running && !due_.empty()) state = take_next(t, Y);
    if (state == State::running) continue;
    breaks.pass();
    return terminal_ ? ended_by(t, Y) : state;
  }
  if (!acted_)
    if (const State state = without_action(t, Y, inside); state != State::running || !moved_) return state;
  const State state = work(t, Y);
  parts_.events.forget_occurrences();
  return state;
}

/// Algebraic variables jump where their equations do, and invariants may have other values. If these determine y, it
/// jumps with them.
State Jumps::without_action(double t, double* Y, bool inside) {
  raw_.assign(Y, Y + extent_.n);
  State state = onto_equations(t, Y);
  if (state != State::running) return state;
  if (parts_.manifold.compare_values(t, Y, others_) == Status::stop) return State::interrupted;
  if (!moved_ && !(others_ && parts_.manifold.determines_state())) return state;
  state = begin(t, raw_.data(), inside);
  moved_ = true;
  rehold_ = others_;
  return state == State::running ? judge(t, Y, 0) : state;
}

/// Events are judged at the state before all jumps.
State Jumps::begin(double t, const double* Y, bool inside) {
  due_.clear();
  acted_ = moved_ = terminal_ = false;
  rehold_ = true;
  occurred_ = 0;
  remarks_.circle.clear();
  const Outcome outcome = parts_.events.leave(t, Y, inside);
  if (outcome == Outcome::ok) return State::running;
  return outcome == Outcome::stop ? State::interrupted : undefined_event(t);
}

State Jumps::undefined_event(double t) {
  remarks_.event = parts_.events.undefined().event;
  remarks_.t = t;
  return State::event_undefined;
}

/// Takes the actions that are due, and those that become due by that, until Y is at rest on the constraints.
State Jumps::work(double t, double* Y) {
  State state = State::running;
  for (int round = 0; state == State::running; ++round) {
    while (state == State::running && !due_.empty()) state = take_next(t, Y);
    if (terminal_ || state != State::running) break;
    raw_.assign(Y, Y + extent_.n);
    state = restore(t, Y);
    if (state != State::running || std::equal(raw_.begin(), raw_.end(), Y)) break;
    state = judge(t, Y, round);
    if (due_.empty()) break;
  }
  return terminal_ ? ended_by(t, Y) : state;
}

/// The run ends with the state behind the jump, on the constraints; actions that were due are not taken.
State Jumps::ended_by(double t, double* y) {
  for (const Due& due : due_)
    if (!due.listed) list(due, t, y);
  due_.clear();
  const State state = restore(t, y);
  return state == State::running ? State::terminal_event : state;
}

/// Takes the action of the event that has waited longest, with those of its vector that became due by the same jump.
State Jumps::take_next(double t, double* Y) {
  const Due first = due_.front();
  EventFunction& function = parts_.events.function(first.event);
  remarks_.event = first.event;
  rehold_ = rehold_ && function.rehold;
  const bool alone = function.vector == EventFunction::alone;
  const auto together = [&](const Due& one) {
    return alone ? one.event == first.event
                 : parts_.events.function(one.event).vector == function.vector && one.depth == first.depth;
  };
  before_.assign(Y, Y + extent_.size());
  if (!alone) {
    const RootVector& vector = parts_.events.vector(function.vector);
    told_.assign(Y, Y + extent_.n);
    told_.resize(extent_.n + vector.count);
    for (const Due& one : due_)
      if (together(one)) told_[extent_.n + one.event - vector.first] = one.direction;
  }
  bool taken = false;  // the same event may be due again
  std::erase_if(due_, [&](const Due& one) {
    if (!together(one) || (alone && taken)) return false;
    list(one, t, Y);
    return taken = true;
  });
  Callback& action = alone ? function.action : parts_.events.vector(function.vector).action;
  const double* given = alone ? before_.data() : told_.data();
  if (const State state = take(action, given, function.jump, t, Y); state != State::running) return state;
  return judge(t, Y, first.depth + 1);
}

/// Y after an action. `given`: y before it, followed by the directions of the functions for the action of a vector.
State Jumps::take(Callback& action, const double* given, Callback& jump, double t, double* Y) {
  if (action(t, given, Y) == Status::stop) return State::interrupted;
  acted_ = true;
  if (!all_finite(Y, extent_.n)) return State::action_undefined;
  if (const State state = solve_equations(t, Y); state != State::running) return state;
  if (jump)
    if (const State state = follow(jump, t, Y); state != State::running) return state;
  return follow_equations(t, Y);
}

/// S behind a jump of y from `before_`.
State Jumps::follow(Callback& jump, double t, double* Y) {
  if (call(jump, t, Y) == Status::stop) return State::interrupted;
  std::copy_n(jumped_.data(), extent_.k * extent_.n, Y + extent_.n);
  for (std::size_t j = 0; j < rates_.size(); ++j) rates_[j] = jumped_[(extent_.k + j) * extent_.n];
  return all_finite(Y, extent_.size()) ? State::running : State::action_undefined;
}

State Jumps::onto_equations(double t, double* Y) {
  const State state = solve_equations(t, Y);
  return state == State::running ? follow_equations(t, Y) : state;
}

State Jumps::solve_equations(double t, double* y) {
  if (!consistent_) return State::running;
  switch (consistent_(t, y)) {
    case Consistency::corrected: moved_ = true; break;
    case Consistency::stop: return State::interrupted;
    case Consistency::not_found:
    case Consistency::undetermined:
    case Consistency::index_too_high: return State::restart_inconsistent;
    case Consistency::consistent:
    case Consistency::undefined: break;  // the restart says so
  }
  return State::running;
}

/// The sensitivities of algebraic variables.
State Jumps::follow_equations(double t, double* Y) {
  const bool stops = consistent_tangent_ && consistent_tangent_(t, Y) == Status::stop;
  return stops ? State::interrupted : State::running;
}

/// Finds the events that the jump to y has carried over zero: their actions are the next ones.
State Jumps::judge(double t, const double* y, int depth) {
  std::vector<std::size_t>& circle = remarks_.circle;
  crossed_.clear();
  switch (parts_.events.arrive(t, y, crossed_)) {
    case Outcome::ok: break;
    case Outcome::stop: return State::interrupted;
    case Outcome::not_finite: return undefined_event(t);
  }
  occurred_ += crossed_.size();
  for (const Occurrence& one : crossed_) {
    const Due due{one.event, one.direction, depth, false};
    const bool known = std::ranges::find(circle, one.event) != circle.end();
    if (depth >= listed_from && !known) circle.push_back(one.event);
    terminal_ = parts_.events.counts_out(one.event) || terminal_;
    if (parts_.events.function(one.event).acts())
      due_.push_back(due);
    else
      list(due, t, y);
  }
  if (terminal_) return State::terminal_event;
  const bool endless =
      depth >= longest_cascade || occurred_ > static_cast<std::size_t>(longest_cascade) * parts_.events.count();
  return endless && !crossed_.empty() ? State::events_endless : State::running;
}

/// The occurrence, with the state that its action gets.
void Jumps::list(const Due& due, double t, const double* Y) {
  Trajectory& all = parts_.occurrences[due.event];
  if (!due.listed)
    all.add(t, Y, extent_.size());
  else if (all.t.size() > 0)  // else it was put out by the run that this one goes on from
    std::copy_n(Y, extent_.size(), all.y.data() + all.y.size() - extent_.size());
}

/// Back within bounds and onto constraints, with new values of invariants that are not demanded.
State Jumps::restore(double t, double* y) {
  remarks_.component = parts_.checks.move_within_bounds(y);
  if (remarks_.component >= 0) return State::action_out_of_bounds;
  remarks_.finding = parts_.manifold.restart(t, y, rehold_, acted_);
  if (remarks_.finding.kind == Finding::Kind::none) return State::running;
  return remarks_.finding.kind == Finding::Kind::stop ? State::interrupted : State::invariant_convicted;
}

}  // namespace invariode
