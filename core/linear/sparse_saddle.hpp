#pragma once
// The linear system of constrained mechanics with few connections: chains, nets, trees.

#include <Eigen/SparseCore>
#include <vector>

#include "linear/least_norm.hpp"
#include "linear/saddle.hpp"
#include "linear/sparse_lu.hpp"

namespace invariode {

/// Returns whether M has entries on its diagonal only.
bool is_diagonal(const Eigen::SparseMatrix<double>& M);

/// Solves the system of `ConstrainedSolution` with sparse M and A: with a diagonal positive M by the Schur complement
/// A M⁻¹ Aᵀ, else by LU factors of the whole. One step of refinement recovers what the squared
/// condition number costs, and the result is tested.
class SparseSaddle {
 public:
  /// Solves the system. Returns false if rows depend on each other or nearly so, M is not definite, or the solution is
  /// not good to roundoff: it is then left to `solve_saddle`.
  bool solve(const Eigen::SparseMatrix<double>& M, const Eigen::SparseMatrix<double>& A, const VectorView& Q,
             const VectorView& gamma, ConstrainedSolution& found);

 private:
  bool factor_complement(const Eigen::SparseMatrix<double>& A);
  bool factor_whole(const Eigen::SparseMatrix<double>& M, const Eigen::SparseMatrix<double>& A);
  double pivot(const Eigen::SparseMatrix<double>& A);
  /// M a − Aᵀ λ = p, A a = q.
  void substitute(const Eigen::SparseMatrix<double>& A, const Eigen::VectorXd& p, const Eigen::VectorXd& q);

  bool diagonal_ = false;  // M, and positive
  Eigen::VectorXd inverse_mass_, row_scale_, a_, lambda_;
  GramFactors complement_;
  KnownPattern pattern_;  // of the whole
  SparseLu<double> whole_;
  std::vector<double> both_;  // its right-hand side and solution
};

}  // namespace invariode
