#pragma once
// The loop for trajectories side by side, each in a lane of its own: its own t, h, error, acceptance. The arithmetic,
// and the order of its operations, is that of a single run (methods/runge_kutta_kernel.hpp, taylor_kernel.hpp, aim.hpp,
// integrate.cpp), so that each lane has its bits. Whatever a lane meets that is rare (something not finite, a step at
// hmin) is left to that code, from the start. (INVARIODE_LANES: see pack.hpp.)

#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>

#include "aim.hpp"
#include "detect/step_look.hpp"
#include "methods/runge_kutta.hpp"
#include "run/lanes/lane_invariant.hpp"
#include "run/lanes/lane_method.hpp"
#include "run/lanes/lane_output.hpp"
#include "run/lanes/lane_pair.hpp"
#include "run/lanes/lane_taylor.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// Integrates by a method in W lanes.
template <int W>
class LaneIntegrator {
  using P = Pack<W>;
  using M = Mask<W>;
  using Series = FailedSeries<P>;
  static constexpr unsigned every_lane = one_lane(W) - 1;
  static constexpr unsigned cancellation_interval = 64;  // attempts between two checks
  // Of the limits of `StepLook`: with room for roundoff, so that no limited step is missed.
  static constexpr double nearly = 0.99;
  static constexpr double least_threshold = std::numeric_limits<double>::min();

 public:
  LaneIntegrator(const Job& job, const LaneRows<W>& rows, LaneMethod<W>& stepper, Host& host)
      : job_(job),
        host_(host),
        rows_(rows.layout),
        now_(rows.now),
        y_(now_ + Rows::y),
        p_(now_ + rows_.parameters),
        candidate_(take<W>(host, job.all)),
        ready_(rows.ready),
        stepper_(stepper),
        reached_y_(take<W>(host, job.all)),
        points_(take<W>(host, Series::points * job.n)->lanes()),
        between_(job, stepper.traits.degree, stepper.traits.evaluate_extension, host),
        outputs_(job, host),
        held_(job, now_ + rows_.invariant, ready_ + rows_.invariant, host),
        watched_(job, intervals_of_step(stepper.traits.degree), now_ + rows_.events, host) {}

  /// Integrates by `method`, which is the stepper, until there is nothing left to take.
  template <class Method>
  void run(Method& method) {
    for (unsigned free = every_lane;;) {
      fill(free);
      if (empty_ && std::popcount(occupied_) < stepper_.traits.fewest_lanes) break;
      if (cancelled()) return;
      attempt(method);
      free = settle();
    }
    for_each_lane(occupied_, [&](int l) {
      host_.go_on({.lane = lane(l),
                   .output = outputs_.number(l),
                   .checks = checks_[l],
                   .series = series_[l].state(),
                   .points = from(l)});
    });
  }

  /// One trajectory, in lane 0, to its end.
  template <class Method>
  void go_on(const Suspended& from, Method& method) {
    trajectory_[0] = from.lane.trajectory;
    for (std::size_t r = 0; r < rows_.size; ++r) now_[r].lanes()[0] = from.lane[r];
    outputs_.go_on(0, from.output);
    checks_[0] = from.checks;
    series_[0].go_on(from.series);
    in_series_ = series_[0].any() ? 1 : 0;
    for (std::size_t i = 0; i < Series::points * job_.n; ++i) points_[i] = from.points[i];
    for (occupied_ = 1; occupied_ != 0 && !cancelled(); settle()) attempt(method);
  }

 private:
  [[nodiscard]] bool holds() const { return job_.invariant != nullptr; }
  [[nodiscard]] bool watches() const { return job_.count_of_events > 0; }
  [[nodiscard]] bool cancelled() { return ++attempts_ % cancellation_interval == 0 && host_.cancelled(); }

  // ------------------------------------------------------------------------------------------- trajectories come and
  // go

