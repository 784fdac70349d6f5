#pragma once
// What the steps of explicit embedded pairs share, Runge-Kutta and Nyström: their vectors, the controller of |h|, the
// first step, the archive, and the frame of the continuous extension.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

#include "methods/controller.hpp"
#include "methods/initial_step.hpp"
#include "methods/runge_kutta.hpp"
#include "methods/runge_kutta_kernel.hpp"
#include "step.hpp"

namespace invariode::runge_kutta {

/// A step of the pair with tableau T, whose last stage is the first of the next step (FSAL). `Small`: compiled for
/// small systems, without vector instructions, by runge_kutta_small.cpp.
template <const auto& T, bool Small = false>
class PairStep : public Step {
 public:
  bool reject(Cause cause, double hmin) final {
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

  void trust_first_step() final { rest_.accept(); }
  void end_attempts() override { keep_only(k_[accepted_ ? last : 0]); }

  [[nodiscard]] Interpolate interpolate() const final { return in_turn<nested_polynomial>; }
  [[nodiscard]] std::size_t extension_size() const final { return (T.degree + 1) * n(); }
  [[nodiscard]] int degree() const final { return T.degree; }
  [[nodiscard]] int order() const final { return T.order; }
  [[nodiscard]] const double* slope() const final { return accepted_ ? k_[last] : k_[0]; }
  [[nodiscard]] int undefined_component() const override {
    for (std::size_t i = 0; i < n(); ++i)
      for (std::size_t k = 0; k < evaluated_; ++k)
        if (!std::isfinite(k_[k][i])) return static_cast<int>(i);
    return -1;
  }

 protected:
  static constexpr std::size_t stages = T.stages;
  static constexpr std::size_t last = stages - 1;
  static constexpr std::size_t extra = T.all_stages - stages;  // of the extension
  static constexpr double exponent = T.exponent();

  /// `others`: the number of further vectors (n,), the first of which is `other_`.
  PairStep(Callback& f, const Weights& weights, Fsal fsal, std::size_t others = 0)
      : Step(f, weights), fsal_(fsal), values_((stages + 3 + others) * weights.size()) {
    double* next = values_.data();
    const auto take = [&next, this] { return std::exchange(next, next + n()); };
    for (std::size_t k = 0; k < stages; ++k) k_[k] = take();
    start_ = take();
    stage_ = take();
    candidate_ = take();
    other_ = next;
  }

  /// `start` of the contract. The first |h| is the one in which y would change by 0.8 rtol^exponent in the norm of the
  /// weights.
  Outcome begin(double t, const double* y, const Span& span) {
    t_ = t;
    std::copy(y, y + n(), y_.data());
    accepted_ = failed_ = false;
    trend_ = {};
    evaluated_ = 1;
    if (f_(t_, y_.data(), k_[0]) == Status::stop) return Outcome::stop;
    if (!all_finite(k_[0], n())) return Outcome::not_finite;
    const double speed = size_of(k_[0], [&](std::size_t i) { return weights_.at(i, y[i]); });
    const double reciprocal = speed / (safety * std::pow(weights_.rtol(), exponent));
    h_ = initial_step(reciprocal, t_, span);
    rest_.begin(reciprocal, t_, span);
    return Outcome::ok;
  }

  /// Begins an attempt to t1.
  void propose(double h, double t1) {
    t1_ = t1;
    h_ = std::abs(h);
    purified_ = t1 - t_;
    error_ = std::numeric_limits<double>::quiet_NaN();
  }

  /// Lets the first attempt of a start at rest fail if f beside the start asks for a shorter one.
  Outcome judge_start() {
    const auto norm = [this](const double* v) {
      return size_of(v, [this](std::size_t i) { return weights_.at(i, y_[i]); });
    };
    return rest_.judge(f_, t_, y_.data(), k_[0], purified_, weights_.rtol(), n(), error_, norm);
  }

  /// (t₁, y₁) becomes the point reached, and the controller chooses the next |h|.
  void commit(const double* y1) {
    std::copy(y_.begin(), y_.end(), start_);
    std::copy(y1, y1 + n(), y_.begin());
    t_ = t1_;
    const double root = std::pow(std::max(smallest_ratio, error_ / weights_.rtol()), exponent);
    h_ = next_h<T>(h_, root, failed_, trend_);
    failed_ = false;
    accepted_ = true;
    rest_.accept();
  }

  /// Evaluates stage k, unless its argument is not finite. A value of f that is not finite is thus found in the
  /// argument of a later stage, and one of the last stage in the error.
  Outcome evaluate(double t, const double* y, std::size_t k) {
    if (!finite(y)) return Outcome::not_finite;
    evaluated_ = k + 1;
    return f_(t, y, k_[k]) == Status::ok ? Outcome::ok : Outcome::stop;
  }

  /// The coefficients of the extension of the step from `start` to `end`. `further(look)`: makes the arguments of
  /// its own stages and calls look(t, y, k) with each, up to one that returns false; their slopes may turn out not
  /// to be finite, or too large, and the extension is a cubic then. `write(data)`: its coefficients, (degree, n).
  template <class Further, class Write>
  Status extend(const double* start, const double* end, double* data, Further further, Write write) {
    bool sound = true;
    if constexpr (extra > 0) {
      if (further_.empty()) {  // memory that steps alone do not need
        further_.resize(extra * n());
        for (std::size_t k = 0; k < extra; ++k) k_[stages + k] = further_.data() + k * n();
      }
      const auto weight = [&](std::size_t i) { return weights_.at(i, start[i], end[i]); };
      double most = 0;
      for (std::size_t k = 0; k < stages; ++k) most = std::max(most, size_of(k_[k], weight));
      Status status = Status::ok;
      further([&](double t, const double* y, std::size_t k) {
        sound = all_finite(y, n());
        if (!sound) return false;
        status = f_(t, y, k_[k]);
        sound = size_of(k_[k], weight) <= largest_slope * most;
        return sound && status == Status::ok;
      });
      if (status == Status::stop) return Status::stop;
    }
    data = std::copy(start, start + n(), data);
    if (sound)
      write(data);
    else
      cubic(start, data);
    return Status::ok;
  }

  /// Writes or reads the memory between steps. The only stage in it is the first one of the next step, `first`.
  void archive_step(Archive& archive, double* first) {
    Step::state(archive);
    archive.values(archive.reading() ? k_[0] : first, n());
    if (archive.reading()) accepted_ = false;
    archive(failed_, trend_.rate, trend_.growth);
    rest_.state(archive);
  }

  /// Gives back all vectors but this slope, the first stage of the next step.
  void keep_only(const double* slope) {
    std::vector<double> kept(slope, slope + n());
    values_.swap(kept);
    further_ = std::vector<double>();
    k_[0] = values_.data();
    evaluated_ = 1;
    accepted_ = false;
  }

  Fsal fsal_;
  std::vector<double> values_, further_;
  std::array<double*, T.all_stages> k_{};
  double* start_ = nullptr;      // y at the start of the accepted step
  double* stage_ = nullptr;      // argument of the stage in work
  double* candidate_ = nullptr;  // y*
  double* other_ = nullptr;
  std::size_t evaluated_ = 0;  // stages of the last attempt that were evaluated
  double t1_ = 0;
  double error_ = 0;
  double purified_ = 0;  // t₁ − t
  Trend<double> trend_;
  RestingStart rest_;
  bool failed_ = false;    // an attempt of this step failed
  bool accepted_ = false;  // a step was accepted, and the next one has not begun

 private:
  /// Returns whether y is finite: `all_finite`, which is compiled for long vectors, or a short loop for small systems.
  [[nodiscard]] bool finite(const double* y) const {
    if constexpr (!Small) return all_finite(y, n());
    double sum = 0;
    for (std::size_t i = 0; i < n(); ++i) sum += 0 * y[i];
    return sum == 0;
  }

  /// ‖v‖ with the weights weight(i).
  template <class Weight>
  double size_of(const double* v, Weight weight) const {
    return max_norm(n(), [&](std::size_t i) { return v[i] / weight(i); });
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
};

}  // namespace invariode::runge_kutta
