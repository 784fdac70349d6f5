#pragma once
// What happens inside of accepted steps in all lanes at once: output at given times, each lane with the time of its own
// that comes next; and events, whose signs are looked at as output/events.cpp does. Where a sign changes a single
// search finds out when. (INVARIODE_LANES: see pack.hpp.)

#include <cstddef>
#include <cstdint>

#include "output/polynomial.hpp"
#include "run/lanes/lane_invariant.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// The extension of the method between the ends of the steps, corrected there (output/interpolant.hpp).
template <int W>
class LaneInterpolant {
  using P = Pack<W>;

 public:
  LaneInterpolant(const Job& job, std::size_t degree, LaneExtension<W>* evaluate, Host& host)
      : job_(job),
        size_((degree + 1) * job.all),
        evaluate_(evaluate),
        data_(take<W>(host, size_ + 2 * job.all + job.n + 2)),
        lack_(data_ + size_ + job.all) {
    for (std::size_t i = 0; i < job.all; ++i) data_[size_ + i] = P(0);
  }

  /// Takes the steps, whose coefficients but for the first have been put there.
  [[nodiscard]] P* coefficients() { return data_; }
  /// The rows of the `Segment` of steps; and those of W, g₀ and g₁ in it.
  [[nodiscard]] const P* segment() const { return data_; }
  [[nodiscard]] P* of_invariant() { return lack_ + job_.all; }
  INVARIODE_SHARED void begin(const LaneStep<W>& step) {
    for (std::size_t i = 0; i < job_.all; ++i) data_[i] = step.y0[i];
    if (!job_.corrects) return;
    evaluate_(data_, size_, job_.all, P(1), lack_);
    for (std::size_t i = 0; i < job_.all; ++i) lack_[i] = step.y1[i] - lack_[i];
  }
  /// The value at θ, not projected. (At the start the extension has the value of the step: nothing is to be corrected.)
  INVARIODE_SHARED void corrected(const P& theta, P* out) const {
    evaluate_(data_, size_, job_.all, theta, out);
    if (!job_.corrects) return;
    const P at1 = part_of_end(theta);
    for (std::size_t i = 0; i < job_.all; ++i) out[i] += lack_[i] * at1;
  }

 private:
  const Job& job_;
  std::size_t size_;
  LaneExtension<W>* evaluate_;
  P *data_, *lack_;  // the rows of a `Segment`; in it e₁, as e₀ = 0
};

template <int W>
class LaneOutput {
  using P = Pack<W>;
  using M = Mask<W>;

 public:
  LaneOutput(const Job& job, Host& host)
      : next_time_(job.forward() * infinity), job_(job), host_(host), value_(take<W>(host, job.all)) {}

  /// The trajectory comes into the lane, at t0 with that y, or where so many have been put out.
  INVARIODE_SHARED void adopt(const Lane& lane, int l) {
    number_[l] = 0;
    while (number_[l] < job_.count_of_times && job_.times[number_[l]] == job_.t0) put_out(lane, l, &lane[Rows::y]);
    aim(l);
  }
  void go_on(int l, std::size_t number) {
    number_[l] = number;
    aim(l);
  }
  void leave(int l) { next_time_.lanes()[l] = job_.forward() * infinity; }
  [[nodiscard]] std::size_t number(int l) const { return number_[l]; }

  /// The steps that contain output times up to the point reached, included.
  [[nodiscard]] M due(const M& accepted, const P& reached) const {
    return accepted & (job_.forward() * next_time_ <= job_.forward() * reached);
  }
  [[nodiscard]] M inside(const M& due, const P& reached) const {
    return due & (job_.forward() * next_time_ < job_.forward() * reached);
  }

  /// Puts out what steps contain that are due, for the trajectories in `lane`. Returns those where that is odd.
  template <class LaneOf>
  INVARIODE_SHARED M put_out(M due, const LaneStep<W>& step, const LaneInterpolant<W>& between, LaneInvariant<W>* held,
                             LaneOf lane) {
    M odd = no_lane<W>();
    for (; any(due); due = this->due(due, step.reached_t)) {
      const P at = choose(due, next_time_, step.reached_t);
      const M before_end = inside(due, step.reached_t);
      if (any(before_end)) {
        const P theta = choose(before_end, (at - step.t0) / step.purified, P(1));
        between.corrected(theta, value_);
        if (held != nullptr) odd = odd | (before_end & mend(value_, step.y1, job_.all));
        if (held != nullptr && job_.projects) odd = odd | held->onto(before_end, at, theta, step, value_);
      }
      for (std::size_t i = 0; i < job_.all; ++i) value_[i] = choose(before_end, value_[i], step.reached_y[i]);
      if (held != nullptr) held->measure(due, at, value_, step.p);
      for_each_lane(bits(due), [&](int l) {
        put_out(lane(l), l, value_->lanes() + l);
        aim(l);
      });
    }
    return odd;
  }

 private:
  void put_out(const Lane& lane, int l, const double* y) { host_.put_out(lane.trajectory, number_[l]++, y, W); }
  void aim(int l) {
    next_time_.lanes()[l] = number_[l] < job_.count_of_times ? job_.times[number_[l]] : job_.forward() * infinity;
  }

  P next_time_;
  const Job& job_;
  Host& host_;
  P* value_;
  std::size_t number_[W]{};
};

