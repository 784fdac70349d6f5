#include "linear/solve.hpp"

#include <Eigen/SparseLU>
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <new>
#include <utility>
#include <vector>

namespace invariode {

void solve_in_place(std::int64_t k, std::int64_t m, double* numbers) noexcept {
  double* const A = numbers;
  double* const B = numbers + k * k;
  for (std::int64_t c = 0; c < k; ++c) {
    std::int64_t pivot = c;
    for (std::int64_t i = c + 1; i < k; ++i)
      if (std::abs(A[i * k + c]) > std::abs(A[pivot * k + c])) pivot = i;
    if (!(std::abs(A[pivot * k + c]) > 0)) {
      std::fill(B, B + k * m, std::numeric_limits<double>::quiet_NaN());
      return;
    }
    if (pivot != c) {
      std::swap_ranges(A + c * k, A + (c + 1) * k, A + pivot * k);
      std::swap_ranges(B + c * m, B + (c + 1) * m, B + pivot * m);
    }
    for (std::int64_t i = c + 1; i < k; ++i) {
      const double factor = A[i * k + c] / A[c * k + c];
      if (factor == 0) continue;
      for (std::int64_t j = c + 1; j < k; ++j) A[i * k + j] -= factor * A[c * k + j];
      for (std::int64_t j = 0; j < m; ++j) B[i * m + j] -= factor * B[c * m + j];
    }
  }
  for (std::int64_t i = k; i-- > 0;)
    for (std::int64_t j = 0; j < m; ++j) {
      double sum = B[i * m + j];
      for (std::int64_t c = i + 1; c < k; ++c) sum -= A[i * k + c] * B[c * m + j];
      B[i * m + j] = sum / A[i * k + i];
    }
}

namespace {

/// Sparse factors of matrices with one pattern, whose columns are ordered once.
class PatternFactors {
 public:
  PatternFactors(std::int64_t k, std::vector<std::int64_t> places) : places_(std::move(places)), A_(k, k) {
    std::vector<Eigen::Triplet<double>> entries;
    entries.reserve(places_.size());
    for (std::size_t e = 0; e < places_.size(); ++e)
      entries.emplace_back(static_cast<int>(places_[e] / k), static_cast<int>(places_[e] % k), static_cast<double>(e));
    A_.setFromTriplets(entries.begin(), entries.end());
    A_.makeCompressed();
    source_.reserve(places_.size());
    for (Eigen::Index e = 0; e < A_.nonZeros(); ++e) source_.push_back(static_cast<std::size_t>(A_.valuePtr()[e]));
    lu_.analyzePattern(A_);
  }

  [[nodiscard]] bool fits(std::int64_t k, std::int64_t entries, const std::int64_t* places) const {
    return A_.rows() == k && static_cast<std::int64_t>(places_.size()) == entries &&
           std::equal(places_.begin(), places_.end(), places);
  }

  /// X in place of B (k, m), by rows; false: A is singular or not finite.
  [[nodiscard]] bool solve(std::int64_t m, const double* numbers, double* B) {
    for (std::size_t e = 0; e < source_.size(); ++e) A_.valuePtr()[e] = numbers[source_[e]];
    lu_.factorize(A_);
    if (lu_.info() != Eigen::Success) return false;
    using Rows = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>;
    Eigen::Map<Rows> right(B, A_.rows(), m);
    for (Eigen::Index j = 0; j < m; ++j) {
      column_ = right.col(j);
      right.col(j) = lu_.solve(column_);
    }
    return right.allFinite();
  }

 private:
  std::vector<std::int64_t> places_;
  Eigen::SparseMatrix<double> A_;
  std::vector<std::size_t> source_;  // the entry among `places` of each value of A
  Eigen::SparseLU<Eigen::SparseMatrix<double>> lu_;
  Eigen::VectorXd column_;
};

constexpr std::size_t most_patterns = 16;  // that a thread keeps

/// The factors for this pattern, which move to the front.
PatternFactors& factors_of(std::int64_t k, std::int64_t entries, const std::int64_t* places) {
  thread_local std::vector<std::unique_ptr<PatternFactors>> kept;
  const auto known =
      std::find_if(kept.begin(), kept.end(), [&](const auto& one) { return one->fits(k, entries, places); });
  if (known != kept.end()) {
    std::rotate(kept.begin(), known, known + 1);
  } else {
    if (kept.size() == most_patterns) kept.pop_back();
    kept.insert(kept.begin(), std::make_unique<PatternFactors>(k, std::vector<std::int64_t>(places, places + entries)));
  }
  return *kept.front();
}

}  // namespace

void solve_sparse_in_place(std::int64_t k, std::int64_t m, std::int64_t entries, const std::int64_t* places,
                           double* numbers) noexcept {
  double* const B = numbers + entries;
  const auto solved = [&] {
    try {
      return factors_of(k, entries, places).solve(m, numbers, B);
    } catch (const std::bad_alloc&) {
      return false;
    }
  };
  if (!solved()) std::fill(B, B + k * m, std::numeric_limits<double>::quiet_NaN());
}

}  // namespace invariode
