#pragma once
// One step by Taylor series in all lanes at once: the memory of methods/taylor.hpp without conditions of f, and its
// operations. (INVARIODE_LANES: see pack.hpp.)

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>

#include "aim.hpp"
#include "compensated.hpp"
#include "methods/initial_step.hpp"
#include "methods/taylor_kernel.hpp"
#include "output/polynomial.hpp"
#include "run/lanes/lane_method.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// Taylor series in W lanes. Its rows are the unit of the expansion at the point reached, and the remainder of y.
/// Where coefficients are not finite the step is odd: single runs choose another unit.
template <int W>
class LaneTaylor final : public LaneMethod<W> {
  using P = Pack<W>;
  using M = Mask<W>;

 public:
  static constexpr bool may_miss_jumps = false;

  /// One lane is enough: series in a whole register take no longer than one alone.
  LaneTaylor(const Job& job, const LaneRows<W>& rows, Host& host)
      : LaneMethod<W>({job.order, power_series<P>, taylor::real_limits[job.order], 1}),
        job_(job),
        size_((job.order + 1) * job.n),
        exponent_(1.0 / (static_cast<double>(job.order) + 1)),
        factor_(std::exp((std::log(job.rtol) - taylor::margin) / (static_cast<double>(job.order) - 1))),
        now_(rows.now),
        unit_(now_ + rows.layout.memory),
        ready_unit_(rows.ready + rows.layout.memory),
        p_(now_ + rows.layout.parameters),
        current_(take<W>(host, size_)),
        next_(take<W>(host, size_)),
        ready_(take<W>(host, size_)),
        end_slope_(take<W>(host, job.n)),
        f_(take<W>(host, job.n)),
        inverse_weight_(take<W>(host, job.n)),
        lost_(take<W>(host, job.n)),
        slope_(take<W>(host, job.n)) {}

  P start(const P& t0, const P* y, const P* p, M& undefined, M& /*rests*/) override {
    evaluate(job_.f, t0, y, f_, p);
    undefined = not_finite(f_, job_.n);
    const auto weight = weight_of<W>(job_, y, y);
    for (std::size_t i = 0; i < job_.n; ++i) inverse_weight_[i] = P(1) / weight(i);
    const auto first = [&](const P& reciprocal) {
      return taylor::with_exact_square(initial_step(reciprocal, t0, job_.tf, job_.hmax));
    };
    *ready_unit_ = taylor::unit_near(first(taylor::norm(f_, job_.n, inverse_weight_)));
    expand(t0, *ready_unit_, y, ready_, p);
    undefined = undefined | not_finite(last_rows(ready_), 2 * job_.n);
    set_slope(ready_, *ready_unit_);
    return first(P(1) / reach(ready_, *ready_unit_));
  }
  [[nodiscard]] const P* slope_at_start() const override { return slope_; }
  void adopt(int lane, int from) override { copy(current_, lane, ready_, from); }
  void keep_defined(int lane, int from) override { copy(current_, lane, current_, from); }

  P attempt(const LaneStep<W>& at, P* candidate, M& odd) {
    const P *y = now_ + Rows::y, *remainder = unit_ + 1;
    const P size = absolute(at.h), per_unit = P(1) / *unit_;
    length_ = at.purified;
    taylor::evaluate_polynomial(current_, job_.n, job_.order, length_ * per_unit,
                                [&](std::size_t i, const P& rise, const P& slope) {
                                  const auto [value, lost] = two_sum(y[i], rise + remainder[i]);
                                  candidate[i] = value;
                                  lost_[i] = lost;
                                  end_slope_[i] = slope;
                                });
    odd = odd | mend(candidate, y, job_.n);
    const auto weight = weight_of<W>(job_, y, candidate);
    for (std::size_t i = 0; i < job_.n; ++i) inverse_weight_[i] = P(1) / weight(i);
    next_unit_ = taylor::unit_near(choose(P(0) < size, size, P(1)));  // of trajectories that have ended: 0
    const P* end_f = f_;
    P per_end_unit(1);
    if (projects()) {
      evaluate(job_.f, at.t1, candidate, f_, p_);
    } else {
      expand(at.t1, next_unit_, candidate, next_, p_);
      odd = odd | not_finite(last_rows(next_), 2 * job_.n);
      end_f = next_ + job_.n;
      per_end_unit = P(1) / next_unit_;
    }
    LaneNorm<W> error;
    for (std::size_t i = 0; i < job_.n; ++i) {
      slope_[i] = end_f[i] * per_end_unit - end_slope_[i] * per_unit;
      error.add(inverse_weight_[i] * slope_[i]);
    }
    const double tested = job_.rtol < taylor::least_tested ? job_.rtol / taylor::least_tested : 1;
    return exponent_ * size * P(tested) * error.value();
  }