  [[nodiscard]] Lane lane(int l) const { return {trajectory_[l], rows_, now_->lanes() + l, W}; }
  void copy(P* to, int l, const P* source, int from) const {
    for (std::size_t r = 0; r < rows_.size; ++r) to[r].lanes()[l] = source[r].lanes()[from];
  }

  /// Puts trajectories into lanes that have none, as long as there are any.
  void fill(unsigned free) {
    for (; free != 0; free &= free - 1) {
      while (ready_count_ == prepared_ && prepare()) {
      }
      if (ready_count_ == prepared_) return keep_defined();
      adopt(std::countr_zero(free), place_[ready_count_++]);
    }
  }

  /// f is asked in lanes that are not occupied, too: those that never were get the state of one that is.
  void keep_defined() {
    if (occupied_ == 0) return;
    for_each_lane(every_lane & ~defined_, [&](int l) {
      copy(now_, l, now_, std::countr_zero(occupied_));
      stepper_.keep_defined(l, std::countr_zero(occupied_));
    });
    defined_ = every_lane;
  }

  /// f at the start of W more trajectories, and their first steps. False: there are no more.
  bool prepare() {
    if (empty_) return false;
    for (std::size_t r = 0; r < rows_.size; ++r) ready_[r] = P(0);
    int taken = 0;
    while (taken < W && host_.take(ready_trajectory_[taken])) load(taken++);
    empty_ = taken < W;
    prepared_ = ready_count_ = 0;
    if (taken == 0) return false;
    for (int l = taken; l < W; ++l) copy(ready_, l, ready_, taken - 1);  // f is asked in all lanes
    start(one_lane(taken) - 1);
    return true;
  }

  /// The initial value and the parameters of a trajectory that is to be made ready.
  void load(int l) {
    const double* y0 = job_.y0 + ready_trajectory_[l] * job_.all;
    const double* row = job_.rows + ready_trajectory_[l] * job_.parameters;
    ready_[Rows::t].lanes()[l] = job_.t0;
    for (std::size_t i = 0; i < job_.all; ++i) ready_[Rows::y + i].lanes()[l] = y0[i];
    for (std::size_t i = 0; i < job_.parameters; ++i) ready_[rows_.parameters + i].lanes()[l] = row[i];
    for (std::size_t i = 0; i < job_.all; ++i)
      ready_[rows_.thresholds + i].lanes()[l] = i < job_.n ? job_.threshold[i] : threshold(ready_trajectory_[l], i);
    for (std::size_t i = 0; i < job_.n; ++i)
      ready_[rows_.watch + i].lanes()[l] = y0[i] >= 0 ? job_.notable[i] : infinity;
  }
  /// Returns the threshold of sensitivities, as `augmented` has it for single runs.
  [[nodiscard]] double threshold(std::uint32_t trajectory, std::size_t i) const {
    if (!job_.varied.counts) return infinity;
    const double threshold = job_.varied.tolerances[trajectory * (job_.all - job_.n) + i - job_.n] / job_.rtol;
    return threshold < least_threshold ? least_threshold : threshold;
  }

  /// |h| of the first steps, and which of them are left alone.
  void start(unsigned taken) {
    const P t0(job_.t0), *p = ready_ + rows_.parameters;
    P* y = ready_ + Rows::y;
    unsigned doubted = 0, inside = 0;
    if (holds() && job_.varied.k > 0) doubted = bits(held_.start_tangent(t0, y, p));
    M not_defined, rests = no_lane<W>();
    const P h = stepper_.start(t0, y, p, not_defined, rests);
    ready_[Rows::h] = job_.first_step > 0 ? P(job_.first_step) : h;
    ready_[Rows::rests] = choose(rests, P(1), P(0));
    const unsigned undefined = bits(not_defined | (ready_[Rows::h] < hmin_ulps * ulp(t0)));
    if (holds()) doubted |= bits(held_.start(t0, y, stepper_.slope_at_start(), job_.forward() * ready_[Rows::h], p));
    if (watches()) inside = bits(watched_.start(ready_ + rows_.events, t0, y, p));
    for_each_lane(taken, [&](int l) {
      if (!has(undefined | doubted | inside, l))
        place_[prepared_++] = l;
      else
        host_.leave(ready_trajectory_[l], has(undefined, l) ? Why::undefined
                                          : has(doubted, l) ? Why::invariant
                                                            : Why::inside);
    });
  }

