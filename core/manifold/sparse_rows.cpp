#include "manifold/sparse_rows.hpp"

#include <algorithm>
#include <cmath>

#include "weights.hpp"

namespace invariode {
namespace {

constexpr double dependent = 1000 * eps;  // pivots of a matrix of ones on the diagonal: what roundoff leaves of 0

}  // namespace

bool SparseRows::least_norm(const RowLayout& layout, const double* values, const std::vector<std::size_t>& rows,
                            const std::vector<double>& scale, const std::vector<double>& right, double threshold,
                            std::vector<double>& x) {
  if (!take(layout, values, rows, scale, right)) return false;
  std::fill(x.begin(), x.end(), 0.0);
  if (right_.size() == 0) return true;
  const Matrix gram = transposed_.transpose() * transposed_;
  if (!analyzed(gram)) analyze(gram);
  factors_->factorize(gram);
  const double least = std::max(threshold * threshold, dependent);  // a pivot is the square of what is left of a row
  if (factors_->info() != Eigen::Success || !(factors_->vectorD().array() > least).all()) return false;
  const Eigen::VectorXd z = transposed_ * Eigen::VectorXd(factors_->solve(right_));
  for (std::size_t j = 0; j < x.size(); ++j) x[j] = scale[j] * z[static_cast<Eigen::Index>(j)];
  return true;
}

/// Whether the order and the structure of the factors are those of this pattern: an equality, since bounds move entries
/// without changing their number.
bool SparseRows::analyzed(const Matrix& gram) const {
  const auto begins = [](const std::vector<int>& known, const int* given, Eigen::Index count) {
    return std::ssize(known) == count && std::equal(known.begin(), known.end(), given);
  };
  return begins(starts_, gram.outerIndexPtr(), gram.outerSize() + 1) &&
         begins(rows_, gram.innerIndexPtr(), gram.nonZeros());
}

void SparseRows::analyze(const Matrix& gram) {
  factors_->analyzePattern(gram);
  starts_.assign(gram.outerIndexPtr(), gram.outerIndexPtr() + gram.outerSize() + 1);
  rows_.assign(gram.innerIndexPtr(), gram.innerIndexPtr() + gram.nonZeros());
}

/// The rows in which something may move, scaled. False: nothing is left of one of them.
bool SparseRows::take(const RowLayout& layout, const double* values, const std::vector<std::size_t>& rows,
                      const std::vector<double>& scale, const std::vector<double>& right) {
  std::vector<Eigen::Triplet<double>> entries;
  std::vector<double> kept;
  for (std::size_t k = 0; k < rows.size(); ++k) {
    const std::size_t before = entries.size();
    double square = 0;
    layout.row(rows[k], values).for_each([&](std::size_t j, double value) {
      if (scale[j] == 0) return;
      const double entry = value * scale[j];
      square += entry * entry;
      entries.emplace_back(static_cast<int>(j), static_cast<int>(kept.size()), entry);
    });
    if (entries.size() == before) continue;
    const double norm = std::sqrt(square);
    if (!(norm > 0) || !std::isfinite(1 / norm)) return false;
    for (std::size_t p = before; p < entries.size(); ++p)
      entries[p] = {entries[p].row(), entries[p].col(), entries[p].value() / norm};
    kept.push_back(right[k] / norm);
  }
  transposed_.resize(static_cast<Eigen::Index>(scale.size()), static_cast<Eigen::Index>(kept.size()));
  transposed_.setFromTriplets(entries.begin(), entries.end());
  right_ = Eigen::Map<const Eigen::VectorXd>(kept.data(), static_cast<Eigen::Index>(kept.size()));
  return true;
}

}  // namespace invariode
