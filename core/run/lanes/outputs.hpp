#pragma once
// Output at given times in all lanes at once, each with the time of its own that comes next. (INVARIODE_LANES: see
// pack.hpp.)

#include <cstddef>
#include <cstdint>

#include "run/lanes/between.hpp"
#include "run/lanes/held.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

template <int W>
class Outputs {
  using P = Pack<W>;
  using M = Mask<W>;

 public:
  static std::size_t memory(const Job& job) { return job.output_at_times() ? job.n : 0; }
  Outputs(const Job& job, Host& host, P* memory)
      : job_(job), host_(host), value_(memory), next_time_(forward() * infinity) {}

  /// The trajectory comes into the lane at t0, with that y.
  void adopt(int lane, std::uint32_t trajectory, const double* y) {
    trajectory_[lane] = trajectory;
    number_[lane] = 0;
    for (; number_[lane] < job_.count_of_times && job_.times[number_[lane]] == job_.t0; ++number_[lane])
      host_.put_out(trajectory, number_[lane], y, W);
    aim(lane);
  }
  /// It goes on there from a lane in which so many had been put out.
  void go_on(int lane, std::uint32_t trajectory, std::size_t number) {
    trajectory_[lane] = trajectory;
    number_[lane] = number;
    aim(lane);
  }
  void leave(int lane) { next_time_.lanes()[lane] = forward() * infinity; }
  [[nodiscard]] std::size_t number(int lane) const { return number_[lane]; }

  /// Which steps to t1 contain output times, the end included.
  [[nodiscard]] M due(const M& accepted, const P& t1) const {
    return accepted & (forward() * next_time_ <= forward() * t1);
  }
  /// And in which of these is one before the end.
  [[nodiscard]] M inside(const M& due, const P& t1) const { return due & (forward() * next_time_ < forward() * t1); }

  /// Puts out what steps contain that are due. Returns those where that is odd.
  M put_out(M due, const LaneStep<W>& step, const Between<W>& between, Held<W>* held) {
    M odd = no_lane<W>();
    for (; bits(due) != 0; due = this->due(due, step.t1)) {
      const P at = choose(due, next_time_, step.t1);
      const M before_end = inside(due, step.t1);
      if (bits(before_end) != 0) {
        const P theta = choose(before_end, (at - step.t0) / (step.t1 - step.t0), P(1));
        between.corrected(theta, value_);
        if (held != nullptr) odd = odd | (before_end & mend(value_, step.y1, job_.n));
        if (held != nullptr && job_.projects) odd = odd | held->onto(before_end, at, theta, step, value_);
      }
      for (std::size_t i = 0; i < job_.n; ++i) value_[i] = choose(before_end, value_[i], step.y1[i]);
      if (held != nullptr) held->measure(due, at, value_, step.p);
      hand_out(bits(due));
    }
    return odd;
  }

 private:
  void hand_out(unsigned due) {
    for (int l = 0; l < W; ++l) {
      if (!has(due, l)) continue;
      host_.put_out(trajectory_[l], number_[l]++, value_->lanes() + l, W);
      aim(l);
    }
  }
  void aim(int lane) {
    const std::size_t next = number_[lane];
    next_time_.lanes()[lane] = next < job_.count_of_times ? job_.times[next] : forward() * infinity;
  }
  [[nodiscard]] double forward() const { return job_.forward(); }

  const Job& job_;
  Host& host_;
  P* value_;
  P next_time_;
  std::uint32_t trajectory_[W]{};
  std::size_t number_[W]{};
};

}  // namespace invariode::lanes::INVARIODE_LANES