  /// A trajectory that was made ready moves into the lane.
  void adopt(int l, int from) {
    trajectory_[l] = ready_trajectory_[from];
    copy(now_, l, ready_, from);
    stepper_.adopt(l, from);
    checks_[l] = 0;
    series_[l].forget();
    in_series_ &= ~one_lane(l);
    if (job_.output_at_times()) outputs_.adopt(lane(l), l);
    occupied_ |= one_lane(l);
    defined_ |= one_lane(l);
  }

  /// Hands back what has ended. Returns the lanes that are free.
  unsigned settle() {
    const unsigned ended = reached_ & occupied_ & ~odd_, odd = odd_ & occupied_;
    if ((ended | odd) == 0) return 0;
    if (holds() && ended != 0) held_.measure(to_mask<W>(ended), t_(), y_, p_);
    for_each_lane(ended | odd, [&](int l) {
      outputs_.leave(l);
      if (has(odd, l))
        host_.leave(trajectory_[l], why(l));
      else
        host_.keep({lane(l), has(cut_, l), evaluations(l), checks_[l]});
    });
    occupied_ &= ~(ended | odd);
    return every_lane & ~occupied_;
  }

  /// It is left after the last attempt.
  [[nodiscard]] Why why(int l) const {
    if (has(doubted_, l)) return Why::invariant;
    if (has(inside_, l)) return Why::inside;
    if (has(jumping_, l)) return Why::jump;
    if (lane(l)[Rows::limited] >= StepLook::long_streak) return Why::stability;
    return lane(l)[Rows::steps] >= job_.max_steps ? Why::limit : Why::undefined;
  }

  [[nodiscard]] std::int64_t evaluations(int l) const {
    const auto count = [this, l](std::size_t row) { return static_cast<std::int64_t>(lane(l)[row]); };
    return stepper_.evaluations(count(Rows::steps), count(Rows::failed), count(Rows::looked));
  }

  // ---------------------------------------------------------------------------------------------------------- a step

  /// One attempt in each lane, from which those that are accepted go on.
  template <class Method>
  void attempt(Method& method) {
    const P t = t_(), hmin = hmin_ulps * ulp(t), reach = choose(retries(), P(1), P(stretch));
    const Aimed<P, M> aim = aimed<M>(t, row(Rows::h), reach, hmin, job_.hmax, job_.forward(), job_.tf);
    const P purified = aim.t1 - t;
    M odd = no_lane<W>();
    LaneStep<W> step{t, aim.t1, aim.h, purified, aim.t1, y_, candidate_, p_, candidate_};
    const P error = method.attempt(step, candidate_, odd);
    odd = odd | ~(error < P(infinity));
    M accepted = (error <= P(job_.rtol)) & ~odd;
    const M looks = accepted & (P(0) < row(Rows::rests));  // single runs look at f beside the start
    odd = odd | looks;
    accepted = accepted & ~looks;
    row(Rows::rests) = P(0);
    doubted_ = inside_ = cut_ = 0;
    unsigned missing = 0;  // may miss a jump of f
    if constexpr (Method::may_miss_jumps) {
      missing = bits(accepted & method.bends(step, candidate_, error, nearly)) | passes_series(bits(accepted), step);
      const M left = to_mask<W>(missing);
      odd = odd | left;
      accepted = accepted & ~left;
    }
    if (holds()) project(accepted, step);
    const M undefined = accepted & method.finish(step);
    odd = odd | undefined;
    accepted = accepted & ~undefined;
    if (holds()) judge(accepted, step);
    if (job_.looks_inside()) look_inside(accepted, step);
    const M again = retries();
    decide(accepted, step);
    row(Rows::h) = method.accept(accepted, step, error, hmin, again);
    odd = odd | (~accepted & (absolute(step.h) <= hmin)) | (P(StepLook::long_streak) <= row(Rows::limited));
    reached_ = bits(accepted & aim.lands) | cut_;
    jumping_ |= missing;
    odd_ = bits(odd) | doubted_ | inside_ | jumping_;
    if (job_.max_steps < infinity) odd_ |= bits(P(job_.max_steps) <= row(Rows::steps)) & ~reached_;
  }

