#pragma once
// A block of trajectories, each in a lane of its own: its own t, h, error, acceptance. The arithmetic, and the order of
// its operations, is that of a single run (methods/runge_kutta_step.hpp, integrate.cpp), so that each lane has its
// bits. Whatever a lane meets that is rare (something not finite, a step at hmin) is left to that code, from the start.
// (INVARIODE_LANES: see pack.hpp.)

#include <array>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "aim.hpp"
#include "methods/runge_kutta.hpp"
#include "methods/runge_kutta_kernel.hpp"
#include "run/lanes/held.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/outputs.hpp"
#include "run/lanes/pack.hpp"
#include "run/lanes/power.hpp"
#include "run/lanes/watched.hpp"

namespace invariode::lanes::INVARIODE_LANES {

// Of `StiffnessDetector`: |h λ| near the limit, what a limited step changes, with room for roundoff; how many there are
// before anything is said.
inline constexpr double at_least = 0.499, at_most = 0.101, limited_looks = 10;

/// The pair T in W lanes.
template <const auto& T, int W>
class Block {
  using P = Pack<W>;
  using M = Mask<W>;
  using Kernel = runge_kutta::Kernel<T, P>;
  using Series = FailedSeries<P>;
  static constexpr std::size_t last = T.stages - 1;
  static constexpr unsigned every_lane = one_lane(W) - 1;
  // With fewer trajectories than this in a block they are faster one at a time (benchmarks/lanes.py).
  static constexpr int too_few = W / 8 + 1;
  static constexpr unsigned patience = 64;  // attempts from one look at `cancelled` to the next

 public:
  /// How many packs a block needs, and their size.
  static std::size_t memory(const Job& job) {
    return sizeof(P) * (own_memory(job) + Held<W>::memory(job) + Between<W>::memory(job, extension) +
                        Outputs<W>::memory(job) + Watched<W>::memory(job));
  }

  Block(const Job& job, Host& host, void* memory)
      : Block(job, host, memory, static_cast<P*>(memory) + own_memory(job)) {
    auto* next = static_cast<P*>(memory);
    const auto take = [&next](std::size_t rows) { return std::exchange(next, next + rows); };
    for (std::size_t k = 0; k < (job.looks_inside() ? T.all_stages : T.stages); ++k) k_[k] = take(job.n);
    y_ = take(job.n);
    stage_ = take(job.n);
    candidate_ = take(job.n);
    p_ = take(job.parameters);
    ready_y_ = take(job.n);
    ready_k_ = take(job.n);
    ready_p_ = take(job.parameters);
    points_ = take(Series::points * job.n)->lanes();
    reached_y_ = take(job.n);
  }

  /// Until there is nothing left to take.
  void run() {
    if constexpr (W > 1) {
      unsigned attempts = 0;
      for (unsigned free = every_lane;;) {
        fill(free);
        if (empty_ && count(occupied_) < too_few) break;
        if (++attempts % patience == 0 && host_.cancelled()) return;
        attempt();
        free = settle();
      }
      for (int l = 0; l < W; ++l)
        if (has(occupied_, l)) host_.go_on(suspended(l));
    }
  }

  /// One trajectory, in lane 0, to its end.
  void go_on(const Suspended& from) {
    trajectory_[0] = from.trajectory;
    t_.lanes()[0] = from.t;
    h_.lanes()[0] = from.h;
    retries_ = to_mask<W>(from.retries ? 1 : 0);
    steps_.lanes()[0] = from.steps;
    limited_.lanes()[0] = from.limited;
    failed_.lanes()[0] = from.failed;
    for (std::size_t i = 0; i < job_.n; ++i) {
      y_[i].lanes()[0] = from.y[i * from.stride];
      k_[0][i].lanes()[0] = from.k[i * from.stride];
    }
    for (std::size_t i = 0; i < job_.parameters; ++i) p_[i].lanes()[0] = from.p[i * from.stride];
    if (holds()) held_.go_on(from);
    if (watches()) watched_.go_on(from);
    if (job_.output_at_times()) outputs_.go_on(0, from.trajectory, from.output);
    looked_.lanes()[0] = from.looked;
    checks_[0] = from.checks;
    series_[0].go_on(from.series);
    in_series_ = series_[0].any() ? 1 : 0;
    for (std::size_t i = 0; i < job_.n; ++i) {
      this->from(0)[i] = from.from[i];
      latest(0)[i] = from.latest[i];
    }
    occupied_ = 1;
    unsigned attempts = 0;
    while (occupied_ != 0) {
      if (++attempts % patience == 0 && host_.cancelled()) return;
      attempt();
      settle();
    }
  }

