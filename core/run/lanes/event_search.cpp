#include "run/lanes/event_search.hpp"

#include <algorithm>
#include <span>

#include "archive.hpp"
#include "methods/controller.hpp"

namespace invariode {
namespace {

using lanes::Rows;

void gather(const double* from, std::size_t stride, std::vector<double>& to) {
  for (std::size_t i = 0; i < to.size(); ++i) to[i] = from[i * stride];
}

/// Puts a pair between two steps, where it is after one without failures, as its `state` archives that.
void resume(Step& step, double t, std::vector<double>& y, std::vector<double>& slope) {
  double h = 0;  // the next attempt is told its size
  runge_kutta::Trend<double> trend;
  bool moved_onto_bounds = false, failed = false, rests = false;
  Archive written(0);
  written(t, y, h, moved_onto_bounds);
  written.values(slope.data(), slope.size());
  written(failed, trend.rate, trend.growth, rests);
  const RunMemory memory = written.take();
  Archive archive(std::span(memory.data(), memory.size()));
  step.state(archive);
}

}  // namespace

EventSearch::EventSearch(const Solver& solver, const Ensemble& ensemble)
    : solver_(solver),
      ensemble_(ensemble),
      f_(solver.problem().f),
      step_(solver.method().step(f_, solver.weights(), solver.options())),
      events_(solver.problem().events, solver.problem().vectors, ensemble.n, step_->max_degree()),
      y0_(ensemble.n),
      k_(ensemble.n),
      y1_(ensemble.n),
      y_(ensemble.n) {
  const Problem& problem = solver.problem();
  const Settings& settings = solver.settings();
  if (!problem.invariants.empty()) {
    invariants_.emplace(problem.n, problem.invariants, problem.value, solver.weights());
    projector_.emplace(*invariants_, solver.weights(), settings.iterations);
    output_projector_.emplace(*invariants_, solver.weights(), 1, 0, &*projector_);
  }
  interpolant_.emplace(*step_, problem.n, settings.interpolation, output_projector_ ? &*output_projector_ : nullptr,
                       nullptr, projector_ ? &*projector_ : nullptr);
}

/// The step that was made in the lane, with its interpolant.
bool EventSearch::make_step(const lanes::Crossed& crossed) {
  const lanes::Lane& lane = crossed.lane;
  const double t0 = lane[Rows::t];
  gather(&lane[Rows::y], lane.stride, y0_);
  gather(&lane[lane.rows.memory], lane.stride, k_);
  gather(crossed.y1, lane.stride, y1_);
  resume(*step_, t0, y0_, k_);
  const Step::Attempt proposal = step_->attempt(crossed.h, crossed.t1);
  if (proposal.outcome != Outcome::ok) return false;
  if (projector_) {
    const double* start = ensemble_.y0 + lane.trajectory * ensemble_.n;
    if (invariants_->hold(solver_.settings().t0, start) != Status::ok) return false;
    std::copy(proposal.y, proposal.y + ensemble_.n, y_.begin());
    if (projector_->project(crossed.t1, y0_.data(), y_.data()).outcome != Outcome::ok) return false;
  }
  if (step_->accept(y1_.data()) != Outcome::ok) return false;
  interpolant_->restart();
  interpolant_->accept(t0, y0_.data());
  return interpolant_->segment().data != nullptr;
}

lanes::Found EventSearch::search(const lanes::Crossed& crossed, std::vector<Trajectory>& found) {
  if (!make_step(crossed)) return {};
  const lanes::Lane& lane = crossed.lane;
  const std::int64_t calls = invariants_ ? invariants_->calls() : 0;
  const std::int64_t jacobians = invariants_ ? invariants_->jacobian_calls() : 0;
  const auto row = [&lane](std::size_t e) { return lane.rows.events + Rows::of_event * e; };
  for (std::size_t e = 0; e < events_.count(); ++e)
    events_.go_on_from(e, {.last = lane[row(e) + Rows::last],
                           .sign = static_cast<int>(lane[row(e) + Rows::sign]),
                           .occurrences = static_cast<std::int64_t>(lane[row(e) + Rows::occurrences]),
                           .slope = lane[row(e) + Rows::slope]});
  if (events_.search(lane[Rows::t], crossed.t1, y1_.data(), step_->degree(), *interpolant_) != Outcome::ok) return {};
  if (!keep(crossed.t1, found)) return {};
  for (std::size_t e = 0; e < events_.count(); ++e) {
    const Events::Watch watch = events_.watch(e);
    lane[row(e) + Rows::last] = watch.last;
    lane[row(e) + Rows::sign] = watch.sign;
    lane[row(e) + Rows::occurrences] = static_cast<double>(watch.occurrences);
    lane[row(e) + Rows::slope] = watch.slope;
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
    found[occurrence.event].add(occurrence.t, y_.data(), ensemble_.n);
  }
  return true;
}

}  // namespace invariode
