#include "methods/trapezoidal.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include "methods/runge_kutta.hpp"

namespace invariode {
namespace {

/// The cubic through the last y serves as a prediction up to this many last steps ahead, the parabola beyond.
constexpr double longest_reach = 2;
constexpr double looked_at_in_trapezoid[] = {0.5};  // where P is tested
constexpr double trapezoid_extension_error =
    0.75;  // of P, in units of the estimate: smooth parts, and stiff ones that ring

}  // namespace

Trapezoidal::Trapezoidal(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : OrderTwo(f, weights, linear, d, {.theta = looked_at_in_trapezoid, .error = trapezoid_extension_error}) {
  for (std::vector<double>* v : {&z0_, &z1_, &bent_, &missed_, &last_missed_, &rise_[0], &rise_[1], &rise_[2]})
    v->resize(weights.size());
}

/// Factors of `rise_` for the polynomials of degree 1, 2 and 3 through the last y at t₁. 0: too few steps.
std::array<double, 3> Trapezoidal::growth() const {
  if (last_h_ == 0) return {};
  const double h = signed_h_, h1 = last_h_;
  const double line = h / h1, parabola = line * ((h + h1) / (h1 + h2_));
  const double cubic = parabola * ((h + h1 + h2_) / (h1 + h2_ + h3_));
  return {line, h2_ == 0 ? 0 : parabola, h3_ == 0 || line > longest_reach ? 0 : cubic};
}

/// y₁ is predicted from values of y alone: the y' of stiff components may be of little worth.
Newton::Result Trapezoidal::stages() {
  const double h = signed_h_;
  smoothed_ = false;
  const auto [line, parabola, cubic] = growth();
  for (std::size_t i = 0; i < n(); ++i) {
    z0_[i] = h * slope_[i];
    base_[i] = y_[i] + d * z0_[i];
    psi_[i] = last_h_ == 0 ? d * (z0_[i] + h * h * second_[i])
                           : line * rise_[0][i] + parabola * rise_[1][i] + cubic * rise_[2][i] - d * z0_[i];
  }
  return solve_stage(t1_, candidate_.data(), z1_.data());
}

/// h³/6 times the divided difference of the last three y'.
void Trapezoidal::estimate(double* error) {
  const double h = signed_h_, ratio = h / last_h_, part = h / (h + last_h_);
  for (std::size_t i = 0; i < n(); ++i) {
    const double bend = last_h_ == 0 ? h * h * second_[i] : ratio * ratio * bent_[i];
    error[i] = missed_[i] = part / 6 * (z1_[i] - z0_[i] - bend);
  }
}

/// Evaluates the continuous extension in the middle of the step.
Status Trapezoidal::extend(double /*theta*/, double* P, double* rise) {
  if (smooth_if_ringing() == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < n(); ++i) {
    P[i] = (y_[i] + candidate_[i]) / 2 + (z0_[i] - z1_[i]) / 8;
    rise[i] = 1.5 * (candidate_[i] - y_[i]) - (z0_[i] + z1_[i]) / 4;
  }
  return Status::ok;
}

/// Smooths the history if it rings, once in a step.
Status Trapezoidal::smooth_if_ringing() { return !std::exchange(smoothed_, true) && rings() ? smooth() : Status::ok; }

/// Returns whether y''' alternates from step to step in some component, and neither step's damped estimate sees it: the
/// formula turns stiff components around in each step, y into nearly −y and y' into nearly −y'.
bool Trapezoidal::rings() {
  if (last_h_ == 0) return false;
  const double ratio = signed_h_ / last_h_, cube = ratio * ratio * ratio;
  for (std::size_t i = 0; i < n(); ++i)
    base_[i] = std::max(0.0, 0.5 * (std::abs(missed_[i] - cube * last_missed_[i]) - std::abs(missed_[i])));
  return error_norm(base_) > std::max(end_error(), cube * last_error_);
}

/// Takes from the parabola through the last three y what is stiff in y'. That changes y' by O(h³). Where GMRES does not
/// solve the system, y' stays as it is, and the next step looks again.
Status Trapezoidal::smooth() {
  const double line = signed_h_ / last_h_, part = signed_h_ / (signed_h_ + last_h_);
  for (std::size_t i = 0; i < n(); ++i) {
    const double rise = candidate_[i] - y_[i];
    base_[i] = rise + part * (rise - line * rise_[0][i]);
    psi_[i] = z1_[i] - base_[i];
  }
  switch (damp(psi_.data())) {
    case Newton::Result::stop: return Status::stop;
    case Newton::Result::failed: return Status::ok;
    case Newton::Result::converged: break;
  }
  for (std::size_t i = 0; i < n(); ++i) z1_[i] = psi_[i] + base_[i];
  return Status::ok;
}

Status Trapezoidal::end_slope(double* slope) {
  if (smooth_if_ringing() == Status::stop) return Status::stop;
  const auto [line, parabola, cubic] = growth();
  for (std::size_t i = 0; i < n(); ++i) {
    slope[i] = z1_[i] / signed_h_;
    bent_[i] = z1_[i] - z0_[i];
    const double rise = candidate_[i] - y_[i], bend = rise - line * rise_[0][i];
    rise_[2][i] = bend - parabola * rise_[1][i];
    rise_[1][i] = bend;
    rise_[0][i] = rise;
  }
  h3_ = last_h_ == 0 ? 0 : h2_;
  h2_ = last_h_;
  last_missed_ = missed_;
  last_error_ = end_error();
  return Status::ok;
}

std::size_t Trapezoidal::directions(const double** vectors) const {
  for (const std::vector<double>* z : {&z0_, &z1_}) *vectors++ = z->data();
  return 2;
}

void Trapezoidal::state(Archive& archive) {
  OrderTwo::state(archive);
  archive(second_, bent_, last_missed_, rise_[0], rise_[1], rise_[2], h2_, h3_, last_error_);
}

Interpolate Trapezoidal::interpolate() const { return in_turn<runge_kutta::nested_polynomial>; }

/// The cubic Hermite interpolant, y + θ (Δ + (1 − θ) (z₀ − Δ + θ (2Δ − z₀ − z₁))) with Δ = y* − y.
void Trapezoidal::cubic(const double* start, const double* rise, double* data) const {
  data = std::copy(start, start + n(), data);
  for (std::size_t i = 0; i < n(); ++i) {
    data[i] = rise[i];
    data[n() + i] = z0_[i] - rise[i];
    data[2 * n() + i] = 2 * rise[i] - z0_[i] - z1_[i];
  }
}

Status Trapezoidal::extension(double* data) {
  cubic(last_y_.data(), rise_[0].data(), data);
  return Status::ok;
}

Status Trapezoidal::extension_of_attempt(double* data, std::size_t& size) {
  size = extension_size();
  for (std::size_t i = 0; i < n(); ++i) base_[i] = candidate_[i] - y_[i];
  cubic(y_.data(), base_.data(), data);
  return Status::ok;
}

}  // namespace invariode
