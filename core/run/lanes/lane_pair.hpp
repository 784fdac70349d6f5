#pragma once
// One step of an explicit Runge-Kutta pair in all lanes at once: the memory of methods/runge_kutta_step.hpp, and its
// operations. (INVARIODE_LANES: see pack.hpp.)

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "aim.hpp"
#include "methods/controller.hpp"
#include "methods/initial_step.hpp"
#include "methods/runge_kutta_kernel.hpp"
#include "output/polynomial.hpp"
#include "run/lanes/lane_method.hpp"
#include "run/lanes/lanes.hpp"
#include "run/lanes/measures.hpp"
#include "run/lanes/pack.hpp"
#include "run/lanes/power.hpp"

namespace invariode::lanes::INVARIODE_LANES {

/// The pair T in W lanes. Its rows are f at the point reached, with the slopes of sensitivities.
template <const auto& T, int W>
class LanePair final : public LaneMethod<W> {
  using P = Pack<W>;
  using M = Mask<W>;
  using Kernel = runge_kutta::Kernel<T, P, LaneNorm<W>>;
  static constexpr std::size_t last = T.stages - 1;

 public:
  LanePair(const Job& job, const LaneRows<W>& rows, Host& host)
      : LaneMethod<W>({T.degree, nested_polynomial<P>, T.real_limit, W / 8 + 1}),
        job_(job),
        y_(rows.now + Rows::y),
        p_(rows.now + rows.layout.parameters),
        thresholds_(rows.now + rows.layout.thresholds),
        ready_thresholds_(rows.ready + rows.layout.thresholds),
        first_(rows.ready + rows.layout.memory),
        trend_(rows.now + rows.layout.memory + job.all),
        stage_(take<W>(host, job.all)),
        slopes_(take<W>(host, job.all * (stages() - 1))) {
    k_[0] = rows.now + rows.layout.memory;
    for (std::size_t k = 1; k < stages(); ++k) k_[k] = slopes_ + (k - 1) * job.all;
  }

  P start(const P& t0, const P* y, const P* p, M& undefined, M& rests) override {
    evaluate_all(t0, y, first_, p);
    first_[job_.all] = runge_kutta::Trend<P>().rate;
    first_[job_.all + 1] = runge_kutta::Trend<P>().growth;
    const P speed = Kernel::size_of_stage(0, {first_}, job_.all, weight(ready_thresholds_, y, y));
    undefined = ~(speed < P(infinity));
    const P reciprocal = speed / P(runge_kutta::safety * std::pow(job_.rtol, T.exponent()));
    rests = ~gives_scale(reciprocal, t0, job_.tf);
    return initial_step(reciprocal, t0, job_.tf, job_.hmax);
  }
  [[nodiscard]] const P* slope_at_start() const override { return first_; }

  P attempt(const LaneStep<W>& at, P* candidate, M& odd) {
    const P t0 = at.t0, h = at.purified;  // which no pointer leads to
    Kernel::inner_stages(t0, y_, h, k_, job_.all, stage_, [&](const P& t, P* y, std::size_t k) {
      odd = odd | mend(y, y_, job_.all);
      evaluate_all(t, y, k_[k], p_);
      return true;
    });
    Kernel::candidate(y_, h, k_, job_.all, candidate);
    odd = odd | mend(candidate, y_, job_.all);
    if constexpr (T.last_in_error()) evaluate_all(at.t1, candidate, k_[last], p_);
    return absolute(h) * Kernel::error(k_, job_.all, weight(thresholds_, y_, candidate));
  }

  /// As `RungeKuttaStep::trust`.
  static constexpr bool may_miss_jumps = true;
  M bends(const LaneStep<W>& step, const P* candidate, const P& error, double nearly) {
    if constexpr (T.watches_bends()) {
      const auto bend = Kernel::bend(k_, job_.all, weight(thresholds_, y_, candidate));
      return Kernel::looks_like_jump(bend, absolute(step.purified), error, job_.rtol, nearly);
    } else {
      return no_lane<W>();
    }
  }