  /// Takes the candidates onto the manifold.
  INVARIODE_SHARED void project(M& accepted, LaneStep<W>& step) {
    if (!any(accepted)) return;
    doubt(held_.project(accepted, step), accepted);
    step.y1 = step.reached_y = held_.projected();
  }

  /// Judges whether steps that are about to be accepted contradict the invariant.
  INVARIODE_SHARED void judge(M& accepted, const LaneStep<W>& step) {
    if (!any(accepted)) return;
    const M noted = held_.to_be_noted(accepted, row(Rows::steps));
    if (any(noted)) held_.note_harm(noted, stepper_.errors(step.purified), candidate_);
    doubt(held_.judge(accepted, step, stepper_.slope(), row(Rows::steps) + P(1)), accepted);
  }
  void doubt(const M& where, M& accepted) {
    doubted_ |= bits(where);
    accepted = accepted & ~where;
  }

  /// The events and the outputs of steps that are about to be accepted; `inside_`: those where these are odd.
  INVARIODE_SHARED void look_inside(const M& accepted, LaneStep<W>& step) {
    if (!any(accepted)) return;
    const M inside = watches() ? accepted : outputs_.inside(outputs_.due(accepted, step.t1), step.t1);
    M odd = no_lane<W>();
    if (any(inside)) {
      odd = inside & stepper_.extend(step, between_.coefficients());
      between_.begin(step);
      row(Rows::looked) += choose(inside, P(1), P(0));
    }
    if (holds()) held_.look_inside(accepted, inside, step);
    if (watches()) find_events(accepted & ~odd, step, odd);
    const M due = outputs_.due(accepted & ~odd, step.reached_t);
    if (any(due))
      odd = odd | outputs_.put_out(due, step, between_, holds() ? &held_ : nullptr, [this](int l) { return lane(l); });
    inside_ = bits(odd);
  }

  /// A terminal event cuts the step.
  void find_events(const M& accepted, LaneStep<W>& step, M& odd) {
    const unsigned crossing = bits(watched_.scan(accepted, step, between_, odd)) & occupied_;
    if (crossing != 0 && job_.projects) held_.complete(between_.of_invariant());
    for_each_lane(crossing, [&](int l) {
      const Found found =
          host_.search({lane(l), step.t1.lanes()[l], step.y1->lanes() + l, between_.segment()->lanes() + l});
      if (!found.sound) odd = odd | to_mask<W>(one_lane(l));
      if (holds()) held_.count_search(l, found);
      if (found.terminal) cut(l, found, step);
    });
  }

  /// The trajectory ends in the step.
  void cut(int l, const Found& found, LaneStep<W>& step) {
    if (cut_ == 0)
      for (std::size_t i = 0; i < job_.all; ++i) reached_y_[i] = step.y1[i];
    cut_ |= one_lane(l);
    step.reached_t.lanes()[l] = found.t;
    for (std::size_t i = 0; i < job_.all; ++i) reached_y_[i].lanes()[l] = found.y[i];
    step.reached_y = reached_y_;
  }