 private:
  static constexpr Extension extension{T.all_stages, T.degree, T.B.front().data()};
  static constexpr std::size_t extra = T.all_stages - T.stages;
  static std::size_t own_memory(const Job& job) {
    return job.n * ((job.looks_inside() ? T.all_stages : T.stages) + 6 + Series::points) + 2 * job.parameters;
  }
  Block(const Job& job, Host& host, void* /*own*/, P* further)
      : outputs_(job, host, std::exchange(further, further + Outputs<W>::memory(job))),
        held_(job, std::exchange(further, further + Held<W>::memory(job))),
        job_(job),
        host_(host),
        between_(job, extension, std::exchange(further, further + Between<W>::memory(job, extension))),
        watched_(job, further),
        beside_(job.invariant != nullptr || job.looks_inside() || job.max_steps < infinity) {}

  [[nodiscard]] bool holds() const { return job_.invariant != nullptr; }
  [[nodiscard]] bool watches() const { return job_.count_of_events > 0; }
  static int count(unsigned set) {
    int n = 0;
    for (; set != 0; set &= set - 1) ++n;
    return n;
  }

  // ------------------------------------------------------------------------------------------- trajectories come and
  // go

  /// Puts trajectories into lanes that have none, as long as there are any.
  void fill(unsigned free) {
    for (int l = 0; l < W; ++l) {
      if (!has(free, l)) continue;
      while (ready_ == prepared_ && prepare()) {
      }
      if (ready_ == prepared_) return keep_defined();
      adopt(l, ready_++);
    }
  }

  /// f is asked in lanes that are not occupied, too: those that never were get the state of one that is.
  void keep_defined() {
    if (defined_ == every_lane || occupied_ == 0) return;
    int from = 0;
    while (!has(occupied_, from)) ++from;
    for (int l = 0; l < W; ++l) {
      if (has(defined_, l)) continue;
      t_.lanes()[l] = t_.lanes()[from];
      h_.lanes()[l] = h_.lanes()[from];
      for (std::size_t i = 0; i < job_.n; ++i) {
        y_[i].lanes()[l] = y_[i].lanes()[from];
        k_[0][i].lanes()[l] = k_[0][i].lanes()[from];
      }
      for (std::size_t i = 0; i < job_.parameters; ++i) p_[i].lanes()[l] = p_[i].lanes()[from];
      if (holds()) held_.copy(l, from);
      if (watches()) watched_.copy(l, from);
    }
    defined_ = every_lane;
  }

  /// f at the start of W more trajectories, and their first steps. False: there are no more.
  bool prepare() {
    if (empty_) return false;
    prepared_ = ready_ = 0;
    while (prepared_ < W && host_.take(ready_trajectory_[prepared_])) load(prepared_++);
    empty_ = prepared_ < W;
    if (prepared_ == 0) return false;
    for (int l = prepared_; l < W; ++l) {  // f is asked in all lanes
      ready_trajectory_[l] = ready_trajectory_[prepared_ - 1];
      load(l);
    }
    const P t0(job_.t0);
    evaluate(job_.f, t0, ready_y_, ready_k_, ready_p_);
    start(t0);
    return true;
  }

  /// The initial value and the parameters of a trajectory that is to be made ready.
  void load(int lane) {
    const double* y0 = job_.y0 + ready_trajectory_[lane] * job_.n;
    const double* row = job_.rows + ready_trajectory_[lane] * job_.parameters;
    for (std::size_t i = 0; i < job_.n; ++i) ready_y_[i].lanes()[lane] = y0[i];
    for (std::size_t i = 0; i < job_.parameters; ++i) ready_p_[i].lanes()[lane] = row[i];
  }

