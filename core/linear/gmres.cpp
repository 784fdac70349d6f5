#include "linear/gmres.hpp"

#include <algorithm>
#include <cmath>

#include "weights.hpp"

namespace invariode {
namespace {

constexpr int most_cycles = 6;          // so many times the dimension, iterations at most
constexpr double least_progress = 0.7;  // of a cycle: what it may leave of the residual, or the solve is given up
constexpr std::size_t block = 512;      // doubles of a vector at a time: those of several vectors stay in the cache

/// Σ a_i b_i, in eight sums, so that none waits for the one before.
double dot(const double* a, const double* b, std::size_t n) {
  constexpr std::size_t lanes = 8;
  double sum[lanes] = {};
  std::size_t i = 0;
  for (; i + lanes <= n; i += lanes)
    for (std::size_t k = 0; k < lanes; ++k) sum[k] += a[i + k] * b[i + k];
  for (; i < n; ++i) sum[0] += a[i] * b[i];
  return ((sum[0] + sum[1]) + (sum[2] + sum[3])) + ((sum[4] + sum[5]) + (sum[6] + sum[7]));
}

double euclidean(const double* v, std::size_t n) { return std::sqrt(dot(v, v, n)); }
double largest(const double* v, std::size_t n) {
  return max_norm(n, [v](std::size_t i) { return v[i]; });
}

}  // namespace

Gmres::Gmres(std::size_t n, std::size_t dimension)
    : n_(n),
      dimension_(dimension),
      basis_((dimension + 1) * n),
      scratch_(n),
      hessenberg_((dimension + 1) * dimension),
      cosines_(dimension),
      sines_(dimension),
      rotated_(dimension + 1),
      coefficients_(dimension + 1) {}

Gmres::Result Gmres::solve(LinearOperator& A, const double* w, double tolerance, double* x) {
  for (std::size_t i = 0; i < n_; ++i) {
    scratch_[i] = x[i] / w[i];
    x[i] = 0;
  }
  size_ = largest(scratch_.data(), n_);
  shrinkage_ = 1;
  for (int count = 0; count < most_cycles; ++count) {
    const double before = size_, norm = euclidean(scratch_.data(), n_);
    if (norm == 0) return Result::converged;
    if (!std::isfinite(norm)) return Result::failed;
    for (std::size_t i = 0; i < n_; ++i) basis(0)[i] = scratch_[i] / norm;
    const Result result = cycle(A, w, tolerance, norm);
    if (result == Result::stop) return result;
    add_solution(w, x);
    if (result == Result::converged) return result;
    if (!(size_ <= least_progress * before)) break;
  }
  return Result::failed;
}

/// From the residual in basis(0), of that norm, until the one formed is small enough or the space is full: `failed`.
Gmres::Result Gmres::cycle(LinearOperator& A, const double* w, double tolerance, double norm) {
  std::fill(rotated_.begin(), rotated_.end(), 0);
  rotated_[0] = norm;
  double ratio = size_ / norm;  // of the largest component to the Euclidean norm, as far as is known
  for (columns_ = 0; columns_ < dimension_;) {
    if (extend(A, w, columns_) == Status::stop) return Result::stop;
    ++iterations_;
    const double estimate = rotate(columns_++);
    if (!std::isfinite(estimate)) return Result::failed;
    shrinkage_ = std::min(shrinkage_, H(columns_ - 1, columns_ - 1));  // about the least singular value, from above
    const double goal = shrinkage_ * tolerance;
    if (estimate * ratio > goal && columns_ < dimension_) continue;
    form_residual();
    if (size_ <= goal) return Result::converged;
    if (estimate == 0) break;
    ratio = size_ / estimate;
  }
  return Result::failed;
}

/// W⁻¹ A W v_j, made orthogonal to the vectors before it (modified Gram-Schmidt), as the next one.
Status Gmres::extend(LinearOperator& A, const double* w, std::size_t j) {
  double* next = basis(j + 1);
  for (std::size_t i = 0; i < n_; ++i) scratch_[i] = basis(j)[i] * w[i];
  if (A.multiply(scratch_.data(), next) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < n_; ++i) next[i] /= w[i];
  for (std::size_t k = 0; k <= j; ++k) {
    const double* v = basis(k);
    const double h = H(k, j) = dot(v, next, n_);
    for (std::size_t i = 0; i < n_; ++i) next[i] -= h * v[i];
  }
  const double norm = H(j + 1, j) = euclidean(next, n_);
  if (norm > 0)
    for (std::size_t i = 0; i < n_; ++i) next[i] /= norm;
  return Status::ok;
}

/// Makes column j triangular. Returns the Euclidean norm of the residual.
double Gmres::rotate(std::size_t j) {
  for (std::size_t k = 0; k < j; ++k) {
    const double upper = H(k, j), lower = H(k + 1, j);
    H(k, j) = cosines_[k] * upper + sines_[k] * lower;
    H(k + 1, j) = cosines_[k] * lower - sines_[k] * upper;
  }
  const double length = std::hypot(H(j, j), H(j + 1, j));
  cosines_[j] = length > 0 ? H(j, j) / length : 0;  // of a column of zeros, which reduces no residual
  sines_[j] = length > 0 ? H(j + 1, j) / length : 1;
  H(j, j) = length;
  rotated_[j + 1] = -sines_[j] * rotated_[j];
  rotated_[j] *= cosines_[j];
  return std::abs(rotated_[j + 1]);
}

/// The residual is the last rotated component, rotated back, in the basis: no product.
void Gmres::form_residual() {
  std::fill(coefficients_.begin(), coefficients_.end(), 0);
  coefficients_[columns_] = rotated_[columns_];
  for (std::size_t k = columns_; k-- > 0;) {
    coefficients_[k] = -sines_[k] * coefficients_[k + 1];
    coefficients_[k + 1] *= cosines_[k];
  }
  for (std::size_t first = 0; first < n_; first += block)
    combine(columns_ + 1, first, std::min(block, n_ - first), scratch_.data() + first);
  size_ = largest(scratch_.data(), n_);
}

/// x + W V z, where H z is the rotated right-hand side.
void Gmres::add_solution(const double* w, double* x) {
  if (columns_ == 0) return;
  std::vector<double>& z = coefficients_;
  for (std::size_t k = columns_; k-- > 0;) {
    double sum = rotated_[k];
    for (std::size_t j = k + 1; j < columns_; ++j) sum -= H(k, j) * z[j];
    z[k] = H(k, k) != 0 ? sum / H(k, k) : 0;
  }
  double part[block];
  for (std::size_t first = 0; first < n_; first += block) {
    const std::size_t size = std::min(block, n_ - first);
    combine(columns_, first, size, part);
    for (std::size_t i = 0; i < size; ++i) x[first + i] += w[first + i] * part[i];
  }
}

/// Components first … first + size − 1 of the sum of vectors of the basis with the coefficients.
void Gmres::combine(std::size_t count, std::size_t first, std::size_t size, double* out) const {
  std::fill_n(out, size, 0);
  for (std::size_t k = 0; k < count; ++k) {
    const double* v = basis_.data() + k * n_ + first;
    for (std::size_t i = 0; i < size; ++i) out[i] += coefficients_[k] * v[i];
  }
}

}  // namespace invariode
