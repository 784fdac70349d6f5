#include "methods/nystrom.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "compensated.hpp"
#include "methods/initial_step.hpp"
#include "methods/runge_kutta_kernel.hpp"
#include "output/polynomial.hpp"

namespace invariode::nystrom {
namespace {

using runge_kutta::cut;
using runge_kutta::grown;
using runge_kutta::halved;
using runge_kutta::largest_slope;
using runge_kutta::safety;

/// A step of the pair T for Y = (y, S₁, …), each of them positions and velocities, as f(t, Y) = (velocities,
/// accelerations) sees it: the accelerations do not depend on velocities, and those of a stage are never formed.
template <const auto& T>
class NystromStep final : public Step {
  static constexpr std::size_t stages = T.stages;
  static constexpr std::size_t last = stages - 1;
  static constexpr std::size_t extra = T.all_stages - stages;  // of the extension
  static constexpr double exponent = 1.0 / (T.error_order + 1);
  /// True if v* depends on f(t₁, q*): the extension does then not end at y* with another slope in its place.
  static constexpr bool last_has_weight = T.b[last] != 0;

 public:
  NystromStep(Callback& f, const Weights& weights, Fsal fsal, std::size_t state)
      : Step(f, weights),
        fsal_(fsal),
        half_(state / 2),
        remainder_(weights.size()),
        values_((stages + 3 + last_has_weight) * n()) {
    assert(state % 2 == 0 && n() % state == 0);
    double* next = values_.data();
    const auto take = [&next, this] { return std::exchange(next, next + n()); };
    for (std::size_t k = 0; k < stages; ++k) k_[k] = take();
    start_ = take();
    stage_ = take();
    candidate_ = take();
    if constexpr (last_has_weight) proposed_ = take();
  }

  Outcome start(double t, const double* y, const Span& span) override {
    t_ = t;
    std::copy(y, y + n(), y_.data());
    remainder_.clear();
    accepted_ = failed_ = false;
    evaluated_ = 1;
    if (f_(t_, y_.data(), k_[0]) == Status::stop) return Outcome::stop;
    if (!all_finite(k_[0], n())) return Outcome::not_finite;
    const double speed = size_of(k_[0], [&](std::size_t i) { return weights_.at(i, y[i]); });
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
    error_ = std::numeric_limits<double>::quiet_NaN();
    std::copy(y_.begin(), y_.end(), stage_);  // whose velocities stay
    Outcome outcome = inner_stages();
    if (outcome == Outcome::ok) {
      propose_positions();
      if constexpr (T.last_in_error()) outcome = evaluate(t1, candidate_, last);
    }
    if (outcome == Outcome::ok) propose_velocities();
    if (outcome == Outcome::ok) error_ = error_norm();
    if (outcome == Outcome::ok) outcome = judge_start();
    return {outcome, error_, candidate_};
  }

  bool errors(double* out) const override {
    for_positions([&](std::size_t q, std::size_t v) {
      out[q] = purified_ * purified_ * dot<stages>([](auto j) { return T.E_q[j]; }, v);
      out[v] = purified_ * dot<stages>([](auto j) { return T.E_v[j]; }, v);
    });
    return true;
  }

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
    renewed_ = T.last_in_error() && evaluates_again(y1);
    if (!T.last_in_error() || renewed_) {
      if constexpr (last_has_weight) std::swap(k_[last], proposed_);
      const Outcome outcome = evaluate(t1_, y1, last);
      if (outcome == Outcome::stop) return outcome;
      if (outcome != Outcome::ok || !all_finite(k_[last], n())) return Outcome::not_finite;
    }
    std::copy(y_.begin(), y_.end(), start_);
    std::copy(y1, y1 + n(), y_.begin());
    remainder_.accept();
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
    archive.values(k_[accepted_ ? last : 0], n());
    archive(remainder_, failed_);
    rest_.state(archive);
  }

  [[nodiscard]] Interpolate interpolate() const override { return in_turn<runge_kutta::nested_polynomial>; }
  [[nodiscard]] std::size_t extension_size() const override { return (T.degree + 1) * n(); }
  [[nodiscard]] int degree() const override { return T.degree; }
  Status extension(double* data) override {
    bool sound = true;
    const bool other_slope = last_has_weight && renewed_;
    if (other_slope) std::swap(k_[last], proposed_);
    if (extra > 0 && further_.empty()) {  // memory that steps alone do not need
      further_.resize(extra * n());
      for (std::size_t k = 0; k < extra; ++k) k_[stages + k] = further_.data() + k * n();
    }
    Status status = Status::ok;
    if constexpr (extra > 0) status = further_stages(sound);
    if (status == Status::ok) {
      data = std::copy(start_, start_ + n(), data);
      if (sound)
        coefficients(data);
      else
        cubic(data);
    }
    if (other_slope) std::swap(k_[last], proposed_);
    return status;
  }