  M finish(const LaneStep<W>& step) {
    M undefined = no_lane<W>();
    if (projects()) {
      expand(step.t1, next_unit_, step.y1, next_, p_);
      undefined = not_finite(last_rows(next_), 2 * job_.n);
    }
    return undefined;
  }
  const P* slope() override {
    set_slope(next_, next_unit_);
    return slope_;
  }

  const P* errors(const P& length) override {
    for (std::size_t i = 0; i < job_.n; ++i) slope_[i] = exponent_ * length * slope_[i];
    return slope_;
  }

  M extend(const LaneStep<W>& step, P* coefficients) override {
    taylor::scale_coefficients(current_, job_.n, job_.order, step.purified / *unit_, coefficients);
    return no_lane<W>();
  }

  std::array<P, 2> stability(const LaneStep<W>& /*step*/, const P* /*candidate*/) override {
    const P before = taylor::norm(current_ + (job_.order - 1) * job_.n, job_.n, inverse_weight_);
    const P last = taylor::norm(current_ + job_.order * job_.n, job_.n, inverse_weight_);
    return {static_cast<double>(job_.order) * (absolute(length_) / *unit_) * last, before};
  }

  P accept(const M& accepted, const LaneStep<W>& step, const P& error, const P& hmin, const M& retries) {
    const P h = next(accepted, step, error, hmin, retries);
    P* remainder = unit_ + 1;
    for (std::size_t i = 0; i < job_.n; ++i) remainder[i] = choose(accepted, lost_[i], remainder[i]);
    if (any(~accepted)) replace(~accepted, next_, current_, size_);
    *unit_ = choose(accepted, next_unit_, *unit_);
    std::swap(current_, next_);
    return h;
  }

  /// Expansions, one in each attempt, and f at the start; with a projection f in each attempt, and expansions in steps.
  [[nodiscard]] std::int64_t evaluations(std::int64_t steps, std::int64_t failed,
                                         std::int64_t /*looked*/) const override {
    return 2 + steps + failed + (projects() ? steps : 0);
  }

 private:
  [[nodiscard]] bool projects() const { return job_.invariant != nullptr; }
  [[nodiscard]] const P* last_rows(const P* c) const { return c + (job_.order - 1) * job_.n; }
  [[nodiscard]] P next(const M& accepted, const LaneStep<W>& step, const P& error, const P& hmin,
                       const M& retries) const {
    const P size = absolute(step.h), longest = choose(retries, size, taylor::largest_growth * size);
    const P grown = taylor::with_exact_square(smaller(reach(next_, next_unit_), longest));
    if (!any(~accepted)) return grown;
    P factor(taylor::halved);
    for_each_lane(bits(~(accepted | retries)), [&](int l) {
      const double root = taylor::safety * std::pow(job_.rtol / error.lanes()[l], exponent_);
      factor.lanes()[l] = taylor::floor_after_failure < root ? root : taylor::floor_after_failure;
    });
    return choose(accepted, grown, larger(hmin, taylor::with_exact_square(size * factor)));
  }
  void copy(P* to, int lane, const P* source, int from) const {
    for (std::size_t r = 0; r < size_; ++r) to[r].lanes()[lane] = source[r].lanes()[from];
  }
  void expand(const P& t, const P& unit, const P* y, P* c, const P* p) const {
    job_.series.function(job_.series.context, t.lanes(), unit.lanes(), y->lanes(), c->lanes(),
                         reinterpret_cast<const double*>(p));
  }
  [[nodiscard]] P reach(const P* c, const P& unit) const {
    return taylor::reach(c, job_.n, job_.order, unit, factor_, inverse_weight_);
  }
  void set_slope(const P* c, const P& unit) {
    for (std::size_t i = 0; i < job_.n; ++i) slope_[i] = c[job_.n + i] / unit;
  }

  const Job& job_;
  std::size_t size_;
  double exponent_, factor_;  // as `Taylor` has them
  P *now_, *unit_, *ready_unit_;
  const P* p_;
  P *current_, *next_, *ready_;  // coefficients (order + 1, n)
  P *end_slope_, *f_, *inverse_weight_, *lost_;
  P* slope_;  // y′ − P′ at the end after an attempt, then y′
  P next_unit_{1}, length_{0};
};

}  // namespace invariode::lanes::INVARIODE_LANES
