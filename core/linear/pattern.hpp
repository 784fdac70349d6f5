#pragma once
// Which entries of ∂f/∂y can differ from zero, found from values of f alone (docs/algorithms.md, 'Jacobians').

#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "callback.hpp"
#include "linear/box.hpp"

namespace invariode {

/// Entries of an n × n matrix as compressed columns: where column j starts, its rows, ascending.
struct Pattern {
  std::vector<int> starts, rows;

  [[nodiscard]] std::size_t n() const { return starts.size() - 1; }
};

/// A search for the pattern that may evaluate f so often, and gives up where it sees that the matrix is rather full, or
/// has more entries than this.
struct PatternSearch {
  std::int64_t most_calls;
  bool sparse_only;
  std::size_t most_entries = std::numeric_limits<int>::max();
};

/// The entries (i, j) for which f_i changes with y_j by its displacement, at (t, y), where f is `value`; and the
/// diagonal. Blocks of columns are displaced together, and those in which something changes are halved: those that have
/// no row in common, as far as is known, share an evaluation of f. A value that is not finite counts as changed.
/// Nothing is returned where the search has given up; `stopped`: f has stopped it.
std::optional<Pattern> find_pattern(Callback& f, double t, const std::vector<double>& y,
                                    const std::vector<double>& value, const std::vector<double>& displacement,
                                    const PatternSearch& search, bool& stopped);

/// Finds the pattern around a point in the box beside (t, y), where no term vanishes by chance.
std::optional<Pattern> find_pattern_near(Callback& f, double t, const std::vector<double>& y, const Box& box,
                                         const PatternSearch& search, bool& stopped);

/// An entry (i, j) for which f_i changes with y_j by its displacement, and that is not among the known ones, sought by
/// halving the components that move together; one evaluation of f tells of each half. Nothing: none was found.
std::optional<std::pair<std::size_t, std::size_t>> find_entry_outside(Callback& f, double t,
                                                                      const std::vector<double>& y,
                                                                      const std::vector<double>& value,
                                                                      const std::vector<double>& displacement,
                                                                      const Pattern& known, bool& stopped);

/// The entries of either.
Pattern united(const Pattern& a, const Pattern& b);

}  // namespace invariode