  /// |h| of the first steps, as `Pair::start` and `Step::first_h` choose it; and which of them are left alone.
  void start(const P& t0) {
    LaneNorm<W> norm;
    for (std::size_t i = 0; i < job_.n; ++i) norm.add(ready_k_[i] / weight(i, absolute(ready_y_[i])));
    const P reciprocal = norm.value() / P(runge_kutta::safety * std::pow(job_.rtol, 1.0 / T.order));
    const P longest = smaller(P(job_.hmax), absolute(P(job_.tf) - t0));
    const P h = choose(P(1) < longest * reciprocal, P(1) / reciprocal, longest);
    ready_h_ = job_.first_step > 0 ? P(job_.first_step) : larger(h, smallest_step(t0));
    const M odd = ~(norm.value() < P(infinity));
    const unsigned undefined = bits(odd);
    unsigned doubted = 0, inside = 0;
    if (holds()) doubted = bits(held_.start(t0, ready_y_, ready_k_, job_.forward() * ready_h_, ready_p_));
    if (watches()) inside = bits(watched_.start(t0, ready_y_, ready_p_));
    const unsigned bad = undefined | doubted | inside;
    int kept = 0;
    for (int l = 0; l < prepared_; ++l) {
      if (has(bad, l))
        host_.leave(ready_trajectory_[l], has(undefined, l) ? Why::undefined
                                          : has(doubted, l) ? Why::invariant
                                                            : Why::inside);
      else
        place_[kept++] = l;
    }
    prepared_ = kept;
  }

  /// The trajectory that was made ready as number `number` moves into the lane.
  void adopt(int lane, int number) {
    const int from = place_[number];
    trajectory_[lane] = ready_trajectory_[from];
    t_.lanes()[lane] = job_.t0;
    h_.lanes()[lane] = ready_h_.lanes()[from];
    retries_.lanes()[lane] = 0;
    steps_.lanes()[lane] = failed_.lanes()[lane] = limited_.lanes()[lane] = 0;
    checks_[lane] = 0;
    series_[lane].forget();
    in_series_ &= ~one_lane(lane);
    for (std::size_t i = 0; i < job_.n; ++i) {
      y_[i].lanes()[lane] = ready_y_[i].lanes()[from];
      k_[0][i].lanes()[lane] = ready_k_[i].lanes()[from];
    }
    for (std::size_t i = 0; i < job_.parameters; ++i) p_[i].lanes()[lane] = ready_p_[i].lanes()[from];
    if (holds()) held_.adopt(lane, from);
    if (watches()) watched_.adopt(lane, from);
    looked_.lanes()[lane] = 0;
    if (job_.output_at_times()) outputs_.adopt(lane, trajectory_[lane], ready_y_->lanes() + from);
    occupied_ |= one_lane(lane);
    defined_ |= one_lane(lane);
  }

  /// Hands back what has ended. Returns the lanes that are free.
  unsigned settle() {
    const unsigned ended = reached_ & occupied_, odd = odd_ & occupied_;
    if ((ended | odd) == 0) return 0;
    if (holds() && ended != 0) held_.measure(to_mask<W>(ended), t_, y_, p_);
    for (int l = 0; l < W; ++l) {
      if (has(ended | odd, l)) outputs_.leave(l);
      if (has(odd, l))
        host_.leave(trajectory_[l], why(l));
      else if (has(ended, l))
        host_.keep(at_end(l));
    }
    occupied_ &= ~(ended | odd);
    return every_lane & ~occupied_;
  }

  /// It is left after the last attempt.
  [[nodiscard]] Why why(int lane) const {
    if (has(doubted_, lane)) return Why::invariant;
    if (has(inside_, lane)) return Why::inside;
    if (has(jumping_, lane)) return Why::jump;
    if (limited_.lanes()[lane] >= limited_looks) return Why::stability;
    return steps_.lanes()[lane] >= job_.max_steps ? Why::limit : Why::undefined;
  }

  [[nodiscard]] Ended at_end(int lane) const {
    const double steps = steps_.lanes()[lane];
    return {.trajectory = trajectory_[lane],
            .t = t_.lanes()[lane],
            .by_event = has(cut_, lane),
            .y = y_[0].lanes() + lane,
            .stride = W,
            .steps = static_cast<std::int64_t>(steps),
            .failed = static_cast<std::int64_t>(failed_.lanes()[lane]),
            .evaluations = evaluations(lane),
            .checks = checks_[lane],
            .held = holds() ? held_.ended(lane) : HeldToEnd{}};
  }

