#pragma once
// An invariant that is held in all lanes at once: its projection (manifold/projection.hpp) and the tests of its guard
// (manifold/guard.hpp), in the order of their operations. What there asks for a closer look, or for more than one
// correction, is odd here: that trajectory is left to them, from its start. (INVARIODE_LANES: see pack.hpp.)

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <utility>

#include "manifold/thresholds.hpp"
#include "run/lanes/between.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"
#include "weights.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// Without an invariant it has no memory, and is not asked anything.
template <int W>
class Held {
  using P = Pack<W>;
  using M = Mask<W>;
  // What belongs to a trajectory: rows of packs, and behind them the sums of `HarmDetector`, two for each component.
  enum Row : std::size_t {
    value,
    before,
    after,
    correction,
    norm,
    evaluations,
    jacobians,
    checks,
    next_look,
    quiet,
    acquitted,
    end,
    known,
    rows
  };

 public:
  /// How many packs it needs.
  static std::size_t memory(const Job& job) {
    return job.invariant != nullptr ? 2 * size_of_state(job) + 8 * job.n : 0;
  }

  Held(const Job& job, P* next) : job_(job) {
    const auto take = [&next](std::size_t count) { return std::exchange(next, next + count); };
    now_ = take(size_of_state(job));
    ready_ = take(size_of_state(job));
    for (P** one : {&w_, &jacobian_, &row_, &delta_, &point_, &y1_, &sizes_, &slope_}) *one = take(job.n);
  }

  // ------------------------------------------------------------------------------------------- trajectories come and
  // go

  void adopt(int lane, int from) { copy(now_, lane, ready_, from); }
  void copy(int lane, int from) { copy(now_, lane, now_, from); }
  [[nodiscard]] const double* suspended(int lane) const { return now_->lanes() + lane; }
  /// The one trajectory, in lane 0.
  void go_on(const Suspended& from) {
    for (std::size_t i = 0; i < size_of_state(job_); ++i) now_[i].lanes()[0] = from.held[i * from.stride];
  }
  [[nodiscard]] HeldToEnd ended(int lane) const {
    const double* state = now_->lanes() + lane;
    return {.value = state[value * W],
            .before = state[before * W],
            .after = state[after * W],
            .correction = state[correction * W],
            .evaluations = static_cast<std::int64_t>(state[evaluations * W]),
            .checks = static_cast<std::int64_t>(state[checks * W]),
            .jacobians = static_cast<std::int64_t>(state[jacobians * W]),
            .errors = state + rows * W,
            .corrections = state + (rows + job_.n) * W};
  }

  // ---------------------------------------------------------------------------------------------------------- the
  // start

  /// The tests of the start for the trajectories that are to be made ready: h is signed. Returns the odd ones.
  INVARIODE_SHARED M start(const P& t, const P* y, const P* f, const P& h, const P* p) {
    for (std::size_t i = 0; i < size_of_state(job_); ++i) ready_[i] = P(0);
    P g;
    evaluate(invariant().g, t, y, &g, p);
    ready_[value] = invariant().held ? g : P(invariant().value);
    ready_[evaluations] = P(2);  // one before the run
    ready_[jacobians] = ready_[next_look] = P(1);
    for (std::size_t i = 0; i < job_.n; ++i) {
      w_[i] = weight(job_, i, absolute(y[i]));
      point_[i] = y[i];
    }
    const P residual = g - ready_[value];
    M odd = ~(absolute(residual) < P(infinity)) | linearize(t, p);
    odd = odd | ~(absolute(residual) <= roundoff(ready_[value]));
    if (job_.output_at_times() && job_.times[0] == job_.t0) ready_[after] = absolute(residual);
    return invariant().tested ? odd | start_tests(t, y, f, h, p) : odd;
  }

  // ----------------------------------------------------------------------------------------------------------- a step

  /// y₁ from the candidates at t of steps from `from`, into `projected`. Returns the odd ones among those that are due.
  INVARIODE_SHARED M project(const M& due, const P& t, const P* from, const P* candidate, const P* p) {
    for (std::size_t i = 0; i < job_.n; ++i) {
      w_[i] = weight(job_, i, larger(absolute(from[i]), absolute(candidate[i])));
      y1_[i] = candidate[i];
    }
    M odd = no_lane<W>(), doubtful = no_lane<W>();
    norm_ = now_[norm];
    for (int iteration = 0; iteration < invariant().iterations; ++iteration) {
      odd = odd | correct(iteration, t, from, p, doubtful);
      odd = odd | mend(y1_, from, job_.n);
    }
    LaneNorm<W> moved;
    P crossed(1);
    for (std::size_t i = 0; i < job_.n; ++i) {
      moved.add((candidate[i] - y1_[i]) / w_[i]);
      crossed = choose(candidate[i] * y1_[i] < P(0), P(0), crossed);
    }
    moved_ = moved.value();
    odd = odd | ~(moved_ <= P(largest_correction * job_.rtol));
    const M sound = due & ~odd;
    now_[norm] = choose(sound, norm_, now_[norm]);
    now_[evaluations] += choose(sound, P(invariant().iterations), P(0));
    now_[jacobians] += choose(sound, P(invariant().iterations), P(0));
    const M looked_at = sound & (doubtful | (crossed < P(1)));
    if (bits(looked_at) != 0) odd = odd | measure_after(looked_at, t, p);
    return odd & due;
  }
  [[nodiscard]] const P* projected() const { return y1_; }

