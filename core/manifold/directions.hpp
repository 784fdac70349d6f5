#pragma once
// The directions that a correction may take (docs/algorithms.md, 'Directions'; M. Kojima, BIT 56 (2016) 1087–1102).

#include <Eigen/Core>
#include <cstddef>
#include <span>
#include <vector>

namespace invariode {

/// The span of some vectors, as an orthonormal basis in the weights of the error test. A row of J W that is cut to it
/// leads to corrections within it.
class Directions {
 public:
  explicit Directions(std::size_t n) : n_(n) {}

  /// Takes vectors of n doubles, which stay where they are until `orthonormalize`.
  void take(std::span<const double* const> vectors) { vectors_.assign(vectors.begin(), vectors.end()); }
  /// Makes the basis of W⁻¹ times the vectors. What is left of a vector with `threshold` of the largest is roundoff of
  /// the others.
  void orthonormalize(const double* w, double threshold);
  /// row ← Q Qᵀ row
  void cut(double* row);

 private:
  std::size_t n_;
  std::vector<const double*> vectors_;
  Eigen::MatrixXd basis_;  // (n, vectors), of which `rank_` columns count
  Eigen::Index rank_ = 0;
  Eigen::VectorXd rest_;
};

}  // namespace invariode
