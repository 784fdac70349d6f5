#pragma once
// An invariant that is held in all lanes at once: its projection (manifold/projection.hpp) and the tests of its guard
// (manifold/guard.hpp), by their arithmetic (manifold/gradient.hpp). What there asks for a closer look, or for more
// than one correction, is odd here: that trajectory is left to them, from its start. Sensitivities follow onto the
// tangent (sensitivity/tangent.hpp). (INVARIODE_LANES: see pack.hpp.)

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "manifold/gradient.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// Without an invariant it is not asked anything. `now` and `ready`: its rows of the trajectories that are in lanes,
/// and of those that are to be made ready.
template <int W>
class LaneInvariant {
  using P = Pack<W>;
  using M = Mask<W>;

 public:
  LaneInvariant(const Job& job, P* now, P* ready, Host& host)
      : job_(job), rates_(Rows::errors + 2 * job.n), now_(now), ready_(ready) {
    if (job.invariant == nullptr) return;
    for (P** one :
         {&w_, &jacobian_, &row_, &delta_, &point_, &sizes_, &slope_, &kept_jacobian_, &kept_row_, &kept_point_})
      *one = take<W>(host, job.n);
    y1_ = take<W>(host, job.all);
    if (varied() == 0) return;
    for (P** one : {&last_row_, &last_jacobian_}) *one = take<W>(host, job.n);
    for (P** one : {&tangent_, &tangent0_, &tangent1_, &target_}) *one = take<W>(host, varied());
  }

  /// The tangent at the start for the trajectories that are to be made ready, and their sensitivities moved onto it.
  /// Returns the odd ones.
  INVARIODE_SHARED M start_tangent(const P& t, P* y, const P* p) {
    P* rates = ready_ + rates_;
    evaluate(invariant().tangent, t, y, rates, p);
    for (std::size_t j = 0; j < varied() && !invariant().held; ++j) rates[j] = P(0);
    for (std::size_t i = 0; i < job_.n; ++i) w_[i] = weight(job_, i, absolute(y[i]));
    const M odd = linearize(t, y, p);
    return odd | follow(~odd, t, rates, y, y, p);
  }

  /// The tests of the start for the trajectories that are to be made ready: h is signed. Returns the odd ones.
  INVARIODE_SHARED M start(const P& t, const P* y, const P* f, const P& h, const P* p) {
    const P g = this->g(t, y, p);
    held_ = ready_[Rows::value] = invariant().held ? g : P(invariant().value);
    const P of_tangent(varied() > 0 ? 1 : 0);       // at the start
    ready_[Rows::evaluations] = P(2) + of_tangent;  // one before the run
    ready_[Rows::jacobians] = P(1) + of_tangent;
    ready_[Rows::next_look] = P(1);
    for (std::size_t i = 0; i < job_.n; ++i) w_[i] = weight(job_, i, absolute(y[i]));
    const P residual = g - held_;
    M odd = linearize(t, y, p);
    odd = odd | ~(absolute(residual) < P(infinity)) | ~(absolute(residual) <= roundoff());
    if (job_.output_at_times() && job_.times[0] == job_.t0) ready_[Rows::after] = absolute(residual);
    return invariant().tested ? odd | start_tests(t, y, f, h, p) : odd;
  }

  // ----------------------------------------------------------------------------------------------------------- a step

  /// y₁ from the candidates of steps, into `projected`. Returns the odd ones among those that are due.
  INVARIODE_SHARED M project(const M& due, const LaneStep<W>& step) {
    const P* candidate = step.y1;
    for (std::size_t i = 0; i < job_.n; ++i)
      w_[i] = weight(job_, i, larger(absolute(step.y0[i]), absolute(candidate[i])));
    for (std::size_t i = 0; i < job_.all; ++i) y1_[i] = candidate[i];
    held_ = now_[Rows::value];
    norm_ = now_[Rows::norm];
    M odd = no_lane<W>(), doubtful = no_lane<W>(), open = due;
    P evaluations(0), jacobians(0);
    for (int iteration = 0; iteration < invariant().iterations && any(open); ++iteration) {
      evaluations += choose(open, P(1), P(0));
      odd = odd | correct(iteration, step, open, jacobians, doubtful);
      odd = odd | mend(y1_, step.y0, job_.n);
    }
    LaneNorm<W> moved;
    for (std::size_t i = 0; i < job_.n; ++i) {
      moved.add((candidate[i] - y1_[i]) / w_[i]);
      doubtful = doubtful | (candidate[i] * y1_[i] < P(0));
    }
    moved_ = moved.value();
    odd = odd | ~(moved_ <= P(largest_correction * job_.rtol));
    const M sound = due & ~odd;
    now_[Rows::norm] = choose(sound, norm_, now_[Rows::norm]);
    now_[Rows::evaluations] += choose(sound, evaluations, P(0));
    now_[Rows::jacobians] += choose(sound, jacobians, P(0));
    if (any(sound & doubtful)) odd = odd | measure_after(sound & doubtful, step);
    if (varied() > 0) odd = odd | follow(due & ~odd, step.t1, now_ + rates_, step.y0, y1_, step.p);
    return odd & due;
  }
  [[nodiscard]] const P* projected() const { return y1_; }