  /// Of f: at the start, then in each attempt those of all stages but the first; the last one only in accepted steps
  /// where it has no part in the error estimate; and those of the extension in steps that were looked into.
  [[nodiscard]] std::int64_t evaluations(int lane) const {
    const auto steps = static_cast<std::int64_t>(steps_.lanes()[lane]);
    const auto attempts = steps + static_cast<std::int64_t>(failed_.lanes()[lane]);
    constexpr auto all = static_cast<std::int64_t>(last);
    const auto inside = static_cast<std::int64_t>(looked_.lanes()[lane]) * static_cast<std::int64_t>(extra);
    return 1 + inside + (T.last_in_error() ? attempts * all : attempts * (all - 1) + steps);
  }

  [[nodiscard]] Suspended suspended(int lane) const {
    return {.trajectory = trajectory_[lane],
            .t = t_.lanes()[lane],
            .h = h_.lanes()[lane],
            .retries = retries_.lanes()[lane] != 0,
            .steps = steps_.lanes()[lane],
            .failed = failed_.lanes()[lane],
            .limited = limited_.lanes()[lane],
            .y = y_[0].lanes() + lane,
            .k = k_[0][0].lanes() + lane,
            .p = job_.parameters > 0 ? p_[0].lanes() + lane : nullptr,
            .held = holds() ? held_.suspended(lane) : nullptr,
            .watched = watches() ? watched_.suspended(lane) : nullptr,
            .stride = W,
            .looked = looked_.lanes()[lane],
            .output = outputs_.number(lane),
            .checks = checks_[lane],
            .series = series_[lane].memory(),
            .from = from(lane),
            .latest = latest(lane)};
  }

  // ---------------------------------------------------------------------------------------------------------- a step

  /// One attempt in each lane, from which those that are accepted go on.
  void attempt() {
    const P rest = P(job_.tf) - t_;
    const P hmin = smallest_step(t_), size = larger(hmin, smaller(P(job_.hmax), h_));
    const M landing = (absolute(rest) <= stretch * size) & ~retries_;
    const P h = choose(landing, rest, job_.forward() * size), t1 = choose(landing, P(job_.tf), t_ + h);
    const P purified = t1 - t_, length = absolute(h);

    M odd = no_lane<W>();
    inner_stages(h, odd, std::make_index_sequence<last - 1>{});
    Kernel::candidate(y_, purified, k_, job_.n, candidate_);
    odd = odd | mend(candidate_, y_, job_.n);
    if constexpr (T.last_in_error()) evaluate(job_.f, t1, candidate_, k_[last], p_);
    const P error = absolute(purified) * Kernel::template error<LaneNorm<W>>(k_, job_.n, [this](std::size_t i) {
                      return weight(i, larger(absolute(y_[i]), absolute(candidate_[i])));
                    });
    odd = odd | ~(error < P(infinity));
    M accepted = (error <= P(job_.rtol)) & ~odd;
    if (beside_) return decide({t_, t1, t1, y_, candidate_, p_, candidate_}, {accepted, odd, landing}, h, error, hmin);
    if constexpr (!T.last_in_error()) {
      evaluate(job_.f, t1, candidate_, k_[last], p_);
      const M undefined = accepted & not_finite(k_[last], job_.n);
      odd = odd | undefined;
      accepted = accepted & ~undefined;
    }
    control(accepted, error, length, hmin);
    note_stability(accepted, purified, candidate_);
    jumping_ = note_failures(bits(accepted), h, t1, candidate_);
    commit(accepted, t1, candidate_);
    odd_ = jumping_ | bits(odd | (~accepted & (length <= hmin)) | (P(limited_looks) <= limited_));
    reached_ = bits(accepted & landing);
  }

  /// What an attempt has come to so far.
  struct Verdicts {
    M accepted, odd, landing;
  };

