#include "integrate.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>

#include "number.hpp"
#include "output/polynomial.hpp"

namespace invariode {
namespace {

constexpr double expected_decrease = 3;  // of the correction by two halvings of h
constexpr int most_refusals = 3;         // of corrections in a step before the invariant is tested
// An attempt that uses its own values is repeated until they change by this much of the tolerance, at most so often,
// and as long as each change is that much smaller than the one before (measured: 1.5 to 2.5 attempts in a step).
constexpr double agreement = 0.03;
constexpr int most_repetitions = 12;
constexpr double slowest_agreement = 0.9;
constexpr int most_landings = 3;           // attempts in a step that are to end where the last one came to a bound
constexpr std::size_t most_marks = 10000;  // that are ahead at one time

}  // namespace

Integration::Integration(std::unique_ptr<Step> step, const Weights& weights, const ManifoldTerms& manifold,
                         LoopFunctions functions, Settings settings)
    : step_(std::move(step)),
      composite_(step_->composite()),
      delays_(functions.delays),
      delayed_(delays_ == nullptr ? nullptr : dynamic_cast<DelayInterface*>(step_.get())),
      history_jumps_(functions.history_jumps.begin(), functions.history_jumps.end()),
      most_level_(functions.most_level),
      weights_(weights),
      settings_(std::move(settings)),
      bounded_slope_(functions.bounded_slope),
      consistent_(functions.consistent),
      callback_(functions.callback),
      n_(step_->n()),
      forward_(settings_.tf >= settings_.t0 ? 1 : -1),
      aim_(forward_, settings_.hmax),
      manifold_(manifold, weights, settings_, *step_, !functions.events.empty() || !functions.breakpoints.empty()),
      initial_checks_(manifold_, weights, settings_),
      breaks_(std::move(functions.breakpoints), std::move(functions.landings), functions.piece, settings_.tf, forward_),
      limits_(settings_),
      stiffness_(weights),
      discontinuities_(functions.f, weights),
      below_zero_(functions.f, weights, forward_, std::move(functions.rate), !functions.signed_states),
      events_(std::move(functions.events), std::move(functions.vectors), n_, step_->max_degree()),
      interpolant_(*step_, weights.size(), settings_.interpolation, manifold_.output_projector(),
                   manifold_.output_tangent(), manifold_.projector(), manifold_.bounds()),
      emitter_(settings_, interpolant_, n_, events_.count(),
               settings_.dense ? std::optional(no_steps()) : std::nullopt),
      jumps_({events_, breaks_, manifold_, initial_checks_, emitter_.output.occurrences, delays_},
             std::move(functions.consistent), std::move(functions.consistent_tangent), functions.f,
             std::move(functions.jump_rate), weights.size(), n_),
      y0_(n_) {
  assert(settings_.hmax >= 0 && settings_.refine >= 1);
  looks_between_ = settings_.looks_between() || !events_.empty() || delays_ != nullptr;
  const double parts = functions.autonomous ? 0 : step_->parts_seen();
  gap_ = parts > 0 ? std::abs(settings_.tf - settings_.t0) / parts : std::numeric_limits<double>::infinity();
  if (!events_.empty()) event_y_.resize(n_);
}

Integration::Course Integration::end(State state) {
  state_ = state;
  return Course::ended;
}

Integration::Verdict Integration::end_attempt(State state) {
  state_ = state;
  return Verdict::ended;
}

Integration::Course Integration::refuse(const Finding& finding) {
  if (finding.kind == Finding::Kind::none) return Course::goes_on;
  if (finding.kind == Finding::Kind::stop) return end(State::interrupted);
  report_.finding = finding;
  return end(state_ == State::created ? State::invariant_refused : State::invariant_convicted);
}

Integration::Course Integration::pass(const InitialChecks::Result& check) {
  if (check.state == State::created) return Course::goes_on;
  report_.finding = check.finding;
  report_.component = check.component;
  return end(check.state);
}

// ---------------------------------------------------------------------------------------------------------- the start

State Integration::start(const double* y0) {
  limits_.begin(0);
  const double t = settings_.t0;
  move_start(t, y0);
  double* y = y0_.data();
  reached_ = {t, y};
  report_.t = t;
  breaks_.start(t);
  if (ended(pass(initial_checks_.inspect(y)))) return state_;
  if (jumps_.follow_equations(t, y) == State::interrupted) return state_ = State::interrupted;
  if (ended(unless_stopped(manifold_.start(t, y)))) return state_;
  below_zero_.start(y, lower_bounds());
  emitter_.begin(reached_);
  if (delays_ != nullptr && ended(begin_past(y))) return state_;
  const bool breaks = breaks_.at(t);
  if (breaks && ended(note_values())) return state_;
  begin_piece();
  if (ended(emit(breaks)) || ended(start_memory(t, y))) return state_;
  if (settings_.first_step > 0) step_->set_h(settings_.first_step);
  if (ended(pass(initial_checks_.inspect_rates(y, step_->slope(), forward_ * step_->h())))) return state_;
  if (ended(watch_events(events_.start(t, y)))) return state_;
  if (breaks && ended(land({.acts = false, .breaks = true, .noted = true}))) return state_;
  if (t == settings_.tf || n_ == 0)
    nothing_to_integrate();
  else
    state_ = State::running;
  return state_;
}

/// The step in work starts at (t, y) from now on.
void Integration::move_start(double t, const double* y) {
  assert(std::isfinite(t));
  t0_ = t;
  std::copy(y, y + n_, y0_.begin());
}

/// Builds the method's memory at (t, y), at the start and after a jump.
Integration::Course Integration::start_memory(double t, const double* y) {
  memory_outdated_ = false;
  if (delays_ != nullptr) delays_->restart();
  discontinuities_.restart();
  aim_.start();
  std::vector<double> at_rest;  // without what iterations have left in the sensitivities of components that rested
  if (bounded_slope_ != nullptr && has_sensitivities() && !bounded_slope_->held().empty()) {
    at_rest.assign(y, y + n_);
    forget_at_bounds(*manifold_.bounds(), bounded_slope_->held(), at_rest);
    y = at_rest.data();
  }
  if (bounded_slope_ != nullptr) bounded_slope_->start_at(y);
  switch (step_->start(t, y, aim_.span(t))) {
    case Outcome::ok: return settings_.first_step > 0 || t == settings_.tf ? Course::goes_on : resolve_first_step(t, y);
    case Outcome::stop: return end(State::interrupted);
    case Outcome::not_finite: break;
  }
  report_.component = step_->undefined_component();
  report_.coefficient = step_->undefined_coefficient();
  report_.linear = step_->linear_work();
  return end(State::start_undefined);
}

/// A first step shorter than the spacing of t becomes as long as that, unless f changes within it: nothing that a
/// method could see would then be what f is beside the start.
Integration::Course Integration::resolve_first_step(double t, const double* y) {
  const double h = step_->h(), spacing = ulp(t);
  if (h >= spacing) return Course::goes_on;
  bool changes = false;
  if (ended(unless_stopped(discontinuities_.changes_at_once(t, y, step_->slope(), forward_, 1, changes))))
    return Course::ended;
  if (!changes) {
    step_->set_h(spacing);
    return Course::goes_on;
  }
  report_.t = t;
  report_.h = h;
  report_.cause = Cause::spacing;
  note_pure_relative();
  return end(State::step_failed);
}

Integration::Course Integration::watch_events(Outcome outcome) {
  if (outcome == Outcome::ok) return Course::goes_on;
  if (outcome == Outcome::stop) return end(State::interrupted);
  report_.event = events_.undefined().event;
  report_.t = events_.undefined().t;
  return end(State::event_undefined);
}

void Integration::nothing_to_integrate() {
  memory_outdated_ = true;
  reached_.t = settings_.tf;
  emitter_.constant(y0_.data());
  state_ = State::reached_end;
}

// ------------------------------------------------------------------------------------------------------------- a step
// The functions of every step are compiled into `advance`: in short steps of small systems calls of them would count.

State Integration::run() {
  while (advance() == State::running) {
  }
  return state_;
}

State Integration::advance() {
  if (state_ != State::running) return state_;
  if (!std::exchange(in_step_, false) && ended(begin_step())) return state_;
  for (;;) {
    if (!std::isfinite(aim_.t1())) {
      if (!ended(explain_failure(Cause::not_finite))) state_ = State::step_failed;
      return state_;
    }
    switch (attempt_or_give_up()) {
      case Verdict::ended: return state_;
      case Verdict::accepted: return finish_step();
      case Verdict::rejected: break;
    }
    if (limits_.out_of_time()) {
      in_step_ = true;
      reach(Limit::time);
      return state_;
    }
  }
}

/// Makes an attempt, unless long linear algebra within its proposal finds that the run is to end. Nothing has been
/// decided by then: if the run continues, the attempt is repeated.
INVARIODE_EACH Integration::Verdict Integration::attempt_or_give_up() {
  try {
    return attempt();
  } catch (const Interruption&) {
    proposing_ = false;
    in_step_ = state_ == State::running;
    if (in_step_) look_at_limits();
    return Verdict::ended;
  }
}

void Integration::poll() {
  if (!proposing_) return;
  if (watch_ && !watch_())
    state_ = State::interrupted;
  else if (!limits_.requested() && !limits_.out_of_time())
    return;
  throw Interruption();
}

INVARIODE_EACH Integration::Course Integration::begin_step() {
  if (bounded_slope_ != nullptr && ended(meet_bounds())) return Course::ended;
  const double t = step_->t();
  if (composite_ != nullptr && discontinuities_.sticks_since()) composite_->stay_explicit();
  if (composite_ != nullptr && composite_->hand_over(aim_.span(t)) == Outcome::stop) return end(State::interrupted);
  move_start(t, step_->y());
  if (delays_ != nullptr) delays_->begin_step(t, step_->y(), step_->slope(), delayed_->stages_on_extension());
  attempt_ = {};
  aim_.begin(t, step_->h());
  return Course::goes_on;
}

/// Restarts the method if components come to rest at bounds or leave them: f is another function from here on.
Integration::Course Integration::meet_bounds() {
  bool changed = false;
  if (ended(unless_stopped(bounded_slope_->begin_step(step_->t(), step_->y(), changed)))) return Course::ended;
  if (!changed) return Course::goes_on;
  const std::vector<double> y(step_->y(), step_->y() + n_);
  return start_memory(step_->t(), y.data());
}

INVARIODE_EACH Integration::Verdict Integration::attempt() {
  assert(aim_.defined());
  if (bounded_slope_ != nullptr) bounded_slope_->start_at(y0_.data());
  proposing_ = true;
  Step::Attempt proposal = propose();
  proposing_ = false;
  if (attempt_.disagrees) return reject(Cause::overlap);
  if (const Verdict verdict = test(proposal); verdict != Verdict::accepted) return verdict;
  const bool may_visit = bounded_slope_ != nullptr &&
                         bounded_slope_->may_visit(t0_, aim_.h(), weights_, y0_.data(), step_->slope(), proposal.y);
  if ((looks_between_ || may_visit) &&
      std::abs(aim_.h()) > aim_.hmin()) {  // in the shortest there is no time to be wrong
    proposal = step_->inspect_extension(proposal);
    if (const Verdict verdict = test(proposal); verdict != Verdict::accepted) return verdict;
  }
  if (std::abs(aim_.h()) > gap_) {
    proposal = step_->inspect_inside(proposal, gap_);
    if (const Verdict verdict = test(proposal); verdict != Verdict::accepted) return verdict;
  }
  if (const Verdict verdict = pass_jump(proposal.y); verdict != Verdict::accepted) return verdict;
  if (may_visit && ended(find_visit())) return Verdict::ended;

  StepEnds ends{t0_, aim_.t1(), aim_.h(), y0_.data(), proposal.y};
  if (manifold_.any())
    if (const Verdict verdict = place(ends); verdict != Verdict::accepted) return verdict;
  switch (step_->accept(ends.y1)) {
    case Outcome::stop: return end_attempt(State::interrupted);
    case Outcome::not_finite: return reject(Cause::not_finite);
    case Outcome::ok: break;
  }
  assert(step_->t() == aim_.t1());
  return Verdict::accepted;
}

/// Makes an attempt. One that depends on its own values, by delays shorter than h, is repeated until it agrees with
/// them.
INVARIODE_EACH Step::Attempt Integration::propose() {
  if (delays_ == nullptr) return step_->attempt(aim_.h(), aim_.t1());
  const auto sound = [](const Step::Attempt& one) {
    return one.outcome == Outcome::ok && one.converged && std::isfinite(one.error);
  };
  attempt_.disagrees = false;
  delays_->begin_attempt(aim_.t1() - t0_);
  Step::Attempt proposal = step_->attempt(aim_.h(), aim_.t1());
  double last_change = std::numeric_limits<double>::infinity();
  for (int repeated = 0; delays_->looked_ahead() && sound(proposal); ++repeated) {
    std::size_t size = 0;
    if (step_->extension_of_attempt(delays_->room(step_->max_extension_size()), size) == Status::stop)
      return {Outcome::stop, proposal.error, proposal.y};
    const double change = delays_->agree(size, proposal.y, weights_);
    if (change <= agreement * weights_.rtol()) break;
    attempt_.disagrees = repeated == most_repetitions || !(change < slowest_agreement * last_change);
    if (attempt_.disagrees) break;
    last_change = change;
    proposal = step_->attempt(aim_.h(), aim_.t1());
  }
  return proposal;
}

/// Tests the error of an attempt.
INVARIODE_EACH Integration::Verdict Integration::test(const Step::Attempt& proposal) {
  if (proposal.outcome == Outcome::stop) return end_attempt(State::interrupted);
  attempt_.error = proposal.error;
  if (!proposal.converged) return reject(Cause::newton);
  if (proposal.outcome == Outcome::not_finite || !std::isfinite(proposal.error)) return reject(Cause::not_finite);
  return proposal.error <= weights_.rtol() ? Verdict::accepted : reject(Cause::error);
}

/// Shortens a step over a jump of f whose error estimate is small by chance, up to the jump or to a length that does no
/// harm.
INVARIODE_EACH Integration::Verdict Integration::pass_jump(const double* candidate) {
  const Step::Trust trust = step_->trust();
  if (trust == Step::Trust::always) return Verdict::accepted;
  const double h = std::abs(aim_.h());
  double longest = h;
  if (ended(unless_stopped(discontinuities_.passes(t0_, y0_.data(), aim_.t1(), candidate, trust == Step::Trust::never,
                                                   counts_.steps + counts_.failed, longest))))
    return Verdict::ended;
  if (longest >= h || h <= aim_.hmin()) return Verdict::accepted;
  ++counts_.failed;
  discontinuities_.failed(Cause::error, aim_.t1(), aim_.h());
  if (!step_->reject(Cause::projection, aim_.hmin())) return Verdict::accepted;  // not the estimate: h is halved
  step_->set_h(std::max(longest, aim_.hmin()));
  aim_.retry(t0_, step_->h());
  return Verdict::rejected;
}

/// Takes y₁ from the candidate. The attempt fails if that is outside of the bounds, or its correction is too large.
Integration::Verdict Integration::place(StepEnds& ends) {
  const double* candidate = ends.y1;
  const Manifold::Placement placement = manifold_.place(*step_, ends, counts_.steps);
  counts_.projections += placement.projected ? 1 : 0;
  counts_.skipped += placement.skipped ? 1 : 0;
  switch (placement.placed) {
    case Manifold::Placed::outside: return land_on_bound();
    case Manifold::Placed::too_far: return oversized(candidate);
    case Manifold::Placed::undefined: return reject(Cause::not_finite);
    case Manifold::Placed::stop: return end_attempt(State::interrupted);
    case Manifold::Placed::accepted: break;
  }
  return Verdict::accepted;
}

/// Looks for a visit of a bound within the attempt, by its continuous extension.
Integration::Course Integration::find_visit() {
  extension_.resize(step_->max_extension_size());
  std::size_t size = 0;
  if (step_->extension_of_attempt(extension_.data(), size) == Status::stop) return end(State::interrupted);
  const auto values = [this, size](std::span<const double> theta, double* Y) {
    step_->interpolate()(extension_.data(), size, n_, theta, Y);
  };
  return unless_stopped(
      bounded_slope_->find_visit({.t0 = t0_,
                                  .h = aim_.h(),
                                  .size = n_,
                                  .parts = intervals_of_step(static_cast<std::size_t>(step_->degree())),
                                  .values = values},
                                 weights_, y0_.data(), attempt_.landing));
}

/// The next attempt ends where this one came to the bound. If several such attempts do not suffice, h is halved.
Integration::Verdict Integration::land_on_bound() {
  const double h = std::abs(aim_.h()), landing = std::exchange(attempt_.landing, 1);
  const bool shortest = h <= aim_.hmin();
  const Verdict verdict = reject(Cause::bounds);
  if (verdict != Verdict::rejected || shortest || !(landing < 1) || ++attempt_.landings > most_landings) return verdict;
  step_->set_h(std::max(landing * h, aim_.hmin()));
  aim_.retry(t0_, step_->h());
  return verdict;
}

/// A correction of a right invariant falls fast with h. If two halvings in a row do not bring it down, the invariant
/// is tested.
Integration::Verdict Integration::oversized(const double* candidate) {
  const double before = attempt_.refused[0];
  attempt_.refused[0] = attempt_.refused[1];
  attempt_.refused[1] = manifold_.correction();
  const bool falls = manifold_.correction() < before / expected_decrease;
  if (++attempt_.refusals >= most_refusals && settings_.check && !falls && !breaks_.at_end_of(aim_) &&
      ended(refuse(manifold_.guard()->confirm(aim_.t1(), candidate, aim_.h()))))
    return Verdict::ended;
  return reject(Cause::projection);
}

Integration::Verdict Integration::reject(Cause cause) {
  ++counts_.failed;
  discontinuities_.failed(cause, aim_.t1(), aim_.h());
  if (!step_->reject(cause, aim_.hmin())) {
    Cure cure = cause == Cause::error || cause == Cause::newton ? reconcile() : Cure::none;
    if (cure == Cure::none) cure = settle_at_bounds();
    if (cure == Cure::none && !ended(explain_failure(cause))) state_ = State::step_failed;
    return cure == Cure::cured ? Verdict::rejected : Verdict::ended;
  }
  aim_.retry(t0_, step_->h());
  return Verdict::rejected;
}

/// An attempt that fails however small h is may not be what is wrong: Newton's iteration, with an old Jacobian of an f
/// that is very nonlinear, has left the start of the step off the algebraic equations. Moves it onto them, once, and
/// starts the method again there.
Integration::Cure Integration::reconcile() {
  if (!consistent_ || manifold_.projector() != nullptr || attempt_.reconciled) return Cure::none;
  std::vector<double> y = y0_;
  const Consistency verdict = consistent_(t0_, y.data());
  if (verdict == Consistency::stop) state_ = State::interrupted;
  if (verdict != Consistency::corrected) return verdict == Consistency::stop ? Cure::ended : Cure::none;
  if (ended(start_step_anew(y.data()))) return Cure::ended;
  attempt_.reconciled = true;
  return Cure::cured;
}

/// Attempts that fail however small h is may end at a bound where f has no derivative, as √y at 0. Moves components
/// that f has led there, but for roundoff, onto it, where they do not depend on parameters, and starts the method
/// again.
Integration::Cure Integration::settle_at_bounds() {
  if (manifold_.bounds() == nullptr) return Cure::none;
  std::vector<double> y = y0_;
  if (!manifold_.bounds()->settle(weights_, forward_, step_->slope(), aim_.hmin(), y.data())) return Cure::none;
  if (rest_at_bounds(*manifold_.bounds(), y0_.data(), y) && jumps_.follow_equations(t0_, y.data()) != State::running) {
    state_ = State::interrupted;
    return Cure::ended;
  }
  ++counts_.clipped;
  return ended(start_step_anew(y.data())) ? Cure::ended : Cure::cured;
}

/// Restarts the step from y, beside its start.
Integration::Course Integration::start_step_anew(const double* y) {
  reached_ = {t0_, y0_.data()};
  discard_step(y);
  if (ended(start_memory(reached_.t, reached_.y)) || ended(watch_events(events_.restart(reached_.t, reached_.y))))
    return Course::ended;
  return begin_step();
}

// ------------------------------------------------------------------------------------------------- an accepted step

/// Tests the invariants, handles the events of the step, stores its output, and decides whether the run continues.
INVARIODE_EACH State Integration::finish_step() {
  reached_ = {t0_, y0_.data()};  // until guard and events have passed the step
  if (manifold_.any() && ended(judge_invariants())) return state_;
  ++counts_.steps;
  if (ended(find_discontinuities())) return state_;
  interpolant_.accept(t0_, y0_.data());
  if (ended(find_events()) || ended(find_arrived()) || ended(record()) ||
      ended(emit(settings_.output_at_times && jumps_here())) || ended(conclude()))
    return state_;
  if (limits_.due(counts_.steps)) look_at_limits();
  return state_;
}

Integration::Course Integration::judge_invariants() {
  counts_.clipped += manifold_.note(aim_.h()) ? 1 : 0;
  const StepEnds ends{t0_, aim_.t1(), aim_.h(), y0_.data(), step_->y()};
  const Finding finding =
      manifold_.judge(ends, *step_, counts_.steps + 1, breaks_.at_end_of(aim_), breaks_.just_passed(t0_));
  if (ended(refuse(finding))) return Course::ended;
  manifold_.commit();
  return Course::goes_on;
}

INVARIODE_EACH Integration::Course Integration::find_discontinuities() {
  const double t1 = step_->t(), *y1 = step_->y();
  if (stiffness_.note(*step_, counts_.steps, t0_, y0_.data())) {
    if (ended(unless_stopped(discontinuities_.watch_pace(t1, y1, step_->slope(), aim_.target(),
                                                         StiffnessDetector::every, counts_, stiffness_.limited()))))
      return Course::ended;
    if (discontinuities_.endless()) limits_.look_soon();
  }
  const std::int64_t attempts = counts_.steps + counts_.failed;
  if (ended(unless_stopped(discontinuities_.accepted(t0_, y0_.data(), t1, y1, attempts)))) return Course::ended;
  return unless_stopped(
      below_zero_.accepted({.t0 = t0_, .t1 = t1, .y0 = y0_.data(), .y1 = y1, .stride = 1, .attempts = attempts}));
}

/// Finds the events of the step and keeps them with their states. The last one may cut the step: that is then the point
/// reached.
INVARIODE_EACH Integration::Course Integration::find_events() {
  const double t1 = aim_.t1();
  const double* y1 = step_->y();
  if (!events_.empty()) {
    if (ended(watch_events(events_.search(t0_, t1, y1, step_->degree(), interpolant_)))) return Course::ended;
    for (const Occurrence& occurrence : events_.occurrences()) {
      if (occurrence.t == t1)
        std::copy(y1, y1 + n_, event_y_.begin());
      else if (ended(unless_stopped(interpolant_.value(occurrence.t, event_y_.data()))))
        return Course::ended;
      output().occurrences[occurrence.event].add(occurrence.t, event_y_.data(), n_);
      EventFunction& function = events_.function(occurrence.event);
      if (delays_ != nullptr && function.jump && !function.acts() &&
          ended(unless_stopped(jumps_.note_occurrence(function.jump, occurrence.t, event_y_.data()))))
        return Course::ended;
      limits_.look_soon();
    }
  }
  const bool cut = events_.terminal() || events_.acts();
  reached_ = cut && events_.occurrences().back().t != t1 ? Reached{events_.occurrences().back().t, event_y_.data()}
                                                         : Reached{t1, y1};
  return Course::goes_on;
}

/// Where a component comes to rest at a bound the slope of explicit methods jumps, and S: to 0, and those of algebraic
/// variables follow; differential ones do not. The step ends before the jump, as its memory and its continuous solution
/// have it; the point reached is after it, where the method starts again.
INVARIODE_EACH Integration::Course Integration::find_arrived() {
  arrived_.clear();
  if (bounded_slope_ == nullptr || reached_.t != aim_.t1()) return Course::goes_on;
  if (ended(unless_stopped(bounded_slope_->find_arrived(reached_.t, y0_, reached_.y, arrived_, memory_outdated_))))
    return Course::ended;
  if (!memory_outdated_ || !has_sensitivities()) return Course::goes_on;
  rested_.assign(reached_.y, reached_.y + n_);
  forget_at_bounds(*manifold_.bounds(), arrived_, rested_);
  if (jumps_.follow_equations(reached_.t, rested_.data()) != State::running) return end(State::interrupted);
  reached_.y = rested_.data();
  return Course::goes_on;
}

/// Keeps the step itself: its row, and its part of the continuous solution.
INVARIODE_EACH Integration::Course Integration::record() {
  if (emitter_.records())
    output().steps.push_back({.t = reached_.t,
                              .h = reached_.t - t0_,
                              .order = static_cast<double>(step_->order()),
                              .error = attempt_.error / weights_.rtol(),
                              .correction = manifold_.correction() / weights_.rtol(),
                              .member = static_cast<double>(composite_ != nullptr ? composite_->member() : 0)});
  if (delays_ != nullptr) {
    const Segment segment = interpolant_.segment();
    if (!segment.data) return end(State::interrupted);
    delays_->add(segment, reached_.t, reached_.y);
  }
  return unless_stopped(emitter_.add_segment(reached_));
}

/// Returns whether the solution jumps at the end of the step.
bool Integration::jumps_here() const { return !events_.terminal() && (events_.acts() || breaks_.at(reached_.t)); }

INVARIODE_EACH Integration::Course Integration::emit(bool jumps_here) {
  return unless_stopped(emitter_.emit(t0_, aim_.t1(), reached_, jumps_here));
}

/// Asks the callback, takes the actions of events, and ends the run where it is to end.
INVARIODE_EACH Integration::Course Integration::conclude() {
  const auto [t, y] = reached_;
  double stop = 0;
  if (callback_ && ended(unless_stopped(callback_(t, y, &stop)))) return Course::ended;
  if (events_.terminal()) return end(State::terminal_event);
  if (stop != 0)  // the jump does not come
    return ended(unless_stopped(emitter_.emit_times(reached_, false))) || ended(rest())
               ? Course::ended
               : end(State::stopped_by_callback);
  if (keeps_last_ && ended(keep_step_before_jump())) return Course::ended;
  const bool breaks = aim_.lands() && breaks_.at(t);
  const bool smooth = breaks && !events_.acts() && goes_smoothly_on(t);
  if (smooth && ended(pass_mark())) return Course::ended;
  if (!smooth && (events_.acts() || breaks) &&
      ended(land({.acts = events_.acts(), .breaks = breaks, .inside = t != aim_.t1()})))
    return Course::ended;
  if (aim_.lands() && t == settings_.tf) return end(State::reached_end);
  return rest();
}

/// Starts the method again where components have come to rest at bounds.
Integration::Course Integration::rest() {
  if (!memory_outdated_) return Course::goes_on;
  discard_step(reached_.y);
  return start_memory(reached_.t, reached_.y);
}

/// Ends the run if a stop was requested or a limit is reached.
void Integration::look_at_limits() {
  if (limits_.requested()) {
    report_.t = reached_.t;
    state_ = State::stopped_by_request;
    return;
  }
  if (const std::optional<Limit> limit = limits_.look(counts_.steps, emitter_))
    reach(*limit);
  else if (discontinuities_.endless() && !limits_.given())
    reach(Limit::sticking);
}

void Integration::reach(Limit limit) {
  report_.t = reached_.t;
  report_.h = step_->h();
  report_.limit = limit;
  report_.steps = limits_.counted(counts_.steps);
  report_.seconds = limits_.seconds();
  state_ = State::limit_reached;
}

// -------------------------------------------------------------------------------------------------------------- jumps

/// Keeps the last step, which nobody can look into once the method has started again at its end.
Integration::Course Integration::keep_step_before_jump() {
  last_one_.reset();
  if (!jumps_here() && !memory_outdated_) return Course::goes_on;
  last_one_ = last_step();
  return last_one_ ? Course::goes_on : Course::ended;
}

/// Discards the step that has ended: the solution continues at (reached t, y), where its data are not valid.
void Integration::discard_step(const double* y) {
  if (y != y0_.data()) move_start(reached_.t, y);
  interpolant_.restart();
  memory_outdated_ = true;
  manifold_.forget();
  report_.t = reached_.t;
  reached_.y = y0_.data();
}

/// Carries the solution over what happens at the point reached, and starts the method again behind it.
Integration::Course Integration::land(const Landing& at) {
  const double t = reached_.t;
  discard_step(reached_.y);
  left_ = y0_;
  double* Y = y0_.data();
  limits_.look_soon();
  const int level = breaks_.level(t);
  const std::vector<double> brought = at.breaks ? breaks_.rates(t) : std::vector<double>();
  if (delays_ != nullptr && has_sensitivities() && ended(unless_stopped(jumps_.note_past(t)))) return take_back();
  State state = at.acts ? jumps_.at_events(t, Y, at.inside) : State::running;
  bool jumps = at.acts, varies = false;
  if (at.breaks && state == State::running) {
    if (!at.noted && ended(note_values())) return take_back();
    varies = breaks_.landing_jump() && breaks_.at_landing(t);
    begin_piece();
    if (varies) state = jumps_.at_landing(t, Y);
    if (state == State::running) state = jumps_.at_breakpoints(t, Y, at.inside && !at.acts);
    jumps = jumps || jumps_.acted() || jumps_.moved();
    const bool moves = std::ranges::any_of(brought, [](double one) { return one != 0; });
    if (state == State::running && moves && ended(unless_stopped(jumps_.at_moving_mark(t, brought, Y))))
      return take_back();
    varies = varies || moves;
  }
  if (state == State::terminal_event) {
    begin_output();
    return ended(emit(false)) ? Course::ended : end(state);
  }
  if (state != State::running) {
    report_jump();
    state_ = state;
    return take_back();
  }
  if (delays_ != nullptr) {
    if (ended(mark_images(t, jumps ? 0 : level, jumps_.rates()))) return take_back();
    begin_piece();  // again, since it may end at one of them
  }
  if (jumps || (varies && !jumps_.others())) return go_on_from_jump();
  if (jumps_.others() && ended(hold_other_values())) return take_back();
  if (t != settings_.tf && ended(start_memory(t, Y))) return Course::ended;
  return unless_stopped(emitter_.emit_times(reached_, false));
}

void Integration::report_jump() {
  const Jumps::Remarks& remarks = jumps_.remarks();
  report_.event = remarks.event;
  report_.t = remarks.t.value_or(report_.t);
  report_.circle = remarks.circle;
  report_.finding = remarks.finding;
  report_.component = remarks.component;
}

/// Begins the past with the history and the marks that it brings.
Integration::Course Integration::begin_past(const double* y) {
  bool jumps = false;
  if (ended(unless_stopped(delays_->begin(no_steps(), y, jumps)))) return Course::ended;
  for (const double t : history_jumps_)
    if (ended(mark_images(t, 0))) return Course::ended;
  return mark_images(settings_.t0, jumps ? 0 : 1);
}

/// Adds the marks of a jump of a derivative of the solution at t: where it comes back by a delay, the next derivative
/// jumps. `rates`: ∂t/∂p of a jump of y, after which f jumps.
Integration::Course Integration::mark_images(double t, int level, std::span<const double> rates) {
  passed_marks_.insert(passed_marks_.end(), {t, static_cast<double>(level)});
  if (level >= most_level_ + (has_sensitivities() ? 1 : 0))
    return Course::goes_on;  // a derivative of S jumps one order earlier
  for (std::size_t j = 0; j < delays_->lags().size(); ++j) {
    const Mark mark = delays_->image(j, t, level, rates);
    if (mark.t >= settings_.t0 - mark.spacing) breaks_.add(mark);
  }
  if (breaks_.marks() <= most_marks) return Course::goes_on;
  report_.t = t;
  return end(State::marks_endless);
}

/// Returns whether the mark at t, where nothing else is, is of a derivative so high that the method can go on.
bool Integration::goes_smoothly_on(double t) const {
  if (delays_ == nullptr) return false;
  const Mark* mark = breaks_.only_mark(t);
  if (mark == nullptr || mark->level < (has_sensitivities() ? 3 : 2)) return false;
  return !delayed_->remembers_slopes() || mark->level > step_->order() + 1;
}

/// Continues through a mark: only the branch of the past changes.
Integration::Course Integration::pass_mark() {
  if (ended(mark_images(reached_.t, breaks_.level(reached_.t), jumps_.rates()))) return Course::ended;
  begin_piece();
  return unless_stopped(emitter_.emit_times(reached_, false));
}

/// Takes back the state that the actions return, from which the run cannot continue: it ends before them.
Integration::Course Integration::take_back() {
  std::copy(left_.begin(), left_.end(), y0_.begin());
  return Course::ended;
}

/// Starts again from where the solution has jumped to.
Integration::Course Integration::go_on_from_jump() {
  below_zero_.jump(y0_.data());
  begin_output();
  if (reached_.t != settings_.tf && ended(start_memory(reached_.t, y0_.data()))) return Course::ended;
  return emit(false);
}

/// Steps go to the next breakpoint from now on.
void Integration::begin_piece() {
  breaks_.begin_piece(reached_.t);
  aim_.at(breaks_.target());
}

/// Notes the values of the invariants before a breakpoint.
Integration::Course Integration::note_values() { return unless_stopped(manifold_.note_values(reached_.t, reached_.y)); }

/// Fixes the invariants, which jump though the solution does not, as the energy where a stiffness is switched, at their
/// values behind the breakpoint. Events continue.
Integration::Course Integration::hold_other_values() {
  Finding finding = manifold_.restart(reached_.t, y0_.data(), true, false);
  if (finding.kind == Finding::Kind::off_value) finding.kind = Finding::Kind::jumps_off;
  if (ended(refuse(finding))) return Course::ended;
  begin_output();
  return emit(true);
}

/// Continues the output from the start of the next step, with the values of the invariants there.
void Integration::begin_output() {
  emitter_.begin({reached_.t, y0_.data()});
  if (delays_ != nullptr) delays_->jump(reached_.t, y0_.data());
  const Invariants* invariants = manifold_.invariants();
  emitter_.jump(reached_.t, invariants != nullptr ? invariants->value() : std::vector<double>{});
}

// ---------------------------------------------------------------------------------------------------------- afterwards

DenseOutput Integration::no_steps() const {
  return {interpolant_.kind(), manifold_.bounds() != nullptr ? std::optional(*manifold_.bounds()) : std::nullopt};
}

std::optional<DenseOutput> Integration::last_step() {
  if (last_one_) return last_one_->from(0);
  const Segment segment = interpolant_.segment();
  if (!segment.data) {
    state_ = State::interrupted;
    return {};
  }
  DenseOutput one = no_steps();
  one.start(t0_, y0_.data());
  one.add(segment, reached_.t, reached_.y);
  return one;
}

std::size_t Integration::most_bytes_of_step() const {
  return (interpolant_.max_size() + DenseOutput::most_of_step(n_)) * sizeof(double);
}

}  // namespace invariode
