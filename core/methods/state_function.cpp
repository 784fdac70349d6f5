#include "methods/state_function.hpp"

#include <cmath>

namespace invariode {
namespace {

// Of y in units of the weights, over which what y does to the slopes of S is a difference, ε^{1/4}: it need not be
// exact, and laws of S are disturbed by roundoff of it.
const double coupling_increment = std::pow(eps, 0.25);

}  // namespace

StateFunction::StateFunction(Callback& f, const Weights& weights, const LinearAlgebra& linear, Jacobian& jacobian)
    : f_(f),
      state_f_(linear.state ? *linear.state->f : f),
      weights_(linear.state ? *linear.state->weights : weights),
      extent_(linear.state ? linear.state->extent : Extent(weights.size())),
      coupled_(linear.state ? linear.state->coupled() : weights.size()),
      sensitivity_weights_(linear.state ? linear.state->iteration : nullptr),
      jacobian_(jacobian) {
  if (linear.state) sensitivities_ = *linear.state->sensitivities;
}

Outcome StateFunction::evaluate(double t, const double* y, double* out) {
  undefined_ = -1;
  if (!all_finite(y, extent_.size())) return Outcome::not_finite;
  if (f_(t, y, out) == Status::stop) return Outcome::stop;
  jacobian_.extend(y, out);
  return finite_or_noted(out, extent_.size());
}

Outcome StateFunction::evaluate_state(double t, const double* y, double* out) {
  undefined_ = -1;
  if (!all_finite(y, extent_.n)) return Outcome::not_finite;
  if (state_f_(t, y, out) == Status::stop) return Outcome::stop;
  jacobian_.extend(y, out);
  return finite_or_noted(out, extent_.n);
}

Outcome StateFunction::evaluate_sensitivities(double t, const double* Y, double* out) {
  undefined_ = -1;
  if (!all_finite(Y, extent_.size())) return Outcome::not_finite;
  if ((*sensitivities_)(t, Y, out + extent_.n) == Status::stop) return Outcome::stop;
  return all_finite(out + extent_.n, extent_.n * extent_.k) ? Outcome::ok : Outcome::not_finite;
}

Outcome StateFunction::finite_or_noted(const double* out, std::size_t count) {
  if (all_finite(out, count)) return Outcome::ok;
  undefined_ = static_cast<int>(std::find_if_not(out, out + count, [](double x) { return std::isfinite(x); }) - out);
  return Outcome::not_finite;
}

Status StateFunction::sensitivity_rate(double t, const double* Y, const double* slope, const double* f, double h,
                                       double* rate) {
  const std::size_t n = extent_.n;
  const double least = std::sqrt(eps) * std::max(std::abs(t), std::abs(t + h));
  const double dt = t + std::copysign(std::min(least, std::abs(h)), h) - t;
  beyond_.assign(Y, Y + extent_.size());
  for (std::size_t i = 0; i < n && slope != nullptr; ++i) beyond_[i] += dt * slope[i];
  if ((*sensitivities_)(t + dt, beyond_.data(), rate + n) == Status::stop) return Status::stop;
  for (std::size_t i = n; i < extent_.size(); ++i) rate[i] = dt == 0 ? 0 : (rate[i] - f[i]) / dt;
  if (!all_finite(rate + n, n * extent_.k)) std::fill_n(rate + n, n * extent_.k, 0);
  return Status::ok;
}

/// b_j += c ∂(J S_j + f_pj)/∂y b_0, by a difference along b_0. It need not be exact: the formulas have their order with
/// any matrix, and it is what keeps S stable where y is stiff.
Status StateFunction::couple(double c, double t, const double* Y, const double* f, double* b) {
  const std::size_t n = extent_.n;
  const double size = max_norm(n, [&](std::size_t i) { return b[i] / weights_.at(i, Y[i]); });
  if (!(size > 0) || !std::isfinite(size)) return Status::ok;
  const double part = coupling_increment / size;
  beyond_.assign(Y, Y + extent_.size());
  changed_.resize(n * extent_.k);
  for (std::size_t i = 0; i < n; ++i) beyond_[i] += part * b[i];
  if ((*sensitivities_)(t, beyond_.data(), changed_.data()) == Status::stop) return Status::stop;
  if (!all_finite(changed_.data(), changed_.size())) return Status::ok;
  for (std::size_t i = 0; i < changed_.size(); ++i) b[n + i] += c * ((changed_[i] - f[n + i]) / part);
  return Status::ok;
}

}  // namespace invariode
