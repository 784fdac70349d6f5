#include "methods/rosenbrock.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <numbers>

#include "methods/initial_step.hpp"
#include "methods/runge_kutta.hpp"

namespace invariode {
namespace {

constexpr double d = 1 / (2 + std::numbers::sqrt2);
constexpr double e32 = 6 + std::numbers::sqrt2;

// |h| times the difference of f in the middle of the step from its linearization, in units of rtol and of the error
// estimate: for a smooth f it is about 3 times the estimate.
constexpr double harmless_difference = 20, told_difference = 100;

}  // namespace

Rosenbrock::Rosenbrock(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : ImplicitBase(f, weights, linear), lu_(make_factorization(solver_.jacobian().structure, linear.lapack)) {
  provide({&f0_, &f1_, &f2_, &ft_, &k1_, &k2_, &k3_, &slope_, &last_y_, &scratch_, &bend_});
}

/// 1/h is 1.25 ‖y'‖ / rtol^{1/3}.
Outcome Rosenbrock::start(double t, const double* y, const Span& span) {
  ft_known_ = false;
  solver_.forget();
  if (const Outcome outcome = begin(t, y, f0_.data(), slope_.data()); outcome != Outcome::ok) return outcome;
  const double reciprocal = starting_safety * norm(slope_.data()) * std::pow(weights_.rtol(), -1 / third);
  return choose_initial_step(span, reciprocal, reciprocal, f0_.data(), slope_.data(), k1_.data(), k2_.data());
}

Step::Attempt Rosenbrock::attempt(double h, double t1) {
  begin_attempt(h, t1);
  Outcome outcome = linearize();
  const bool linearized = outcome != Outcome::not_finite;
  if (outcome == Outcome::ok) outcome = stages();
  if (outcome == Outcome::ok) {
    for (std::size_t i = 0; i < n(); ++i) k3_[i] = h / 6 * (k1_[i] - 2 * k2_[i] + k3_[i]);
    error_ = error_norm(k3_);
    bent_ = error_ <= weights_.rtol() && looks_like_jump();
  }
  return {outcome, error_, candidate_.data(), linearized};
}

/// J and ∂f/∂t, if this is the first attempt of the step, and the factors of W = M − h d J.
Outcome Rosenbrock::linearize() {
  if (solver_.repair(t_, y(), f0_.data()) == Status::stop) return Outcome::stop;
  if (!ft_known_) {
    if (solver_.time_derivative(t_, y(), f0_.data(), signed_h_, ft_.data()) == Status::stop) return Outcome::stop;
    if (solver_.system().sensitivity_rate(t_, y(), nullptr, f0_.data(), signed_h_, ft_.data()) == Status::stop)
      return Outcome::stop;
  }
  ft_known_ = true;
  return solver_.prepare(signed_h_ * d, t1_, [this] {
    const bool regular = lu_->factor(solver_.mass_matrix(), signed_h_ * d, solver_.jacobian());
    solver_.count_factorization();  // unless it was given up
    return regular;
  });
}

/// W k₁ = f₀ + h d f_t
/// W (k₂ − k₁) = f₁ − M k₁,  f₁ = f(t + h/2, y + h k₁ / 2)
/// W k₃ = f₂ − e₃₂ (M k₂ − f₁) − 2 (M k₁ − f₀) + h d f_t,  f₂ = f(t₁, y + h k₂)
Outcome Rosenbrock::stages() {
  const double h = signed_h_;
  for (std::size_t i = 0; i < n(); ++i) k1_[i] = f0_[i] + h * d * ft_[i];
  if (solve(k1_) == Status::stop) return Outcome::stop;
  for (std::size_t i = 0; i < n(); ++i) scratch_[i] = y_[i] + 0.5 * h * k1_[i];
  if (const Outcome outcome = solver_.evaluate(t_ + 0.5 * h, scratch_.data(), f1_.data()); outcome != Outcome::ok)
    return outcome;
  const double* Mk = times_mass(k1_);
  for (std::size_t i = 0; i < n(); ++i) {
    k2_[i] = f1_[i] - Mk[i];
    k3_[i] = h * d * ft_[i] - 2 * (Mk[i] - f0_[i]);
  }
  if (solve(k2_) == Status::stop) return Outcome::stop;
  for (std::size_t i = 0; i < n(); ++i) {
    k2_[i] += k1_[i];
    candidate_[i] = y_[i] + h * k2_[i];
  }
  if (const Outcome outcome = solver_.evaluate(t1_, candidate_.data(), f2_.data()); outcome != Outcome::ok)
    return outcome;
  Mk = times_mass(k2_);
  for (std::size_t i = 0; i < n(); ++i) k3_[i] += f2_[i] - e32 * (Mk[i] - f1_[i]);
  return solve(k3_) == Status::stop ? Outcome::stop : Outcome::ok;
}

/// Looks for a jump of f by the same amount in both halves of the step, which J does not contain: the estimate
/// vanishes. W⁻¹ (f₁ − f₀ − h/2 (J k₁ + f_t)), with h d (J k₁ + f_t) = M k₁ − f₀, does not. W⁻¹ removes roundoff of J
/// and stiff components, as in the estimate.
bool Rosenbrock::looks_like_jump() {
  const std::size_t states = solver_.system().state().size();
  const auto size = [&] {
    return h_ * max_norm(states, [&](std::size_t i) { return bend_[i] / weights_.at(i, y_[i], candidate_[i]); });
  };
  const double harmless = std::max(harmless_difference * weights_.rtol(), told_difference * error_);
  const double* Mk = times_mass(k1_);
  for (std::size_t i = 0; i < states; ++i) bend_[i] = f1_[i] - f0_[i] - (Mk[i] - f0_[i]) / (2 * d);
  if (solver_.mass() == nullptr && !(size() > harmless)) return false;
  lu_->solve(bend_.data());
  return size() > harmless;
}

Status Rosenbrock::solve(std::vector<double>& b) {
  assert(solver_.has_factors());
  return solver_.solve_whole(*lu_, signed_h_ * d, t_, y(), f0_.data(), b.data());
}

/// M k, in place of what the last call returned.
const double* Rosenbrock::times_mass(const std::vector<double>& k) {
  const Matrix* M = solver_.mass_matrix();
  if (!M) return k.data();
  solver_.system().multiply_mass(*M, k.data(), scratch_.data());
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

/// f at y₁ is f₂, unless projection has moved it: differences for J start from it.
Outcome Rosenbrock::accept(const double* y1) {
  if (!std::equal(y1, y1 + n(), candidate_.begin()))
    if (const Outcome outcome = solver_.evaluate(t1_, y1, f2_.data()); outcome != Outcome::ok) return outcome;
  f0_.swap(f2_);
  if (solver_.mass())  // the derivative of the extension
    for (std::size_t i = 0; i < n(); ++i) slope_[i] = ((2 - 2 * d) * k2_[i] - k1_[i]) / (1 - 2 * d);
  else
    slope_ = f0_;
  last_y_.swap(y_);
  commit(y1);
  solver_.renew();
  solver_.forget_factors();  // the suite's code, whose counts these are, factorises in every step
  ft_known_ = false;
  if (!failed_) h_ /= divisor_of_order_two();
  failed_ = false;
  return Outcome::ok;
}

void Rosenbrock::state(Archive& archive) {
  Step::state(archive);
  solver_.state(archive, [this](double c) { return lu_->factor(solver_.mass_matrix(), c, solver_.jacobian()); });
  archive(f0_, slope_, ft_, ft_known_, failed_);
}

Interpolate Rosenbrock::interpolate() const { return in_turn<runge_kutta::nested_polynomial>; }

/// y + h (θ (1 − θ) k₁ + θ (θ − 2d) k₂) / (1 − 2d) = y + θ (h k₂ + (1 − θ) h (k₁ − k₂) / (1 − 2d))
void Rosenbrock::parabola(const std::vector<double>& start, double* data) const {
  data = std::copy(start.begin(), start.end(), data);
  for (std::size_t i = 0; i < n(); ++i) {
    data[i] = signed_h_ * k2_[i];
    data[n() + i] = signed_h_ * (k1_[i] - k2_[i]) / (1 - 2 * d);
  }
}

Status Rosenbrock::extension(double* data) {
  parabola(last_y_, data);
  return Status::ok;
}

Status Rosenbrock::extension_of_attempt(double* data, std::size_t& size) {
  size = extension_size();
  parabola(y_, data);
  return Status::ok;
}

}  // namespace invariode
