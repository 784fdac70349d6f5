#pragma once
// Solutions of least norm, for equations with few entries each.

#include <Eigen/SparseCholesky>
#include <Eigen/SparseCore>
#include <cstddef>
#include <memory>
#include <vector>

#include "manifold/rows.hpp"

namespace invariode {

/// Equations a_i x = r_i with sparse rows: with rows b_i of norm 1 in the scaled unknowns, by the factors L D Lᵀ of B
/// Bᵀ, which are ordered anew where its pattern changes. That squares the condition number; the next Newton iteration
/// recovers what is lost.
class SparseRows {
 public:
  /// Writes x = S z of least norm ‖z‖ for the rows named, S the diagonal matrix `scale`; 0: that unknown does not move.
  /// Equations in which nothing moves are left out. False: rows depend on each other to within `threshold`.
  bool least_norm(const RowLayout& layout, const double* values, const std::vector<std::size_t>& rows,
                  const std::vector<double>& scale, const std::vector<double>& right, double threshold,
                  std::vector<double>& x);

 private:
  using Matrix = Eigen::SparseMatrix<double>;

  [[nodiscard]] bool analyzed(const Matrix& gram) const;
  void analyze(const Matrix& gram);
  bool take(const RowLayout& layout, const double* values, const std::vector<std::size_t>& rows,
            const std::vector<double>& scale, const std::vector<double>& right);

  Matrix transposed_;      // (n, k): the scaled rows
  Eigen::VectorXd right_;  // (k)
  std::unique_ptr<Eigen::SimplicialLDLT<Matrix>> factors_ = std::make_unique<Eigen::SimplicialLDLT<Matrix>>();
  std::vector<int> starts_, rows_;  // the pattern that the order of the factors is for
};

}  // namespace invariode
