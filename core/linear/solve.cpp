#include "linear/solve.hpp"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <new>
#include <numeric>
#include <utility>
#include <vector>

#include "linear/sparse_lu.hpp"
#include "weights.hpp"

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

/// The rows of a square matrix in an order that has no 0 on the diagonal: the place of each row; empty if there is
/// none. `rows`: of the entries of each column. (Maximum transversal by augmenting paths, in breadth; I. S. Duff, ACM
/// Trans. Math. Softw. 7 (1981) 315.)
std::vector<int> without_zero_diagonal(const std::vector<std::vector<int>>& rows) {
  const std::size_t k = rows.size();
  std::vector<int> place(k, -1), row_of(k, -1), reached_from(k);
  std::vector<std::size_t> seen(k, 0), columns;
  for (std::size_t start = 0; start < k; ++start) {
    columns.assign(1, start);
    int free = -1;
    for (std::size_t next = 0; next < columns.size() && free < 0; ++next)
      for (const int row : rows[columns[next]]) {
        const auto i = static_cast<std::size_t>(row);
        if (seen[i] == start + 1) continue;
        seen[i] = start + 1;
        reached_from[i] = static_cast<int>(columns[next]);
        if (place[i] < 0) {
          free = row;
          break;
        }
        columns.push_back(static_cast<std::size_t>(place[i]));
      }
    if (free < 0) return {};
    while (free >= 0) {  // back along the path: each column takes the row by which the path leaves it
      const int column = reached_from[static_cast<std::size_t>(free)];
      place[static_cast<std::size_t>(free)] = column;
      free = std::exchange(row_of[static_cast<std::size_t>(column)], free);
    }
  }
  return place;
}

/// Sparse factors of matrices with one pattern, whose columns are ordered once.
class PatternFactors {
 public:
  PatternFactors(std::int64_t k, std::vector<std::int64_t> places)
      : places_(std::move(places)), k_(static_cast<std::size_t>(k)), values_(places_.size()) {
    std::vector<std::vector<int>> rows(k_);
    for (const std::int64_t p : places_) rows[static_cast<std::size_t>(p % k)].push_back(static_cast<int>(p / k));
    place_ = without_zero_diagonal(rows);
    if (place_.empty()) return;
    source_.resize(places_.size());
    std::iota(source_.begin(), source_.end(), std::size_t{0});
    const auto by_columns = [&](std::size_t e) {
      return std::pair(places_[e] % k, place_[static_cast<std::size_t>(places_[e] / k)]);
    };
    std::ranges::sort(source_, {}, by_columns);
    Pattern pattern{std::vector<int>(k_ + 1, 0), {}};
    for (const std::size_t e : source_) {
      const auto [column, row] = by_columns(e);
      ++pattern.starts[static_cast<std::size_t>(column) + 1];
      pattern.rows.push_back(row);
    }
    std::partial_sum(pattern.starts.begin(), pattern.starts.end(), pattern.starts.begin());
    lu_.analyse(pattern);
  }

  [[nodiscard]] bool fits(std::int64_t k, std::int64_t entries, const std::int64_t* places) const {
    return static_cast<std::int64_t>(k_) == k && static_cast<std::int64_t>(places_.size()) == entries &&
           std::equal(places_.begin(), places_.end(), places);
  }

  /// X in place of B (k, m), by rows; false: A is singular or not finite.
  [[nodiscard]] bool solve(std::size_t m, const double* numbers, double* B) {
    if (place_.empty() || !all_finite(numbers, values_.size())) return false;
    for (std::size_t e = 0; e < source_.size(); ++e) values_[e] = numbers[source_[e]];
    if (!lu_.factor(values_)) return false;
    columns_.resize(k_ * m);
    for (std::size_t j = 0; j < m; ++j)
      for (std::size_t i = 0; i < k_; ++i) columns_[j * k_ + static_cast<std::size_t>(place_[i])] = B[i * m + j];
    lu_.solve(columns_.data(), m);
    for (std::size_t j = 0; j < m; ++j)
      for (std::size_t i = 0; i < k_; ++i) B[i * m + j] = columns_[j * k_ + i];
    return all_finite(B, k_ * m);
  }

 private:
  std::vector<std::int64_t> places_;
  std::size_t k_;
  std::vector<int> place_;           // of the rows of A among those of what is factored; none: A is singular
  std::vector<std::size_t> source_;  // the entry among `places` of each value
  std::vector<double> values_, columns_;
  SparseLu<double> lu_;
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
      return factors_of(k, entries, places).solve(static_cast<std::size_t>(m), numbers, B);
    } catch (const std::bad_alloc&) {
      return false;
    }
  };
  if (!solved()) std::fill(B, B + k * m, std::numeric_limits<double>::quiet_NaN());
}

}  // namespace invariode
