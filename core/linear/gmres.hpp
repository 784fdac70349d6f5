#pragma once
// Restarted GMRES for systems whose matrix is known by its products alone (Saad & Schultz, SIAM J. Sci. Stat. Comput. 7
// (1986) 856-869), in the weights of the error test (Brown & Hindmarsh, Appl. Math. Comput. 31 (1989) 40-91).

#include <cassert>
#include <complex>
#include <cstddef>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "callback.hpp"

namespace invariode {

using Complex = std::complex<double>;

/// The components of a vector as reals, one or two for each.
template <class Scalar>
inline constexpr std::size_t parts = std::is_same_v<Scalar, Complex> ? 2 : 1;
template <class Scalar>
const double* reals(const Scalar* v) {
  return reinterpret_cast<const double*>(v);
}

/// A matrix of which only products with vectors are needed. A product that cannot be formed holds NaN.
template <class Scalar>
class LinearOperator {
 public:
  LinearOperator() = default;
  LinearOperator(const LinearOperator&) = delete;
  LinearOperator& operator=(const LinearOperator&) = delete;
  virtual ~LinearOperator() = default;

  /// A v into out, both (n,).
  virtual Status multiply(const Scalar* v, Scalar* out) = 0;
};

/// The vectors of a solve, which real and complex solves share, one at a time: an array of complex numbers is one of
/// twice as many reals.
class KrylovMemory {
 public:
  /// Makes room for that many vectors of n components.
  template <class Scalar>
  void reserve(std::size_t vectors, std::size_t n) {
    const std::size_t size = (parts<Scalar> * vectors * n + 1) / 2;
    if (values_.size() >= size) return;
    give_back();  // not both at a time
    values_.resize(size);
  }
  void give_back() { values_ = std::vector<Complex>(); }
  template <class Scalar>
  [[nodiscard]] Scalar* as() {
    return reinterpret_cast<Scalar*>(values_.data());
  }

 private:
  std::vector<Complex> values_;
};

/// The end of a solve. `undefined`: a product, or b, holds NaN or infinity.
enum class [[nodiscard]] GmresResult { converged, failed, undefined, stop };

/// Solves A x = b until the largest component of the residual, in units of the weights, is small enough, divided by
/// what products shrink vectors. The Krylov space minimises the Euclidean norm of the weighted residual; where that
/// seems to be enough, the residual itself is formed: a few components among a million hardly count in a mean. The
/// components of a complex vector are its real and imaginary parts.
template <class Scalar>
class Gmres {
 public:
  /// `dimension`: of the space, after which GMRES starts anew. Takes dimension + 2 vectors of the memory, which
  /// outlives this.
  Gmres(std::size_t n, std::size_t dimension, KrylovMemory& memory);

  /// x: b at the start, the solution at the end; `w`: the weights, all (n,).
  GmresResult solve(LinearOperator<Scalar>& A, const double* w, double tolerance, Scalar* x);
  /// The vector (n,) whose product was `undefined`; null if b itself was.
  [[nodiscard]] const Scalar* tried() const { return tried_; }
  [[nodiscard]] std::size_t n() const { return n_; }
  /// The smallest ratio of a product to its vector in the last solve, at most 1: a residual is about that much
  /// smaller than the error of x. Small where a preconditioner is crude, or of another scale than A.
  [[nodiscard]] double least_singular_value() const { return least_singular_value_; }
  /// All iterations so far: one product each.
  [[nodiscard]] std::int64_t iterations() const { return iterations_; }
  void state(Archive& archive) { archive(iterations_); }

 private:
  GmresResult cycle(LinearOperator<Scalar>& A, const double* w, double tolerance, double norm);
  Status extend(LinearOperator<Scalar>& A, const double* w, std::size_t j);
  double rotate(std::size_t j);
  void form_residual();
  void add_solution(const double* w, Scalar* x);
  void combine(std::size_t count, std::size_t first, std::size_t size, Scalar* out) const;

  Scalar* basis(std::size_t j) {
    assert(j <= dimension_);
    return basis_ + j * n_;
  }
  Scalar& H(std::size_t i, std::size_t j) {
    assert(i <= dimension_ && j < dimension_);
    return hessenberg_[j * (dimension_ + 1) + i];
  }

  std::size_t n_, dimension_;
  KrylovMemory& memory_;
  Scalar* basis_ = nullptr;         // (dimension + 1, n), orthonormal
  Scalar* scratch_ = nullptr;       // a vector in the units of y, or the residual, weighted
  std::vector<Scalar> hessenberg_;  // column by column; triangular once rotated, with a diagonal ≥ 0
  std::vector<Scalar> cosines_;     // of the unitary rotations (c̄ s; −s c)
  std::vector<double> sines_;
  std::vector<Scalar> rotated_;       // the right-hand side of the least-squares problem
  std::vector<Scalar> coefficients_;  // of vectors of the basis
  const Scalar* tried_ = nullptr;     // see `tried`
  std::size_t columns_ = 0;           // of the present cycle
  double size_ = 0;                   // of the residual that was formed last
  double least_singular_value_ = 1;
  std::int64_t iterations_ = 0;
};

extern template class Gmres<double>;
extern template class Gmres<Complex>;

}  // namespace invariode