  /// Returns the steps that `note_harm` is to be told of, after so many before.
  [[nodiscard]] M to_be_noted(const M& due, const P& steps) const {
    return invariant().tested ? due & multiple_of(steps, harm_period) : no_lane<W>();
  }
  /// Notes the estimated errors of the candidates of accepted steps.
  INVARIODE_SHARED void note_harm(const M& noted, const P* error, const P* candidate) {
    P *errors = now_ + Rows::errors, *corrections = errors + job_.n;
    for (std::size_t i = 0; i < job_.n; ++i) {
      errors[i] += choose(noted, absolute(error[i]) / w_[i], P(0));
      corrections[i] += choose(noted, absolute(y1_[i] - candidate[i]) / w_[i], P(0));
    }
  }

  /// After accepted steps, `steps` of them by now, f being the slope at their ends. Returns those that are suspicious.
  INVARIODE_SHARED M judge(const M& due, const LaneStep<W>& step, const P* f, const P& steps) {
    const P correction = moved_ / P(job_.rtol);
    now_[Rows::before] = choose(due, larger(now_[Rows::before], before_), now_[Rows::before]);
    now_[Rows::correction] = choose(due, larger(now_[Rows::correction], correction), now_[Rows::correction]);
    if (!invariant().tested) return no_lane<W>();
    M odd = P(suspicious_correction * job_.rtol) < moved_;
    const M looks = due & (now_[Rows::next_look] <= steps);
    if (any(looks)) odd = odd | changes_with_time(bits(looks), step, steps);
    P drift;
    const M suspicion = due & suspicious(step.h, f, drift);
    const M asked = suspicion & ((now_[Rows::quiet] <= steps) | (much_larger * now_[Rows::acquitted] < drift));
    if (any(asked)) odd = odd | convicted(asked, drift, step, steps);
    return odd & due;
  }

  // ------------------------------------------------------------------------------------------------------- the outputs

  /// Looks into some of the accepted steps: takes g at both ends of these, as `StepInterpolant` asks for it, and the
  /// tangent.
  INVARIODE_SHARED void look_inside(const M& accepted, const M& looked, const LaneStep<W>& step) {
    const M known = P(0) < now_[Rows::known], asked = looked & ~known;
    start_ = now_[Rows::end];
    if (job_.projects && any(asked)) start_ = choose(known, start_, g(step.t0, step.y0, step.p));
    if (job_.projects && any(looked)) {
      now_[Rows::end] = choose(looked, g(step.t1, step.y1, step.p), now_[Rows::end]);
      count(Rows::evaluations, looked, 1);
      count(Rows::evaluations, asked, 1);
      if (varied() > 0) evaluate(invariant().tangent, step.t0, step.y0, tangent0_, step.p);
      if (varied() > 0) evaluate(invariant().tangent, step.t1, step.y1, tangent1_, step.p);
    }
    now_[Rows::known] = choose(accepted, choose(looked, P(1), P(0)), now_[Rows::known]);
  }