  /// The rest of an attempt of signed size h, from the candidates on, where runs have something beside f.
  INVARIODE_SHARED void decide(LaneStep<W> step, Verdicts verdicts, const P& h, const P& error, const P& hmin) {
    auto& [accepted, odd, landing] = verdicts;
    const P purified = step.t1 - step.t0, length = absolute(h);
    M doubted = no_lane<W>(), inside = no_lane<W>();
    if (holds() && bits(accepted) != 0) {
      doubted = held_.project(accepted, step.t1, y_, candidate_, p_);
      accepted = accepted & ~doubted;
      step.y1 = step.reached_y = held_.projected();
    }
    if constexpr (!T.last_in_error()) {
      evaluate(job_.f, step.t1, step.y1, k_[last], p_);
      const M undefined = accepted & not_finite(k_[last], job_.n);
      odd = odd | undefined;
      accepted = accepted & ~undefined;
    }
    if (holds() && bits(accepted) != 0) doubted = doubted | judge(accepted, purified, h, step.t1);
    accepted = accepted & ~doubted;
    cut_ = 0;
    if (job_.looks_inside() && bits(accepted) != 0) inside = look_inside(accepted, h, purified, step);
    control(accepted, error, length, hmin);
    note_stability(accepted, purified, step.y1);
    jumping_ = note_failures(bits(accepted), h, step.t1, step.y1);
    commit(accepted, step.reached_t, step.reached_y);
    doubted_ = bits(doubted);
    inside_ = bits(inside);
    reached_ = bits(accepted & landing) | cut_;
    odd_ = jumping_ | bits(odd | doubted | inside | (~accepted & (length <= hmin)) | (P(limited_looks) <= limited_));
    odd_ |= bits(P(job_.max_steps) <= steps_) & ~reached_;
  }

  /// Whether steps that are about to be accepted speak against the invariant.
  M judge(const M& accepted, const P& purified, const P& h, const P& t1) {
    const M noted = held_.to_be_noted(accepted, steps_);
    if (bits(noted) != 0) {
      Kernel::errors(purified, k_, job_.n, stage_);
      held_.note_harm(noted, stage_, candidate_);
    }
    return held_.judge(accepted, t1, h, k_[last], steps_ + P(1), p_);
  }

  /// The events and the outputs of steps of size h that are about to be accepted. Returns those where these are odd.
  INVARIODE_SHARED M look_inside(const M& accepted, const P& h, const P& purified, LaneStep<W>& step) {
    const M inside = watches() ? accepted : outputs_.inside(outputs_.due(accepted, step.t1), step.t1);
    M odd = no_lane<W>();
    if (bits(inside) != 0) {
      if constexpr (extra > 0) odd = inside & further_stages(purified, step);
      between_.take(step, purified, k_.data());
      looked_ += choose(inside, P(1), P(0));
    }
    if (holds()) held_.look_inside(accepted, inside, step);
    if (watches()) odd = odd | find_events(accepted & ~odd, h, step);
    const M due = outputs_.due(accepted & ~odd, step.reached_t);
    return bits(due) != 0 ? odd | outputs_.put_out(due, step, between_, holds() ? &held_ : nullptr) : odd;
  }

  /// A terminal event cuts the step. Returns the lanes where something is odd.
  M find_events(const M& accepted, const P& h, LaneStep<W>& step) {
    M odd = no_lane<W>();
    unsigned crossing = bits(watched_.scan(accepted, step, between_, odd)) & occupied_;
    for (int l = 0; crossing != 0 && l < W; ++l) {
      if (!has(crossing, l)) continue;
      const Found found = host_.search({.trajectory = trajectory_[l],
                                        .t0 = step.t0.lanes()[l],
                                        .t1 = step.t1.lanes()[l],
                                        .h = h.lanes()[l],
                                        .y0 = y_->lanes() + l,
                                        .k = k_[0]->lanes() + l,
                                        .y1 = step.y1->lanes() + l,
                                        .watched = watched_.state(l),
                                        .stride = W});
      if (!found.sound) odd = odd | to_mask<W>(one_lane(l));
      if (holds()) held_.count_search(l, found);
      if (found.terminal) cut(l, found, step);
    }
    return odd;
  }

  /// The trajectory ends in the step.
  void cut(int lane, const Found& found, LaneStep<W>& step) {
    if (cut_ == 0)
      for (std::size_t i = 0; i < job_.n; ++i) reached_y_[i] = step.y1[i];
    cut_ |= one_lane(lane);
    step.reached_t.lanes()[lane] = found.t;
    for (std::size_t i = 0; i < job_.n; ++i) reached_y_[i].lanes()[lane] = found.y[i];
    step.reached_y = reached_y_;
  }

