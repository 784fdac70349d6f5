#pragma once
// Solutions of least norm, of equations with many entries each or few.

#include <Eigen/Core>
#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <cmath>
#include <cstddef>
#include <memory>
#include <vector>

#include "linear/index.hpp"
#include "linear/rows.hpp"

namespace invariode {

/// Vectors of which some become an orthonormal basis Q of all, by the modified Gram-Schmidt process with pivoting, in
/// which each pivot is orthogonalised twice: Q is then orthogonal to roundoff. (Eigen's pivoted QR allocates in each
/// call.) The vectors of the basis are Q R. Equations with these rows have the solution of least norm Q z, Rᵀ z = r.
class PivotedBasis {
 public:
  /// Memory for `count` vectors (n), which are written to `vector(i)`.
  void provide(std::size_t n, std::size_t count) {
    if (vectors_.rows() == index(n) && vectors_.cols() >= index(count)) return;
    vectors_.resize(index(n), index(count));
    R_.resize(index(count), index(count));
    z_.resize(count);
    members_.reserve(count);
  }
  /// Empties the basis.
  void clear() {
    members_.clear();
    R_.setZero();
  }
  /// Vector i, or in its place the unit vector of the basis.
  [[nodiscard]] auto vector(std::size_t i) { return vectors_.col(index(i)); }
  /// The vectors in the basis, in the order of the pivots.
  [[nodiscard]] const std::vector<std::size_t>& members() const { return members_; }

  /// Adds pivots from these vectors, the longest one first, until ends(i, length) of what is left of the longest, i.
  /// The candidates that were added come first then. Returns how many there are.
  template <class Ends>
  std::size_t add(std::vector<std::size_t>& candidates, Ends ends) {
    for (const std::size_t i : candidates)
      for (const std::size_t q : members_) remove_component(i, q);
    std::size_t added = 0;
    for (; added < candidates.size() && index(members_.size()) < vectors_.rows(); ++added) {
      bring_longest_to(added, candidates);
      const std::size_t pivot = candidates[added];
      for (const std::size_t q : members_) remove_component(pivot, q);
      const double length = vector(pivot).norm();
      if (ends(pivot, length)) break;
      vector(pivot) /= length;
      R_(index(pivot), index(pivot)) = length;
      members_.push_back(pivot);
      for (std::size_t k = added + 1; k < candidates.size(); ++k) remove_component(candidates[k], pivot);
    }
    return added;
  }

  /// Component of vector i along the basis vector in the place of vector q.
  [[nodiscard]] double R(std::size_t q, std::size_t i) const { return R_(index(q), index(i)); }

  /// Rᵀ z = r in the part of the basis from its member `first` on: calls use(i, z) with each z in the order of the
  /// members, where i is the vector whose residual is right(i).
  template <class Right, class Use>
  void solve(std::size_t first, Right right, Use use) {
    for (std::size_t k = first; k < members_.size(); ++k) {
      const std::size_t i = members_[k];
      double sum = right(i);
      for (std::size_t l = first; l < k; ++l) sum -= R(members_[l], i) * z_[l];
      z_[k] = sum / R(i, i);
      use(i, z_[k]);
    }
  }

 private:
  void bring_longest_to(std::size_t place, std::vector<std::size_t>& candidates);
  void remove_component(std::size_t i, std::size_t q);

  Eigen::MatrixXd vectors_;           // (n, count), as columns
  Eigen::MatrixXd R_;                 // (count, count): column i has the components of vector i in Q
  std::vector<double> z_;             // of each member
  std::vector<std::size_t> members_;  // whose vectors have become those of Q
};

/// Remembers the pattern for which something was prepared.
class KnownPattern {
 public:
  /// Compares entry by entry, since entries move without changing their number.
  [[nodiscard]] bool differs(const Eigen::SparseMatrix<double>& A) const;
  /// Stores the pattern of A. To be called once the preparation for it has succeeded: a failed one is then repeated.
  void note(const Eigen::SparseMatrix<double>& A);

 private:
  std::vector<int> starts_, rows_;
};

/// The factors L D Lᵀ of BᵀB, where B has few entries and columns of norm 1. They are ordered anew where the pattern
/// changes. That squares the condition number; an iteration recovers what is lost.
class GramFactors {
 public:
  /// Forms the factors. Returns false if columns depend on each other to within `threshold`.
  [[nodiscard]] bool factor(const Eigen::SparseMatrix<double>& B, double threshold);
  /// (BᵀB)⁻¹ r
  [[nodiscard]] Eigen::VectorXd solve(const Eigen::VectorXd& r) const { return factors_->solve(r); }
  /// The least of what is left of a column without those before.
  [[nodiscard]] double least_pivot() const { return std::sqrt(factors_->vectorD().minCoeff()); }

 private:
  using Factors = Eigen::SimplicialLDLT<Eigen::SparseMatrix<double>>;

  KnownPattern pattern_;
  std::unique_ptr<Factors> factors_ = std::make_unique<Factors>();  // Eigen's own cannot be moved
};

/// Equations a_i x = r_i with sparse rows, by the factors for rows of norm 1 in the scaled unknowns.
class SparseRows {
 public:
  /// Writes x = S z of least norm ‖z‖ for the rows named, S the diagonal matrix `scale`; 0: that unknown does not move.
  /// Equations in which nothing moves are left out. False: rows depend on each other to within `threshold`.
  bool least_norm(const RowLayout& layout, const double* values, const std::vector<std::size_t>& rows,
                  const std::vector<double>& scale, const std::vector<double>& right, double threshold,
                  std::vector<double>& x);

 private:
  bool take(const RowLayout& layout, const double* values, const std::vector<std::size_t>& rows,
            const std::vector<double>& scale, const std::vector<double>& right);

  Eigen::SparseMatrix<double> transposed_;  // (n, k): the scaled rows
  Eigen::VectorXd right_;                   // (k)
  GramFactors factors_;
};

}  // namespace invariode