  /// Values between the ends of steps, at θ: onto g = (1−θ) g₀ + θ g₁. Returns the odd ones.
  INVARIODE_SHARED M onto(const M& due, const P& t, const P& theta, const LaneStep<W>& step, P* y) {
    const P target = (P(1) - theta) * start_ + theta * now_[Rows::end] - held_;
    const M between = due & (P(0) < theta) & (theta < P(1));
    M odd = no_lane<W>(), open = between;
    for (int iteration = 0; iteration < interpolation_iterations && any(open); ++iteration) {
      const P residual = (g(t, y, step.p) - held_) - target;
      const M fresh = iteration == 0 ? open : open & ~serves(residual);
      odd = odd | (open & ~(absolute(residual) < P(infinity)));
      if (iteration == 0)
        odd = odd | (open & linearize(t, y, step.p));
      else if (any(fresh))
        odd = odd | renew(fresh, t, y, step.p);
      if (varied() > 0) note_linearization(fresh);
      count(Rows::evaluations, open, 1);
      count(Rows::jacobians, fresh, 1);
      distance_ = absolute(residual) / norm_;
      invariode::correction(w_, row_, residual / norm_, job_.n, delta_);
      LaneNorm<W> moved;
      for (std::size_t i = 0; i < job_.n; ++i) {
        moved.add(delta_[i] / w_[i]);
        y[i] = choose(open, y[i] - delta_[i], y[i]);
      }
      odd = odd | (open & mend(y, step.y1, job_.n));
      open = fresh & ~(moved.value() <= P(last_correction));
    }
    if (varied() > 0 && any(between)) odd = odd | follow_between(between & ~odd, t, theta, step, y);
    return odd;
  }

  /// Writes W, g₀ and g₁ of the steps that were looked into.
  INVARIODE_SHARED void complete(P* segment) const {
    for (std::size_t i = 0; i < job_.n; ++i) segment[i] = w_[i];
    segment[job_.n] = start_;
    segment[job_.n + 1] = now_[Rows::end];
  }

  /// Counts the cost of a search for events.
  void count_search(int lane, const Found& found) {
    now_[Rows::evaluations].lanes()[lane] += static_cast<double>(found.evaluations);
    now_[Rows::jacobians].lanes()[lane] += static_cast<double>(found.jacobians);
  }

  /// The residual at outputs, and at the end.
  INVARIODE_SHARED void measure(const M& due, const P& t, const P* y, const P* p) {
    const P residual = absolute(g(t, y, p) - now_[Rows::value]);
    const M larger_or_nan = (now_[Rows::after] < residual) | ~(residual <= residual);
    now_[Rows::after] = choose(due & larger_or_nan, residual, now_[Rows::after]);
  }

 private:
  [[nodiscard]] const Invariant& invariant() const { return *job_.invariant; }
  P g(const P& t, const P* y, const P* p) const {
    P value;
    evaluate(invariant().g, t, y, &value, p);
    return value;
  }
  void count(std::size_t row, const M& where, int many) { now_[row] += choose(where, P(many), P(0)); }
  [[nodiscard]] RowOf<P> gradient() const { return {jacobian_, nullptr, job_.n}; }
  [[nodiscard]] P roundoff() const { return roundoff_of_terms(held_, gradient(), point_); }

  /// ∇g at y, its length in the weights, and the unit vector along it. Returns the lanes without such a vector.
  M linearize(const P& t, const P* y, const P* p) {
    for (std::size_t i = 0; i < job_.n; ++i) point_[i] = y[i];
    evaluate(invariant().jacobian, t, point_, jacobian_, p);
    for (std::size_t i = 0; i < job_.n; ++i) row_[i] = jacobian_[i] * w_[i];
    const P sum = sum_of_squares(row_, job_.n);
    norm_ = square_root(sum);
    const P factor = P(1) / norm_;
    for (std::size_t i = 0; i < job_.n; ++i) row_[i] = row_[i] * factor;
    return ~((P(small_square) < sum) & (sum < P(large_square)));
  }

  // ------------------------------------------------------------------------------------------------ the sensitivities

  [[nodiscard]] std::size_t varied() const { return job_.varied.k; }