  /// Which steps `note_harm` is to be told of, after so many before.
  [[nodiscard]] M to_be_noted(const M& due, const P& steps) const {
    return invariant().tested ? due & multiple_of(steps, harm_period) : no_lane<W>();
  }
  /// Of accepted steps: the estimated errors of the candidates.
  INVARIODE_SHARED void note_harm(const M& noted, const P* error, const P* candidate) {
    P *errors = now_ + rows, *corrections = errors + job_.n;
    for (std::size_t i = 0; i < job_.n; ++i) {
      errors[i] += choose(noted, absolute(error[i]) / w_[i], P(0));
      corrections[i] += choose(noted, absolute(y1_[i] - candidate[i]) / w_[i], P(0));
    }
  }

  /// After accepted steps, `steps` of them by now, to t with the signed size h, f being the slope there. Returns those
  /// that are suspicious.
  INVARIODE_SHARED M judge(const M& due, const P& t, const P& h, const P* f, const P& steps, const P* p) {
    note_drift(due);
    if (!invariant().tested) return no_lane<W>();
    M odd = P(suspicious_correction * job_.rtol) < moved_;
    const M looks = due & (now_[next_look] <= steps);
    if (bits(looks) != 0) odd = odd | changes_with_time(bits(looks), t, h, steps, p);
    P drift;
    const M suspicion = due & suspicious(h, f, drift);
    const M asked = suspicion & ((now_[quiet] <= steps) | (much_larger * now_[acquitted] < drift));
    if (bits(asked) != 0) odd = odd | convicted(asked, drift, t, h, steps, p);
    return odd & due;
  }

  // ------------------------------------------------------------------------------------------------------- the outputs

  /// Of accepted steps, some of which are looked into: g at both ends of these, as `StepInterpolant` asks for it.
  INVARIODE_SHARED void look_inside(const M& accepted, const M& looked, const LaneStep<W>& step) {
    P start = now_[end], g;
    const M known_at_start = P(0) < now_[known], asked = looked & ~known_at_start;
    if (job_.projects && bits(asked) != 0) {
      evaluate(invariant().g, step.t0, step.y0, &g, step.p);
      start = choose(known_at_start, start, g);
    }
    start_ = start;
    if (job_.projects && bits(looked) != 0) {
      evaluate(invariant().g, step.t1, step.y1, &g, step.p);
      now_[end] = choose(looked, g, now_[end]);
      now_[evaluations] += choose(looked, P(1), P(0)) + choose(asked, P(1), P(0));
    }
    now_[known] = choose(accepted, choose(looked, P(1), P(0)), now_[known]);
  }

  /// Values between the ends of steps, at θ: onto g = (1−θ) g₀ + θ g₁. Returns the odd ones.
  INVARIODE_SHARED M onto(const M& due, const P& t, const P& theta, const LaneStep<W>& step, P* y) {
    const P target = (P(1) - theta) * start_ + theta * now_[end] - now_[value];
    M odd = no_lane<W>(), open = due & (P(0) < theta) & (theta < P(1));
    for (int iteration = 0; iteration < interpolation_iterations && bits(open) != 0; ++iteration) {
      P g;
      evaluate(invariant().g, t, y, &g, step.p);
      const P residual = (g - now_[value]) - target;
      for (std::size_t i = 0; i < job_.n; ++i) point_[i] = y[i];
      odd = odd | (open & (linearize(t, step.p) | ~(absolute(residual) < P(infinity))));
      now_[evaluations] += choose(open, P(1), P(0));
      now_[jacobians] += choose(open, P(1), P(0));
      const P distance = residual / norm_;
      LaneNorm<W> moved;
      for (std::size_t i = 0; i < job_.n; ++i) {
        const P delta = w_[i] * (row_[i] * distance);
        moved.add(delta / w_[i]);
        y[i] = choose(open, y[i] - delta, y[i]);
      }
      odd = odd | (open & mend(y, step.y1, job_.n));
      open = open & ~(moved.value() <= P(last_correction));
    }
    return odd;
  }

