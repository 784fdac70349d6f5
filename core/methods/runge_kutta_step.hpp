#pragma once
// The step of all explicit Runge-Kutta pairs.

#include <array>
#include <cmath>
#include <memory>
#include <utility>
#include <vector>

#include "delay_interface.hpp"
#include "methods/initial_step.hpp"
#include "methods/runge_kutta.hpp"
#include "methods/runge_kutta_kernel.hpp"
#include "step.hpp"

namespace invariode::runge_kutta {

// Arguments of stages that differ by no more than this, in the weights, tell nothing about λ but roundoff.
inline constexpr double indistinct = 1000 * eps;

/// A step of the pair T. `Small`: compiled for small systems, without vector instructions, by runge_kutta_small.cpp.
template <const auto& T, bool Small>
class RungeKuttaStep final : public Step, public DelayInterface {
  static constexpr std::size_t stages = T.stages;
  static constexpr std::size_t last = stages - 1;
  static constexpr std::size_t evaluated_in_attempt = T.last_in_error() ? stages : last;
  static constexpr std::size_t extra = T.all_stages - stages;  // of the extension
  using Kernel = runge_kutta::Kernel<T, double, MaxNorm, Small>;

 public:
  RungeKuttaStep(Callback& f, const Weights& weights, Fsal fsal)
      : Step(f, weights), fsal_(fsal), values_((stages + 3) * weights.size()) {
    double* next = values_.data();
    const auto take = [&next, this] { return std::exchange(next, next + n()); };
    for (std::size_t k = 0; k < stages; ++k) k_[k] = take();
    start_ = take();
    stage_ = take();
    candidate_ = take();
    if (fsal_ == Fsal::evaluate) provide_reevaluated();
  }

  Outcome start(double t, const double* y, const Span& span) override {
    t_ = t;
    std::copy(y, y + n(), y_.data());
    accepted_ = failed_ = false;
    evaluated_ = 1;
    if (f_(t_, y_.data(), k_[0]) == Status::stop) return Outcome::stop;
    if (!all_finite(k_[0], n())) return Outcome::not_finite;
    const double speed = Kernel::size_of_stage(0, k_, n(), [&](std::size_t i) { return weights_.at(i, y[i]); });
    const double reciprocal = speed / (safety * std::pow(weights_.rtol(), exponent));
    h_ = initial_step(reciprocal, t_, span);
    rest_.begin(reciprocal, t_, span);
    return Outcome::ok;
  }

  Attempt attempt(double h, double t1) override {
    if (accepted_) advance_memory();
    t1_ = t1;
    h_ = std::abs(h);
    purified_ = t1 - t_;
    reevaluation_failed_ = false;
    error_ = std::numeric_limits<double>::quiet_NaN();
    Outcome outcome = Outcome::ok;
    Kernel::inner_stages(t_, y_.data(), purified_, k_, n(), stage_, [&](double t, const double* y, std::size_t k) {
      return (outcome = evaluate(t, y, k)) == Outcome::ok;
    });
    if (outcome == Outcome::ok) {
      Kernel::candidate(y_.data(), purified_, k_, n(), candidate_);
      if constexpr (T.last_in_error()) outcome = evaluate(t1, candidate_, last);
    }
    if (outcome == Outcome::ok) error_ = error_norm();
    if (outcome == Outcome::ok) outcome = judge_start();
    return {outcome, error_, candidate_};
  }

