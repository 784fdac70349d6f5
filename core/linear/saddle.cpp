#include "linear/saddle.hpp"

#include <Eigen/Cholesky>
#include <Eigen/QR>
#include <cmath>
#include <limits>
#include <stdexcept>

#include "weights.hpp"

namespace invariode {
namespace {

using Dense = Eigen::MatrixXd;
using Vector = Eigen::VectorXd;
using Eigen::Index;

constexpr double singular_pivots = 1000;  // in units of roundoff: smaller pivots of Cholesky are what it leaves of 0

/// Cholesky's factors where all pivots stand out from the roundoff of `size`, the diagonal that they come from.
bool factor(const Dense& symmetric, const Vector& size, Eigen::LLT<Dense>& llt) {
  llt.compute(symmetric);
  if (llt.info() != Eigen::Success) return false;
  const Vector pivots = Vector(llt.matrixLLT().diagonal()).cwiseAbs2();
  return (pivots.array() > singular_pivots * eps * size.array()).all();
}

/// A pivoted QR of columns that are scaled to norm 1 (zero ones stay): B S⁻¹ Π = Q R.
class Columns {
 public:
  Columns(const Dense& B, double threshold) : scale_(B.colwise().norm()), qr_(B.rows(), B.cols()) {
    scale_ = (scale_.array() > 0).select(scale_, 1);
    qr_.setThreshold(threshold);
    qr_.compute(B * scale_.cwiseInverse().asDiagonal());
  }
  [[nodiscard]] Index rank() const { return qr_.rank(); }
  /// The last pivot: 0 where some columns depend on others.
  [[nodiscard]] double pivot() const {
    return rank() < qr_.cols() ? 0 : std::abs(qr_.matrixR()(rank() - 1, rank() - 1));
  }

  /// The vector u of least norm with Bᵀ u = c, as far as its independent rows go.
  [[nodiscard]] Vector least_norm(const Vector& c) const {
    const Index r = rank();
    const Vector first = (qr_.colsPermutation().transpose() * c.cwiseQuotient(scale_)).head(r);
    Vector u = Vector::Zero(qr_.rows());
    u.head(r) = R().triangularView<Eigen::Upper>().transpose().solve(first);
    return qr_.householderQ() * u;
  }
  /// The λ of least norm among those with B λ = u, where u is in the range of B.
  [[nodiscard]] Vector coefficients(const Vector& u) const {
    const Index r = rank();
    const Vector first = Vector(qr_.householderQ().transpose() * u).head(r);
    if (r == 0) return Vector::Zero(qr_.cols());
    if (r < qr_.cols()) return Columns(rows().transpose(), 0).least_norm(first);
    return (qr_.colsPermutation() * Vector(R().triangularView<Eigen::Upper>().solve(first))).cwiseQuotient(scale_);
  }
  /// An orthonormal basis of what is orthogonal to all columns.
  [[nodiscard]] Dense complement() const {
    const Dense all = qr_.householderQ() * Dense::Identity(qr_.rows(), qr_.rows());
    return all.rightCols(qr_.rows() - rank());
  }

 private:
  [[nodiscard]] Dense R() const { return qr_.matrixR().topLeftCorner(rank(), rank()); }
  /// C of full rank with B = Q C.
  [[nodiscard]] Dense rows() const {
    const Dense upper = qr_.matrixR().topRows(rank()).triangularView<Eigen::Upper>();
    return upper * qr_.colsPermutation().transpose() * scale_.asDiagonal();
  }

  Vector scale_;
  Eigen::ColPivHouseholderQR<Dense> qr_;
};

/// M = L Lᵀ: with B = L⁻¹Aᵀ and Lᵀ a = L⁻¹ Q + B λ, the second equation is Bᵀ (Lᵀ a) = γ.
void solve_definite(const Eigen::LLT<Dense>& mass, const MatrixView& A, const VectorView& Q, const VectorView& gamma,
                    double threshold, ConstrainedSolution& found) {
  const Vector free = mass.matrixL().solve(Q);
  if (A.rows() == 0) {
    found.a = mass.matrixU().solve(free);
    return;
  }
  const Dense B = mass.matrixL().solve(A.transpose());
  const Columns columns(B, threshold);
  const Vector u = columns.least_norm(gamma - B.transpose() * free);
  found.rank = columns.rank();
  found.pivot = columns.pivot();
  found.a = mass.matrixU().solve(free + u);
  found.lambda = columns.coefficients(u);
}

/// a = a₀ + Z w with A a₀ = γ, A Z = 0, and Zᵀ M Z w = Zᵀ (Q − M a₀).
void solve_semidefinite(const MatrixView& M, const MatrixView& A, const VectorView& Q, const VectorView& gamma,
                        double threshold, ConstrainedSolution& found) {
  found.unique = false;
  found.a.setConstant(std::numeric_limits<double>::quiet_NaN());
  found.lambda.setConstant(std::numeric_limits<double>::quiet_NaN());
  if (A.rows() == 0) return;  // M itself would have to be definite
  const auto mass = M.selfadjointView<Eigen::Lower>();
  const Dense At = A.transpose();
  const Columns columns(At, threshold);
  found.rank = columns.rank();
  found.pivot = columns.pivot();
  const Dense Z = columns.complement();
  Vector a = columns.least_norm(gamma);
  if (Z.cols() > 0) {
    const Eigen::LDLT<Dense> inside(Z.transpose() * (mass * Z));  // pivoted: a small pivot would magnify roundoff
    const double roundoff = singular_pivots * eps * M.diagonal().cwiseAbs().maxCoeff();
    if (!(inside.vectorD().array() > roundoff).all()) return;
    a += Z * inside.solve(Z.transpose() * (Q - mass * a));
  }
  found.unique = true;
  found.a = a;
  found.lambda = columns.coefficients(mass * a - Q);
}

}  // namespace

ConstrainedSolution solve_saddle(const MatrixView& M, const MatrixView& A, const VectorView& Q, const VectorView& gamma,
                                 double threshold) {
  const Index n = M.rows(), k = A.rows();
  if (M.cols() != n || A.cols() != n || Q.size() != n || gamma.size() != k)
    throw std::invalid_argument("the sizes of M, A, Q and gamma do not match");
  ConstrainedSolution found{.a = Vector(n), .lambda = Vector::Zero(k)};
  Eigen::LLT<Dense> llt;
  if (factor(M, M.diagonal().cwiseAbs(), llt))
    solve_definite(llt, A, Q, gamma, threshold, found);
  else
    solve_semidefinite(M, A, Q, gamma, threshold, found);
  return found;
}

Vector least_squares(const Dense& B, const Vector& u) { return B.colPivHouseholderQr().solve(u); }

}  // namespace invariode
