#include "manifold/directions.hpp"

#include <algorithm>

namespace invariode {

/// By the modified Gram-Schmidt process with pivoting, each pivot orthogonalised twice.
void Directions::orthonormalize(const double* w, double threshold) {
  const auto n = static_cast<Eigen::Index>(n_), count = static_cast<Eigen::Index>(vectors_.size());
  if (basis_.cols() < count) basis_.resize(n, count);
  for (Eigen::Index k = 0; k < count; ++k)
    for (Eigen::Index j = 0; j < n; ++j) basis_(j, k) = vectors_[static_cast<std::size_t>(k)][j] / w[j];
  const auto remove = [this](Eigen::Index k, Eigen::Index q) {
    basis_.col(k) -= basis_.col(q).dot(basis_.col(k)) * basis_.col(q);
  };
  double first = 0;
  for (rank_ = 0; rank_ < std::min(n, count); ++rank_) {
    Eigen::Index pivot = rank_;
    for (Eigen::Index k = rank_ + 1; k < count; ++k)
      if (basis_.col(k).squaredNorm() > basis_.col(pivot).squaredNorm()) pivot = k;
    if (pivot != rank_) basis_.col(rank_).swap(basis_.col(pivot));
    for (Eigen::Index q = 0; q < rank_; ++q) remove(rank_, q);
    const double size = basis_.col(rank_).norm();
    if (rank_ == 0) first = size;
    if (!(size > threshold * first)) break;
    basis_.col(rank_) /= size;
    for (Eigen::Index k = rank_ + 1; k < count; ++k) remove(k, rank_);
  }
}

void Directions::cut(double* row) {
  Eigen::Map<Eigen::VectorXd> cut(row, static_cast<Eigen::Index>(n_));
  rest_ = cut;
  cut.setZero();
  for (Eigen::Index q = 0; q < rank_; ++q) {
    const double component = basis_.col(q).dot(rest_);
    cut += component * basis_.col(q);
  }
}

}  // namespace invariode
