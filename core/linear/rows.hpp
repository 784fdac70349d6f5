#pragma once
// The gradients of invariants, row by row: all entries, or those of a pattern.

#include <cassert>
#include <cstddef>
#include <vector>

namespace invariode {

/// One gradient, of doubles, or of packs of them (run/lanes).
template <class Real>
struct RowOf {
  const Real* values;
  const int* columns;  ///< which components they belong to, ascending; null: to all, one after the other
  std::size_t size;

  /// Calls visit(j, value) for each entry.
  template <class Visit>
  void for_each(Visit&& visit) const {
    if (columns == nullptr)
      for (std::size_t j = 0; j < size; ++j) visit(j, values[j]);
    else
      for (std::size_t k = 0; k < size; ++k) visit(static_cast<std::size_t>(columns[k]), values[k]);
  }
  [[nodiscard]] Real dot(const Real* x) const {
    Real sum(0);
    for_each([&](std::size_t j, const Real& value) { sum += value * x[j]; });
    return sum;
  }
  [[nodiscard]] Real entry(std::size_t component) const {
    if (columns == nullptr) return values[component];
    for (std::size_t k = 0; k < size; ++k)
      if (static_cast<std::size_t>(columns[k]) == component) return values[k];
    return Real(0);
  }
};
using Row = RowOf<double>;

/// The entries of some gradients that can differ from zero: where each gradient begins, and their components,
/// ascending. Empty: all.
struct RowPattern {
  std::vector<std::size_t> starts;
  std::vector<int> columns;

  explicit operator bool() const noexcept { return !starts.empty(); }
};

/// The layout of gradients in one array of values.
class RowLayout {
 public:
  explicit RowLayout(std::size_t n) : n_(n) {}

  void add(std::size_t rows, const RowPattern& pattern) {
    for (std::size_t i = 0; i < rows; ++i) {
      const std::size_t size = pattern ? pattern.starts[i + 1] - pattern.starts[i] : n_;
      if (pattern)
        columns_.insert(columns_.end(), pattern.columns.begin() + static_cast<std::ptrdiff_t>(pattern.starts[i]),
                        pattern.columns.begin() + static_cast<std::ptrdiff_t>(pattern.starts[i + 1]));
      rows_.push_back({starts_.back(), size, pattern ? columns_.size() - size : full});
      starts_.push_back(starts_.back() + size);
    }
  }

  [[nodiscard]] std::size_t size() const { return starts_.back(); }
  /// Returns where gradient i begins.
  [[nodiscard]] std::size_t start(std::size_t i) const { return starts_[i]; }
  [[nodiscard]] Row row(std::size_t i, const double* values) const {
    assert(i < rows_.size());
    const auto& [start, size, columns] = rows_[i];
    return {values + start, columns == full ? nullptr : columns_.data() + columns, size};
  }
  [[nodiscard]] bool sparse() const { return !columns_.empty(); }

 private:
  static constexpr std::size_t full = static_cast<std::size_t>(-1);
  struct Place {
    std::size_t start, size, columns;
  };

  std::size_t n_;
  std::vector<std::size_t> starts_{0};
  std::vector<Place> rows_;
  std::vector<int> columns_;
};

}  // namespace invariode
