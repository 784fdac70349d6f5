#include "methods/nystrom.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "compensated.hpp"
#include "methods/pair_step.hpp"

namespace invariode::nystrom {
namespace {

/// A step of the pair T for Y = (y, S₁, …), each of them positions and velocities, as f(t, Y) = (velocities,
/// accelerations) sees it: the accelerations do not depend on velocities, and those of a stage are never formed.
template <const auto& T>
class NystromStep final : public runge_kutta::PairStep<T> {
  using Base = runge_kutta::PairStep<T>;
  using Base::accepted_, Base::candidate_, Base::error_, Base::evaluate, Base::fsal_, Base::k_, Base::last, Base::n,
      Base::other_, Base::purified_, Base::stage_, Base::stages, Base::start_, Base::t1_, Base::t_, Base::weights_,
      Base::y_;
  using typename Base::Attempt, typename Base::Span;
  /// True if v* depends on f(t₁, q*): the extension does then not end at y* with another slope in its place.
  static constexpr bool last_has_weight = T.b[last] != 0;

 public:
  NystromStep(Callback& f, const Weights& weights, Fsal fsal, std::size_t state)
      : Base(f, weights, fsal, last_has_weight), half_(state / 2), remainder_(n()) {
    assert(state % 2 == 0 && n() % state == 0);
  }

  Outcome start(double t, const double* y, const Span& span) override {
    remainder_.clear();
    return Base::begin(t, y, span);
  }

  Attempt attempt(double h, double t1) override {
    if (accepted_) advance_memory();
    Base::propose(h, t1);
    std::copy(y_.begin(), y_.end(), stage_);  // whose velocities stay
    Outcome outcome = inner_stages();
    if (outcome == Outcome::ok) {
      propose_positions();
      if constexpr (T.last_in_error()) outcome = evaluate(t1, candidate_, last);
    }
    if (outcome == Outcome::ok) propose_velocities();
    if (outcome == Outcome::ok) error_ = error_norm();
    if (outcome == Outcome::ok) outcome = Base::judge_start();
    return {outcome, error_, candidate_};
  }

  bool errors(double* out) const override {
    for_positions([&](std::size_t q, std::size_t v) {
      out[q] = purified_ * purified_ * dot<stages>([](auto j) { return T.E_q[j]; }, v);
      out[v] = purified_ * dot<stages>([](auto j) { return T.E_v[j]; }, v);
    });
    return true;
  }

  Outcome accept(const double* y1) override {
    renewed_ = T.last_in_error() && evaluates_again(y1);
    if (!T.last_in_error() || renewed_) {
      if constexpr (last_has_weight) std::swap(k_[last], other_);
      const Outcome outcome = evaluate(t1_, y1, last);
      if (outcome == Outcome::stop) return outcome;
      if (outcome != Outcome::ok || !all_finite(k_[last], n())) return Outcome::not_finite;
    }
    remainder_.accept();
    Base::commit(y1);
    return Outcome::ok;
  }

  void state(Archive& archive) override {
    Base::archive_step(archive, k_[accepted_ ? last : 0]);
    archive(remainder_);
  }

  Status extension(double* data) override {
    const bool other_slope = last_has_weight && renewed_;
    if (other_slope) std::swap(k_[last], other_);
    const Status status = Base::extend(
        start_, y_.data(), data, [this](auto look) { this->further_stages(look); },
        [this](double* out) { coefficients(out); });
    if (other_slope) std::swap(k_[last], other_);
    return status;
  }

 private:
  /// each(q, v) with the indices of every position and of its velocity.
  template <class Each>
  void for_positions(Each each) const {
    for (std::size_t block = 0; block < n(); block += 2 * half_)
      for (std::size_t q = block; q < block + half_; ++q) each(q, q + half_);
  }

  /// Σ_j w(j) k_j[v] over the stages j < Count.
  template <std::size_t Count, class W>
  [[nodiscard]] double dot(W w, std::size_t v) const {
    return runge_kutta::Kernel<T, double, MaxNorm>::template dot<Count>(k_, w, v);
  }

  /// Stages 1 … last − 1.
  Outcome inner_stages() {
    const double h = purified_;
    Outcome outcome = Outcome::ok;
    [&]<std::size_t... I>(std::index_sequence<I...>) {
      const auto stage = [&]<std::size_t i>(std::integral_constant<std::size_t, i>) {
        for_positions([&](std::size_t q, std::size_t v) {
          stage_[q] = y_[q] + h * (T.c[i] * y_[v] + h * dot<i>([](auto j) { return T.A[i][j]; }, v));
        });
        return (outcome = evaluate(t_ + T.c[i] * h, stage_, i)) == Outcome::ok;
      };
      (stage(std::integral_constant<std::size_t, I + 1>{}) && ...);
    }(std::make_index_sequence<last - 1>{});
    return outcome;
  }

