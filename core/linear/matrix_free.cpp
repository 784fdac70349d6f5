#include "linear/matrix_free.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>

namespace invariode {
namespace {

const double difference_size = std::sqrt(eps);  // of the largest component of σ v, in units of the weights
constexpr int most_undefined = 8;  // attempts: h has then been cut to 1e-4, and the functions are no better

constexpr std::size_t default_dimension = 10, default_complex_dimension = 5;  // measured in benchmarks/krylov.py

std::size_t dimension(const KrylovTerms& terms, std::size_t n, bool complex) {
  const std::size_t own = complex ? default_complex_dimension : default_dimension;
  return std::min(terms.dimension > 0 ? terms.dimension : own, n);
}

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

MatrixFree::MatrixFree(Callback& f, const Weights& weights, const LinearAlgebra& linear, bool complex)
    : product_(f, linear.krylov->product, weights),
      preconditioner_(linear.krylov->preconditioner),
      gmres_(weights.size(), dimension(*linear.krylov, weights.size(), complex), memory_),
      mass_times_v_(linear.mass ? weights.size() : 0),
      known_y_(preconditioner_ ? weights.size() : 0) {
  if (complex) complex_gmres_.emplace(gmres_.n(), dimension(*linear.krylov, gmres_.n(), true), memory_);
}

void MatrixFree::take_scratch(double* part, double* product) {
  part_ = part;
  part_product_ = product;
}

void MatrixFree::reach(double t, const double* y) {
  assert(std::isfinite(t));
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

template <class Scalar>
Outcome MatrixFree::precondition(Scalar* b) {
  if (!preconditioner_) return Outcome::ok;
  const std::size_t n = gmres_.n();
  const auto vanishes = [b, n] { return std::all_of(b, b + n, [](Scalar x) { return x == 0.0; }); };
  const bool zero = vanishes();
  if (apply(b) == Status::stop) return Outcome::stop;
  if (!all_finite(reals(b), parts<Scalar> * n)) {
    note(Unsolved::preconditioner, known_t_);
    return Outcome::not_finite;
  }
  if (zero || !vanishes()) return Outcome::ok;
  note(Unsolved::preconditioner_zero, known_t_);
  return Outcome::not_finite;
}

template Outcome MatrixFree::precondition(double* b);
template Outcome MatrixFree::precondition(Complex* b);

Status MatrixFree::apply(double* b) { return preconditioner_ ? preconditioner_.solve(b) : Status::ok; }

/// Part by part: P is real.
Status MatrixFree::apply(Complex* b) {
  if (!preconditioner_) return Status::ok;
  auto* x = reinterpret_cast<double*>(b);
  for (std::size_t part = 0; part < 2; ++part) {
    for (std::size_t i = 0; i < gmres_.n(); ++i) part_[i] = x[2 * i + part];
    if (preconditioner_.solve(part_) == Status::stop) return Status::stop;
    for (std::size_t i = 0; i < gmres_.n(); ++i) x[2 * i + part] = part_[i];
  }
  return Status::ok;
}

bool MatrixFree::negligible(const double* w, double tolerance, const double* b) const {
  return max_norm(gmres_.n(), [b, w](std::size_t i) { return b[i] / w[i]; }) <=
         gmres_.least_singular_value() * tolerance;
}

/// Both parts of b: w belongs to each.
bool MatrixFree::negligible(const double* w, double tolerance, const Complex* b) const {
  return max_norm(2 * gmres_.n(), [b = reals(b), w](std::size_t i) { return b[i] / w[i / 2]; }) <=
         complex_gmres_->least_singular_value() * tolerance;
}

GmresResult MatrixFree::solve(double c, const Matrix* mass, const double* w, double tolerance, double* b) {
  c_ = c;
  mass_ = mass;
  return explained(gmres_, gmres_.solve(*this, w, tolerance, b));
}

GmresResult MatrixFree::solve(Complex c, const Matrix* mass, const double* w, double tolerance, Complex* b) {
  assert(complex_gmres_);
  complex_c_ = c;
  mass_ = mass;
  return explained(*complex_gmres_, complex_gmres_->solve(*this, w, tolerance, b));
}

/// Notes why it was not solved. What was not finite is found by the same product once more.
template <class Scalar>
GmresResult MatrixFree::explained(const Gmres<Scalar>& gmres, GmresResult result) {
  if (result != GmresResult::failed && result != GmresResult::undefined) return result;
  note(Unsolved::slow, product_.t());
  if (gmres.tried() == nullptr) return result;
  const std::size_t n = gmres.n();
  std::vector<double> v(n), Jv(n);
  if (preconditioner_) note(Unsolved::preconditioner, known_t_);
  for (std::size_t part = 0; part < parts<Scalar>; ++part) {
    for (std::size_t i = 0; i < n; ++i) v[i] = reals(gmres.tried())[parts<Scalar> * i + part];
    if (product_.multiply(v.data(), Jv.data()) == Status::stop) return GmresResult::stop;
    if (!all_finite(Jv.data(), n)) note(product_.given() ? Unsolved::product : Unsolved::difference, product_.t());
  }
  return result;
}

void MatrixFree::note(Unsolved why, double t) {
  unsolved_ = why;
  unsolved_t_ = t;
}

void MatrixFree::begin_attempt() {
  undefined_ = undefined_function(unsolved_) ? undefined_ + 1 : 0;
  unsolved_ = Unsolved::none;
}

bool MatrixFree::hopeless() const { return undefined_function(unsolved_) && undefined_ + 1 >= most_undefined; }

std::int64_t MatrixFree::iterations() const {
  return gmres_.iterations() + (complex_gmres_ ? complex_gmres_->iterations() : 0);
}

const double* MatrixFree::mass_times(const double* v) {
  if (!mass_) return v;
  mass_->multiply(v, mass_times_v_.data());
  return mass_times_v_.data();
}

/// P⁻¹ (M − c J) v
Status MatrixFree::multiply(const double* v, double* out) {
  if (product_.multiply(v, out) == Status::stop) return Status::stop;
  const double* Mv = mass_times(v);
  for (std::size_t i = 0; i < gmres_.n(); ++i) out[i] = Mv[i] - c_ * out[i];
  return apply(out);
}

/// Multiplies the real and the imaginary part of v separately: J and M are real.
Status MatrixFree::multiply(const Complex* v, Complex* out) {
  const std::size_t n = gmres_.n();
  const double re = complex_c_.real(), im = complex_c_.imag();
  for (std::size_t i = 0; i < n; ++i) part_[i] = v[i].real();
  if (product_.multiply(part_, part_product_) == Status::stop) return Status::stop;
  const double* Mv = mass_times(part_);
  for (std::size_t i = 0; i < n; ++i) out[i] = {Mv[i] - re * part_product_[i], -im * part_product_[i]};
  for (std::size_t i = 0; i < n; ++i) part_[i] = v[i].imag();
  if (product_.multiply(part_, part_product_) == Status::stop) return Status::stop;
  Mv = mass_times(part_);
  for (std::size_t i = 0; i < n; ++i) out[i] += Complex(im * part_product_[i], Mv[i] - re * part_product_[i]);
  return apply(out);
}

void MatrixFree::state(Archive& archive) {
  product_.state(archive);
  gmres_.state(archive);
  if (complex_gmres_) complex_gmres_->state(archive);
  archive(known_t_, known_y_);
}

}  // namespace invariode