  M finish(const LaneStep<W>& step) {
    if constexpr (T.last_in_error()) return no_lane<W>();
    evaluate_all(step.t1, step.y1, k_[last], p_);
    return not_finite(k_[last], job_.all);
  }
  const P* slope() override { return k_[last]; }

  const P* errors(const P& length) override {
    Kernel::errors(length, k_, job_.all, stage_);
    return stage_;
  }

  /// As `RungeKuttaStep::extension`.
  M extend(const LaneStep<W>& step, P* coefficients) override {
    M odd = no_lane<W>();
    if constexpr (T.all_stages > T.stages) {
      const auto weight = this->weight(thresholds_, step.y0, step.y1);
      const P most = Kernel::largest_of_extension(k_, job_.all, weight);
      Kernel::further_stages(step.t1, y_, step.purified, k_, job_.all, stage_, [&](const P& t, P* y, std::size_t k) {
        odd = odd | mend(y, y_, job_.all);
        evaluate_all(t, y, k_[k], p_);
        odd = odd | ~(Kernel::size_of_stage(k, k_, job_.all, weight) <= most);
        return true;
      });
    }
    Kernel::coefficients(step.purified, k_, job_.all, coefficients + job_.all);
    return odd;
  }

  std::array<P, 2> stability(const LaneStep<W>& step, const P* candidate) override {
    return Kernel::probed(k_, job_.all, step.purified, step.y1, candidate, weight(thresholds_, y_, step.y1));
  }

  P accept(const M& accepted, const LaneStep<W>& step, const P& error, const P& hmin, const M& retries) {
    for (std::size_t i = 0; i < job_.all; ++i) k_[0][i] = choose(accepted, k_[last][i], k_[0][i]);
    const P rtol(job_.rtol), length = absolute(step.h);
    const P ratio = choose(accepted, error, rtol) / choose(accepted, rtol, error);
    const P root = root_by_pow<T.order>(larger(P(runge_kutta::smallest_ratio), ratio));
    runge_kutta::Trend<P> trend{trend_[0], trend_[1]};
    const P next = runge_kutta::next_h<T>(length, root, retries, trend);
    trend_[0] = choose(accepted, trend.rate, trend_[0]);
    trend_[1] = choose(accepted, trend.growth, trend_[1]);
    const P factor = choose(retries, P(runge_kutta::halved), runge_kutta::cut(root, T.floor));
    return choose(accepted, next, larger(hmin, length * factor));
  }

  /// Evaluations of f: at the start, then in each attempt those of all stages but the first; the last one only in
  /// accepted steps where it has no part in the error estimate; and those of the extension in steps that were looked
  /// into.
  [[nodiscard]] std::int64_t evaluations(std::int64_t steps, std::int64_t failed, std::int64_t looked) const override {
    constexpr auto all = static_cast<std::int64_t>(last), extra = static_cast<std::int64_t>(T.all_stages - T.stages);
    return 1 + looked * extra + (steps + failed) * all - (T.last_in_error() ? 0 : failed);
  }

 private:
  [[nodiscard]] std::size_t stages() const { return job_.looks_inside() ? T.all_stages : T.stages; }

  /// f, and the slopes of the sensitivities.
  INVARIODE_EACH void evaluate_all(const P& t, const P* y, P* out, const P* p) const {
    evaluate(job_.f, t, y, out, p);
    if (job_.varied.k > 0) evaluate(job_.varied.slope, t, y, out + job_.n, p);
  }
  /// The weights of a step from y0 to y1, of the state and its sensitivities.
  auto weight(const P* thresholds, const P* y0, const P* y1) const {
    return [this, thresholds, y0, y1](std::size_t i) {
      const P size = larger(absolute(y0[i]), absolute(y1[i]));
      return larger(job_.scale != nullptr ? job_.scale[i] * size : size, thresholds[i]);
    };
  }

  const Job& job_;
  const P *y_, *p_, *thresholds_, *ready_thresholds_;
  P *first_, *trend_, *stage_, *slopes_;
  typename Kernel::Stages k_{};  // NOLINT(readability-redundant-typename): clang 14 asks for it
};

}  // namespace invariode::lanes::INVARIODE_LANES
