// A run that goes on where it was interrupted: its memory as bytes, and the steps after it.

#include <algorithm>
#include <cmath>

#include "integrate.hpp"

namespace invariode {

bool Integration::between_steps() const {
  const bool ended_there = state_ == State::running || state_ == State::reached_end || state_ == State::limit_reached ||
                           state_ == State::stopped_by_request ||
                           (state_ == State::stopped_by_callback && !events_.acts());
  return ended_there && !memory_outdated_ && !breaks_.at(reached_.t) && reached_.t == step_->t();
}

void Integration::state(Archive& archive) {
  std::vector<double> y(n_);
  double target = aim_.target();
  if (!archive.reading()) {
    std::copy(reached_.y, reached_.y + n_, y.begin());
    anew_ = !between_steps();
  }
  due_ = state_ == State::stopped_by_callback && events_.acts();
  archive(reached_.t, y, anew_, target, due_, breaks_);
  bool looked_between = looks_between_;
  archive(looked_between);
  looks_between_ = looks_between_ || looked_between;
  archive(counts_.steps, counts_.failed, counts_.projections, counts_.skipped, counts_.clipped);
  manifold_.archive_drift(archive);
  archive(in_step_);  // interrupted between two attempts of a step: what comes next
  aim_.state(archive);
  archive.require(!in_step_ || aim_.defined());
  archive(attempt_.refused[0], attempt_.refused[1], attempt_.refusals, attempt_.landings, attempt_.reconciled);
  if (archive.reading()) {
    archive.require(std::isfinite(reached_.t));
    move_start(reached_.t, y.data());
    reached_.y = y0_.data();
    breaks_.resume_piece(reached_.t);
    aim_.at(breaks_.target());
    const double ahead = forward_ * (breaks_.target() - reached_.t);  // not if the breakpoints are those of another run
    archive.require(ahead > -hmin_ulps * ulp(reached_.t));
    in_step_ = in_step_ && target == aim_.target();
  }
  if (delays_ != nullptr) {
    bool jumps = false;  // which was seen when the run began
    const bool begins = archive.reading() || !delays_->begun();
    if (begins && delays_->begin(no_steps(), y0_.data(), jumps) == Status::stop) archive.stop();
    delays_->state(archive);
    archive.resizable(passed_marks_);
  }
  step_->state(archive);
  archive.require(anew_ || n_ == 0 || step_->h() > 0);
  manifold_.state(archive);
  stiffness_.state(archive);
  discontinuities_.state(archive);
  below_zero_.state(archive);
  events_.state(archive);
  interpolant_.state(archive);
  if (!archive.whole()) anew_ = true;
  if (archive.stopped()) state_ = State::interrupted;
}

State Integration::resume(bool anew) {
  limits_.begin(counts_.steps);
  if (state_ == State::interrupted) return state_;
  report_.t = reached_.t;
  anew = memory_outdated_ = anew || anew_;
  const bool lands = due_ || breaks_.at(reached_.t);
  if (anew && !lands)
    if (const State state = jumps_.onto_equations(reached_.t, y0_.data()); state != State::running)
      return state_ = state;
  if (ended(unless_stopped(emitter_.resume(reached_, lands)))) return state_;
  if (n_ == 0)
    nothing_to_integrate();
  else if (reached_.t == settings_.tf)
    state_ = State::reached_end;
  else if (!anew || !ended(start_again()))
    state_ = State::running;
  return state_;
}

/// Starts the method at the point reached, where a run ended inside a step, before a breakpoint, or without memory.
Integration::Course Integration::start_again() {
  in_step_ = false;
  if (ended(watch_events(events_.go_on(reached_.t, reached_.y)))) return Course::ended;
  if (due_ || breaks_.at(reached_.t)) return land({.acts = due_, .breaks = breaks_.at(reached_.t)});
  discard_step(reached_.y);
  if (ended(start_memory(reached_.t, reached_.y))) return Course::ended;
  if (settings_.first_step > 0) step_->set_h(settings_.first_step);
  return Course::goes_on;
}

}  // namespace invariode