  /// Moves the sensitivities of Y, where that is due, to these values of ∇g S_j + g_pj, as `TangentProjector::onto`,
  /// by the latest linearization. Where they are not finite those of `instead` take their place. Returns the odd ones.
  M follow(const M& due, const P& t, const P* values, const P* instead, P* Y, const P* p) {
    M odd = no_lane<W>(), moved = due;
    for (int correction = 0; correction < tangent_iterations && any(moved); ++correction) {
      evaluate(invariant().tangent, t, Y, tangent_, p);
      odd = odd | not_finite(tangent_, varied());
      moved = no_lane<W>();
      for (std::size_t j = 0; j < varied(); ++j)
        moved = moved | approach(due, tangent_[j], values[j], Y + (1 + j) * job_.n);
      if (any(moved)) odd = odd | mend(Y + job_.n, instead + job_.n, job_.all - job_.n);
    }
    return odd & due;
  }
  /// One correction of S_j, where its value is off by more than roundoff. Returns where it was.
  M approach(const M& due, const P& value, const P& target, P* S) {
    const P residual = value - target;
    const P terms = size_of_terms(absolute(value) + absolute(target), gradient(), S);
    const M off = due & (eps * terms < absolute(residual));
    if (!any(off)) return off;
    invariode::correction(w_, row_, residual / norm_, job_.n, delta_);
    for (std::size_t i = 0; i < job_.n; ++i) S[i] = choose(off, S[i] - delta_[i], S[i]);
    return off;
  }
  /// Moves S at θ to T = (1−θ) T₀ + θ T₁, by the linearizations that were noted.
  M follow_between(const M& due, const P& t, const P& theta, const LaneStep<W>& step, P* Y) {
    std::swap(row_, last_row_);
    std::swap(jacobian_, last_jacobian_);
    norm_ = last_norm_;
    for (std::size_t j = 0; j < varied(); ++j) target_[j] = (P(1) - theta) * tangent0_[j] + theta * tangent1_[j];
    return follow(due, t, target_, step.y1, Y, step.p);
  }
  /// Notes the linearization of each point's last correction.
  void note_linearization(const M& where) {
    for (std::size_t i = 0; i < job_.n; ++i) {
      last_row_[i] = choose(where, row_[i], last_row_[i]);
      last_jacobian_[i] = choose(where, jacobian_[i], last_jacobian_[i]);
    }
    last_norm_ = choose(where, norm_, last_norm_);
  }

  /// Corrects `y1_` once in the open lanes, for the last time in lanes in which the former gradient serves.
  M correct(int iteration, const LaneStep<W>& step, M& open, P& jacobians, M& doubtful) {
    const P residual = g(step.t1, y1_, step.p) - held_, length = norm_;
    const M fresh = iteration == 0 ? open : open & ~serves(residual);
    jacobians += choose(fresh, P(1), P(0));
    M odd = open & ~(absolute(residual) < P(infinity));
    if (iteration == 0)
      odd = odd | linearize(step.t1, y1_, step.p);
    else if (any(fresh))
      odd = odd | renew(fresh, step.t1, y1_, step.p);
    const P bent = bend(norm_, length);  // 0 there is no gradient before: infinity
    if (iteration == 0) {
      before_ = absolute(residual);
      doubtful = P(large_residual) * size_of_terms(held_, gradient(), point_) < before_;
    }
    distance_ = absolute(residual) / norm_;
    invariode::correction(w_, row_, residual / norm_, job_.n, delta_);
    const M bends = fresh & (P(slight_bend) < bent) & (P(0) < length);
    if (any(bends)) doubtful = doubtful | (bends & bends_sharply(bent, step.y0, y1_, delta_, job_.n));
    for (std::size_t i = 0; i < job_.n; ++i) y1_[i] = choose(open, y1_[i] - delta_[i], y1_[i]);
    open = fresh;
    return odd;
  }

  /// Returns the lanes in which the gradient of the last correction serves for the next one too, by the rule of
  /// `Projector::correct_again`.
  [[nodiscard]] M serves(const P& residual) const {
    const P distance = absolute(residual) / norm_;
    return P(2) * distance * distance * norm_ <= P(eps) * size_of_terms(held_, gradient(), point_) * distance_;
  }
  /// The linearization at y becomes that of these lanes; the others keep theirs. Returns the odd ones.
  M renew(const M& fresh, const P& t, const P* y, const P* p) {
    std::swap(row_, kept_row_);
    std::swap(jacobian_, kept_jacobian_);
    std::swap(point_, kept_point_);
    const P kept_norm = norm_;
    const M odd = linearize(t, y, p);
    norm_ = choose(fresh, norm_, kept_norm);
    for (std::size_t i = 0; i < job_.n; ++i) {
      row_[i] = choose(fresh, row_[i], kept_row_[i]);
      jacobian_[i] = choose(fresh, jacobian_[i], kept_jacobian_[i]);
      point_[i] = choose(fresh, point_[i], kept_point_[i]);
    }
    return fresh & odd;
  }

  /// Returns whether the corrections have led away from the manifold: `Projector::measure_after`, except for its last
  /// excuse.
  M measure_after(const M& looked_at, const LaneStep<W>& step) {
    const P left = absolute(g(step.t1, y1_, step.p) - held_);
    count(Rows::evaluations, looked_at, 1);
    const double allowed = std::pow(slowest_newton, invariant().iterations);
    return looked_at & ~(left <= larger(allowed * before_, roundoff()));
  }

