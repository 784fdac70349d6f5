#include "integrate.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

namespace invariode {
namespace {

constexpr double hmin_ulps = 16;  // hmin = 16 ulp(t) (docs/algorithms.md, 'Every method')
constexpr double stretch = 1.1;   // a step that comes this close to tf lands on it
constexpr double largest_correction =
    100;                                 // in units of rtol; right invariants stay below (docs/algorithms.md, 'Guard')
constexpr double expected_decrease = 3;  // of the correction by two halvings of h

}  // namespace

Integration::Integration(std::unique_ptr<Step> step, const Weights& weights, const Manifold& manifold,
                         std::vector<EventFunction> events, Callback callback, Settings settings)
    : step_(std::move(step)),
      weights_(weights),
      invariants_(manifold.steps),
      settings_(std::move(settings)),
      callback_(callback),
      n_(weights.size()),
      forward_(settings_.tf >= settings_.t0 ? 1 : -1),
      events_(std::move(events), n_, step_->max_degree()),
      interpolant_(*step_, settings_.interpolation, manifold.between,
                   manifold.between ? &between_.emplace(*manifold.between, weights, 1) : nullptr),
      y0_(n_),
      y1_(invariants_ ? n_ : 0),
      point_(events_.empty() ? 0 : n_),
      between_point_(settings_.output_at_times || settings_.refine > 1 || !events_.empty() ? n_ : 0) {
  occurrences.resize(events_.count());
  if (invariants_) {
    projector_.emplace(*invariants_, weights_, settings_.iterations, settings_.negligible);
    drift.residual.resize(invariants_->m());
    drift.distance.resize(invariants_->m());
    guard_.emplace(*invariants_, weights_, manifold.slope);
  }
  if (settings_.dense)
    dense.emplace(n_, manifold.between ? manifold.between->m() : 0, settings_.interpolation, step_->interpolate());
}

State Integration::end(State state) { return state_ = state; }

State Integration::refuse(const Finding& finding) {
  if (finding.kind == Finding::Kind::stop) return end(State::interrupted);
  report_.finding = finding;
  return end(state_ == State::created ? State::invariant_refused : State::invariant_convicted);
}

State Integration::start(const double* y0) {
  t0_ = report_.t = reached_t_ = settings_.t0;
  reached_y_ = y0_.data();
  std::copy(y0, y0 + n_, y0_.begin());
  if (inspect_start(y0_.data()) != State::created) return state_;
  if (dense) dense->start(t0_, y0_.data());
  if (emit(t0_, y0_.data()) != State::created) return state_;
  if (start_method(y0_.data()) != State::created) return state_;
  if (after(events_.start(t0_, y0_.data())) != State::created) return state_;
  if (t0_ != settings_.tf && n_ > 0) return state_ = State::running;
  return nothing_to_integrate();
}

State Integration::nothing_to_integrate() {
  reached_t_ = settings_.tf;
  if (!settings_.save_all) points.clear();
  if (!settings_.save_all || !settings_.output_at_times) points.add(settings_.tf, y0_.data(), n_);
  for (; next_time_ < settings_.times.size(); ++next_time_) points.add(settings_.times[next_time_], y0_.data(), n_);
  return end(State::reached_end);
}

State Integration::after(Events::Result result) {
  if (result == Events::Result::ok) return state_;
  if (result == Events::Result::stop) return end(State::interrupted);
  report_.event = events_.undefined().event;
  report_.t = events_.undefined().t;
  return end(State::event_undefined);
}

/// The invariants at y0, which may be projected.
State Integration::inspect_start(double* y0) {
  if (!guard_ || settings_.resumed) return state_;
  Finding finding = guard_->start_value(t0_, y0);
  if (finding.kind == Finding::Kind::none && settings_.check) finding = guard_->start_jacobian(t0_, y0);
  return finding.kind == Finding::Kind::none ? state_ : refuse(finding);
}

/// Builds the method's memory at (t0, y0), at the start and after a jump.
State Integration::start_memory(const double* y0) {
  switch (step_->start(t0_, y0, {settings_.tf, settings_.hmax, hmin_ulps * ulp(t0_)})) {
    case Outcome::stop: return end(State::interrupted);
    case Outcome::not_finite:
      report_.component = step_->undefined_component();
      report_.linear = step_->linear_work();
      return end(State::start_undefined);
    case Outcome::ok: break;
  }
  return state_;
}

/// Starts the method, and asks whether the invariants are conserved there.
State Integration::start_method(const double* y0) {
  if (start_memory(y0) != State::created) return state_;
  if (settings_.first_step > 0) step_->set_h(settings_.first_step);
  if (!guard_ || !settings_.check || settings_.resumed || t0_ == settings_.tf) return state_;
  const Finding finding = guard_->start_rate(t0_, y0, step_->slope(), forward_ * step_->h());
  return finding.kind == Finding::Kind::none ? state_ : refuse(finding);
}

State Integration::run() {
  while (advance() == State::running) {
  }
  return state_;
}

State Integration::advance() {
  if (state_ != State::running) return state_;
  begin_step();
  for (;;) {
    if (!std::isfinite(t1_)) {
      explain_failure(Cause::not_finite);
      return end(State::step_failed);
    }
    switch (attempt()) {
      case Verdict::ended: return state_;
      case Verdict::accepted: return finish_step();
      case Verdict::rejected: break;
    }
  }
}

/// |h| ≤ hmax but never below hmin, and a step that comes close to tf is stretched or cut to land on it exactly.
void Integration::begin_step() {
  t0_ = step_->t();
  std::copy(step_->y(), step_->y() + n_, y0_.begin());
  hmin_ = hmin_ulps * ulp(t0_);
  constexpr double huge = std::numeric_limits<double>::max() / 16;  // on an infinite interval nothing else bounds h
  const double size = std::max(hmin_, std::min({settings_.hmax, huge, step_->h()}));
  landing_ = stretch * size >= std::abs(settings_.tf - t0_);
  h_ = landing_ ? settings_.tf - t0_ : forward_ * size;
  t1_ = landing_ ? settings_.tf : t0_ + h_;
  correction_ = 0;
  oversized_count_ = 0;
}

Integration::Verdict Integration::attempt() {
  const Step::Attempt proposal = step_->attempt(h_, t1_);
  if (proposal.outcome == Outcome::stop) {
    end(State::interrupted);
    return Verdict::ended;
  }
  error_ = proposal.error;
  if (!proposal.converged) return reject(Cause::newton);
  if (proposal.outcome == Outcome::not_finite || !std::isfinite(error_)) return reject(Cause::not_finite);
  if (!(error_ <= weights_.rtol())) return reject(Cause::error);

  const double* y1 = proposal.y;
  if (projector_) {
    if (const Verdict verdict = project(proposal.y); verdict != Verdict::accepted) return verdict;
    y1 = y1_.data();
  }
  switch (step_->accept(y1)) {
    case Outcome::stop: end(State::interrupted); return Verdict::ended;
    case Outcome::not_finite: return reject(Cause::not_finite);
    case Outcome::ok: break;
  }
  return Verdict::accepted;
}

/// y₁ from the candidate y*. A correction that is too large fails the attempt.
Integration::Verdict Integration::project(const double* candidate) {
  std::copy(candidate, candidate + n_, y1_.begin());
  const Outcome outcome = projector_->project(t1_, y0_.data(), y1_.data());
  ++(projector_->skipped() ? counts_.skipped : counts_.projections);
  if (outcome == Outcome::stop) {
    end(State::interrupted);
    return Verdict::ended;
  }
  if (projector_->skipped()) {
    correction_ = 0;
    return Verdict::accepted;
  }
  correction_ = outcome == Outcome::ok ? projector_->correction() : std::numeric_limits<double>::infinity();
  if (!(correction_ > largest_correction * weights_.rtol())) return Verdict::accepted;
  if (outcome == Outcome::ok) {
    double roundoff = 0;
    for (std::size_t i = 0; i < invariants_->m(); ++i)
      if (projector_->row_norm(i) > 0)
        roundoff = std::max(
            roundoff, invariants_->roundoff(i, projector_->point(), projector_->jacobian()) / projector_->row_norm(i));
    if (correction_ <= roundoff) return Verdict::accepted;
  }
  return oversized(candidate);
}

/// A correction of a right invariant falls fast with h. Where two halvings in a row do not bring it down, the invariant
/// is looked at.
Integration::Verdict Integration::oversized(const double* candidate) {
  const double before = oversized_[0];
  oversized_[0] = oversized_[1];
  oversized_[1] = correction_;
  if (++oversized_count_ >= 3 && settings_.check && !(correction_ < before / expected_decrease)) {
    Finding finding = guard_->confirm(t1_, candidate, h_);
    if (finding.kind != Finding::Kind::none) {
      refuse(finding);
      return Verdict::ended;
    }
  }
  return reject(Cause::projection);
}

Integration::Verdict Integration::reject(Cause cause) {
  ++counts_.failed;
  if (!step_->reject(cause, hmin_)) {
    explain_failure(cause);
    end(State::step_failed);
    return Verdict::ended;
  }
  landing_ = landing_ && step_->h() >= std::abs(h_);
  h_ = landing_ ? h_ : forward_ * step_->h();
  t1_ = landing_ ? settings_.tf : t0_ + h_;
  return Verdict::rejected;
}

void Integration::explain_failure(Cause cause) {
  report_.t = t0_;
  report_.h = h_;
  report_.cause = cause;
  report_.linear = step_->linear_work();
  if (cause == Cause::not_finite || cause == Cause::newton) report_.component = step_->undefined_component();
  if (cause != Cause::error) return;
  for (std::size_t i = 0; i < n_ && !report_.pure_relative; ++i)
    if (weights_.pure_relative(i) && y0_[i] == 0) {
      report_.pure_relative = true;
      report_.component = static_cast<int>(i);
    }
}

/// After the commitment: is the invariant one, what happened in the step, what is to be kept?
State Integration::finish_step() {
  reached_y_ = y0_.data();  // until events and guard have passed the step
  if (projector_) {
    for (std::size_t i = 0; i < drift.residual.size(); ++i) {
      drift.residual[i] = std::max(drift.residual[i], std::abs(projector_->residual_before()[i]));
      drift.distance[i] = std::max(drift.distance[i], projector_->distance_before()[i] / weights_.rtol());
    }
    drift.correction = std::max(drift.correction, correction_ / weights_.rtol());
  }
  if (guard_ && settings_.check && !projector_->skipped()) {
    Finding finding = guard_->rate(*projector_, t1_, step_->slope(), h_, counts_.steps + 1);
    if (finding.kind == Finding::Kind::none)
      finding = guard_->corrected(correction_, t1_, step_->y(), h_, counts_.steps + 1);
    if (finding.kind != Finding::Kind::none) return refuse(finding);
  }
  ++counts_.steps;
  interpolant_.begin(t0_, y0_.data(), projector_ ? projector_->weights() : nullptr);
  double t = t1_;
  const double* y = step_->y();
  bool terminal = false, acts = false;
  if (!events_.empty()) {
    if (locate_events() != State::running) return state_;
    terminal = events_.terminal();
    acts = events_.acts();
    if ((terminal || acts) && events_.occurrences().back().t != t1_) {
      t = events_.occurrences().back().t;
      y = point_.data();
    }
  }
  reached_t_ = t;
  reached_y_ = y;
  if (settings_.save_all && settings_.record) {
    steps.push_back({.t = t,
                     .h = t - t0_,
                     .order = static_cast<double>(step_->order()),
                     .error = error_ / weights_.rtol(),
                     .correction = correction_ / weights_.rtol()});
  }
  if (dense) {
    const Segment segment = interpolant_.segment();
    if (!segment.data) return end(State::interrupted);
    dense->add(segment, t, y);
  }
  if (emit(t, y, acts) != State::running) return state_;
  bool stop = false;
  if (callback_) {
    double flag = 0;
    if (callback_(t, y, &flag) == Status::stop) return end(State::interrupted);
    stop = flag != 0;
  }
  if (terminal) return end(State::terminal_event);
  if (stop) return end(State::stopped_by_callback);
  if (acts && jump(t) != State::running) return state_;
  if (landing_ && t == settings_.tf) return end(State::reached_end);
  return state_;
}

std::optional<DenseOutput> Integration::last_step() {
  const Segment segment = interpolant_.segment();
  if (!segment.data) {
    end(State::interrupted);
    return {};
  }
  DenseOutput one(n_, between_ ? between_->invariants().m() : 0, settings_.interpolation, step_->interpolate());
  one.start(t0_, y0_.data());
  one.add(segment, reached_t_, reached_y_);
  return one;
}

/// Takes the actions of the events at t, where the step was cut, and starts again from what they return.
State Integration::jump(double t) {
  t0_ = report_.t = t;
  y0_ = point_;
  bool rehold = true;
  for (const Occurrence& occurrence : events_.occurrences()) {
    EventFunction& function = events_.function(occurrence.event);
    if (occurrence.t != t || !function.action) continue;
    rehold = rehold && function.rehold;
    std::copy(y0_.begin(), y0_.end(), between_point_.begin());
    if (function.action(t, between_point_.data(), y0_.data()) == Status::stop) return end(State::interrupted);
    if (!all_finite(y0_.data(), n_)) {
      report_.event = occurrence.event;
      return end(State::action_undefined);
    }
  }
  if (invariants_) {
    if (rehold && invariants_->hold(t, y0_.data()) == Status::stop) return end(State::interrupted);
    const Finding finding = guard_->start_value(t, y0_.data());
    if (finding.kind != Finding::Kind::none) return refuse(finding);
  }
  if (dense) dense->start(t, y0_.data());
  jumps.push_back(
      {settings_.save_all ? points.t.size() : 0, t, invariants_ ? invariants_->value() : std::vector<double>{}});
  interpolant_.restart();
  if (t != settings_.tf && start_memory(y0_.data()) != State::running) return state_;
  if (after(events_.restart(t, y0_.data())) != State::running) return state_;
  t1_ = t;
  reached_y_ = y0_.data();
  return emit(t, y0_.data());
}

/// Finds the events of the step and keeps them with their states; the last one's is left in `point_`.
State Integration::locate_events() {
  if (after(events_.search(t0_, t1_, step_->y(), step_->degree(), interpolant_)) != State::running) return state_;
  for (const Occurrence& occurrence : events_.occurrences()) {
    if (occurrence.t == t1_)
      std::copy(step_->y(), step_->y() + n_, point_.begin());
    else if (interpolant_.value(occurrence.t, point_.data()) == Status::stop)
      return end(State::interrupted);
    occurrences[occurrence.event].add(occurrence.t, point_.data(), n_);
  }
  return state_;
}

/// Puts out what the step from t0_ to (t, y), or the start, contributes.
State Integration::emit(double t, const double* y, bool jumps_there) {
  if (!settings_.save_all) {
    points.clear();
    points.add(t, y, n_);
    return state_;
  }
  const auto inside = [&](double at) {
    if (interpolant_.value(at, between_point_.data()) == Status::stop) return end(State::interrupted);
    points.add(at, between_point_.data(), n_);
    return state_;
  };
  if (settings_.output_at_times) {
    for (; next_time_ < settings_.times.size(); ++next_time_) {
      const double at = settings_.times[next_time_];
      if (forward_ * at > forward_ * t || (at == t && jumps_there)) break;  // after the jump
      if (at == t)
        points.add(at, y, n_);
      else if (inside(at) != State::running)
        return state_;
    }
    return state_;
  }
  for (int j = 1; j < settings_.refine && t != t0_; ++j) {
    const double at = t0_ + (t1_ - t0_) * (static_cast<double>(j) / settings_.refine);
    if (forward_ * at >= forward_ * t) break;
    if (inside(at) != State::running) return state_;
  }
  points.add(t, y, n_);
  return state_;
}

}  // namespace invariode