  /// q* = q + h v + h² Σ b̄_j F_j, of the pairs with their remainders. The velocities beside them are those before.
  void propose_positions() {
    const double h = purified_;
    for_positions([&](std::size_t q, std::size_t v) {
      const double rise = remainder_[v] + h * dot<last>([](auto j) { return T.A[last][j]; }, v);
      candidate_[q] = remainder_.propose(q, y_[q], h * y_[v] + h * rise);
      candidate_[v] = y_[v];
    });
  }
  /// v* = v + h Σ b_j F_j, which the slope at the end has too.
  void propose_velocities() {
    for_positions([&](std::size_t q, std::size_t v) {
      candidate_[v] = remainder_.propose(v, y_[v], purified_ * dot<stages>([](auto j) { return T.b[j]; }, v));
      if constexpr (T.last_in_error()) k_[last][q] = candidate_[v];
    });
  }

  /// Returns whether f(t₁, y₁) takes the place of the last stage, which is f(t₁, q*).
  [[nodiscard]] bool evaluates_again(const double* y1) const {
    return fsal_ == Fsal::evaluate && !std::equal(y1, y1 + n(), candidate_);
  }

  /// The last stage of the accepted step is the first of the next one (FSAL).
  void advance_memory() {
    std::swap(k_[0], k_[last]);
    accepted_ = false;
  }

  /// max(h² ‖Σ E_q F‖, |h| ‖Σ E_v F‖) with weights max(|y|, |y*|, thr)
  [[nodiscard]] double error_norm() const {
    MaxNorm norm;
    const auto weight = [this](std::size_t i) { return weights_.at(i, y_[i], candidate_[i]); };
    for_positions([&](std::size_t q, std::size_t v) {
      norm.add(purified_ * dot<stages>([](auto j) { return T.E_q[j]; }, v) / weight(q));
      norm.add(dot<stages>([](auto j) { return T.E_v[j]; }, v) / weight(v));
    });
    return std::abs(purified_) * norm.value();
  }

  /// Makes the arguments of the stages of the extension; look(t, y, k) takes each, up to one that returns false.
  template <class Evaluate>
  void further_stages(Evaluate look) {
    std::copy(start_, start_ + n(), stage_);
    for (std::size_t s = stages; s < T.all_stages; ++s) {
      for_positions([&](std::size_t q, std::size_t v) {
        double sum = 0;
        for (std::size_t j = 0; j < s; ++j) sum += T.A[s][j] * k_[j][v];
        stage_[q] = start_[q] + purified_ * (T.c[s] * start_[v] + purified_ * sum);
      });
      if (!look(t1_ - (1 - T.c[s]) * purified_, stage_, s)) return;
    }
  }

  /// Coefficients of the continuous extension, (degree, n).
  void coefficients(double* out) const {
    const double h = purified_;
    [&]<std::size_t... D>(std::index_sequence<D...>) {
      const auto row = [&]<std::size_t d>(std::integral_constant<std::size_t, d>) {
        double* c = out + d * n();
        for_positions([&](std::size_t q, std::size_t v) {
          const double in_q = h * dot<T.all_stages>([](auto j) { return T.B_q[j][d]; }, v);
          c[q] = d == 0 ? h * (start_[v] + in_q) : h * in_q;
          c[v] = h * dot<T.all_stages>([](auto j) { return T.B_v[j][d]; }, v);
        });
      };
      (row(std::integral_constant<std::size_t, D>{}), ...);
    }(std::make_index_sequence<T.degree>{});
  }

  std::size_t half_;  // positions in a state
  Remainder remainder_;
  bool renewed_ = false;  // f(t₁, y₁) took the place of the step's last stage, which is then `other_`
};

template <const auto&... T>
constexpr std::array<MakeStep, sizeof...(T)> factories(runge_kutta::Tableaux<T...>) noexcept {
  return {[](Callback& f, const Weights& weights, Fsal fsal, std::size_t state) -> std::unique_ptr<Step> {
    return std::make_unique<NystromStep<T>>(f, weights, fsal, state);
  }...};
}

}  // namespace

constinit const std::array<MakeStep, Pairs::count> steps = factories(Pairs());

}  // namespace invariode::nystrom
