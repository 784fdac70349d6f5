#pragma once
// The linear system of constrained mechanics (docs/algorithms.md, 'The right-hand side of mechanics').

#include <Eigen/Core>
#include <cstddef>

namespace invariode {

using MatrixView = Eigen::Ref<const Eigen::MatrixXd>;
using VectorView = Eigen::Ref<const Eigen::VectorXd>;

/// a and λ of
///
///   M a = Q + Aᵀ λ,   A a = γ,
///
/// where M (n, n) is positive definite on the null space of A (k, n).
struct ConstrainedSolution {
  Eigen::VectorXd a;       ///< (n); NaN where it is not unique
  Eigen::VectorXd lambda;  ///< (k); of least norm where rows of A depend on each other
  Eigen::Index rank = 0;   ///< of A
  bool unique = true;      ///< M is positive definite on the null space of A
  double pivot = 1;        ///< how far the rows of A are from depending on each other: about the least singular value,
                           ///< of rows with norm 1; 0: some depend on others
};

/// Solves the system, if M is definite, by M = L Lᵀ and a pivoted QR of L⁻¹Aᵀ, never the Gram matrix A M⁻¹ Aᵀ, whose
/// condition is the square; if it is not, by a pivoted QR of Aᵀ, and Cholesky of M on the null space. Rows of A that
/// depend on others to within `threshold`, whatever their units, are left out. M is symmetric; its lower triangle is
/// read.
ConstrainedSolution solve_saddle(const MatrixView& M, const MatrixView& A, const VectorView& Q, const VectorView& gamma,
                                 double threshold);

/// Returns a λ of least |B λ − u|, by a pivoted QR, whose code is compiled in this file alone.
[[nodiscard]] Eigen::VectorXd least_squares(const Eigen::MatrixXd& B, const Eigen::VectorXd& u);

}  // namespace invariode
