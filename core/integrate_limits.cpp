// The limits of a run: requests to stop, steps, time, points and memory.

#include <algorithm>
#include <atomic>
#include <chrono>
#include <limits>

#include "integrate.hpp"

namespace invariode {

/// Unless the run is asked to stop, or a limit is reached.
bool Integration::goes_on() {
  if (request_ && request_->load(std::memory_order_relaxed)) {
    report_.t = reached_.t;
    return end(State::stopped_by_request);
  }
  if (counts_.steps >= settings_.max_steps) return reach(Limit::steps);
  if (out_of_time()) return reach(Limit::time);
  if (kept_points() >= settings_.max_points) return reach(Limit::points);
  if (kept_bytes() >= settings_.max_bytes) return reach(Limit::memory);
  next_look_ = counts_.steps + steps_to_spare();
  return true;
}

/// In how many steps no limit can be reached, whatever they keep, if no event occurs in them.
std::int64_t Integration::steps_to_spare() const {
  if (request_ || limited_in_time()) return 0;
  const std::size_t inside = std::max(static_cast<std::size_t>(settings_.refine), settings_.times.size());
  const std::size_t rows = inside + 1;  // after a jump
  std::size_t doubles = rows * (n_ + 1);
  if (dense) doubles += interpolant_->max_size() + DenseOutput::most_of_step(n_);
  const auto bytes = static_cast<std::int64_t>(sizeof(AcceptedStep) + doubles * sizeof(double));
  return std::min({settings_.max_steps - counts_.steps,
                   (settings_.max_points - kept_points()) / static_cast<std::int64_t>(rows),
                   (settings_.max_bytes - kept_bytes()) / bytes});
}

double Integration::seconds() const {
  return std::chrono::duration<double>(std::chrono::steady_clock::now() - started_).count();
}

bool Integration::out_of_time() const { return limited_in_time() && seconds() >= settings_.time_limit; }

bool Integration::limited_in_time() const { return settings_.time_limit < std::numeric_limits<double>::infinity(); }

/// Outputs or steps of the continuous solution, whichever are more, and occurrences of events.
std::int64_t Integration::kept_points() const {
  std::size_t count = std::max(points.t.size(), dense ? dense->knots().size() : 0);
  for (const Trajectory& one : occurrences) count += one.t.size();
  return static_cast<std::int64_t>(count);
}

std::int64_t Integration::kept_bytes() const {
  std::size_t bytes = points.bytes() + steps.size() * sizeof(AcceptedStep) + (dense ? dense->bytes() : 0);
  for (const Trajectory& one : occurrences) bytes += one.bytes();
  return static_cast<std::int64_t>(bytes);
}

bool Integration::reach(Limit limit) {
  report_.t = reached_.t;
  report_.h = step_->h();
  report_.limit = limit;
  report_.steps = counts_.steps - steps_before_;
  report_.seconds = seconds();
  return end(State::limit_reached);
}

}  // namespace invariode
