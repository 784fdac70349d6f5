#include "linear/sparse_saddle.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "linear/scattered.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

using Sparse = Eigen::SparseMatrix<double>;
using Vector = Eigen::VectorXd;
using Eigen::Index;

constexpr double accurate = 1e-13;     // residuals, as a part of their terms
constexpr double roundoff = 10 * eps;  // of the largest unknown, which the factors leave in all that are coupled to it

/// The residual is at most `accurate` of its terms, row by row, or what roundoff leaves of them.
bool is_roundoff(const Vector& residual, const Vector& terms, const Vector& floor) {
  return (residual.array().abs() <= accurate * terms.array() + floor.array()).all();
}

double largest(const Vector& v) { return v.size() == 0 ? 0 : v.cwiseAbs().maxCoeff(); }

}  // namespace

bool is_diagonal(const Sparse& M) {
  for (Index j = 0; j < M.outerSize(); ++j)
    for (Sparse::InnerIterator it(M, j); it; ++it)
      if (it.row() != j) return false;
  return true;
}

bool SparseSaddle::solve(const Sparse& M, const Sparse& A, const VectorView& Q, const VectorView& gamma,
                         ConstrainedSolution& found) {
  const Index n = M.rows();
  inverse_mass_ = M.diagonal().cwiseInverse();
  diagonal_ = is_diagonal(M) && (inverse_mass_.array() > 0).all();
  const bool needs_factors = A.rows() > 0 || !diagonal_;
  if (needs_factors && !(diagonal_ ? factor_complement(A) : factor_whole(M, A))) return false;
  const Sparse size = A.cwiseAbs();
  const Sparse mass_size = M.cwiseAbs();
  const Vector row_sum = size * Vector::Ones(n), column_sum = size.transpose() * Vector::Ones(A.rows());
  const auto massless = (mass_size * Vector::Ones(n)).array() == 0;  // no acceleration sees what is left in such a row
  found.a = Vector::Zero(n);
  found.lambda = Vector::Zero(A.rows());
  Vector p = Q, q = gamma;
  for (int pass = 0;; ++pass) {
    substitute(A, p, q);
    found.a += a_;
    found.lambda += lambda_;
    p = Q + A.transpose() * found.lambda - M * found.a;
    q = gamma - A * found.a;
    const Vector force_terms =
        Q.cwiseAbs() + size.transpose() * found.lambda.cwiseAbs() + mass_size * found.a.cwiseAbs();
    const Vector terms = gamma.cwiseAbs() + size * found.a.cwiseAbs();
    const Vector force_floor = massless.select(roundoff * largest(found.lambda) * column_sum, 0);
    if (is_roundoff(p, force_terms, force_floor) && is_roundoff(q, terms, roundoff * largest(found.a) * row_sum)) break;
    if (pass == 1) return false;
  }
  found.rank = A.rows();
  found.unique = true;
  found.pivot = pivot(A);
  return true;
}

/// B Bᵀ with the rows of B = A M^(-1/2) scaled to norm 1.
bool SparseSaddle::factor_complement(const Sparse& A) {
  const Sparse B = inverse_mass_.cwiseSqrt().asDiagonal() * Sparse(A.transpose());
  row_scale_ = (B.cwiseAbs2().transpose() * Vector::Ones(B.rows())).cwiseSqrt();
  if (!(row_scale_.array() > 0).all()) return false;
  row_scale_ = row_scale_.cwiseInverse();
  return complement_.factor(B * row_scale_.asDiagonal(), 0);
}

bool SparseSaddle::factor_whole(const Sparse& M, const Sparse& A) {
  const Index n = M.rows(), k = A.rows();
  std::vector<Eigen::Triplet<double>> entries;
  entries.reserve(static_cast<std::size_t>(M.nonZeros() + 2 * A.nonZeros()));
  for (Index j = 0; j < n; ++j) {
    for (Sparse::InnerIterator it(M, j); it; ++it)
      entries.emplace_back(static_cast<int>(it.row()), static_cast<int>(j), it.value());
    for (Sparse::InnerIterator it(A, j); it; ++it) {
      entries.emplace_back(static_cast<int>(n + it.row()), static_cast<int>(j), it.value());
      entries.emplace_back(static_cast<int>(j), static_cast<int>(n + it.row()), -it.value());
    }
  }
  Sparse all(n + k, n + k);
  all.setFromTriplets(entries.begin(), entries.end());
  if (pattern_.differs(all)) {
    whole_.analyse({{all.outerIndexPtr(), all.outerIndexPtr() + n + k + 1},
                    {all.innerIndexPtr(), all.innerIndexPtr() + all.nonZeros()}});
    pattern_.note(all);
  }
  both_.assign(all.valuePtr(), all.valuePtr() + all.nonZeros());
  return all_finite(both_.data(), both_.size()) && whole_.factor(both_);
}

/// The last pivot of the complement; or what the inverse makes of right-hand sides of size 1, which are of the size of
/// the rows and of either sign.
double SparseSaddle::pivot(const Sparse& A) {
  if (A.rows() == 0) return 1;
  if (diagonal_) return complement_.least_pivot();
  const Vector row_norm = (A.cwiseAbs2() * Vector::Ones(A.cols())).cwiseSqrt();
  Vector signs(A.rows());
  for (Index i = 0; i < signs.size(); ++i) signs[i] = spread(static_cast<std::size_t>(i)) < 0.5 ? -1 : 1;
  substitute(A, Vector::Zero(A.cols()), signs.cwiseProduct(row_norm));
  return 1 / largest(a_);
}

void SparseSaddle::substitute(const Sparse& A, const Vector& p, const Vector& q) {
  const Index n = p.size(), k = q.size();
  if (!diagonal_) {
    both_.assign(p.begin(), p.end());
    both_.insert(both_.end(), q.begin(), q.end());
    whole_.solve(both_.data(), 1);
    a_ = Eigen::Map<const Vector>(both_.data(), n);
    lambda_ = Eigen::Map<const Vector>(both_.data() + n, k);
    return;
  }
  a_ = inverse_mass_.cwiseProduct(p);
  lambda_ = Vector::Zero(k);
  if (k == 0) return;
  const Vector rest = row_scale_.cwiseProduct(q - A * a_);
  lambda_ = row_scale_.cwiseProduct(complement_.solve(rest));
  a_ += inverse_mass_.cwiseProduct(A.transpose() * lambda_);
}

}  // namespace invariode