/// Events. Their rows are those of trajectories that are in lanes, or are to be made ready.
template <int W>
class EventScan {
  using P = Pack<W>;
  using M = Mask<W>;

 public:
  EventScan(const Job& job, std::size_t intervals, P* now, Host& host)
      : job_(job),
        intervals_(intervals),
        now_(now),
        sign_(take<W>(host, job.count_of_events)),
        last_(take<W>(host, job.count_of_events)),
        change_(take<W>(host, job.count_of_events)),
        apart_(take<W>(host, job.count_of_events)),
        across_(take<W>(host, job.count_of_events)),
        most_(take<W>(host, job.count_of_events)),
        least_(take<W>(host, job.count_of_events)),
        point_(take<W>(host, job.all)) {}

  /// Takes the signs at the start into `ready`. Returns the lanes where an event is not defined.
  INVARIODE_SHARED M start(P* ready, const P& t, const P* y, const P* p) {
    M odd = no_lane<W>();
    for (std::size_t e = 0; e < job_.count_of_events; ++e) {
      P* row = ready + Rows::of_event * e;
      row[Rows::sign] = sign_at(e, t, y, p, row[Rows::last], odd);
      row[Rows::slope] = P(0);
    }
    return odd;
  }

  /// Finds, among steps that are about to be accepted, those where a sign changes, or the values leave room for a pair
  /// of changes (`Events::leaves_room`), and the odd ones. The others have passed.
  INVARIODE_SHARED M scan(const M& accepted, const LaneStep<W>& step, const LaneInterpolant<W>& between, M& odd) {
    M crossing = no_lane<W>();
    for (std::size_t e = 0; e < job_.count_of_events; ++e) {
      sign_[e] = row(e)[Rows::sign];
      last_[e] = row(e)[Rows::last];
      change_[e] = P(0);
      apart_[e] = across_[e] = P(infinity);
      most_[e] = least_[e] = absolute(last_[e]);
    }
    for (std::size_t j = 1; j <= intervals_; ++j) {
      const bool at_end = j == intervals_;
      const P part(static_cast<double>(j) / static_cast<double>(intervals_));
      const P t = at_end ? step.t1 : step.t0 + step.purified * part;
      if (!at_end) between.corrected((t - step.t0) / step.purified, point_);
      if (!at_end) odd = odd | mend(point_, step.y1, job_.all);
      for (std::size_t e = 0; e < job_.count_of_events; ++e) {
        const P from = last_[e];
        const P now = sign_at(e, t, at_end ? step.y1 : point_, step.p, last_[e], odd), before = sign_[e];
        note(e, from, last_[e]);
        const M zero = now * now < P(1);
        crossing = crossing | (now * before < P(0));
        if (at_end) crossing = crossing | (zero & (P(0) < before * before));
        sign_[e] = at_end ? now : choose(zero, before, now);
      }
    }
    const P width = absolute(step.t1 - step.t0) / P(static_cast<double>(intervals_));
    for (std::size_t e = 0; e < job_.count_of_events; ++e) crossing = crossing | leaves_room(e, width);
    odd = odd & accepted;
    crossing = crossing & accepted & ~odd;
    const M pass = accepted & ~crossing & ~odd;
    for (std::size_t e = 0; e < job_.count_of_events; ++e) {
      row(e)[Rows::slope] = choose(pass, change_[e] / width, row(e)[Rows::slope]);
      row(e)[Rows::last] = choose(pass, last_[e], row(e)[Rows::last]);
      row(e)[Rows::sign] = choose(pass, sign_[e], row(e)[Rows::sign]);
    }
    return crossing;
  }

 private:
  [[nodiscard]] P* row(std::size_t event) const { return now_ + Rows::of_event * event; }
  /// Two neighbours of the scan.
  void note(std::size_t event, const P& a, const P& b) {
    const P sum = absolute(a) + absolute(b);
    const M same = P(0) < a * b;
    apart_[event] = choose(same, smaller(apart_[event], sum), apart_[event]);
    across_[event] = choose(same, across_[event], smaller(across_[event], sum));
    change_[event] = larger(change_[event], absolute(b - a));
    most_[event] = larger(most_[event], absolute(b));
    least_[event] = smaller(least_[event], absolute(b));
  }
  [[nodiscard]] M leaves_room(std::size_t event, const P& width) const {
    const P reach = larger(change_[event], row(event)[Rows::slope] * width);
    const M bends =
        (apart_[event] <= P(room_between_points) * reach) | (P(room_between_points) * across_[event] < reach);
    const M condition = (most_[event] <= P(1)) & (P(1) <= least_[event]);
    return (bends | ~(change_[event] < P(infinity))) & ~condition;
  }
  P sign_at(std::size_t event, const P& t, const P* y, const P* p, P& value, M& odd) const {
    evaluate(job_.events[event], t, y, &value, p);
    odd = odd | ~(value <= value);
    return choose(P(0) < value, P(1), choose(value < P(0), P(-1), P(0)));
  }

  const Job& job_;
  std::size_t intervals_;
  P* now_;
  P* sign_;             // of each event, at the latest point of the scan where it was not zero
  P* last_;             // its latest value
  P* change_;           // the largest change between neighbours,
  P *apart_, *across_;  // the least sum of sizes of neighbours on one side of zero, and of others,
  P *most_, *least_;    // the largest and the smallest size
  P* point_;
};

}  // namespace invariode::lanes::INVARIODE_LANES
