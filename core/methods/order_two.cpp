#include "methods/order_two.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace invariode {
namespace {

constexpr double estimate_order = 3;  // it is O(h³)

// The constants of ode23s. Newton's iteration has to be more exact than in ode15s: its errors enter z, divided by d,
// and the stages of the next step (at ode15s' goal of 0.5 rtol van der Pol's equation has errors ten times larger).
constexpr double starting_safety = 1.25;
constexpr double safety = 1.25, smallest_divisor = 0.2;
constexpr double retry = 0.8, smallest_retry = 0.1;
constexpr Convergence::Rules rules{.most_iterations = 5, .goal = 0.03, .first_goal = 0.003};
constexpr double newton_cut = 0.3;
/// Steps. An older J may be so much larger than the present one that Newton's updates are too small to show how wrong
/// they are: the iteration converges, to what does not solve the equations (van der Pol's equation with ε = 1e-12 loses
/// its limit cycle at 1e-3, the Oregonator its second pulse). CVODE looks at its matrix as often.
constexpr int old_jacobian = 20;
constexpr double kept_up_to = 1.2;  // a change of h up to this is not worth a factorisation

}  // namespace

OrderTwo::OrderTwo(Callback& f, const Weights& weights, const LinearAlgebra& linear, double d)
    : Step(f, weights), newton_(f, weights, linear, rules), initial_(f, linear), d_(d) {
  for (std::vector<double>* v :
       {&slope_, &second_, &last_y_, &last_slope_, &candidate_, &base_, &psi_, &weight_, &increment_, &error_vector_})
    v->resize(weights.size());
}

/// 1/h is 1.25 rtol^{-1/3} times the larger one of ‖y'‖ and √(‖y''‖ / 2).
Outcome OrderTwo::start(double t, const double* y, const Span& span) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  last_h_ = 0;
  failed_ = false;
  newton_.restart();
  weights_.fill(y, weight_.data());
  if (const Outcome outcome = initial_.first(newton_, t, y, weight_.data(), candidate_.data(), slope_.data());
      outcome != Outcome::ok)
    return outcome;
  const auto norm = [this](const std::vector<double>& v) {
    return max_norm(n(), [&](std::size_t i) { return v[i] / weight_[i]; });
  };
  const double scale = starting_safety * std::pow(weights_.rtol(), -1 / estimate_order);
  const double first = scale * norm(slope_);
  const double h = std::copysign(first_h(first, t, span), span.tf - t);
  if (initial_.second(newton_, t, y, h, candidate_.data(), slope_.data(), base_.data(), second_.data()) == Status::stop)
    return Outcome::stop;
  h_ = first_h(std::max(first, scale * std::sqrt(0.5 * norm(second_))), t, span);
  return Outcome::ok;
}

Step::Attempt OrderTwo::attempt(double h, double t1) {
  signed_h_ = h;
  h_ = std::abs(h);
  t1_ = t1;
  error_ = std::numeric_limits<double>::quiet_NaN();
  newton_.forget_undefined();
  newton_.renew_if_noise(d_ * h);
  if (newton_.jacobian_age() >= old_jacobian) newton_.renew();
  if (newton_.repair(t_, y()) == Status::stop) return {Outcome::stop, error_, candidate_.data(), false};
  Newton::Result result = stages();
  if (result == Newton::Result::converged) {
    estimate(error_vector_.data());
    result = newton_.damp(error_vector_.data());
    if (result == Newton::Result::converged) error_ = error_norm(error_vector_);
  }
  return {result == Newton::Result::stop ? Outcome::stop : Outcome::ok, error_, candidate_.data(),
          result == Newton::Result::converged};
}

Newton::Result OrderTwo::solve_stage(double t, double* y, double* z) {
  const double c = d_ * signed_h_;
  switch (newton_.prepare(c, t)) {
    case Outcome::stop: return Newton::Result::stop;
    case Outcome::not_finite: return Newton::Result::failed;
    case Outcome::ok: break;
  }
  for (std::size_t i = 0; i < n(); ++i) base_[i] += psi_[i];
  weights_.fill(this->y(), base_.data(), weight_.data());
  const Newton::Result result = newton_.solve(c, t, base_.data(), psi_.data(), weight_.data(), increment_.data(), y);
  for (std::size_t i = 0; i < n(); ++i) z[i] = (psi_[i] + increment_[i]) / d_;
  return result;
}

double OrderTwo::error_norm(const std::vector<double>& v) const {
  return max_norm(n(), [&](std::size_t i) { return v[i] / weights_.at(i, y_[i], candidate_[i]); });
}

bool OrderTwo::errors(double* out) const {
  std::copy(error_vector_.begin(), error_vector_.end(), out);
  return true;
}

bool OrderTwo::reject(Cause cause, double hmin) {
  if (cause == Cause::newton && newton_.hopeless()) return false;
  if (cause == Cause::newton && newton_.renew_if_old()) return true;
  if (h_ <= hmin) return false;
  double factor = 0.5;
  if (cause == Cause::newton) {
    factor = newton_cut;
    newton_.renew_if_undefined();
  } else if (cause == Cause::error && !failed_) {
    factor = std::max(smallest_retry, retry * std::pow(weights_.rtol() / error_, 1 / estimate_order));
  }
  if (cause != Cause::newton) failed_ = true;
  h_ = std::max(hmin, factor * h_);
  return true;
}

/// The slope belongs to y*: that projection has moved it is of higher order (as in explicit pairs), and costs no f.
Outcome OrderTwo::accept(const double* y1) {
  if (end_slope(last_slope_.data()) == Status::stop) return Outcome::stop;
  last_slope_.swap(slope_);
  last_y_.swap(y_);
  std::copy(y1, y1 + n(), y_.begin());
  t_ = t1_;
  last_h_ = signed_h_;
  newton_.step_accepted();
  if (!failed_) {
    const double divisor = std::max(smallest_divisor, safety * std::pow(error_ / weights_.rtol(), 1 / estimate_order));
    if (divisor > 1 || divisor * kept_up_to < 1) h_ /= divisor;
  }
  failed_ = false;
  return Outcome::ok;
}

void OrderTwo::state(Archive& archive) {
  Step::state(archive);
  newton_.state(archive);
  archive(slope_, last_y_, last_slope_, last_h_, failed_);
}

}  // namespace invariode
