#include "linear/gmres.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>

#include "weights.hpp"

namespace invariode {
namespace {

constexpr int most_cycles = 6;          // so many times the dimension, iterations at most
constexpr double least_progress = 0.7;  // of a cycle: what it may leave of the residual, or the solve is given up
constexpr std::size_t block = 512;      // components at a time: those of all vectors stay in the cache

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

/// Σ ā_i b_i: its real part is the sum of a real vector of twice the size.
Complex dot(const Complex* a, const Complex* b, std::size_t n) {
  constexpr std::size_t lanes = 4;
  double sum[lanes] = {};
  const auto imaginary = [a, b](std::size_t i) { return a[i].real() * b[i].imag() - a[i].imag() * b[i].real(); };
  std::size_t i = 0;
  for (; i + lanes <= n; i += lanes)
    for (std::size_t k = 0; k < lanes; ++k) sum[k] += imaginary(i + k);
  for (; i < n; ++i) sum[0] += imaginary(i);
  return {dot(reals(a), reals(b), 2 * n), (sum[0] + sum[1]) + (sum[2] + sum[3])};
}

/// out + a v. (The product of complex numbers in the standard library looks for infinities, which is slow.)
void add_multiple(double a, const double* v, double* out, std::size_t n) {
  for (std::size_t i = 0; i < n; ++i) out[i] += a * v[i];
}
void add_multiple(Complex a, const Complex* v, Complex* out, std::size_t n) {
  const double re = a.real(), im = a.imag();
  for (std::size_t i = 0; i < n; ++i)
    out[i] += Complex(re * v[i].real() - im * v[i].imag(), re * v[i].imag() + im * v[i].real());
}

double conjugate(double a) { return a; }
Complex conjugate(Complex a) { return std::conj(a); }

template <class Scalar>
double euclidean(const Scalar* v, std::size_t n) {
  return std::sqrt(dot(reals(v), reals(v), parts<Scalar> * n));
}
template <class Scalar>
double largest(const Scalar* v, std::size_t n) {
  return max_norm(parts<Scalar> * n, [x = reals(v)](std::size_t i) { return x[i]; });
}

}  // namespace

template <class Scalar>
Gmres<Scalar>::Gmres(std::size_t n, std::size_t dimension, KrylovMemory& memory)
    : n_(n),
      dimension_(dimension),
      memory_(memory),
      hessenberg_((dimension + 1) * dimension),
      cosines_(dimension),
      sines_(dimension),
      rotated_(dimension + 1),
      coefficients_(dimension + 1) {
  memory.reserve<Scalar>(dimension + 2, n);
}

template <class Scalar>
GmresResult Gmres<Scalar>::solve(LinearOperator<Scalar>& A, const double* w, double tolerance, Scalar* x) {
  basis_ = memory_.as<Scalar>();
  assert(tolerance > 0 && (basis_ != nullptr || n_ == 0));  // the memory has not been given back
  scratch_ = basis_ + (dimension_ + 1) * n_;
  tried_ = nullptr;
  for (std::size_t i = 0; i < n_; ++i) {
    scratch_[i] = x[i] / w[i];
    x[i] = 0;
  }
  size_ = largest(scratch_, n_);
  least_singular_value_ = 1;
  for (int count = 0; count < most_cycles; ++count) {
    const double before = size_, norm = euclidean(scratch_, n_);
    if (norm == 0) return GmresResult::converged;
    if (!std::isfinite(norm)) return GmresResult::undefined;
    for (std::size_t i = 0; i < n_; ++i) basis(0)[i] = scratch_[i] / norm;
    const GmresResult result = cycle(A, w, tolerance, norm);
    if (result == GmresResult::stop || result == GmresResult::undefined) return result;
    add_solution(w, x);
    if (result == GmresResult::converged) return result;
    if (!(size_ <= least_progress * before)) break;
  }
  return GmresResult::failed;
}

/// Iterates from the residual in basis(0), of that norm, until it is small enough or the space is full: `failed`.
template <class Scalar>
GmresResult Gmres<Scalar>::cycle(LinearOperator<Scalar>& A, const double* w, double tolerance, double norm) {
  std::fill(rotated_.begin(), rotated_.end(), 0);
  rotated_[0] = norm;
  double ratio = size_ / norm;  // of the largest component to the Euclidean norm, as far as is known
  for (columns_ = 0; columns_ < dimension_;) {
    if (extend(A, w, columns_) == Status::stop) return GmresResult::stop;
    ++iterations_;
    if (!std::isfinite(std::abs(H(columns_ + 1, columns_)))) {
      tried_ = scratch_;
      return GmresResult::undefined;
    }
    const double estimate = rotate(columns_++);
    least_singular_value_ =
        std::min(least_singular_value_, std::real(H(columns_ - 1, columns_ - 1)));  // about the least singular value
    const double goal = least_singular_value_ * tolerance;
    if (estimate * ratio > goal && columns_ < dimension_) continue;
    form_residual();
    if (size_ <= goal) return GmresResult::converged;
    if (estimate == 0) break;
    ratio = size_ / estimate;
  }
  return GmresResult::failed;
}

/// W⁻¹ A W v_j, made orthogonal to the vectors before it (modified Gram-Schmidt), as the next one.
template <class Scalar>
Status Gmres<Scalar>::extend(LinearOperator<Scalar>& A, const double* w, std::size_t j) {
  Scalar* next = basis(j + 1);
  for (std::size_t i = 0; i < n_; ++i) scratch_[i] = basis(j)[i] * w[i];
  if (A.multiply(scratch_, next) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < n_; ++i) next[i] /= w[i];
  for (std::size_t k = 0; k <= j; ++k) {
    const Scalar* v = basis(k);
    const Scalar h = H(k, j) = dot(v, next, n_);
    add_multiple(-h, v, next, n_);
  }
  const double norm = euclidean(next, n_);
  H(j + 1, j) = norm;
  if (norm > 0)
    for (std::size_t i = 0; i < n_; ++i) next[i] /= norm;
  return Status::ok;
}

/// Makes column j triangular. Returns the Euclidean norm of the residual.
template <class Scalar>
double Gmres<Scalar>::rotate(std::size_t j) {
  for (std::size_t k = 0; k < j; ++k) {
    const Scalar upper = H(k, j), lower = H(k + 1, j);
    H(k, j) = conjugate(cosines_[k]) * upper + sines_[k] * lower;
    H(k + 1, j) = cosines_[k] * lower - sines_[k] * upper;
  }
  const double below = std::real(H(j + 1, j)), length = std::hypot(std::abs(H(j, j)), below);
  cosines_[j] = length > 0 ? H(j, j) / length : 0;  // of a column of zeros, which reduces no residual
  sines_[j] = length > 0 ? below / length : 1;
  H(j, j) = length;
  rotated_[j + 1] = -sines_[j] * rotated_[j];
  rotated_[j] *= conjugate(cosines_[j]);
  return std::abs(rotated_[j + 1]);
}

/// The residual is the last rotated component, rotated back, in the basis: no product.
template <class Scalar>
void Gmres<Scalar>::form_residual() {
  std::fill(coefficients_.begin(), coefficients_.end(), 0);
  coefficients_[columns_] = rotated_[columns_];
  for (std::size_t k = columns_; k-- > 0;) {
    coefficients_[k] = -sines_[k] * coefficients_[k + 1];
    coefficients_[k + 1] *= conjugate(cosines_[k]);
  }
  for (std::size_t first = 0; first < n_; first += block)
    combine(columns_ + 1, first, std::min(block, n_ - first), scratch_ + first);
  size_ = largest(scratch_, n_);
}

/// x + W V z, where H z is the rotated right-hand side.
template <class Scalar>
void Gmres<Scalar>::add_solution(const double* w, Scalar* x) {
  if (columns_ == 0) return;
  std::vector<Scalar>& z = coefficients_;
  for (std::size_t k = columns_; k-- > 0;) {
    Scalar sum = rotated_[k];
    for (std::size_t j = k + 1; j < columns_; ++j) sum -= H(k, j) * z[j];
    z[k] = H(k, k) != 0.0 ? sum / H(k, k) : 0;
  }
  Scalar part[block];
  for (std::size_t first = 0; first < n_; first += block) {
    const std::size_t size = std::min(block, n_ - first);
    combine(columns_, first, size, part);
    for (std::size_t i = 0; i < size; ++i) x[first + i] += w[first + i] * part[i];
  }
}

/// Components first … first + size − 1 of the sum of vectors of the basis with the coefficients.
template <class Scalar>
void Gmres<Scalar>::combine(std::size_t count, std::size_t first, std::size_t size, Scalar* out) const {
  std::fill_n(out, size, 0);
  for (std::size_t k = 0; k < count; ++k) add_multiple(coefficients_[k], basis_ + k * n_ + first, out, size);
}

template class Gmres<double>;
template class Gmres<Complex>;

}  // namespace invariode
