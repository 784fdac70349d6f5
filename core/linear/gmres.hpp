#pragma once
// Restarted GMRES for systems whose matrix is known by its products alone (Saad & Schultz, SIAM J. Sci. Stat. Comput. 7
// (1986) 856-869), in the weights of the error test (Brown & Hindmarsh, Appl. Math. Comput. 31 (1989) 40-91).

#include <cstddef>
#include <cstdint>
#include <vector>

#include "callback.hpp"

namespace invariode {

/// A matrix of which only products with vectors are needed. A product that cannot be formed holds NaN.
class LinearOperator {
 public:
  LinearOperator() = default;
  LinearOperator(const LinearOperator&) = delete;
  LinearOperator& operator=(const LinearOperator&) = delete;
  virtual ~LinearOperator() = default;

  /// A v into out, both (n,).
  virtual Status multiply(const double* v, double* out) = 0;
};

/// Solves A x = b until the largest component of the residual, in units of the weights, is small enough, divided by
/// what products shrink vectors. The Krylov space minimises the Euclidean norm of the weighted residual; where that
/// seems to be enough, the residual itself is formed: a few components among a million hardly count in a mean.
class Gmres {
 public:
  enum class [[nodiscard]] Result { converged, failed, stop };

  /// `dimension`: vectors of the space, after which it starts anew. Takes dimension + 2 vectors of memory.
  Gmres(std::size_t n, std::size_t dimension);

  /// x: b at the start, the solution at the end; `w`: the weights, all (n,).
  Result solve(LinearOperator& A, const double* w, double tolerance, double* x);
  /// Nothing is solved any more: gives its memory back.
  void give_back() { basis_ = std::vector<double>(), scratch_ = std::vector<double>(); }
  [[nodiscard]] std::size_t n() const { return n_; }
  /// How much smaller than a vector its product has been in the last solve, at most 1: a residual is about that much
  /// smaller than the error of x. Small where a preconditioner is crude, or of another scale than A.
  [[nodiscard]] double shrinkage() const { return shrinkage_; }
  /// All iterations so far: one product each.
  [[nodiscard]] std::int64_t iterations() const { return iterations_; }
  void state(Archive& archive) { archive(iterations_); }

 private:
  Result cycle(LinearOperator& A, const double* w, double tolerance, double norm);
  Status extend(LinearOperator& A, const double* w, std::size_t j);
  double rotate(std::size_t j);
  void form_residual();
  void add_solution(const double* w, double* x);
  void combine(std::size_t count, std::size_t first, std::size_t size, double* out) const;

  double* basis(std::size_t j) { return basis_.data() + j * n_; }
  double& H(std::size_t i, std::size_t j) { return hessenberg_[j * (dimension_ + 1) + i]; }

  std::size_t n_, dimension_;
  std::vector<double> basis_;       // (dimension + 1, n), orthonormal
  std::vector<double> scratch_;     // a vector in the units of y, or the residual, weighted
  std::vector<double> hessenberg_;  // column by column; triangular once rotated
  std::vector<double> cosines_, sines_;
  std::vector<double> rotated_;       // the right-hand side of the least-squares problem
  std::vector<double> coefficients_;  // of vectors of the basis
  std::size_t columns_ = 0;           // of the present cycle
  double size_ = 0;                   // of the residual that was formed last
  double shrinkage_ = 1;
  std::int64_t iterations_ = 0;
};

}  // namespace invariode