  /// Those of the extension, as `Pair::extension` evaluates them. Returns where they are not sound.
  M further_stages(const P& h, const LaneStep<W>& step) {
    P largest(0);
    for (std::size_t k = 0; k < T.stages; ++k) largest = larger(largest, size_of_stage(k, step));
    M odd = no_lane<W>();
    for (std::size_t k = T.stages; k < T.all_stages; ++k) {
      Kernel::extension_argument(k, step.y0, h, k_, job_.n, stage_);
      odd = odd | mend(stage_, step.y0, job_.n);
      evaluate(job_.f, step.t1 - (1 - T.c[k]) * h, stage_, k_[k], p_);
      odd = odd | ~(size_of_stage(k, step) <= runge_kutta::largest_slope * largest);
    }
    return odd;
  }
  [[nodiscard]] P size_of_stage(std::size_t k, const LaneStep<W>& step) const {
    LaneNorm<W> norm;
    for (std::size_t i = 0; i < job_.n; ++i)
      norm.add(k_[k][i] / weight(i, larger(absolute(step.y0[i]), absolute(step.y1[i]))));
    return norm.value();
  }

  /// |h| of the next attempt, as `Pair::accept` and `Pair::reject` choose it; and the counts.
  INVARIODE_SHARED void control(const M& accepted, const P& error, const P& length, const P& hmin) {
    const P rtol(job_.rtol), safety(runge_kutta::safety), most(runge_kutta::largest_growth);
    const P ratio = choose(accepted, error, rtol) / choose(accepted, rtol, error);
    const P root = root_by_pow<T.order>(larger(P(smallest_ratio), ratio));
    const P tau = root / safety;
    const P grown = choose(P(1 / runge_kutta::largest_growth) < tau, length / tau, length * most);
    const P factor = choose(retries_, P(0.5), larger(P(T.floor), safety * root));
    const P cut = larger(hmin, length * factor);
    h_ = choose(accepted, choose(retries_, length, grown), cut);
    steps_ += choose(accepted, P(1), P(0));
    failed_ += choose(accepted, P(0), P(1));
    retries_ = ~accepted;
  }

  /// Looks at one step in 64 of each lane, as the `StiffnessDetector` of a single run does, with thresholds that find
  /// no fewer limited steps. So many of them may be a stiff problem: single runs find that out.
  INVARIODE_SHARED void note_stability(const M& accepted, const P& purified, const P* y1) {
    const M now = accepted & multiple_of(steps_, 64);
    if (bits(now) == 0) return;
    LaneNorm<W> slopes, arguments, changes;
    for (std::size_t i = 0; i < job_.n; ++i) {
      const P w = weight(i, larger(absolute(y_[i]), absolute(y1[i])));
      auto [slope, argument] = Kernel::probed(k_, i);
      if constexpr (!T.last_in_error())  // the last slope is that at y₁
        argument += (y1[i] - candidate_[i]) / purified;
      slopes.add(slope / w);
      arguments.add(argument / w);
      changes.add((y1[i] - y_[i]) / w);
    }
    const M at_limit = P(at_least * job_.real_limit) * arguments.value() <= slopes.value();
    const M limited = now & at_limit & (changes.value() <= P(at_most));
    limited_ += choose(limited, P(1), P(0));
  }

  /// Where attempts fail one after the other, as `DiscontinuityDetector` of a single run sees it. Returns the lanes in
  /// which f jumps: single runs tell where. Most attempts find no lane that is in a series.
  unsigned note_failures(unsigned accepted, const P& h, const P& t1, const P* y1) {
    const unsigned watched = occupied_ & (~accepted | in_series_);
    unsigned jumping = 0;
    for (unsigned rest = watched; rest != 0; rest &= rest - 1) {
      const int l = std::countr_zero(rest);
      Series& series = series_[l];
      const double t0 = t_.lanes()[l], end = t1.lanes()[l];
      if (!has(accepted, l))
        series.add(end, h.lanes()[l]);
      else if (series.accept(t0, y_[0].lanes() + l, W, job_.n, end, from(l), latest(l)) && jumps(l, end, y1))
        jumping |= one_lane(l);
      in_series_ = series.any() ? in_series_ | one_lane(l) : in_series_ & ~one_lane(l);
    }
    return jumping;
  }
  bool jumps(int lane, double t1, const P* y1) {
    const auto attempts = static_cast<std::int64_t>(steps_.lanes()[lane] + failed_.lanes()[lane]);
    const Suspicion suspicion{.trajectory = trajectory_[lane],
                              .t0 = series_[lane].from_t(),
                              .t1 = t1,
                              .latest = series_[lane].latest(),
                              .y0 = from(lane),
                              .y1 = y1[0].lanes() + lane,
                              .stride = W,
                              .attempts = attempts};
    return host_.jumps(suspicion, checks_[lane]);
  }
  /// The points of a series, (n,).
  [[nodiscard]] double* from(int lane) const {
    return points_ + static_cast<std::size_t>(lane) * Series::points * job_.n;
  }
  [[nodiscard]] double* latest(int lane) const { return from(lane) + job_.n; }

