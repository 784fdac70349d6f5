#include "methods/trbdf2.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

namespace invariode {
namespace {

// y_γ = y + d (z₀ + z₁) and y₁ = y + w (z₀ + z₁) + d z₂, where z = h y'. γ makes the factors of both stages the same.
constexpr double gamma = 2 - std::numbers::sqrt2;
constexpr double d = gamma / 2;
constexpr double w = std::numbers::sqrt2 / 4;
/// The difference from the formula of order 3 on the same stages.
constexpr double e[] = {(1 - 4 * w) / 3, 1.0 / 3, -2 * d / 3};
constexpr double estimate_order = 3;  // it is O(h³)

// The constants of ode23s. Newton's iteration has to be more exact than in ode15s: its errors enter z, divided by d,
// and the stages of the next step (at ode15s' goal of 0.5 rtol van der Pol's equation has errors ten times larger).
constexpr double starting_safety = 1.25;
constexpr double safety = 1.25, smallest_divisor = 0.2;
constexpr double retry = 0.8, smallest_retry = 0.1;
constexpr Convergence::Rules rules{.most_iterations = 5, .goal = 0.03, .first_goal = 0.003};
constexpr double newton_cut = 0.3;
constexpr int old_jacobian = 20;    // steps
constexpr double kept_up_to = 1.2;  // a change of h up to this is not worth a factorisation

/// The derivative at u of the cubic that rises by `rise` from u = 0 to 1, with derivatives da and db there.
double hermite_slope(double rise, double da, double db, double u) {
  return 6 * u * (1 - u) * rise + (1 - u) * (1 - 3 * u) * da + u * (3 * u - 2) * db;
}

}  // namespace

void two_hermite_cubics(const double* data, std::size_t, std::size_t n, double theta, double* out) {
  const bool first = theta < gamma;
  const double* a = first ? data : data + 2 * n;
  const double width = first ? gamma : 1 - gamma;
  const double u = (theta - (first ? 0 : gamma)) / width, v = 1 - u;
  const double a1 = v * v * (1 + 2 * u), b1 = u * u * (3 - 2 * u);
  for (std::size_t i = 0; i < n; ++i)
    out[i] = a1 * a[i] + b1 * a[2 * n + i] + u * v * width * (v * a[n + i] - u * a[3 * n + i]);
}

TrBdf2::TrBdf2(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : Step(f, weights), newton_(f, weights, linear, rules), initial_(f, linear) {
  for (std::vector<double>* v : {&slope_, &z0_, &z1_, &z2_, &middle_, &candidate_, &base_, &last_y_, &last_slope_,
                                 &weight_, &predictor_, &psi_, &d_, &error_vector_})
    v->resize(weights.size());
}

/// 1/h is 1.25 rtol^{-1/3} times the larger one of ‖y'‖ and √(‖y''‖ / 2).
Outcome TrBdf2::start(double t, const double* y, const Span& span) {
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
  if (initial_.second(newton_, t, y, h, candidate_.data(), slope_.data(), base_.data(), psi_.data()) == Status::stop)
    return Outcome::stop;
  h_ = first_h(std::max(first, scale * std::sqrt(0.5 * norm(psi_))), t, span);
  return Outcome::ok;
}

Step::Attempt TrBdf2::attempt(double h, double t1) {
  signed_h_ = h;
  h_ = std::abs(h);
  t1_ = t1;
  error_ = std::numeric_limits<double>::quiet_NaN();
  newton_.forget_undefined();
  const auto ended = [this](Newton::Result result) {
    return Attempt{result == Newton::Result::stop ? Outcome::stop : Outcome::ok, error_, candidate_.data(), false};
  };
  newton_.renew_if_noise(d * h);
  if (newton_.repair(t_, y()) == Status::stop) return ended(Newton::Result::stop);
  predict_first();
  if (const Newton::Result result = solve_stage(t_ + gamma * h, middle_.data(), z1_.data());
      result != Newton::Result::converged)
    return ended(result);
  predict_second();
  if (const Newton::Result result = solve_stage(t1, candidate_.data(), z2_.data()); result != Newton::Result::converged)
    return ended(result);
  if (const Newton::Result result = estimate(); result != Newton::Result::converged) return ended(result);
  return {Outcome::ok, error_, candidate_.data()};
}

/// z₁ as the last step, extended, has it; in a first step as it is at the start.
void TrBdf2::predict_first() {
  const double u = 1 + gamma * signed_h_ / last_h_;
  for (std::size_t i = 0; i < n(); ++i) {
    z0_[i] = signed_h_ * slope_[i];
    const double rate =
        last_h_ == 0 ? slope_[i] : hermite_slope((y_[i] - last_y_[i]) / last_h_, last_slope_[i], slope_[i], u);
    base_[i] = y_[i] + d * z0_[i];
    psi_[i] = d * signed_h_ * rate;
  }
}

/// z₂ as the interpolant of the first part of the step, extended, has it.
void TrBdf2::predict_second() {
  for (std::size_t i = 0; i < n(); ++i) {
    base_[i] = y_[i] + w * (z0_[i] + z1_[i]);
    psi_[i] = d * hermite_slope((middle_[i] - y_[i]) / gamma, z0_[i], z1_[i], 1 / gamma);
  }
}

/// y = base + d z with M z = h f(t, y), from the prediction ψ of d z.
Newton::Result TrBdf2::solve_stage(double t, double* y, double* z) {
  const double c = d * signed_h_;
  switch (newton_.prepare(c, t)) {
    case Outcome::stop: return Newton::Result::stop;
    case Outcome::not_finite: return Newton::Result::failed;
    case Outcome::ok: break;
  }
  for (std::size_t i = 0; i < n(); ++i) predictor_[i] = base_[i] + psi_[i];
  weights_.fill(this->y(), predictor_.data(), weight_.data());
  const Newton::Result result = newton_.solve(c, t, predictor_.data(), psi_.data(), weight_.data(), d_.data(), y);
  for (std::size_t i = 0; i < n(); ++i) z[i] = (psi_[i] + d_[i]) / d;
  return result;
}

/// Σ e_i z_i, damped by (M − d h J)⁻¹ M: of stiff components it would say too much.
Newton::Result TrBdf2::estimate() {
  for (std::size_t i = 0; i < n(); ++i) error_vector_[i] = e[0] * z0_[i] + e[1] * z1_[i] + e[2] * z2_[i];
  if (const Newton::Result result = newton_.damp(error_vector_.data()); result != Newton::Result::converged)
    return result;
  error_ = max_norm(n(), [this](std::size_t i) { return error_vector_[i] / weights_.at(i, y_[i], candidate_[i]); });
  return Newton::Result::converged;
}

bool TrBdf2::errors(double* out) const {
  std::copy(error_vector_.begin(), error_vector_.end(), out);
  return true;
}

std::size_t TrBdf2::directions(const double** vectors) const {
  for (const std::vector<double>* z : {&z0_, &z1_, &z2_}) *vectors++ = z->data();
  return 3;
}

bool TrBdf2::reject(Cause cause, double hmin) {
  if (cause == Cause::newton && newton_.renew_if_old()) return true;
  if (h_ <= hmin) return false;
  double factor = 0.5;
  if (cause == Cause::newton) {
    factor = newton_cut;
    newton_.renew_if_undefined();
  } else if (cause == Cause::error) {
    if (!failed_) factor = std::max(smallest_retry, retry * std::pow(weights_.rtol() / error_, 1 / estimate_order));
    if (newton_.jacobian_age() >= old_jacobian) newton_.renew();
  }
  if (cause != Cause::newton) failed_ = true;
  h_ = std::max(hmin, factor * h_);
  return true;
}

/// z₂ belongs to y*: that projection has moved it is of higher order (as in explicit pairs), and costs no f.
Outcome TrBdf2::accept(const double* y1) {
  last_slope_.swap(slope_);
  for (std::size_t i = 0; i < n(); ++i) slope_[i] = z2_[i] / signed_h_;
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

void TrBdf2::state(Archive& archive) {
  Step::state(archive);
  newton_.state(archive);
  archive(slope_, last_y_, last_slope_, last_h_, failed_);
}

Status TrBdf2::extension(double* data) {
  for (const std::vector<double>* row : {&last_y_, &z0_, &middle_, &z1_, &candidate_, &z2_})
    data = std::copy(row->begin(), row->end(), data);
  return Status::ok;
}

}  // namespace invariode
