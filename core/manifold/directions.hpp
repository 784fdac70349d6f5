#pragma once
// The directions that a correction may take (docs/algorithms.md, 'Directions'; M. Kojima, BIT 56 (2016) 1087–1102).

#include <Eigen/Core>
#include <cstddef>
#include <span>
#include <vector>

#include "linear/least_norm.hpp"

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
  std::vector<std::size_t> waiting_;  // those that are to join the basis
  PivotedBasis basis_;
  Eigen::VectorXd rest_;
};

}  // namespace invariode
