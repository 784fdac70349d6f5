#include "methods/trbdf2.hpp"

#include <algorithm>

namespace invariode {
namespace {

// Where P is tested: in each of its cubics, of which neither knows the other. In the middle of the first one the error
// of stiff components vanishes as h grows by 3/2, and the controller finds that h; here no ratio of steps hides it.
constexpr double looked_at_in_trbdf2[] = {std::numbers::sqrt2 - 1, (1 + TrBdf2::gamma) / 2};
// Of P, in units of the estimate: 0.3 in smooth parts, 0.3 to 0.5 in stiff ones that follow t³, unless h grows.
constexpr double trbdf2_extension_error = 0.5;

/// The derivative at u of the cubic that rises by `rise` from u = 0 to 1, with derivatives da and db there.
double hermite_slope(double rise, double da, double db, double u) {
  return 6 * u * (1 - u) * rise + (1 - u) * (1 - 3 * u) * da + u * (3 * u - 2) * db;
}

}  // namespace

void two_hermite_cubics(const double* data, std::size_t, std::size_t n, double theta, double* out) {
  constexpr double gamma = TrBdf2::gamma;
  const bool first = theta < gamma;
  const double* a = first ? data : data + 2 * n;
  const double width = first ? gamma : 1 - gamma;
  const double u = (theta - (first ? 0 : gamma)) / width, v = 1 - u;
  const double a1 = v * v * (1 + 2 * u), b1 = u * u * (3 - 2 * u);
  for (std::size_t i = 0; i < n; ++i)
    out[i] = a1 * a[i] + b1 * a[2 * n + i] + u * v * width * (v * a[n + i] - u * a[3 * n + i]);
}

TrBdf2::TrBdf2(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : OrderTwo(f, weights, linear, d, {.theta = looked_at_in_trbdf2, .error = trbdf2_extension_error}) {
  for (std::vector<double>* v : {&z0_, &z1_, &z2_, &middle_}) v->resize(weights.size());
}

Newton::Result TrBdf2::stages() {
  predict_first();
  const Newton::Result first = solve_stage(t_ + gamma * signed_h_, middle_.data(), z1_.data());
  if (first != Newton::Result::converged) return first;
  predict_second();
  return solve_stage(t1_, candidate_.data(), z2_.data());
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

void TrBdf2::estimate(double* error) {
  for (std::size_t i = 0; i < n(); ++i) error[i] = e[0] * z0_[i] + e[1] * z1_[i] + e[2] * z2_[i];
}

Status TrBdf2::extend(double theta, double* P, double* rise) {
  const bool first = theta < gamma;
  const std::vector<double>&a = first ? y_ : middle_, &b = first ? middle_ : candidate_;
  const std::vector<double>&za = first ? z0_ : z1_, &zb = first ? z1_ : z2_;
  const double width = first ? gamma : 1 - gamma;
  const double u = (theta - (first ? 0 : gamma)) / width, v = 1 - u;
  for (std::size_t i = 0; i < n(); ++i) {
    const double part = b[i] - a[i];
    P[i] = a[i] + u * u * (3 - 2 * u) * part + u * v * width * (v * za[i] - u * zb[i]);
    rise[i] = hermite_slope(part / width, za[i], zb[i], u);
  }
  return Status::ok;
}

Status TrBdf2::end_slope(double* slope) {
  for (std::size_t i = 0; i < n(); ++i) slope[i] = z2_[i] / signed_h_;
  return Status::ok;
}

std::size_t TrBdf2::directions(const double** vectors) const {
  for (const std::vector<double>* z : {&z0_, &z1_, &z2_}) *vectors++ = z->data();
  return 3;
}

void TrBdf2::cubics(const std::vector<double>& start, double* data) const {
  for (const std::vector<double>* row : {&start, &z0_, &middle_, &z1_, &candidate_, &z2_})
    data = std::copy(row->begin(), row->end(), data);
}

Status TrBdf2::extension(double* data) {
  cubics(last_y_, data);
  return Status::ok;
}

Status TrBdf2::extension_of_attempt(double* data, std::size_t& size) {
  size = extension_size();
  cubics(y_, data);
  return Status::ok;
}

}  // namespace invariode
