#include "integrate.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

#include "manifold/thresholds.hpp"

namespace invariode {
namespace {

constexpr double expected_decrease = 3;  // of the correction by two halvings of h
constexpr int start_iterations = 5;      // of the projection of the start within bounds: Newton's is at roundoff then
constexpr int patience = 3;              // corrections refused in a step before the invariant is looked at

}  // namespace

Integration::Integration(std::unique_ptr<Step> step, const Weights& weights, Callback f, const Manifold& manifold,
                         std::vector<EventFunction> events, Breaks breaks, Callback callback, Settings settings)
    : step_(std::move(step)),
      weights_(weights),
      invariants_(manifold.steps),
      bounds_(manifold.bounds),
      bounded_slope_(manifold.bounded_slope),
      off_bounds_only_(manifold.off_bounds_only),
      settings_(std::move(settings)),
      callback_(callback),
      n_(weights.size()),
      forward_(settings_.tf >= settings_.t0 ? 1 : -1),
      aim_(forward_, settings_.hmax),
      stiffness_(weights),
      discontinuities_(f, weights),
      events_(std::move(events), n_, step_->max_degree()),
      breaks_(std::move(breaks)) {
  pass_breakpoints(0);
  if (invariants_) {
    projector_.emplace(*invariants_, weights_, settings_.iterations, settings_.negligible);
    guard_.emplace(*invariants_, weights_, *manifold.slope, std::abs(settings_.tf - settings_.t0));
    if (!events_.empty() && Restoration::needed(*invariants_)) restoration_.emplace(*invariants_, weights_);
    harm_.emplace(n_);
    if (invariants_->along_steps()) {
      directions_.resize(step_->max_directions());
      if (directions_.empty())
        throw std::invalid_argument("this method does not tell what its steps are made of: use direction='gradient'");
    }
    drift.residual.resize(invariants_->m());
    drift.distance.resize(invariants_->m());
    if (bounds_) active_set_.emplace(*projector_, *bounds_);
    if (invariants_->any_one_sided()) one_sided_.emplace(*projector_, active_set_ ? &*active_set_ : nullptr);
  }
  if (invariants_ || bounds_) y1_.resize(n_);
  if (manifold.between) output_projector_.emplace(*manifold.between, weights, 1);
  interpolant_.emplace(*step_, settings_.interpolation, output_projector_ ? &*output_projector_ : nullptr,
                       projector_ ? &*projector_ : nullptr, bounds_);
  if (!events_.empty()) event_y_.resize(n_);
  if (settings_.output_at_times || settings_.refine > 1 || !events_.empty() || !breaks_.points.empty())
    inside_y_.resize(n_);
  occurrences.resize(events_.count());
  if (settings_.dense)
    dense.emplace(n_, manifold.between ? manifold.between->m() : 0, settings_.interpolation, step_->interpolate(),
                  bounds_ ? std::optional(*bounds_) : std::nullopt);
}

bool Integration::end(State state) {
  state_ = state;
  return false;
}

Integration::Verdict Integration::ended(State state) {
  end(state);
  return Verdict::ended;
}

bool Integration::refuse(const Finding& finding) {
  if (finding.kind == Finding::Kind::none) return true;
  if (finding.kind == Finding::Kind::stop) return end(State::interrupted);
  report_.finding = finding;
  return end(state_ == State::created ? State::invariant_refused : State::invariant_convicted);
}

// ---------------------------------------------------------------------------------------------------------- the start

State Integration::start(const double* y0) {
  started_ = std::chrono::steady_clock::now();
  const double t0 = settings_.t0;
  interpolant_->start_at(t0, y0);
  reached_ = {t0, interpolant_->start_y()};
  report_.t = t0;
  begin_piece();
  if (!inspect_start()) return state_;
  const double* y = interpolant_->start_y();
  if (one_sided_ && one_sided_->start(t0, y) == Status::stop) {
    end(State::interrupted);
    return state_;
  }
  if (dense) dense->start(t0, y);
  const bool breaks = breaks_here();
  if (!emit(breaks) || !start_memory(t0, y)) return state_;
  if (settings_.first_step > 0) step_->set_h(settings_.first_step);
  if (!start_rate(t0, y) || !watch_events(events_.start(t0, y))) return state_;
  if (breaks && !pass_breakpoint()) return state_;
  if (t0 == settings_.tf || n_ == 0)
    nothing_to_integrate();
  else
    state_ = State::running;
  return state_;
}

/// The invariants at y0, which may be projected.
bool Integration::inspect_start() {
  double* y0 = interpolant_->start_y();
  if (!start_within_bounds()) return end(State::start_out_of_bounds);
  if (!guard_) return true;
  if (!refuse(guard_->start_value(settings_.t0, y0))) return false;
  if (bounds_ && !bounds_->contain(y0) && !project_start_within_bounds()) return false;
  return !settings_.check || refuse(guard_->start_jacobian(settings_.t0, y0));
}

/// Moves the start onto the bounds that it is outside of by less than the tolerance.
bool Integration::start_within_bounds() {
  if (!bounds_) return true;
  double* y = interpolant_->start_y();
  const Bounds::Excess outside = bounds_->excess(y, weights_);
  if (outside.size > weights_.rtol()) {
    report_.component = outside.component;
    return false;
  }
  bounds_->clip(y);
  return true;
}

/// The projection of the start, which has led out of the bounds, again within them.
bool Integration::project_start_within_bounds() {
  const double t = settings_.t0;
  double* y = interpolant_->start_y();
  for (int i = 0; i < start_iterations; ++i) {
    std::copy(y, y + n_, y1_.begin());
    const Outcome outcome = active_set_->project(t, y1_.data(), y).outcome;
    if (outcome == Outcome::stop) return end(State::interrupted);
    if (outcome != Outcome::ok) return end(State::start_contradicts);
  }
  return refuse(guard_->start_value(t, y)) && (bounds_->contain(y) || end(State::start_contradicts));
}

/// Builds the method's memory at (t, y), at the start and after a jump.
bool Integration::start_memory(double t, const double* y) {
  left_ = false;
  discontinuities_.restart();
  switch (step_->start(t, y, aim_.span(t))) {
    case Outcome::ok: return true;
    case Outcome::stop: return end(State::interrupted);
    case Outcome::not_finite: break;
  }
  report_.component = step_->undefined_component();
  report_.linear = step_->linear_work();
  return end(State::start_undefined);
}

/// Are the invariants conserved at the start?
bool Integration::start_rate(double t, const double* y) {
  if (!guard_ || !settings_.check || t == settings_.tf) return true;
  return refuse(guard_->start_rate(t, y, step_->slope(), forward_ * step_->h()));
}

bool Integration::watch_events(Outcome outcome) {
  if (outcome == Outcome::ok) return true;
  if (outcome == Outcome::stop) return end(State::interrupted);
  report_.event = events_.undefined().event;
  report_.t = events_.undefined().t;
  return end(State::event_undefined);
}

bool Integration::nothing_to_integrate() {
  const double* y = interpolant_->start_y();
  left_ = true;
  reached_.t = settings_.tf;
  if (!settings_.save_all) points.clear();
  if (!settings_.save_all || !settings_.output_at_times) points.add(settings_.tf, y, n_);
  for (; next_time_ < settings_.times.size(); ++next_time_) points.add(settings_.times[next_time_], y, n_);
  return end(State::reached_end);
}

// ------------------------------------------------------------------------------------------------------------- a step

State Integration::run() {
  while (advance() == State::running) {
  }
  return state_;
}

State Integration::advance() {
  if (state_ != State::running) return state_;
  if (!std::exchange(in_step_, false) && !begin_step()) return state_;
  for (;;) {
    if (!std::isfinite(aim_.t1())) {
      if (explain_failure(Cause::not_finite)) end(State::step_failed);
      return state_;
    }
    switch (attempt()) {
      case Verdict::ended: return state_;
      case Verdict::accepted: return finish_step();
      case Verdict::rejected: break;
    }
    if (out_of_time()) {
      in_step_ = true;
      reach(Limit::time);
      return state_;
    }
  }
}

bool Integration::begin_step() {
  if (bounded_slope_ && !meet_bounds()) return false;
  const double t = step_->t();
  if (step_->hand_over(aim_.span(t)) == Outcome::stop) return end(State::interrupted);
  interpolant_->start_at(t, step_->y());
  attempt_ = {};
  aim_.begin(t, step_->h());
  return true;
}

/// Where components come to rest at bounds, or leave them, f is another function from here on: the method starts anew.
bool Integration::meet_bounds() {
  bool changed = false;
  if (bounded_slope_->begin_step(step_->t(), step_->y(), changed) == Status::stop) return end(State::interrupted);
  if (!changed) return true;
  const std::vector<double> y(step_->y(), step_->y() + n_);
  return start_memory(step_->t(), y.data());
}

Integration::Verdict Integration::attempt() {
  const Step::Attempt proposal = step_->attempt(aim_.h(), aim_.t1());
  if (proposal.outcome == Outcome::stop) return ended(State::interrupted);
  attempt_.error = proposal.error;
  if (!proposal.converged) return reject(Cause::newton);
  if (proposal.outcome == Outcome::not_finite || !std::isfinite(proposal.error)) return reject(Cause::not_finite);
  if (!(proposal.error <= weights_.rtol())) return reject(Cause::error);

  const double* y1 = proposal.y;
  if (bounds_)
    if (const Verdict verdict = stay_within_bounds(y1); verdict != Verdict::accepted) return verdict;
  if (projector_ && (!off_bounds_only_ || outside_.off_bounds)) {
    if (const Verdict verdict = project(proposal.y); verdict != Verdict::accepted) return verdict;
    y1 = y1_.data();
  }
  switch (step_->accept(y1)) {
    case Outcome::stop: return ended(State::interrupted);
    case Outcome::not_finite: return reject(Cause::not_finite);
    case Outcome::ok: break;
  }
  return Verdict::accepted;
}

/// A candidate that is outside of the bounds by more than the tolerance fails the attempt, any other is moved onto
/// them.
Integration::Verdict Integration::stay_within_bounds(const double*& y1) {
  const Bounds::Excess outside = bounds_->excess(y1, weights_);
  outside_ = {.off_bounds = outside.component >= 0, .component = outside.component};
  step_->moved_onto_bounds(outside_.off_bounds);
  projected_ = {};
  projected_.skipped = true;  // until it is projected
  if (!outside_.off_bounds) return Verdict::accepted;
  if (outside.size > weights_.rtol()) return reject(Cause::bounds);
  std::copy(y1, y1 + n_, y1_.begin());
  outside_.clipped = bounds_->clip(y1_.data());
  y1 = y1_.data();
  return Verdict::accepted;
}

/// y₁ from the candidate y*. A correction that is too large fails the attempt.
Integration::Verdict Integration::project(const double* candidate) {
  std::copy(candidate, candidate + n_, y1_.begin());
  if (!directions_.empty()) tell_directions();
  const double *from = interpolant_->start_y(), t1 = aim_.t1();
  projected_ = one_sided_    ? one_sided_->project(t1, from, y1_.data())
               : active_set_ ? active_set_->project(t1, from, y1_.data())
                             : projector_->project(t1, from, y1_.data());
  ++(projected_.skipped ? counts_.skipped : counts_.projections);
  if (projected_.outcome == Outcome::stop) return ended(State::interrupted);
  const bool defined = projected_.outcome == Outcome::ok;
  attempt_.correction = defined ? projected_.correction : std::numeric_limits<double>::infinity();
  const bool large = attempt_.correction > largest_correction * weights_.rtol();
  if (large && (!defined || !(attempt_.correction <= roundoff_of_correction()))) return oversized(candidate);
  if (settings_.check && !at_bounds())
    harm_->note(*step_, counts_.steps, candidate, y1_.data(), projector_->linearization().weights.data());
  return Verdict::accepted;
}

/// What the step is made of.
void Integration::tell_directions() {
  const std::size_t count = step_->directions(directions_.data());
  projector_->seek_along({directions_.data(), count});
}

/// What roundoff in g does to a correction.
double Integration::roundoff_of_correction() const {
  const Linearization at = projector_->linearization();
  double largest = 0;
  for (std::size_t i = 0; i < at.m(); ++i)
    if (at.row_norm[i] > 0)
      largest = std::max(largest, invariants_->roundoff(i, at.y.data(), at.jacobian.data()) / at.row_norm[i]);
  return largest;
}

/// A correction of a right invariant falls fast with h. Where two halvings in a row do not bring it down, the invariant
/// is looked at.
Integration::Verdict Integration::oversized(const double* candidate) {
  const double before = attempt_.refused[0];
  attempt_.refused[0] = attempt_.refused[1];
  attempt_.refused[1] = attempt_.correction;
  const bool falls = attempt_.correction < before / expected_decrease;
  if (++attempt_.refusals >= patience && settings_.check && !falls && !at_breakpoint() &&
      !refuse(guard_->confirm(aim_.t1(), candidate, aim_.h())))
    return Verdict::ended;
  return reject(Cause::projection);
}

Integration::Verdict Integration::reject(Cause cause) {
  ++counts_.failed;
  discontinuities_.failed(cause, aim_.t1(), aim_.h());
  if (!step_->reject(cause, aim_.hmin())) {
    if ((cause == Cause::error || cause == Cause::newton) && reconcile()) return Verdict::rejected;
    if (state_ == State::running && settle_at_bounds()) return Verdict::rejected;
    return ended(state_ == State::running && explain_failure(cause) ? State::step_failed : state_);
  }
  aim_.retry(interpolant_->start_t(), step_->h());
  return Verdict::rejected;
}

/// An attempt that fails however small h is may not be what is wrong: Newton's iteration, with an old Jacobian of an f
/// that is very nonlinear, has left the start of the step off the algebraic equations. Moves it onto them, once, and
/// starts the method again there. False: it was not that, or the run has ended.
bool Integration::reconcile() {
  const double t = interpolant_->start_t(), *old = interpolant_->start_y();
  if (!breaks_.consistent || projector_ || attempt_.reconciled) return false;
  std::vector<double> y(old, old + n_);
  const Consistency verdict = breaks_.consistent(t, y.data());
  if (verdict == Consistency::stop) return end(State::interrupted);
  if (verdict != Consistency::corrected || !start_step_anew(y.data())) return false;
  return attempt_.reconciled = true;
}

/// Attempts that fail however small h is may end at a bound where f has no derivative, as √y at 0. Moves components
/// that f has led there, but for roundoff, onto it, and starts the method again. False: there were none, or the run has
/// ended.
bool Integration::settle_at_bounds() {
  if (!bounds_) return false;
  const double* old = interpolant_->start_y();
  std::vector<double> y(old, old + n_);
  if (!bounds_->settle(weights_, forward_, step_->slope(), y.data())) return false;
  return start_step_anew(y.data());
}

/// From y, beside the start of the step.
bool Integration::start_step_anew(const double* y) {
  reached_ = {interpolant_->start_t(), interpolant_->start_y()};
  leave_step(y);
  return start_memory(reached_.t, reached_.y) && watch_events(events_.restart(reached_.t, reached_.y)) && begin_step();
}

/// False: a user function has stopped the run, and that is why it ends.
bool Integration::explain_failure(Cause cause) {
  report_.t = interpolant_->start_t();
  report_.h = aim_.h();
  report_.cause = cause;
  report_.linear = step_->linear_work();
  if (cause == Cause::not_finite || cause == Cause::newton) report_.component = step_->undefined_component();
  if (cause == Cause::projection && projected_.outcome == Outcome::not_finite && projector_->undefined() >= 0)
    report_.finding = {.kind = Finding::Kind::undefined, .invariant = projector_->undefined(), .t = aim_.t1()};
  if (cause == Cause::bounds) report_.component = outside_.component;
  if ((cause != Cause::error && cause != Cause::newton) || undefined_function(report_.linear.unsolved)) return true;
  if (discontinuities_.gave_up(report_.t, interpolant_->start_y(), step_->slope(), aim_.t1(), aim_.target()) ==
      Status::stop)
    return end(State::interrupted);
  if (cause != Cause::error) return true;
  for (std::size_t i = 0; i < n_ && !report_.pure_relative; ++i)
    if (weights_.pure_relative(i) && interpolant_->start_y()[i] == 0) {
      report_.pure_relative = true;
      report_.component = static_cast<int>(i);
    }
  return true;
}

// ------------------------------------------------------------------------------------------------- after the
// commitment

/// Are the invariants conserved, what happened in the step, what is to be kept, does the run go on?
State Integration::finish_step() {
  reached_ = {interpolant_->start_t(), interpolant_->start_y()};  // until guard and events have passed the step
  note_drift();
  if (!judge_invariants()) return state_;
  if (one_sided_) one_sided_->commit();
  const double t0 = interpolant_->start_t(), *y0 = interpolant_->start_y();
  const std::int64_t attempts = ++counts_.steps + counts_.failed;
  if (stiffness_.note(*step_, counts_.steps, t0, y0) &&
      discontinuities_.watch_pace(step_->t(), step_->y(), step_->slope(), aim_.target(), StiffnessDetector::every,
                                  attempts) == Status::stop) {
    end(State::interrupted);
    return state_;
  }
  if (discontinuities_.accepted(t0, y0, step_->t(), step_->y(), attempts) == Status::stop) {
    end(State::interrupted);
    return state_;
  }
  interpolant_->accept();
  if (find_events() && record() && emit(settings_.output_at_times && jumps_here()) && conclude() &&
      counts_.steps >= next_look_)
    goes_on();
  return state_;
}

void Integration::note_drift() {
  for (std::size_t i = 0; i < projected_.residual.size(); ++i) {
    drift.residual[i] = std::max(drift.residual[i], std::abs(projected_.residual[i]));
    drift.distance[i] = std::max(drift.distance[i], projected_.distance[i] / weights_.rtol());
  }
  drift.correction = std::max(drift.correction, attempt_.correction / weights_.rtol());
  if (!bounds_) return;
  clipped += outside_.clipped;
  counts_.clipped += outside_.off_bounds ? 1 : 0;
}

bool Integration::judge_invariants() {
  if (!guard_ || !settings_.check || projected_.skipped) return true;
  if (one_sided_ && one_sided_->engaged() && !judge_start_of_step()) return false;
  if (at_breakpoint()) return true;
  const double h = aim_.h(), t1 = aim_.t1();
  const std::int64_t step = counts_.steps + 1;
  return refuse(guard_->rate(projector_->linearization(), t1, step_->slope(), h, step)) &&
         (at_bounds() || refuse(guard_->corrected(attempt_.correction, t1, step_->y(), h, step)));
}

/// What rises over a step rises at one of its ends, unless its rate changes sign twice within.
bool Integration::judge_start_of_step() {
  const double t = interpolant_->start_t();
  if (next_break_ > 0 && here(breaks_.points[next_break_ - 1].t, t)) return true;  // no room for differences there
  return refuse(guard_->violated(t, interpolant_->start_y(), aim_.h(), counts_.steps + 1));
}

/// Finds the events of the step and keeps them with their states. The last one may cut the step: that is then the point
/// reached.
bool Integration::find_events() {
  const double t0 = interpolant_->start_t(), t1 = aim_.t1();
  const double* y1 = step_->y();
  if (!events_.empty()) {
    if (!watch_events(events_.search(t0, t1, y1, step_->degree(), *interpolant_))) return false;
    for (const Occurrence& occurrence : events_.occurrences()) {
      if (occurrence.t == t1)
        std::copy(y1, y1 + n_, event_y_.begin());
      else if (interpolant_->value(occurrence.t, event_y_.data()) == Status::stop)
        return end(State::interrupted);
      occurrences[occurrence.event].add(occurrence.t, event_y_.data(), n_);
      next_look_ = 0;
    }
  }
  const bool cut = events_.terminal() || events_.acts();
  reached_ = cut && events_.occurrences().back().t != t1 ? Point{events_.occurrences().back().t, event_y_.data()}
                                                         : Point{t1, y1};
  return true;
}

/// Keeps the step itself: its row, and its part of the continuous solution.
bool Integration::record() {
  const auto& [t, y] = reached_;
  if (settings_.save_all && settings_.record)
    steps.push_back({.t = t,
                     .h = t - interpolant_->start_t(),
                     .order = static_cast<double>(step_->order()),
                     .error = attempt_.error / weights_.rtol(),
                     .correction = attempt_.correction / weights_.rtol(),
                     .member = static_cast<double>(step_->member())});
  if (!dense) return true;
  const Segment segment = interpolant_->segment();
  if (!segment.data) return end(State::interrupted);
  dense->add(segment, t, y);
  return true;
}

/// Does the solution jump at the end of the step?
bool Integration::jumps_here() const { return !events_.terminal() && (events_.acts() || breaks_here()); }

/// Puts out what the step up to the point reached, or the start, contributes. `jumps_here`: the solution jumps there.
bool Integration::emit(bool jumps_here) {
  const auto& [t, y] = reached_;
  if (!settings_.save_all) {
    points.clear();
    points.add(t, y, n_);
    return true;
  }
  if (settings_.output_at_times) return emit_times(jumps_here);
  const double t0 = interpolant_->start_t(), t1 = aim_.t1();
  for (int j = 1; j < settings_.refine && t != t0; ++j) {
    const double at = t0 + (t1 - t0) * (static_cast<double>(j) / settings_.refine);
    if (forward_ * at >= forward_ * t) break;
    if (!emit_inside(at)) return false;
  }
  points.add(t, y, n_);
  return true;
}

bool Integration::emit_times(bool jumps_here) {
  const auto& [t, y] = reached_;
  for (; next_time_ < settings_.times.size(); ++next_time_) {
    const double at = settings_.times[next_time_];
    if (forward_ * at > forward_ * t || (at == t && jumps_here)) break;  // the value after the jump is put out
    if (at == t)
      points.add(at, y, n_);
    else if (!emit_inside(at))
      return false;
  }
  return true;
}

/// A value that was left to come after a jump, and the jump does not come.
bool Integration::emit_before_end() { return !settings_.save_all || !settings_.output_at_times || emit_times(false); }

bool Integration::emit_inside(double t) {
  if (interpolant_->value(t, inside_y_.data()) == Status::stop) return end(State::interrupted);
  points.add(t, inside_y_.data(), n_);
  return true;
}

/// Asks the callback, takes the actions of events, and ends the run where it is to end.
bool Integration::conclude() {
  const auto [t, y] = reached_;
  double stop = 0;
  if (callback_ && callback_(t, y, &stop) == Status::stop) return end(State::interrupted);
  if (events_.terminal()) return end(State::terminal_event);
  if (stop != 0) return emit_before_end() && end(State::stopped_by_callback);
  if (keeps_last_ && !keep_step_left()) return false;
  if (events_.acts() && !jump()) return false;
  if (!aim_.lands()) return true;
  if (breaks_here() && !pass_breakpoint()) return false;
  return t != settings_.tf || end(State::reached_end);
}

/// The last step, which nobody can look into once the method has started again at its end.
bool Integration::keep_step_left() {
  left_step_.reset();
  if (!jumps_here()) return true;
  left_step_ = last_step();
  return left_step_.has_value();
}

/// What is known of the step that has ended does not hold at (reached t, y), where the solution goes on.
void Integration::leave_step(const double* y) {
  if (y != interpolant_->start_y()) interpolant_->start_at(reached_.t, y);
  interpolant_->restart();
  left_ = true;
  if (projector_) projector_->forget();
  report_.t = reached_.t;
  reached_.y = interpolant_->start_y();
}

/// Takes the actions of the events at the point reached, where the step was cut, and starts again from what they
/// return, put back onto constraints of velocities.
bool Integration::jump() {
  leave_step(event_y_.data());
  bool rehold = true;
  return take_actions(rehold) && go_on_from_jump(rehold);
}

/// `rehold`: every event that acts asks for it.
bool Integration::take_actions(bool& rehold) {
  for (const Occurrence& occurrence : events_.occurrences()) {
    EventFunction& function = events_.function(occurrence.event);
    if (occurrence.t != reached_.t || !function.action) continue;
    rehold = rehold && function.rehold;
    report_.event = occurrence.event;
    if (!take(function.action)) return false;
  }
  return true;
}

/// The solution after the jump into the start of the next step.
bool Integration::take(Callback& action) {
  double* y = interpolant_->start_y();
  std::copy(y, y + n_, inside_y_.begin());
  if (action(reached_.t, inside_y_.data(), y) == Status::stop) return end(State::interrupted);
  return all_finite(y, n_) || end(State::action_undefined);
}

/// Holds the invariants at the start of the next step, where the solution has jumped to, and starts again.
bool Integration::go_on_from_jump(bool rehold) {
  const double t = reached_.t;
  double* y = interpolant_->start_y();
  if (!start_within_bounds()) return end(State::action_out_of_bounds);
  if (invariants_) {
    if (rehold && restoration_ && restoration_->restore(t, y) == Status::stop) return end(State::interrupted);
    if (rehold && invariants_->hold(t, y) == Status::stop) return end(State::interrupted);
    if (!refuse(guard_->start_value(t, y))) return false;
    if (one_sided_ && one_sided_->go_on(t, y) == Status::stop) return end(State::interrupted);
  }
  if (dense) dense->start(t, y);
  jumps.push_back(
      {settings_.save_all ? points.t.size() : 0, t, invariants_ ? invariants_->value() : std::vector<double>{}});
  if (t != settings_.tf && !start_memory(t, y)) return false;
  if (!watch_events(events_.restart(t, y))) return false;
  return emit(breaks_here());
}

// -------------------------------------------------------------------------------------------------------- breakpoints

/// `count` more have been passed.
void Integration::pass_breakpoints(std::size_t count) {
  next_break_ += count;
  const bool none = next_break_ == breaks_.points.size();
  break_t_ = none ? std::numeric_limits<double>::quiet_NaN() : breaks_.points[next_break_].t;
}

/// Breakpoints that no step fits between are one, at the first of their times.
bool Integration::here(double breakpoint, double t) { return std::abs(breakpoint - t) < hmin_ulps * ulp(t); }

/// The first breakpoint after the point reached.
std::size_t Integration::next_piece() const {
  std::size_t next = next_break_;
  while (next < breaks_.points.size() && here(breaks_.points[next].t, reached_.t)) ++next;
  return next;
}

/// A piece begins at the point reached; functions see it from beyond the last breakpoint there.
void Integration::begin_piece() {
  const std::size_t next = next_piece();
  piece_from_break_ = next > 0 && here(breaks_.points[next - 1].t, reached_.t);
  piece_start_ = piece_from_break_ ? breaks_.points[next - 1].t : reached_.t;
  enter_piece();
}

/// Steps go to the next breakpoint from now on, and functions see the piece up to there.
void Integration::enter_piece() {
  const std::size_t next = next_piece();
  const bool breaks = next < breaks_.points.size();
  aim_.at(breaks ? breaks_.points[next].t : settings_.tf);
  if (breaks_.piece) breaks_.piece->enter(piece_start_, piece_from_break_, aim_.target(), breaks);
}

/// Starts again at the point reached, in the next piece, from what the actions return.
bool Integration::pass_breakpoint() {
  leave_step(reached_.y);
  begin_piece();
  bool acts = false, moved = false;
  for (; breaks_here(); pass_breakpoints(1)) {
    Breakpoint& point = breaks_.points[next_break_];
    if (!point.action) continue;
    acts = true;
    report_.event = events_.count() + next_break_;
    if (!take(point.action)) return false;
  }
  if (!make_consistent(moved)) return false;
  if (acts || moved) return go_on_from_jump(acts);
  if (reached_.t != settings_.tf && !start_memory(reached_.t, reached_.y)) return false;
  return !settings_.output_at_times || emit_times(false);
}

/// Algebraic variables jump where their equations do.
bool Integration::make_consistent(bool& moved) {
  if (!breaks_.consistent) return true;
  switch (breaks_.consistent(reached_.t, interpolant_->start_y())) {
    case Consistency::corrected: moved = true; return true;
    case Consistency::stop: return end(State::interrupted);
    case Consistency::not_found:
    case Consistency::index_too_high: return end(State::restart_inconsistent);
    case Consistency::consistent:
    case Consistency::undefined: break;  // the restart says so
  }
  return true;
}

std::optional<DenseOutput> Integration::last_step() {
  if (left_step_) return left_step_->from(0);
  const Segment segment = interpolant_->segment();
  if (!segment.data) {
    end(State::interrupted);
    return {};
  }
  const std::size_t m = output_projector_ ? output_projector_->invariants().m() : 0;
  DenseOutput one(n_, m, settings_.interpolation, step_->interpolate(),
                  bounds_ ? std::optional(*bounds_) : std::nullopt);
  one.start(interpolant_->start_t(), interpolant_->start_y());
  one.add(segment, reached_.t, reached_.y);
  return one;
}

}  // namespace invariode