  [[nodiscard]] Trust trust() const override {
    if constexpr (T.watches_bends()) {
      const auto weight = [this](std::size_t i) { return weights_.at(i, y_[i], candidate_[i]); };
      const auto [bend, low] = Kernel::bends(k_, n(), weight);
      if (h_ * bend > harmless_bend * weights_.rtol() && bend > bend_of_jump * low) return Trust::never;
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

  bool reject(Cause cause, double hmin) override {
    const double limit = rest_.reject();
    if (h_ <= hmin) return false;
    double factor = halved;
    if (!failed_ && cause == Cause::error)
      factor = cut(std::pow(weights_.rtol() / error_, exponent), T.floor);
    else if (!failed_ && cause == Cause::not_finite)
      factor = T.floor;
    h_ = std::max(hmin, limit > 0 ? limit : h_ * factor);
    failed_ = true;
    return true;
  }

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
    std::copy(y_.begin(), y_.end(), start_);
    std::copy(y1, y1 + n(), y_.begin());
    t_ = t1_;
    if (!failed_) h_ = grown(h_, std::pow(error_ / weights_.rtol(), exponent));
    failed_ = false;
    accepted_ = true;
    rest_.accept();
    return Outcome::ok;
  }

  /// Archives, of the stages, only the first of the next step, which is read again.
  void state(Archive& archive) override {
    Step::state(archive);
    if (archive.reading()) accepted_ = false;
    archive.values(next_first_stage(), n());
    archive(failed_);
    rest_.state(archive);
  }

  [[nodiscard]] Interpolate interpolate() const override { return in_turn<nested_polynomial>; }
  [[nodiscard]] std::size_t extension_size() const override { return (T.degree + 1) * n(); }
  [[nodiscard]] int degree() const override { return T.degree; }
  Status extension(double* data) override { return extend(start_, y_.data(), data); }
  Status extension_of_attempt(double* data, std::size_t& size) override {
    size = extension_size();
    if constexpr (!T.last_in_error())
      if (evaluate(t1_, candidate_, last) == Outcome::stop) return Status::stop;
    return extend(y_.data(), candidate_, data);
  }

  [[nodiscard]] int order() const override { return T.order; }
  [[nodiscard]] double stability() const override {
    const auto [slopes, arguments] = Kernel::probed(k_, n(), purified_, y_.data(), candidate_, weight_of_step());
    return std::abs(purified_) * arguments > indistinct ? slopes / arguments / real_limit() : 0;
  }
  [[nodiscard]] double real_limit() const override { return Kernel::real_limit; }
  [[nodiscard]] const double* slope() const override { return accepted_ ? k_[last] : k_[0]; }
  [[nodiscard]] int undefined_component() const override {
    for (std::size_t i = 0; i < n(); ++i) {
      bool finite = !reevaluation_failed_ || std::isfinite(reevaluated_[i]);
      for (std::size_t k = 0; k < evaluated_; ++k) finite &= std::isfinite(k_[k][i]);
      if (!finite) return static_cast<int>(i);
    }
    return -1;
  }

 private:
  static constexpr double exponent = 1.0 / T.order;

  void provide_reevaluated() { reevaluated_ = resized(again_, n()); }

  /// Returns whether f(t₁, y₁) takes the place of the last stage, which is f(t₁, y*).
  [[nodiscard]] bool evaluates_again() const { return projected_ && (fsal_ == Fsal::evaluate || moved_onto_bounds_); }

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

  Outcome judge_start() {
    const auto norm = [this](const double* v) {
      return max_norm(n(), [&](std::size_t i) { return v[i] / weights_.at(i, y_[i]); });
    };
    return rest_.judge(f_, t_, y_.data(), k_[0], purified_, weights_.rtol(), n(), error_, norm);
  }

  /// f is never asked at a point that is not finite: what an earlier stage got wrong shows in the argument of a later
  /// one, and what the last stage got wrong in the error.
  Outcome evaluate(double t, const double* y, std::size_t k) {
    if (!finite(y)) return Outcome::not_finite;
    evaluated_ = k + 1;
    return f_(t, y, k_[k]) == Status::ok ? Outcome::ok : Outcome::stop;
  }

  /// Returns whether y is finite, as `all_finite`, of which the program has one copy, made for many.
  [[nodiscard]] bool finite(const double* y) const {
    if constexpr (!Small) return all_finite(y, n());
    double sum = 0;
    for (std::size_t i = 0; i < n(); ++i) sum += 0 * y[i];
    return sum == 0;
  }

  /// The coefficients of the extension of the step from `start` to `end`.
  Status extend(const double* start, const double* end, double* data) {
    bool sound = true;
    if (extra > 0 && further_.empty()) {  // memory that steps alone do not need
      further_.resize(extra * n());
      for (std::size_t k = 0; k < extra; ++k) k_[stages + k] = further_.data() + k * n();
    }
    if constexpr (extra > 0)
      if (further_stages(start, end, sound) == Status::stop) return Status::stop;
    data = std::copy(start, start + n(), data);
    if (sound)
      Kernel::coefficients(purified_, k_, n(), data);
    else
      cubic(start, data);
    return Status::ok;
  }

  /// Evaluates the stages of the extension; their slopes may turn out not to be finite, or too large.
  Status further_stages(const double* start, const double* end, bool& sound) {
    const auto weight = [&](std::size_t i) { return weights_.at(i, start[i], end[i]); };
    const double most = Kernel::largest_of_extension(k_, n(), weight);
    Status status = Status::ok;
    Kernel::further_stages(t1_, start, purified_, k_, n(), stage_, [&](double t, const double* y, std::size_t k) {
      sound = all_finite(y, n());
      if (!sound) return false;
      status = f_(t, y, k_[k]);
      sound = Kernel::size_of_stage(k, k_, n(), weight) <= most;
      return sound && status == Status::ok;
    });
    return status;
  }

  /// The weights of the accepted step.
  [[nodiscard]] auto weight_of_step() const {
    return [this](std::size_t i) { return weights_.at(i, start_[i], y_[i]); };
  }

  /// |h| ‖Σ E_k k_k‖ with weights max(|y|, |y*|, thr)
  [[nodiscard]] double error_norm() const {
    const auto weight = [this](std::size_t i) { return weights_.at(i, y_[i], candidate_[i]); };
    return std::abs(purified_) * Kernel::error(k_, n(), weight);
  }

  /// The cubic Hermite interpolant, where f is not sound at a stage of the extension.
  void cubic(const double* start, double* data) const {
    std::fill(data, data + T.degree * n(), 0);
    for (std::size_t i = 0; i < n(); ++i) {
      const double rise = candidate_[i] - start[i], k0 = purified_ * k_[0][i], k1 = purified_ * k_[last][i];
      data[i] = rise;
      data[n() + i] = k0 - rise;
      data[2 * n() + i] = 2 * rise - k0 - k1;
    }
  }

  Fsal fsal_;
  std::vector<double> values_, further_, again_;
  std::array<double*, T.all_stages> k_{};
  double* start_ = nullptr;        // y at the start of the accepted step
  double* stage_ = nullptr;        // argument of the stage in work
  double* candidate_ = nullptr;    // y*
  double* reevaluated_ = nullptr;  // f(t₁, y₁), with Fsal::evaluate or within bounds
  std::size_t evaluated_ = 0;      // stages of the last attempt that were evaluated
  double t1_ = 0;
  double error_ = 0;
  double purified_ = 0;  // t₁ − t
  RestingStart rest_;
  bool reevaluation_failed_ = false;  // f(t₁, y₁) was not finite
  bool failed_ = false;               // an attempt of this step failed
  bool accepted_ = false;
  bool projected_ = false;  // y₁ differs from y*
};

template <bool Small, const auto&... T>
constexpr std::array<MakeStep, sizeof...(T)> factories(Tableaux<T...>) noexcept {
  return {[](Callback& f, const Weights& weights, Fsal fsal) -> std::unique_ptr<Step> {
    return std::make_unique<RungeKuttaStep<T, Small>>(f, weights, fsal);
  }...};
}

}  // namespace invariode::runge_kutta