  /// The counts; where those that are accepted have come to.
  INVARIODE_SHARED void decide(const M& accepted, const LaneStep<W>& step) {
    row(Rows::steps) += choose(accepted, P(1), P(0));
    row(Rows::failed) += choose(accepted, P(0), P(1));
    row(Rows::retries) = choose(accepted, P(0), P(1));
    note_stability(accepted, step);
    jumping_ = note_failures(bits(accepted), step) | note_falls(accepted, step);
    row(Rows::t) = choose(accepted, step.reached_t, step.t0);
    for (std::size_t i = 0; i < job_.all; ++i) y_[i] = choose(accepted, step.reached_y[i], y_[i]);
  }

  /// Looks at steps as the `StiffnessDetector` of a single run does, with thresholds that find no fewer limited ones.
  /// So many of them may be a stiff problem: single runs find that out.
  void note_stability(const M& accepted, const LaneStep<W>& step) {
    const M now = accepted & multiple_of(row(Rows::steps), StepLook::every);
    if (!any(now)) return;
    const auto weight = weight_of<W>(job_, y_, step.y1);
    const auto probed = stepper_.stability(step, candidate_);
    LaneNorm<W> moved;
    for (std::size_t i = 0; i < job_.n; ++i) moved.add((step.y1[i] - y_[i]) / weight(i));
    const M at_limit = P(nearly * StepLook::near * stepper_.traits.limit) * probed[1] <= probed[0];
    const M limited = now & at_limit & (nearly * moved.value() <= P(StepLook::slow));
    row(Rows::limited) += choose(limited, P(1), P(0));
  }

  /// Notes attempts that fail one after the other, as `DiscontinuityDetector` of a single run sees it. Returns the
  /// lanes in which f jumps: single runs tell where. Most attempts find no lane that is in a series.
  unsigned note_failures(unsigned accepted, const LaneStep<W>& step) {
    unsigned jumping = 0;
    for_each_lane(occupied_ & (~accepted | in_series_), [&](int l) {
      Series& series = series_[l];
      const double t0 = step.t0.lanes()[l], t1 = step.t1.lanes()[l];
      if (!has(accepted, l))
        series.add(t1, step.h.lanes()[l]);
      else if (series.accept(t0, y_->lanes() + l, W, job_.n, t1, from(l), from(l) + job_.n) && jumps(l, t1, step.y1))
        jumping |= one_lane(l);
      in_series_ = series.any() ? in_series_ | one_lane(l) : in_series_ & ~one_lane(l);
    });
    return jumping;
  }
  /// Lanes in a series of failures in which a step is about to be accepted where f may jump.
  [[nodiscard]] unsigned passes_series(unsigned accepted, const LaneStep<W>& step) const {
    unsigned passing = 0;
    for_each_lane(occupied_ & accepted & in_series_, [&](int l) {
      if (series_[l].suspicious(step.t1.lanes()[l] - step.t0.lanes()[l])) passing |= one_lane(l);
    });
    return passing;
  }
  /// Components that fall below 0, as `BelowZero` of a single run sees them. Returns the lanes in which f cannot be
  /// evaluated there.
  unsigned note_falls(const M& accepted, const LaneStep<W>& step) {
    M falls = no_lane<W>();
    for (std::size_t i = 0; i < job_.n; ++i) {
      const P limit = P(0) - absolute(row(rows_.watch + i));
      falls = falls | ((step.y1[i] < limit) & ~(y_[i] < limit));
    }
    unsigned undefined = 0;
    for_each_lane(bits(falls & accepted) & occupied_, [&](int l) {
      const auto attempts = static_cast<std::int64_t>(lane(l)[Rows::steps] + lane(l)[Rows::failed]);
      if (!host_.judge({lane(l), step.t1.lanes()[l], step.y1->lanes() + l, attempts})) undefined |= one_lane(l);
    });
    return undefined;
  }
  bool jumps(int l, double t1, const P* y1) {
    const auto attempts = static_cast<std::int64_t>(lane(l)[Rows::steps] + lane(l)[Rows::failed]);
    return host_.jumps({.trajectory = trajectory_[l],
                        .t0 = series_[l].from_t(),
                        .t1 = t1,
                        .latest = series_[l].latest(),
                        .y0 = from(l),
                        .y1 = y1->lanes() + l,
                        .stride = W,
                        .attempts = attempts},
                       checks_[l]);
  }
  /// The points of a series, (2, n).
  [[nodiscard]] double* from(int l) const { return points_ + static_cast<std::size_t>(l) * Series::points * job_.n; }

