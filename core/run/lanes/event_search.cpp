#include "run/lanes/event_search.hpp"

namespace invariode {
namespace {

using lanes::Rows;

void gather(const double* from, std::size_t stride, std::size_t size, double* to) {
  for (std::size_t i = 0; i < size; ++i) to[i] = from[i * stride];
}

std::size_t row_of(const lanes::Lane& lane, std::size_t event) { return lane.rows.events + Rows::of_event * event; }

}  // namespace

EventSearch::EventSearch(const Solver& solver)
    : f_(solver.problem().f),
      step_(solver.method().step(f_, solver.weights(), solver.options())),
      events_(solver.problem().events, solver.problem().vectors, step_->n(), step_->max_degree()),
      y0_(step_->n()),
      y1_(step_->n()),
      y_(step_->n()) {
  const Problem& problem = solver.problem();
  const Settings& settings = solver.settings();
  if (!problem.invariants.empty()) {
    invariants_.emplace(problem.n, problem.invariants, problem.value, solver.weights());
    projector_.emplace(*invariants_, solver.weights(), 1);
  }
  interpolant_.emplace(*step_, problem.n, settings.interpolation, projector_ ? &*projector_ : nullptr, nullptr,
                       nullptr);
}

/// Takes the step that was made in the lane, and what the lane knows of the events and the invariant.
void EventSearch::take(const lanes::Crossed& crossed) {
  const lanes::Lane& lane = crossed.lane;
  gather(&lane[Rows::y], lane.stride, y0_.size(), y0_.data());
  gather(crossed.y1, lane.stride, y1_.size(), y1_.data());
  double* segment = interpolant_->take(lane[Rows::t], y0_.data(), crossed.t1);
  gather(crossed.segment, lane.stride, interpolant_->max_size(), segment);
  if (invariants_) invariants_->set_value({lane[lane.rows.invariant + Rows::value]});
  for (std::size_t e = 0; e < events_.count(); ++e) {
    const std::size_t row = row_of(lane, e);
    events_.go_on_from(e, {.last = lane[row + Rows::last],
                           .sign = static_cast<int>(lane[row + Rows::sign]),
                           .occurrences = static_cast<std::int64_t>(lane[row + Rows::occurrences]),
                           .slope = lane[row + Rows::slope]});
  }
}

lanes::Found EventSearch::search(const lanes::Crossed& crossed, std::vector<Trajectory>& found) {
  take(crossed);
  const lanes::Lane& lane = crossed.lane;
  const std::int64_t calls = invariants_ ? invariants_->calls() : 0;
  const std::int64_t jacobians = invariants_ ? invariants_->jacobian_calls() : 0;
  if (events_.search(lane[Rows::t], crossed.t1, y1_.data(), step_->degree(), *interpolant_) != Outcome::ok) return {};
  if (!keep(crossed.t1, found)) return {};
  for (std::size_t e = 0; e < events_.count(); ++e) {
    const Events::Watch watch = events_.watch(e);
    const std::size_t row = row_of(lane, e);
    lane[row + Rows::last] = watch.last;
    lane[row + Rows::sign] = watch.sign;
    lane[row + Rows::occurrences] = static_cast<double>(watch.occurrences);
    lane[row + Rows::slope] = watch.slope;
  }
  return {.sound = true,
          .terminal = events_.terminal(),
          .t = events_.terminal() ? events_.occurrences().back().t : 0,
          .y = y_.data(),
          .evaluations = invariants_ ? invariants_->calls() - calls : 0,
          .jacobians = invariants_ ? invariants_->jacobian_calls() - jacobians : 0};
}

/// The occurrences with their states, as `Integration::find_events` keeps them.
bool EventSearch::keep(double t1, std::vector<Trajectory>& found) {
  for (const Occurrence& occurrence : events_.occurrences()) {
    if (occurrence.t == t1)
      y_ = y1_;
    else if (interpolant_->value(occurrence.t, y_.data()) == Status::stop)
      return false;
    found[occurrence.event].add(occurrence.t, y_.data(), y_.size());
  }
  return true;
}

}  // namespace invariode
