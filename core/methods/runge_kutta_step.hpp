#pragma once
// The step of all explicit Runge-Kutta pairs.

#include <array>
#include <cmath>
#include <memory>
#include <utility>
#include <vector>

#include "delay_interface.hpp"
#include "methods/pair_step.hpp"
#include "methods/runge_kutta.hpp"
#include "methods/runge_kutta_kernel.hpp"
#include "step.hpp"

namespace invariode::runge_kutta {

// Arguments of stages that differ by no more than this, in the weights, tell nothing about λ but roundoff.
inline constexpr double indistinct = 1000 * eps;

/// A step of the pair T.
template <const auto& T, bool Small>
class RungeKuttaStep final : public PairStep<T, Small>, public DelayInterface {
  using Base = PairStep<T, Small>;
  using Kernel = runge_kutta::Kernel<T, double, MaxNorm, Small>;
  using Base::accepted_, Base::candidate_, Base::error_, Base::evaluate, Base::evaluated_, Base::extension_size,
      Base::f_, Base::fsal_, Base::h_, Base::k_, Base::last, Base::n, Base::purified_, Base::stage_, Base::stages,
      Base::start_, Base::t1_, Base::t_, Base::weights_, Base::y_;
  using typename Base::Attempt, typename Base::Span, typename Base::Trust;
  static constexpr std::size_t evaluated_in_attempt = T.last_in_error() ? stages : last;

 public:
  RungeKuttaStep(Callback& f, const Weights& weights, Fsal fsal) : Base(f, weights, fsal) {
    if (fsal_ == Fsal::evaluate) provide_reevaluated();
  }

  Outcome start(double t, const double* y, const Span& span) override { return Base::begin(t, y, span); }

  Attempt attempt(double h, double t1) override {
    if (accepted_) advance_memory();
    Base::propose(h, t1);
    reevaluation_failed_ = false;
    Outcome outcome = Outcome::ok;
    Kernel::inner_stages(t_, y_.data(), purified_, k_, n(), stage_, [&](double t, const double* y, std::size_t k) {
      return (outcome = evaluate(t, y, k)) == Outcome::ok;
    });
    if (outcome == Outcome::ok) {
      Kernel::candidate(y_.data(), purified_, k_, n(), candidate_);
      if constexpr (T.last_in_error()) outcome = evaluate(t1, candidate_, last);
    }
    if (outcome == Outcome::ok) error_ = error_norm();
    if (outcome == Outcome::ok) outcome = Base::judge_start();
    return {outcome, error_, candidate_};
  }

  [[nodiscard]] Trust trust() const override {
    if constexpr (T.watches_bends()) {
      const auto weight = [this](std::size_t i) { return weights_.at(i, y_[i], candidate_[i]); };
      if (Kernel::looks_like_jump(Kernel::bend(k_, n(), weight), h_, error_, weights_.rtol())) return Trust::never;
    }
    return Trust::unless_suspicious;
  }

  bool errors(double* out) const override {
    Kernel::errors(purified_, k_, n(), out);
    return true;
  }

  std::size_t directions(const double** vectors) const override {
    std::copy(k_.begin(), k_.begin() + evaluated_in_attempt, vectors);
    return evaluated_in_attempt;
  }
  [[nodiscard]] std::size_t max_directions() const override { return evaluated_in_attempt; }

  Outcome accept(const double* y1) override {
    projected_ = y1 != candidate_ && !std::equal(y1, y1 + n(), candidate_);
    if constexpr (!T.last_in_error()) {
      const Outcome outcome = evaluate(t1_, y1, last);
      if (outcome == Outcome::stop) return outcome;
      if (outcome != Outcome::ok || !all_finite(k_[last], n())) return Outcome::not_finite;
    } else if (evaluates_again()) {
      if (reevaluated_ == nullptr) provide_reevaluated();
      if (f_(t1_, y1, reevaluated_) == Status::stop) return Outcome::stop;
      reevaluation_failed_ = !all_finite(reevaluated_, n());
      if (reevaluation_failed_) return Outcome::not_finite;
    }
    Base::commit(y1);
    return Outcome::ok;
  }

  void end_attempts() override { Base::keep_only(next_first_stage()); }
  void state(Archive& archive) override { Base::archive_step(archive, next_first_stage()); }

  Status extension(double* data) override { return extend(start_, y_.data(), data); }
  Status extension_of_attempt(double* data, std::size_t& size) override {
    size = extension_size();
    if constexpr (!T.last_in_error())
      if (evaluate(t1_, candidate_, last) == Outcome::stop) return Status::stop;
    return extend(y_.data(), candidate_, data);
  }

  [[nodiscard]] double stability() const override {
    const auto weight = [this](std::size_t i) { return weights_.at(i, start_[i], y_[i]); };
    const auto [slopes, arguments] = Kernel::probed(k_, n(), purified_, y_.data(), candidate_, weight);
    return std::abs(purified_) * arguments > indistinct ? slopes / arguments / real_limit() : 0;
  }
  [[nodiscard]] double real_limit() const override { return T.real_limit; }
  [[nodiscard]] int undefined_component() const override {
    for (std::size_t i = 0; i < n(); ++i) {
      bool finite = !reevaluation_failed_ || std::isfinite(reevaluated_[i]);
      for (std::size_t k = 0; k < evaluated_; ++k) finite &= std::isfinite(k_[k][i]);
      if (!finite) return static_cast<int>(i);
    }
    return -1;
  }

 private:
  void provide_reevaluated() { reevaluated_ = resized(again_, n()); }

  /// Returns whether f(t₁, y₁) takes the place of the last stage, which is f(t₁, y*).
  [[nodiscard]] bool evaluates_again() const { return projected_ && fsal_ == Fsal::evaluate; }

  /// The last stage of the accepted step is the first of the next one (FSAL).
  void advance_memory() {
    if (T.last_in_error() && evaluates_again())
      std::swap(k_[0], reevaluated_);
    else
      std::swap(k_[0], k_[last]);
    accepted_ = false;
  }
  double* next_first_stage() {
    if (!accepted_) return k_[0];
    return T.last_in_error() && evaluates_again() ? reevaluated_ : k_[last];
  }

  Status extend(const double* start, const double* end, double* data) {
    return Base::extend(
        start, end, data, [&](auto look) { Kernel::further_stages(t1_, start, purified_, k_, n(), stage_, look); },
        [&](double* coefficients) { Kernel::coefficients(purified_, k_, n(), coefficients); });
  }

  /// |h| ‖Σ E_k k_k‖ with weights max(|y|, |y*|, thr)
  [[nodiscard]] double error_norm() const {
    const auto weight = [this](std::size_t i) { return weights_.at(i, y_[i], candidate_[i]); };
    return std::abs(purified_) * Kernel::error(k_, n(), weight);
  }

  std::vector<double> again_;
  double* reevaluated_ = nullptr;     // f(t₁, y₁), with Fsal::evaluate
  bool reevaluation_failed_ = false;  // it was not finite
  bool projected_ = false;            // y₁ differs from y*
};

template <bool Small, const auto&... T>
constexpr std::array<MakeStep, sizeof...(T)> factories(Tableaux<T...>) noexcept {
  return {[](Callback& f, const Weights& weights, Fsal fsal) -> std::unique_ptr<Step> {
    return std::make_unique<RungeKuttaStep<T, Small>>(f, weights, fsal);
  }...};
}

}  // namespace invariode::runge_kutta