  P& row(std::size_t r) { return now_[r]; }
  [[nodiscard]] const P& t_() const { return now_[Rows::t]; }
  [[nodiscard]] M retries() const { return P(0) < now_[Rows::retries]; }

  const Job& job_;
  Host& host_;
  Rows rows_;
  P* now_;  // the rows of the trajectories in lanes; of these
  P *y_, *p_;
  P* candidate_;
  P* ready_;  // the rows of those that are ready to take their places
  LaneMethod<W>& stepper_;
  P* reached_y_;
  double* points_;  // (lanes, 2, n)
  LaneInterpolant<W> between_;
  LaneOutput<W> outputs_;
  LaneInvariant<W> held_;
  EventScan<W> watched_;
  std::int64_t checks_[W]{};
  Series series_[W];
  unsigned occupied_ = 0, defined_ = 0, reached_ = 0, odd_ = 0, cut_ = 0;  // lanes
  unsigned doubted_ = 0, inside_ = 0, jumping_ = 0;                        // why some are odd
  unsigned in_series_ = 0;                                                 // lanes in which attempts have failed
  unsigned attempts_ = 0;
  int prepared_ = 0, ready_count_ = 0;  // trajectories that were made ready, and that have moved on
  std::uint32_t trajectory_[W]{}, ready_trajectory_[W]{};
  int place_[W]{};      // of those that were made ready
  bool empty_ = false;  // there are no more to be made ready
};

// ------------------------------------------------------------------------------------------------- what the host calls

/// Makes the loop and its method for a job, and calls the operation with both.
template <class Method, class Operation>
void with(const Job& job, Host& host, Operation operation) {
  const LaneRows<Method::width> rows(job, host);
  Method method(job, rows, host);
  operation(LaneIntegrator<Method::width>(job, rows, method, host), method);
}
template <class Method>
void run(const Job& job, Host& host) {
  with<Method>(job, host, [](auto&& loop, auto& method) { loop.run(method); });
}
template <class Method>
void go_on(const Job& job, const Suspended& from, Host& host) {
  with<Method>(job, host, [&](auto&& loop, auto& method) { loop.go_on(from, method); });
}

/// `Alone`: with the code for trajectories that have no neighbours.
template <const auto& T, int W, bool Alone>
constexpr Kernel kernel_of_pair() {
  if constexpr (Alone)
    return {T.name, W, run<LanePair<T, W>>, go_on<LanePair<T, 1>>};
  else
    return {T.name, W, run<LanePair<T, W>>, nullptr};
}
template <int W, bool Alone, class Tableaux>
struct KernelTable;
template <int W, bool Alone, const auto&... T>
struct KernelTable<W, Alone, runge_kutta::Tableaux<T...>> {
  // Coefficients of series fill the first cache; their code is no faster in more lanes, and takes longer to compile.
  static constexpr int of_series = native < 4 ? 4 : native;
  using Taylor = LaneTaylor<of_series>;
  static constexpr Kernel kernels[] = {kernel_of_pair<T, W, Alone>()..., {"taylor", of_series, run<Taylor>, nullptr}};
};

template <int W, bool Alone>
constexpr Instructions instructions(std::string_view name) {
  return {name, W, KernelTable<W, Alone, runge_kutta::Pairs>::kernels};
}

}  // namespace invariode::lanes::INVARIODE_LANES
