#include "linear/least_norm.hpp"

#include <algorithm>
#include <cmath>
#include <memory>
#include <utility>

#include "weights.hpp"

namespace invariode {
namespace {

constexpr double dependent = 1000 * eps;  // pivots of a matrix of ones on the diagonal: what roundoff leaves of 0
constexpr double tie =
    2e-13;  // of squares: vectors as long as each other but for roundoff, of which the first is taken

}  // namespace

void PivotedBasis::bring_longest_to(std::size_t place, std::vector<std::size_t>& candidates) {
  const auto next = candidates.begin() + static_cast<std::ptrdiff_t>(place);
  auto longest = next;
  for (auto other = next + 1; other != candidates.end(); ++other)
    if (vector(*other).squaredNorm() > vector(*longest).squaredNorm() * (1 + tie)) longest = other;
  std::rotate(next, longest, longest + 1);
}

/// Takes out of vector i what it has of the basis vector q, and notes it in R.
void PivotedBasis::remove_component(std::size_t i, std::size_t q) {
  const double component = vector(q).dot(vector(i));
  vector(i) -= component * vector(q);
  R_(index(q), index(i)) += component;
}

bool KnownPattern::differs(const Eigen::SparseMatrix<double>& A) const {
  const auto same = [](const std::vector<int>& known, const int* given, Eigen::Index count) {
    return std::ssize(known) == count && std::equal(known.begin(), known.end(), given);
  };
  return !same(starts_, A.outerIndexPtr(), A.outerSize() + 1) || !same(rows_, A.innerIndexPtr(), A.nonZeros());
}

void KnownPattern::note(const Eigen::SparseMatrix<double>& A) {
  starts_.assign(A.outerIndexPtr(), A.outerIndexPtr() + A.outerSize() + 1);
  rows_.assign(A.innerIndexPtr(), A.innerIndexPtr() + A.nonZeros());
}

bool GramFactors::factor(const Eigen::SparseMatrix<double>& B, double threshold) {
  const Eigen::SparseMatrix<double> gram = B.transpose() * B;
  if (pattern_.differs(gram)) {  // new factors: Eigen's vectors are not valid after a failed allocation of another size
    auto fresh = std::make_unique<Factors>();
    fresh->analyzePattern(gram);
    factors_ = std::move(fresh);
    pattern_.note(gram);
  }
  factors_->factorize(gram);
  const double least = std::max(threshold * threshold, dependent);  // a pivot is the square of what is left of a column
  return factors_->info() == Eigen::Success && (factors_->vectorD().array() > least).all();
}

bool SparseRows::least_norm(const RowLayout& layout, const double* values, const std::vector<std::size_t>& rows,
                            const std::vector<double>& scale, const std::vector<double>& right, double threshold,
                            std::vector<double>& x) {
  if (!take(layout, values, rows, scale, right)) return false;
  std::fill(x.begin(), x.end(), 0.0);
  if (right_.size() == 0) return true;
  if (!factors_.factor(transposed_, threshold)) return false;
  const Eigen::VectorXd z = transposed_ * factors_.solve(right_);
  for (std::size_t j = 0; j < x.size(); ++j) x[j] = scale[j] * z[index(j)];
  return true;
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
  transposed_.resize(index(scale.size()), index(kept.size()));
  transposed_.setFromTriplets(entries.begin(), entries.end());
  right_ = Eigen::VectorXd(Eigen::Map<const Eigen::VectorXd>(kept.data(), index(kept.size())));
  return true;
}

}  // namespace invariode