  [[nodiscard]] int order() const override { return T.order; }
  [[nodiscard]] const double* slope() const override { return accepted_ ? k_[last] : k_[0]; }
  [[nodiscard]] int undefined_component() const override {
    for (std::size_t i = 0; i < n(); ++i)
      for (std::size_t k = 0; k < evaluated_; ++k)
        if (!std::isfinite(k_[k][i])) return static_cast<int>(i);
    return -1;
  }

 private:
  Outcome judge_start() {
    const auto norm = [this](const double* v) {
      return size_of(v, [this](std::size_t i) { return weights_.at(i, y_[i]); });
    };
    return rest_.judge(f_, t_, y_.data(), k_[0], purified_, weights_.rtol(), n(), error_, norm);
  }

  /// each(q, v) with the indices of every position and of its velocity.
  template <class Each>
  void for_positions(Each each) const {
    for (std::size_t block = 0; block < n(); block += 2 * half_)
      for (std::size_t q = block; q < block + half_; ++q) each(q, q + half_);
  }

  /// Σ_j w(j) k_j[v] over the stages j < Count whose weight, known at compile time, is not zero.
  template <std::size_t Count, class W>
  [[nodiscard]] double dot(W w, std::size_t v) const {
    return [&]<std::size_t... J>(std::index_sequence<J...>) {
      double sum = 0;
      const auto add = [&]<std::size_t j>(std::integral_constant<std::size_t, j> index) {
        if constexpr (w(index) != 0) sum += w(index) * k_[j][v];
      };
      (add(std::integral_constant<std::size_t, J>{}), ...);
      return sum;
    }(std::make_index_sequence<Count>{});
  }

  /// ‖v‖ with the weights weight(i).
  template <class Weight>
  double size_of(const double* v, Weight weight) const {
    return max_norm(n(), [&](std::size_t i) { return v[i] / weight(i); });
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
    return (fsal_ == Fsal::evaluate || moved_onto_bounds_) && !std::equal(y1, y1 + n(), candidate_);
  }

  /// The last stage of the accepted step is the first of the next one (FSAL).
  void advance_memory() {
    std::swap(k_[0], k_[last]);
    accepted_ = false;
  }

  /// f is never asked at a point that is not finite.
  Outcome evaluate(double t, const double* y, std::size_t k) {
    if (!all_finite(y, n())) return Outcome::not_finite;
    evaluated_ = k + 1;
    return f_(t, y, k_[k]) == Status::ok ? Outcome::ok : Outcome::stop;
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

  /// The weights of the accepted step.
  [[nodiscard]] auto weight_of_step() const {
    return [this](std::size_t i) { return weights_.at(i, start_[i], y_[i]); };
  }

  /// Evaluates the stages of the extension; their slopes may turn out not to be finite, or too large.
  Status further_stages(bool& sound) {
    const auto weight = weight_of_step();
    double most = 0;
    for (std::size_t s = 0; s < stages; ++s) most = std::max(most, size_of(k_[s], weight));
    std::copy(start_, start_ + n(), stage_);
    for (std::size_t s = stages; s < T.all_stages; ++s) {
      for_positions([&](std::size_t q, std::size_t v) {
        double sum = 0;
        for (std::size_t j = 0; j < s; ++j) sum += T.A[s][j] * k_[j][v];
        stage_[q] = start_[q] + purified_ * (T.c[s] * start_[v] + purified_ * sum);
      });
      sound = all_finite(stage_, n());
      if (!sound) return Status::ok;
      if (f_(t1_ - (1 - T.c[s]) * purified_, stage_, k_[s]) == Status::stop) return Status::stop;
      sound = size_of(k_[s], weight) <= largest_slope * most;
      if (!sound) return Status::ok;
    }
    return Status::ok;
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

  /// The cubic Hermite interpolant, where f is not sound at a stage of the extension.
  void cubic(double* data) const {
    std::fill(data, data + T.degree * n(), 0);
    for (std::size_t i = 0; i < n(); ++i) {
      const double rise = candidate_[i] - start_[i], k0 = purified_ * k_[0][i], k1 = purified_ * k_[last][i];
      data[i] = rise;
      data[n() + i] = k0 - rise;
      data[2 * n() + i] = 2 * rise - k0 - k1;
    }
  }

  Fsal fsal_;
  std::size_t half_;  // positions in a state
  Remainder remainder_;
  std::vector<double> values_, further_;
  std::array<double*, T.all_stages> k_{};  // (velocities, F_j) of all stages; of inner ones the velocities mean nothing
  double* start_ = nullptr;                // y at the start of the accepted step
  double* stage_ = nullptr;                // argument of the stage in work
  double* candidate_ = nullptr;            // y*
  double* proposed_ = nullptr;             // the last stage, where f(t₁, y₁) took its place: of v* and the extension
  std::size_t evaluated_ = 0;              // stages of the last attempt that were evaluated
  double t1_ = 0;
  double error_ = 0;
  RestingStart rest_;
  double purified_ = 0;    // t₁ − t
  bool failed_ = false;    // an attempt of this step failed
  bool accepted_ = false;  // and the next has not begun
  bool renewed_ = false;   // f(t₁, y₁) took the place of its last stage
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
