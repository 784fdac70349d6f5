#include "linear/matrix_free.hpp"

#include <algorithm>
#include <cmath>

namespace invariode {
namespace {

const double difference_size = std::sqrt(eps);  // of the largest component of σ v, in units of the weights

}  // namespace

JacobianProduct::JacobianProduct(Callback& f, const Callback& product, const Weights& weights)
    : f_(f), product_(product), weights_(weights), point_(weights.size() * (product_ ? 2 : 1)) {}

void JacobianProduct::at(double t, const double* y, const double* slope) {
  t_ = t;
  y_ = y;
  slope_ = slope;
  if (product_) std::copy(y, y + weights_.size(), point_.begin());
}

Status JacobianProduct::multiply(const double* v, double* out) {
  ++count_;
  if (!product_) return difference(v, out);
  std::copy(v, v + weights_.size(), point_.begin() + static_cast<std::ptrdiff_t>(weights_.size()));
  return product_(t_, point_.data(), out);
}

/// (f(t, y + σ v) − f(t, y)) / σ; where f is not finite there, to the other side.
Status JacobianProduct::difference(const double* v, double* out) {
  const std::size_t n = weights_.size();
  const double size = max_norm(n, [this, v](std::size_t i) { return v[i] / weights_.at(i, y_[i]); });
  if (size == 0) {
    std::fill(out, out + n, 0);
    return Status::ok;
  }
  for (const double sigma : {difference_size / size, -difference_size / size}) {
    for (std::size_t i = 0; i < n; ++i) point_[i] = y_[i] + sigma * v[i];
    if (f_(t_, point_.data(), out) == Status::stop) return Status::stop;
    for (std::size_t i = 0; i < n; ++i) out[i] = (out[i] - slope_[i]) / sigma;
    if (all_finite(out, n)) break;
  }
  return Status::ok;
}

void JacobianProduct::state(Archive& archive) {
  archive(count_);
  product_.state(archive);
}

MatrixFree::MatrixFree(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : product_(f, linear.krylov->product, weights),
      preconditioner_(linear.krylov->preconditioner),
      gmres_(weights.size(), std::min(linear.krylov->dimension, weights.size())),
      mass_times_v_(linear.mass ? weights.size() : 0),
      known_y_(preconditioner_ ? weights.size() : 0) {}

void MatrixFree::reach(double t, const double* y) {
  t_ = t;
  y_ = y;
}

Status MatrixFree::set_up(double c) {
  if (!preconditioner_) return Status::ok;
  known_t_ = t_;
  std::copy(y_, y_ + known_y_.size(), known_y_.begin());
  return preconditioner_.set_up(known_t_, known_y_.data(), c);
}

Status MatrixFree::set_up_again(double c) {
  return preconditioner_ ? preconditioner_.set_up(known_t_, known_y_.data(), c) : Status::ok;
}

Status MatrixFree::precondition(double* b) { return preconditioner_ ? preconditioner_.solve(b) : Status::ok; }

bool MatrixFree::negligible(const double* w, double tolerance, const double* b) const {
  return max_norm(gmres_.n(), [b, w](std::size_t i) { return b[i] / w[i]; }) <= gmres_.shrinkage() * tolerance;
}

Gmres::Result MatrixFree::solve(double c, const Matrix* mass, const double* w, double tolerance, double* b) {
  c_ = c;
  mass_ = mass;
  return gmres_.solve(*this, w, tolerance, b);
}

/// P⁻¹ (M − c J) v
Status MatrixFree::multiply(const double* v, double* out) {
  if (product_.multiply(v, out) == Status::stop) return Status::stop;
  const double* Mv = v;
  if (mass_) {
    mass_->multiply(v, mass_times_v_.data());
    Mv = mass_times_v_.data();
  }
  for (std::size_t i = 0; i < gmres_.n(); ++i) out[i] = Mv[i] - c_ * out[i];
  return precondition(out);
}

void MatrixFree::state(Archive& archive) {
  product_.state(archive);
  gmres_.state(archive);
  archive(known_t_, known_y_);
}

}  // namespace invariode
