#pragma once
// Events in all lanes at once: their signs at the ends of accepted steps and inside (output/events.hpp), in the order
// of the operations there. Where a sign changes a single search finds out when. (INVARIODE_LANES: see pack.hpp.)

#include <algorithm>
#include <cstddef>
#include <utility>

#include "run/lanes/between.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

template <int W>
class Watched {
  using P = Pack<W>;
  using M = Mask<W>;
  // Rows that belong to a trajectory, for each event: its value and sign at the end of the last step, and how often it
  // has occurred.
  static constexpr std::size_t rows = 3;

 public:
  static std::size_t memory(const Job& job) {
    return job.count_of_events > 0 ? (2 * rows + 2) * job.count_of_events + job.n : 0;
  }
  Watched(const Job& job, P* next) : job_(job) {
    const auto take = [&next](std::size_t count) { return std::exchange(next, next + count); };
    now_ = take(rows * job.count_of_events);
    ready_ = take(rows * job.count_of_events);
    sign_ = take(job.count_of_events);
    last_ = take(job.count_of_events);
    point_ = next;
  }

  void adopt(int lane, int from) { copy(lane, ready_, from); }
  void copy(int lane, int from) { copy(lane, now_, from); }
  [[nodiscard]] double* state(int lane) { return now_->lanes() + lane; }
  [[nodiscard]] const double* suspended(int lane) const { return now_->lanes() + lane; }
  /// The one trajectory, in lane 0.
  void go_on(const Suspended& from) {
    for (std::size_t r = 0; r < rows * job_.count_of_events; ++r) now_[r].lanes()[0] = from.watched[r * from.stride];
  }

  /// Takes the signs at the start. Returns the lanes where an event is not defined.
  INVARIODE_SHARED M start(const P& t, const P* y, const P* p) {
    M odd = no_lane<W>();
    for (std::size_t e = 0; e < job_.count_of_events; ++e) {
      P* row = ready_ + rows * e;
      evaluate(job_.events[e], t, y, row, p);
      row[1] = sign(row[0]);
      row[2] = P(0);
      odd = odd | ~(row[0] <= row[0]);
    }
    return odd;
  }

  /// Of steps that are about to be accepted: where a sign changes, and the odd ones. The others have passed.
  INVARIODE_SHARED M scan(const M& accepted, const LaneStep<W>& step, const Between<W>& between, M& odd) {
    constexpr std::size_t fewest_points = 3;  // as in events.cpp
    const std::size_t parts = std::max(between.degree(), fewest_points) + 1;
    const P length = step.t1 - step.t0;
    M crossing = no_lane<W>();
    for (std::size_t e = 0; e < job_.count_of_events; ++e) sign_[e] = now_[rows * e + 1];
    for (std::size_t j = 1; j < parts; ++j) {
      const P t = step.t0 + length * P(static_cast<double>(j) / static_cast<double>(parts));
      between.corrected((t - step.t0) / length, point_);
      odd = odd | mend(point_, step.y1, job_.n);
      for (std::size_t e = 0; e < job_.count_of_events; ++e) {
        P value;
        evaluate(job_.events[e], t, point_, &value, step.p);
        const P now = sign(value), before = sign_[e];
        const M awake = P(0) < now * now;
        odd = odd | ~(value <= value);
        crossing = crossing | (now * before < P(0));
        sign_[e] = choose(awake, now, before);
      }
    }
    for (std::size_t e = 0; e < job_.count_of_events; ++e) {
      P& value = last_[e];
      evaluate(job_.events[e], step.t1, step.y1, &value, step.p);
      const P now = sign(value), before = sign_[e];
      odd = odd | ~(value <= value);
      crossing = crossing | (now * before < P(0)) | ((now * now < P(1)) & (P(0) < before * before));  // zero at the end
      sign_[e] = now;
    }
    odd = odd & accepted;
    crossing = crossing & accepted & ~odd;
    pass(accepted & ~crossing & ~odd);
    return crossing;
  }

 private:
  void pass(const M& steps) {
    for (std::size_t e = 0; e < job_.count_of_events; ++e) {
      P* row = now_ + rows * e;
      row[0] = choose(steps, last_[e], row[0]);
      row[1] = choose(steps, sign_[e], row[1]);
    }
  }
  static P sign(const P& value) { return choose(P(0) < value, P(1), choose(value < P(0), P(-1), P(0))); }
  void copy(int lane, const P* source, int from) {
    for (std::size_t r = 0; r < rows * job_.count_of_events; ++r) now_[r].lanes()[lane] = source[r].lanes()[from];
  }

  const Job& job_;
  P *now_, *ready_;
  P* sign_;  // of each event, at the latest point of the scan where it was not zero
  P* last_;  // values at the end of the step
  P* point_;
};

}  // namespace invariode::lanes::INVARIODE_LANES
