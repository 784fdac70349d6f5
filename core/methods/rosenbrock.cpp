#include "methods/rosenbrock.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <numbers>

#include "linear/time_derivative.hpp"
#include "methods/runge_kutta.hpp"

namespace invariode {
namespace {

constexpr double d = 1 / (2 + std::numbers::sqrt2);
constexpr double e32 = 6 + std::numbers::sqrt2;

// The constants of the code.
constexpr double starting_safety = 1.25;
constexpr double safety = 1.25, smallest_divisor = 0.2;  // of h after a success
constexpr double retry = 0.8, smallest_retry = 0.1;      // after a first failure
constexpr double estimate_order = 3;                     // it is O(h³)

}  // namespace

Rosenbrock::Rosenbrock(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : Step(f, weights),
      jacobian_(f, weights, linear),
      initial_(f, linear),
      lu_(make_factorization(jacobian_.jacobian().structure, linear.lapack)) {
  for (std::vector<double>* v : {&f0_, &f1_, &f2_, &ft_, &k1_, &k2_, &k3_, &last_y_, &candidate_, &slope_, &scratch_})
    v->resize(weights.size());
}

/// 1/h is 1.25 ‖y'‖ / rtol^{1/3}.
Outcome Rosenbrock::start(double t, const double* y, const Span& span) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  failed_ = ft_known_ = false;
  jacobian_.forget();
  weights_.fill(y, scratch_.data());
  if (const Outcome outcome = initial_.first(jacobian_, t, y, scratch_.data(), f0_.data(), slope_.data());
      outcome != Outcome::ok)
    return outcome;
  const double size = max_norm(n(), [this](std::size_t i) { return slope_[i] / scratch_[i]; });
  h_ = first_h(starting_safety * size * std::pow(weights_.rtol(), -1 / estimate_order), t, span);
  return Outcome::ok;
}

Step::Attempt Rosenbrock::attempt(double h, double t1) {
  signed_h_ = h;
  h_ = std::abs(h);
  t1_ = t1;
  error_ = std::numeric_limits<double>::quiet_NaN();
  jacobian_.forget_undefined();
  Outcome outcome = linearize();
  const bool linearized = outcome != Outcome::not_finite;
  if (outcome == Outcome::ok) outcome = stages();
  if (outcome == Outcome::ok) {
    for (std::size_t i = 0; i < n(); ++i) k3_[i] = h / 6 * (k1_[i] - 2 * k2_[i] + k3_[i]);
    error_ = max_norm(n(), [this](std::size_t i) { return k3_[i] / weights_.at(i, y_[i], candidate_[i]); });
  }
  return {outcome, error_, candidate_.data(), linearized};
}

/// J and ∂f/∂t, if this is the first attempt of the step, and the factors of W = M − h d J.
Outcome Rosenbrock::linearize() {
  if (jacobian_.repair(t_, y(), f0_.data()) == Status::stop) return Outcome::stop;
  if (!ft_known_ && time_derivative(f_, t_, y(), f0_.data(), signed_h_, n(), ft_.data()) == Status::stop)
    return Outcome::stop;
  ft_known_ = true;
  return jacobian_.prepare(signed_h_ * d, t1_, [this] {
    jacobian_.count_factorization();
    return lu_->factor(jacobian_.mass_matrix(), signed_h_ * d, jacobian_.jacobian());
  });
}

/// W k₁ = f₀ + h d f_t
/// W (k₂ − k₁) = f₁ − M k₁,  f₁ = f(t + h/2, y + h k₁ / 2)
/// W k₃ = f₂ − e₃₂ (M k₂ − f₁) − 2 (M k₁ − f₀) + h d f_t,  f₂ = f(t₁, y + h k₂)
Outcome Rosenbrock::stages() {
  const double h = signed_h_;
  for (std::size_t i = 0; i < n(); ++i) k1_[i] = f0_[i] + h * d * ft_[i];
  solve(k1_);
  for (std::size_t i = 0; i < n(); ++i) scratch_[i] = y_[i] + 0.5 * h * k1_[i];
  if (const Outcome outcome = jacobian_.evaluate(t_ + 0.5 * h, scratch_.data(), f1_.data()); outcome != Outcome::ok)
    return outcome;
  const double* Mk = times_mass(k1_);
  for (std::size_t i = 0; i < n(); ++i) {
    k2_[i] = f1_[i] - Mk[i];
    k3_[i] = h * d * ft_[i] - 2 * (Mk[i] - f0_[i]);
  }
  solve(k2_);
  for (std::size_t i = 0; i < n(); ++i) {
    k2_[i] += k1_[i];
    candidate_[i] = y_[i] + h * k2_[i];
  }
  if (const Outcome outcome = jacobian_.evaluate(t1_, candidate_.data(), f2_.data()); outcome != Outcome::ok)
    return outcome;
  Mk = times_mass(k2_);
  for (std::size_t i = 0; i < n(); ++i) k3_[i] += f2_[i] - e32 * (Mk[i] - f1_[i]);
  solve(k3_);
  return Outcome::ok;
}

void Rosenbrock::solve(std::vector<double>& b) {
  assert(jacobian_.has_factors());
  jacobian_.count_solve();
  lu_->solve(b.data());
}

/// M k, in place of what the last call returned.
const double* Rosenbrock::times_mass(const std::vector<double>& k) {
  const Matrix* M = jacobian_.mass_matrix();
  if (!M) return k.data();
  M->multiply(k.data(), scratch_.data());
  return scratch_.data();
}

bool Rosenbrock::errors(double* out) const {
  std::copy(k3_.begin(), k3_.end(), out);
  return true;
}

std::size_t Rosenbrock::directions(const double** vectors) const {
  for (const std::vector<double>* k : {&k1_, &k2_, &k3_}) *vectors++ = k->data();
  return 3;
}

bool Rosenbrock::reject(Cause cause, double hmin) {
  if (h_ <= hmin) return false;
  const bool first = !failed_ && cause == Cause::error;
  failed_ = true;
  const double factor =
      first ? std::max(smallest_retry, retry * std::pow(weights_.rtol() / error_, 1 / estimate_order)) : 0.5;
  h_ = std::max(hmin, factor * h_);
  return true;
}

/// f at y₁ is f₂, unless projection has moved it: differences for J start from it.
Outcome Rosenbrock::accept(const double* y1) {
  if (!std::equal(y1, y1 + n(), candidate_.begin()))
    if (const Outcome outcome = jacobian_.evaluate(t1_, y1, f2_.data()); outcome != Outcome::ok) return outcome;
  f0_.swap(f2_);
  if (jacobian_.mass())  // the derivative of the extension
    for (std::size_t i = 0; i < n(); ++i) slope_[i] = ((2 - 2 * d) * k2_[i] - k1_[i]) / (1 - 2 * d);
  else
    slope_ = f0_;
  last_y_.swap(y_);
  std::copy(y1, y1 + n(), y_.begin());
  t_ = t1_;
  jacobian_.step_accepted();
  jacobian_.renew();
  jacobian_.forget_factors();  // the suite's code, whose counts these are, factorises in every step
  ft_known_ = false;
  if (!failed_) h_ /= std::max(smallest_divisor, safety * std::pow(error_ / weights_.rtol(), 1 / estimate_order));
  failed_ = false;
  return Outcome::ok;
}

void Rosenbrock::state(Archive& archive) {
  Step::state(archive);
  jacobian_.state(archive, [this](double c) { return lu_->factor(jacobian_.mass_matrix(), c, jacobian_.jacobian()); });
  archive(f0_, slope_, ft_, ft_known_, failed_);
}

Interpolate Rosenbrock::interpolate() const { return runge_kutta::nested_polynomial; }

/// y + h (θ (1 − θ) k₁ + θ (θ − 2d) k₂) / (1 − 2d) = y + θ (h k₂ + (1 − θ) h (k₁ − k₂) / (1 − 2d))
Status Rosenbrock::extension(double* data) {
  data = std::copy(last_y_.begin(), last_y_.end(), data);
  for (std::size_t i = 0; i < n(); ++i) {
    data[i] = signed_h_ * k2_[i];
    data[n() + i] = signed_h_ * (k1_[i] - k2_[i]) / (1 - 2 * d);
  }
  return Status::ok;
}

}  // namespace invariode
