#pragma once
// The base class of implicit methods: what they share besides Newton's iteration: the memory of a step, the first |h|,
// and what becomes of |h|.

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <limits>
#include <vector>

#include "implicit_interface.hpp"
#include "methods/initial_step.hpp"
#include "methods/newton.hpp"
#include "step.hpp"

namespace invariode {

/// A step of M y' = f(t, y) with the linear algebra of a solver: AgingJacobian, or what derives from it. The formula
/// derives from this. The constants are those of the suite.
template <class Solver>
class ImplicitBase : public Step, public ImplicitInterface {
 public:
  bool errors(double* out) const override {
    std::copy(error_vector_.begin(), error_vector_.end(), out);
    return true;
  }
  void end_attempts() override { solver_.end_attempts(); }

  [[nodiscard]] const double* slope() const override { return slope_.data(); }
  [[nodiscard]] int undefined_component() const final { return solver_.system().undefined_component(); }
  [[nodiscard]] LinearWork linear_work() const final { return solver_.work(); }
  [[nodiscard]] const Matrix* jacobian() const final { return &solver_.jacobian(); }
  Status multiply_jacobian(const double* slope, const double* v, double* out) final {
    return solver_.multiply(t_, y(), slope, v, out);
  }

 protected:
  static constexpr double starting_safety = 1.25;
  static constexpr double smallest_retry = 0.1;  // of h
  static constexpr double third = 3;             // order of the estimate of a code of order 2
  static constexpr double newton_cut = 0.3;      // of h, where a current Jacobian does not help
  static constexpr int old_jacobian = 20;        // steps

  /// Gives back memory that only attempts need.
  static void give_back(std::initializer_list<std::vector<double>*> vectors) {
    for (std::vector<double>* v : vectors) *v = std::vector<double>();
  }
  /// The mass matrix, if there is one, belongs to the caller and outlives this. `more`: of the solver.
  template <class... More>
  ImplicitBase(Callback& f, const Weights& weights, const LinearAlgebra& linear, const More&... more)
      : Step(f, weights), solver_(f, weights, linear, more...), initial_(linear) {
    provide({&candidate_, &weight_});
  }
  void provide(std::initializer_list<std::vector<double>*> vectors) {
    for (std::vector<double>* v : vectors) v->resize(n());
  }

  // ---------------------------------------------------------------------------------------------------------- a start

  /// The point; there f and y' with M y' = f, J, and the weights of the start.
  Outcome begin(double t, const double* y, double* f, double* slope) {
    t_ = t;
    std::copy(y, y + n(), y_.begin());
    failed_ = false;
    weights_.fill(y, weight_.data());
    return initial_.first(solver_, t, y, f, slope);
  }
  /// y'' there, for a first |h| of 1 / reciprocal. `ft`: becomes ∂f/∂t.
  Status bend(const Span& span, double reciprocal, const double* f, double* slope, double* ft, double* second) {
    const double h = std::copysign(std::max(initial_step(reciprocal, t_, span), span.hmin), span.tf - t_);
    return initial_.second(solver_, t_, y(), h, f, slope, ft, second);
  }
  /// 1/h is 1.25 rtol^{-1/q} times the larger one of ‖y'‖ and √(‖y''‖ / 2), where the estimate is O(h^q).
  Outcome choose_initial_step(const Span& span, double q, const double* f, double* slope, double* ft, double* second) {
    const double scale = starting_safety * std::pow(weights_.rtol(), -1 / q);
    const double first = scale * norm(slope);
    if (bend(span, first, f, slope, ft, second) == Status::stop) return Outcome::stop;
    const double reciprocal = std::max(first, scale * std::sqrt(0.5 * norm(second)));
    return choose_initial_step(span, first, reciprocal, f, slope, ft, second);
  }
  /// 1 / h is `reciprocal`, or what f beside the start says, if it is at rest by `first`, the reciprocal from y' alone.
  Outcome choose_initial_step(const Span& span, double first, double reciprocal, const double* f, const double* slope,
                              double* point, double* quotient) {
    h_ = initial_step(reciprocal, t_, span);
    if (gives_scale(first, t_, span.tf)) return Outcome::ok;
    const double h = std::copysign(initial_step(first, t_, span), span.tf - t_);
    const Status looked = look_beside_start(t_, h, weights_.rtol(), first, [&](double delta, double& size) {
      const Status status = initial_.beside(solver_, t_, y(), delta, f, slope, point, quotient);
      const double algebraic = norm(point);
      size = std::max(norm(quotient), 2 * algebraic * algebraic);  // so that h ‖y'‖ is at most √rtol / 1.25 there
      return status;
    });
    h_ = initial_step(std::max(reciprocal, first), t_, span);
    return looked == Status::stop ? Outcome::stop : Outcome::ok;
  }

