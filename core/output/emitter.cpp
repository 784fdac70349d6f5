#include "output/emitter.hpp"

#include <algorithm>
#include <cassert>
#include <utility>

namespace invariode {
namespace {

/// Doubles for which room is made before a run that may end early: a quarter of a gigabyte.
constexpr std::size_t most_reserved = std::size_t{32} * 1024 * 1024;

}  // namespace

Emitter::Emitter(const Settings& settings, StepInterpolant& interpolant, std::size_t n, std::size_t events,
                 std::optional<DenseOutput> dense)
    : settings_(settings), interpolant_(interpolant), n_(n), forward_(settings.tf >= settings.t0 ? 1 : -1) {
  if (at_times()) {
    output.points.t.reserve(std::min(settings_.times.size(), most_reserved));
    output.points.y.reserve(std::min(settings_.times.size() * n_, most_reserved));
  }
  output.occurrences.resize(events);
  output.dense = std::move(dense);
}

Status Emitter::add_segment(const Reached& reached) {
  if (!output.dense) return Status::ok;
  const Segment segment = interpolant_.segment();
  if (!segment.data) return Status::stop;
  output.dense->add(segment, reached.t, reached.y);
  return Status::ok;
}

Status Emitter::emit(double t0, double t1, const Reached& reached, bool jumps) {
  const auto& [t, y] = reached;
  if (!settings_.save_all) {
    output.points.clear();
    output.points.add(t, y, n_);
    return Status::ok;
  }
  if (settings_.output_at_times) return emit_times(reached, jumps);
  for (int j = 1; j < settings_.refine && t != t0; ++j) {
    const double at = t0 + (t1 - t0) * (static_cast<double>(j) / settings_.refine);
    if (forward_ * at >= forward_ * t) break;
    if (emit_inside({&at, 1}) == Status::stop) return Status::stop;
  }
  output.points.add(t, y, n_);
  return Status::ok;
}

Status Emitter::emit_times(const Reached& reached, bool jumps) {
  if (!at_times()) return Status::ok;
  const auto& [t, y] = reached;
  const std::span<const double> left = settings_.times.from(next_time_);
  std::size_t inside = 0;
  while (inside < left.size() && forward_ * left[inside] < forward_ * t) ++inside;
  if (emit_inside(left.first(inside)) == Status::stop) return Status::stop;
  next_time_ += inside;
  if (inside == left.size() || left[inside] != t || jumps) return Status::ok;  // the value after the jump is put out
  output.points.add(t, y, n_);
  ++next_time_;
  return Status::ok;
}

/// Emits the outputs at some times within the step.
Status Emitter::emit_inside(std::span<const double> times) {
  if (times.empty()) return Status::ok;
  Trajectory& points = output.points;
  if (interpolant_.values(times, points.y.room(times.size() * n_)) == Status::stop) return Status::stop;
  points.y.fill_room(times.size() * n_);
  points.t.append(times.data(), times.size());
  return Status::ok;
}

Status Emitter::resume(const Reached& at, bool jumps) {
  begin(at);
  if (!settings_.save_all) output.points.add(at.t, at.y, n_);
  return emit_times(at, jumps);
}

void Emitter::constant(const double* y) {
  if (!settings_.save_all) output.points.clear();
  if (!settings_.save_all || !settings_.output_at_times) output.points.add(settings_.tf, y, n_);
  for (; next_time_ < settings_.times.size(); ++next_time_) output.points.add(settings_.times[next_time_], y, n_);
}

void Emitter::jump(double t, std::vector<double> values) {
  output.jumps.push_back({settings_.save_all ? output.points.t.size() : 0, t, std::move(values)});
}

/// Points: outputs or steps of the continuous solution, whichever are more, and occurrences of events.
Kept Emitter::kept() const {
  const std::optional<DenseOutput>& dense = output.dense;
  std::size_t points = std::max(output.points.t.size(), dense ? dense->knots().size() : 0);
  std::size_t bytes = output.points.bytes() + output.steps.size() * sizeof(AcceptedStep) + (dense ? dense->bytes() : 0);
  for (const Trajectory& one : output.occurrences) {
    points += one.t.size();
    bytes += one.bytes();
  }
  return {static_cast<std::int64_t>(points), static_cast<std::int64_t>(bytes)};
}

Kept Emitter::most_of_step() const {
  const std::size_t inside = std::max(static_cast<std::size_t>(settings_.refine), settings_.times.size());
  const std::size_t rows = inside + 1;  // after a jump
  std::size_t doubles = rows * (n_ + 1);
  if (output.dense) doubles += interpolant_.max_size() + DenseOutput::most_of_step(n_);
  return {static_cast<std::int64_t>(rows), static_cast<std::int64_t>(sizeof(AcceptedStep) + doubles * sizeof(double))};
}

}  // namespace invariode