  /// `Guard::suspect`, of an invariant that does not change with t.
  [[nodiscard]] M suspicious(const P& h, const P* f, P& drift) const {
    const P rate = gradient().dot(f), tolerated = job_.rtol * norm_;
    const P angle = absolute(rate) / (norm_ * weighted_norm(f, w_, job_.n));
    drift = absolute(h * rate) / tolerated;
    return drifts(rate, h, std::abs(job_.tf - job_.t0), tolerated) & (P(suspicious_angle) < angle);
  }

  /// `Guard::acquitted_here`: with f where the linearization is. Those that are not acquitted would have to be
  /// confirmed.
  M convicted(const M& asked, const P& drift, const LaneStep<W>& step, const P& steps) {
    evaluate(job_.f, step.t1, point_, slope_, step.p);
    P drift_here;
    const M odd = not_finite(slope_, job_.n) | suspicious(step.h, slope_, drift_here);
    now_[Rows::quiet] = choose(asked, steps + smaller(steps, P(longest_pause)), now_[Rows::quiet]);
    now_[Rows::acquitted] = choose(asked, drift, now_[Rows::acquitted]);
    count(Rows::checks, asked, 1);
    return asked & odd;
  }

  /// The tests of g_t in `Guard::rate`. (There g_t is evaluated in each step if the invariant depends on t.)
  M changes_with_time(unsigned looking, const LaneStep<W>& made, const P& steps) {
    P increment(0);
    for_each_lane(looking, [&](int l) {
      increment.lanes()[l] = invariant().time_increment(made.t1.lanes()[l], made.h.lanes()[l]);
      const auto step = static_cast<std::int64_t>(steps.lanes()[l]);
      const std::int64_t half = step > 1 ? step / 2 : 1;
      now_[Rows::next_look].lanes()[l] = static_cast<double>(step + (half < longest_pause ? half : longest_pause));
    });
    count(Rows::evaluations, to_mask<W>(looking), 2);
    const P later = g(made.t1 + increment, point_, made.p), earlier = g(made.t1 - increment, point_, made.p);
    const P change = (later - held_) - (earlier - held_);
    return to_mask<W>(looking) & ~(absolute(change) <= roundoffs_of_change * roundoff());
  }

  /// `Guard::start_jacobian` and `Guard::start_rate`, whose linearization at the start has just been taken.
  M start_tests(const P& t, const P* y, const P* f, const P& h, const P* p) {
    const double* direction = invariant().direction;
    take_sizes(y, job_.threshold, job_.n, sizes_);
    const Directional<P> along(gradient(), sizes_, [&](std::size_t j) { return direction[j]; });
    const P noise = roundoff();
    P drift;
    M odd = suspicious(h, f, drift);
    const auto displace = [&](double side) {
      for (std::size_t i = 0; i < job_.n; ++i) point_[i] = y[i] + side * (cbrt_eps * sizes_[i] * P(direction[i]));
      odd = odd | mend(point_, y, job_.n);
    };
    displace(-1);
    const P minus = g(t, point_, p) - held_;
    displace(1);
    const P plus = g(t, point_, p) - held_, later = g(t + h, point_, p) - held_;
    ready_[Rows::evaluations] += P(4);
    return odd | along.contradicted((plus - minus) / P(2 * cbrt_eps), noise, cbrt_eps) | (plus < later) |
           ~(later <= plus);
  }

  const Job& job_;
  std::size_t rates_;  // the first row of what the tangent holds
  P *now_, *ready_;
  P *w_ = nullptr, *jacobian_ = nullptr, *row_ = nullptr, *delta_ = nullptr, *point_ = nullptr, *y1_ = nullptr,
    *sizes_ = nullptr, *slope_ = nullptr, *kept_jacobian_ = nullptr, *kept_row_ = nullptr, *kept_point_ = nullptr;
  P *tangent_ = nullptr, *tangent0_ = nullptr, *tangent1_ = nullptr, *target_ = nullptr;  // (k,), at the ends of steps
  P *last_row_ = nullptr, *last_jacobian_ = nullptr;
  P last_norm_{0};
  P held_{0}, norm_{0}, moved_{0}, before_{0}, start_{0}, distance_{0};  // of the step in work
};

}  // namespace invariode::lanes::INVARIODE_LANES