  void commit(const M& accepted, const P& t1, const P* y1) {
    t_ = choose(accepted, t1, t_);
    for (std::size_t i = 0; i < job_.n; ++i) {
      y_[i] = choose(accepted, y1[i], y_[i]);
      k_[0][i] = choose(accepted, k_[last][i], k_[0][i]);
    }
  }

  template <std::size_t... I>
  void inner_stages(const P& h, M& odd, std::index_sequence<I...>) {
    (stage<I + 1>(h, odd), ...);
  }
  template <std::size_t I>
  void stage(const P& h, M& odd) {
    Kernel::template argument<I>(y_, h, k_, job_.n, stage_);
    odd = odd | mend(stage_, y_, job_.n);
    evaluate(job_.f, t_ + T.c[I] * h, stage_, k_[I], p_);
  }

  [[nodiscard]] P weight(std::size_t i, const P& size) const { return lanes::INVARIODE_LANES::weight(job_, i, size); }
  static P smallest_step(const P& t) {
    const P size = absolute(t);
    return hmin_ulps * (next(size) - size);
  }

  P t_{0}, h_{0}, steps_{0}, failed_{0};
  P looked_{0};   // steps that were looked into
  P limited_{0};  // looks at steps that stability limits
  P ready_h_{0};  // of those that are ready to take the place of such as end
  Outputs<W> outputs_;
  Held<W> held_;
  M retries_ = to_mask<W>(0);
  const Job& job_;
  Host& host_;
  P *y_, *stage_, *candidate_, *p_;
  P *ready_y_, *ready_k_, *ready_p_, *reached_y_;
  double* points_;               // (lanes, 2, n)
  typename Kernel::Stages k_{};  // NOLINT(readability-redundant-typename): clang 14 asks for it
  Between<W> between_;
  Watched<W> watched_;
  std::int64_t checks_[W]{};
  Series series_[W];
  unsigned occupied_ = 0, defined_ = 0, reached_ = 0, odd_ = 0, cut_ = 0;  // lanes
  unsigned doubted_ = 0, inside_ = 0, jumping_ = 0;                        // why some are odd
  unsigned in_series_ = 0;                                                 // lanes in which attempts have failed
  int prepared_ = 0, ready_ = 0;
  std::uint32_t trajectory_[W]{};
  std::uint32_t ready_trajectory_[W]{};
  int place_[W]{};
  bool beside_;         // runs have something beside f
  bool empty_ = false;  // there are no more to be made ready
};

// ------------------------------------------------------------------------------------------------- what the host calls

template <const auto& T, int W>
void run(const Job& job, Host& host, void* memory) {
  Block<T, W>(job, host, memory).run();
}
template <const auto& T, int W>
void go_on(const Job& job, const Suspended& from, Host& host, void* memory) {
  Block<T, W>(job, host, memory).go_on(from);
}

/// `Alone`: with the code for trajectories that have no neighbours.
template <int W, bool Alone, const auto&... T>
constexpr std::array<Pair, sizeof...(T)> kernels(runge_kutta::Tableaux<T...>) {
  if constexpr (Alone)
    return {{{T.name, Block<T, W>::memory, run<T, W>, go_on<T, 1>}...}};
  else
    return {{{T.name, Block<T, W>::memory, run<T, W>, nullptr}...}};
}

}  // namespace invariode::lanes::INVARIODE_LANES