  /// What a search for events has cost.
  void count_search(int lane, const Found& found) {
    now_[evaluations].lanes()[lane] += static_cast<double>(found.evaluations);
    now_[jacobians].lanes()[lane] += static_cast<double>(found.jacobians);
  }

  /// The residual at outputs, and at the end.
  INVARIODE_SHARED void measure(const M& due, const P& t, const P* y, const P* p) {
    P g;
    evaluate(invariant().g, t, y, &g, p);
    const P residual = absolute(g - now_[value]);
    const M larger_or_nan = (now_[after] < residual) | ~(residual <= residual);
    now_[after] = choose(due & larger_or_nan, residual, now_[after]);
  }

 private:
  static std::size_t size_of_state(const Job& job) { return job.invariant != nullptr ? rows + 2 * job.n : 0; }
  [[nodiscard]] const Invariant& invariant() const { return *job_.invariant; }
  void copy(P* to, int lane, const P* source, int from) {
    for (std::size_t i = 0; i < size_of_state(job_); ++i) to[i].lanes()[lane] = source[i].lanes()[from];
  }

  /// ∇g at `point_`, its length in the weights, and the unit vector along it. Returns the lanes without such a vector.
  M linearize(const P& t, const P* p) {
    evaluate(invariant().jacobian, t, point_, jacobian_, p);
    P sum(0);
    for (std::size_t i = 0; i < job_.n; ++i) {
      row_[i] = jacobian_[i] * w_[i];
      sum += row_[i] * row_[i];
    }
    norm_ = square_root(sum);
    const P factor = P(1) / norm_;
    for (std::size_t i = 0; i < job_.n; ++i) row_[i] = row_[i] * factor;
    return ~((P(small_square) < sum) & (sum < P(large_square)));
  }

  /// The size of what g sums at `point_`.
  [[nodiscard]] P terms(const P& held) const {
    P sum = absolute(held);
    for (std::size_t i = 0; i < job_.n; ++i) sum += absolute(jacobian_[i] * point_[i]);
    return sum;
  }
  [[nodiscard]] P roundoff(const P& held) const { return (roundoff_of_g * eps) * terms(held); }

  /// One correction of `y1_`, by y − W u r / ‖∇g W‖ with the unit vector u.
  M correct(int iteration, const P& t, const P* from, const P* p, M& doubtful) {
    P g;
    evaluate(invariant().g, t, y1_, &g, p);
    const P residual = g - now_[value], length = norm_;
    for (std::size_t i = 0; i < job_.n; ++i) point_[i] = y1_[i];
    const M odd = linearize(t, p) | ~(absolute(residual) < P(infinity));
    const P bent = larger(norm_ / length, length / norm_) - P(1);  // 0 there is no gradient before: infinity
    if (iteration == 0) {
      before_ = absolute(residual);
      doubtful = P(large_residual) * terms(now_[value]) < before_;
    }
    const P distance = residual / norm_;
    for (std::size_t i = 0; i < job_.n; ++i) delta_[i] = w_[i] * (row_[i] * distance);
    const M bends = (P(slight_bend) < bent) & (P(0) < length);
    if (bits(bends) != 0) doubtful = doubtful | (bends & bends_sharply(bent, from));
    for (std::size_t i = 0; i < job_.n; ++i) y1_[i] = y1_[i] - delta_[i];
    return odd;
  }

  [[nodiscard]] M bends_sharply(const P& bent, const P* from) const {
    M sharp = P(sharp_bend) < bent;
    for (std::size_t i = 0; i < job_.n; ++i)
      sharp = sharp | (bend_of_correction * absolute(y1_[i] - from[i]) < bent * absolute(delta_[i]));
    return sharp;
  }

  /// Whether the corrections have led away from the manifold: `Projector::measure_after`, but for its last excuse.
  M measure_after(const M& looked_at, const P& t, const P* p) {
    P g;
    evaluate(invariant().g, t, y1_, &g, p);
    now_[evaluations] += choose(looked_at, P(1), P(0));
    const P left = absolute(g - now_[value]);
    const double allowed = std::pow(slowest_newton, invariant().iterations);
    const P most = larger(allowed * before_, roundoff(now_[value]));
    return looked_at & ~(left <= most);
  }

  void note_drift(const M& due) {
    const P rtol(job_.rtol);
    now_[before] = choose(due, larger(now_[before], before_), now_[before]);
    now_[correction] = choose(due, larger(now_[correction], moved_ / rtol), now_[correction]);
  }