  // --------------------------------------------------------------------------------------------------------- attempts

  void begin_attempt(double h, double t1) {
    signed_h_ = h;
    h_ = std::abs(h);
    t1_ = t1;
    error_ = std::numeric_limits<double>::quiet_NaN();
    solver_.system().forget_undefined();
  }
  [[nodiscard]] Attempt proposal(Newton::Result result) const {
    const bool converged = result == Newton::Result::converged;
    return {result == Newton::Result::stop ? Outcome::stop : Outcome::ok,
            converged ? error_ : std::numeric_limits<double>::quiet_NaN(), candidate_.data(), converged};
  }

  /// In the weights of the start, or of the attempt.
  [[nodiscard]] double norm(const double* v) const {
    return max_norm(n(), [this, v](std::size_t i) { return v[i] / weight_[i]; });
  }
  /// In those of the error test.
  [[nodiscard]] double error_norm(const std::vector<double>& v) const {
    return max_norm(n(), [&](std::size_t i) { return v[i] / weights_.at(i, y_[i], candidate_[i]); });
  }

  // ------------------------------------------------------------------------------------------------- the next attempt

  /// |h| of a retry: c (rtol / error)^{1/q} times the present one, where the estimate is O(h^q), and at least a tenth.
  [[nodiscard]] double retry_h(double error, double q, double c) const {
    return std::max(smallest_retry, c * std::pow(weights_.rtol() / error, 1 / q)) * h_;
  }
  /// After an iteration that failed: with a J of this point h stays as it is, and is cut where that does not help.
  bool retry_newton(double hmin, double cut) {
    if (solver_.hopeless()) return false;
    if (solver_.renew_if_old()) return true;
    if (h_ <= hmin) return false;
    solver_.renew_if_undefined();
    h_ = std::max(hmin, cut * h_);
    return true;
  }

  // The controller of ode23s, which the codes of order 2 share: their estimate is O(h³).

  bool retry_of_order_two(Cause cause, double hmin) {
    if (h_ <= hmin) return false;
    const double h = !failed_ && cause == Cause::error ? retry_h(error_, third, 0.8) : 0.5 * h_;
    failed_ = true;
    h_ = std::max(hmin, h);
    return true;
  }
  /// Returns the divisor of h after a success.
  [[nodiscard]] double divisor_of_order_two() const {
    return std::max(0.2, 1.25 * std::pow(error_ / weights_.rtol(), 1 / third));
  }

  /// (t₁, y₁) is the point reached.
  void commit(const double* y1) {
    std::copy(y1, y1 + n(), y_.begin());
    t_ = t1_;
    solver_.step_accepted();
  }

  Solver solver_;
  std::vector<double> candidate_;  // y*
  std::vector<double> weight_;     // of the start, then of the attempt
  // Provided by the methods that use them: y' at the point reached, y before the last accepted step, the error of y*.
  std::vector<double> slope_, last_y_, error_vector_;
  double signed_h_ = 0, t1_ = 0;  // of the attempt
  double error_ = 0;              // of the attempt
  bool failed_ = false;           // an attempt of this step

 private:
  InitialSlopes initial_;
};

}  // namespace invariode