  /// `Guard::suspect`, of an invariant that does not change with t.
  [[nodiscard]] M suspicious(const P& h, const P* f, P& drift) const {
    P rate(0), square(0);
    for (std::size_t i = 0; i < job_.n; ++i) {
      rate += jacobian_[i] * f[i];
      square += (f[i] / w_[i]) * (f[i] / w_[i]);
    }
    const P tolerated = job_.rtol * norm_;
    const M drifts = (suspicious_drift * tolerated < absolute(h * rate)) |
                     (harmful_drift * tolerated < absolute(invariant().interval * rate));
    const P angle = absolute(rate) / (norm_ * square_root(square));
    drift = absolute(h * rate) / tolerated;
    return drifts & (P(suspicious_angle) < angle);
  }

  /// `Guard::acquitted_here`: with f where the linearization is. Those that are not acquitted would have to be
  /// confirmed.
  M convicted(const M& asked, const P& drift, const P& t, const P& h, const P& steps, const P* p) {
    evaluate(job_.f, t, point_, slope_, p);
    P drift_here;
    const M odd = not_finite(slope_, job_.n) | suspicious(h, slope_, drift_here);
    now_[quiet] = choose(asked, steps + smaller(steps, P(longest_pause)), now_[quiet]);
    now_[acquitted] = choose(asked, drift, now_[acquitted]);
    now_[checks] += choose(asked, P(1), P(0));
    return asked & odd;
  }

  /// The looks of `Guard::rate` at g_t. (An invariant that changes with t is asked for it in each step there.)
  M changes_with_time(unsigned looking, const P& t, const P& h, const P& steps, const P* p) {
    P increment(0);
    for (int l = 0; l < W; ++l) {
      if (!has(looking, l)) continue;
      increment.lanes()[l] = invariant().time_increment(t.lanes()[l], h.lanes()[l]);
      const auto step = static_cast<std::int64_t>(steps.lanes()[l]);
      const std::int64_t half = step > 1 ? step / 2 : 1;
      now_[next_look].lanes()[l] = static_cast<double>(step + (half < longest_pause ? half : longest_pause));
      now_[evaluations].lanes()[l] += 2;
    }
    P later, earlier;
    evaluate(invariant().g, t + increment, point_, &later, p);
    evaluate(invariant().g, t - increment, point_, &earlier, p);
    const P change = (later - now_[value]) - (earlier - now_[value]);
    return to_mask<W>(looking) & ~(absolute(change) <= 2 * roundoff(now_[value]));
  }

  /// `Guard::start_jacobian` and `Guard::start_rate`, whose linearization at the start has just been taken.
  M start_tests(const P& t, const P* y, const P* f, const P& h, const P* p) {
    take_sizes(y);
    P expected(0), sum(0), plus, minus, later, drift;
    const P noise = roundoff(ready_[value]) / P(invariant().increment);
    M odd = suspicious(h, f, drift);
    const auto displace = [&](double side) {
      for (std::size_t i = 0; i < job_.n; ++i)
        point_[i] = y[i] + side * (invariant().direction[i] * (invariant().increment * sizes_[i]));
      return mend(point_, y, job_.n);
    };
    for (std::size_t i = 0; i < job_.n; ++i) {
      const P term = invariant().direction[i] * (jacobian_[i] * sizes_[i]);
      expected += term;
      sum += absolute(term);
    }
    odd = odd | displace(-1);
    evaluate(invariant().g, t, point_, &minus, p);
    odd = odd | displace(1);
    evaluate(invariant().g, t, point_, &plus, p);
    evaluate(invariant().g, t + h, point_, &later, p);
    const P a = plus - ready_[value], b = minus - ready_[value], c = later - ready_[value];
    const P quotient = (a - b) / P(2 * invariant().increment);
    const P allowed = jacobian_tolerance * larger(sum, absolute(quotient)) + noise;
    odd = odd | (allowed < absolute(quotient - expected)) | ~((a <= c) & (c <= a));
    ready_[evaluations] += P(4);
    return odd;
  }

  /// `Invariants::sizes`
  void take_sizes(const P* y) {
    P largest(0);
    for (std::size_t i = 0; i < job_.n; ++i) largest = larger(largest, absolute(y[i]));
    largest = choose(largest < P(smallest_scale), P(1), largest);
    for (std::size_t i = 0; i < job_.n; ++i) {
      const double thr = job_.threshold[i];
      const P size = absolute(y[i]);
      const P least = thr < smallest_scale ? choose(size < P(smallest_scale), largest, P(0)) : smaller(P(thr), largest);
      sizes_[i] = larger(size, least);
    }
  }

  const Job& job_;
  P *now_, *ready_;  // states
  P *w_, *jacobian_, *row_, *delta_, *point_, *y1_, *sizes_, *slope_;
  P norm_{0}, moved_{0}, before_{0}, start_{0};  // of the step in work
};

}  // namespace invariode::lanes::INVARIODE_LANES
