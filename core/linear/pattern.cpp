#include "linear/pattern.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <iterator>
#include <utility>

#include "linear/groups.hpp"
#include "linear/scattered.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

constexpr std::size_t first_blocks = 32;  // with fewer of them a sparse matrix looks full
constexpr double full = 0.5;              // of the blocks of a row: where more of them count, the matrix is not sparse
// How far beside y the pattern is sought, in parts of the sizes of the components: where f is defined that far away, no
// term is small by chance.
constexpr std::array<double, 5> beside = {0.1, -0.1, 1e-3, 1e-6, 0};
constexpr double part_displaced = 0.05;
constexpr double smallest_part = 0.1;  // of the largest component: smaller ones are displaced by as much

/// Consecutive columns from edges[b] to edges[b + 1], and the rows in which one of them may have an entry.
struct Blocks {
  std::vector<std::size_t> edges;
  Pattern rows;

  [[nodiscard]] std::size_t size() const { return edges.size() - 1; }
  [[nodiscard]] bool single() const { return size() == edges.back(); }
};

/// One block, every row.
Blocks everything(std::size_t n) {
  Blocks all{.edges = {0, n}, .rows = {.starts = {0, static_cast<int>(n)}, .rows = std::vector<int>(n)}};
  for (std::size_t i = 0; i < n; ++i) all.rows.rows[i] = static_cast<int>(i);
  return all;
}

/// Each block in `parts`, as far as it has so many columns; each part may have entries where the block has.
Blocks divided(const Blocks& blocks, std::size_t parts) {
  Blocks finer{.edges = {0}, .rows = {.starts = {0}, .rows = {}}};
  for (std::size_t b = 0; b < blocks.size(); ++b) {
    const std::size_t first = blocks.edges[b], width = blocks.edges[b + 1] - first;
    const std::size_t count = std::min(parts, width);
    for (std::size_t k = 1; k <= count; ++k) {
      finer.edges.push_back(first + k * width / count);
      finer.rows.rows.insert(finer.rows.rows.end(), blocks.rows.rows.begin() + blocks.rows.starts[b],
                             blocks.rows.rows.begin() + blocks.rows.starts[b + 1]);
      finer.rows.starts.push_back(static_cast<int>(finer.rows.rows.size()));
    }
  }
  return finer;
}

/// Rows in which nothing has changed are left out.
void keep(Blocks& blocks, const std::vector<char>& changed) {
  Pattern kept{.starts = {0}, .rows = {}};
  for (std::size_t b = 0; b < blocks.size(); ++b) {
    for (int p = blocks.rows.starts[b]; p < blocks.rows.starts[b + 1]; ++p)
      if (changed[static_cast<std::size_t>(p)] != 0) kept.rows.push_back(blocks.rows.rows[static_cast<std::size_t>(p)]);
    kept.starts.push_back(static_cast<int>(kept.rows.size()));
  }
  blocks.rows = std::move(kept);
}

bool rather_full(const Blocks& blocks, std::size_t n) {
  return static_cast<double>(blocks.rows.rows.size()) > full * static_cast<double>(n * blocks.size());
}

Pattern diagonal(std::size_t n) {
  Pattern pattern{.starts = std::vector<int>(n + 1), .rows = std::vector<int>(n)};
  for (std::size_t j = 0; j < n; ++j) pattern.starts[j + 1] = 1 + (pattern.rows[j] = static_cast<int>(j));
  return pattern;
}

/// Returns the distance in the direction that leads away from 0, and never across it.
double outward(double y, double distance) { return y < 0 ? -distance : distance; }

/// Parts between ½ and 1½, of two kinds.
double part(std::size_t j, std::size_t kind) { return 0.5 + scattered(2 * j + kind); }

}  // namespace

std::optional<Pattern> find_pattern(Callback& f, double t, const std::vector<double>& y,
                                    const std::vector<double>& value, const std::vector<double>& displacement,
                                    const PatternSearch& search, bool& stopped) {
  const std::size_t n = y.size();
  assert(value.size() == n && displacement.size() == n);
  std::vector<double> point = y, moved(n);
  std::int64_t calls = 0;
  Blocks blocks = everything(n);
  while (!blocks.single()) {
    if (blocks.rows.rows.size() > search.most_entries / (blocks.size() == 1 ? first_blocks : 2)) return {};
    blocks = divided(blocks, blocks.size() == 1 ? first_blocks : 2);
    const ColumnGroups groups = group_columns(n, blocks.size(), blocks.rows.starts.data(), blocks.rows.rows.data());
    calls += static_cast<std::int64_t>(groups.size());
    if (calls > search.most_calls) return {};
    std::vector<char> changed(blocks.rows.rows.size());
    for (const std::vector<std::size_t>& group : groups) {
      for (const std::size_t b : group)
        for (std::size_t j = blocks.edges[b]; j < blocks.edges[b + 1]; ++j) point[j] = y[j] + displacement[j];
      stopped = f(t, point.data(), moved.data()) == Status::stop;
      if (stopped) return {};
      for (const std::size_t b : group) {
        for (std::size_t j = blocks.edges[b]; j < blocks.edges[b + 1]; ++j) point[j] = y[j];
        for (int p = blocks.rows.starts[b]; p < blocks.rows.starts[b + 1]; ++p) {
          const auto q = static_cast<std::size_t>(p);
          const auto i = static_cast<std::size_t>(blocks.rows.rows[q]);
          changed[q] = !(moved[i] == value[i]);  // NaN too
        }
      }
    }
    keep(blocks, changed);
    if (search.sparse_only && rather_full(blocks, n)) return {};
  }
  return united(blocks.rows, diagonal(n));
}

std::optional<Pattern> find_pattern_near(Callback& f, double t, const std::vector<double>& y, const Box& box,
                                         const PatternSearch& search, bool& stopped) {
  const std::size_t n = y.size();
  std::vector<double> size(n), point(n), value(n);
  double largest = 0;
  for (const double one : y) largest = std::max(largest, std::abs(one));
  for (std::size_t j = 0; j < n; ++j)
    size[j] = largest < smallest_scale ? 1 : std::max(std::abs(y[j]), smallest_part * largest);
  for (const double distance : beside) {
    for (std::size_t j = 0; j < n; ++j)
      point[j] = y[j] + box.turned(j, y[j], outward(y[j], distance * part(j, 0) * size[j]));
    stopped = f(t, point.data(), value.data()) == Status::stop;
    if (stopped) return {};
    if (!all_finite(value.data(), n)) continue;
    const double reach = distance == 0 ? part_displaced : std::min(std::abs(distance), part_displaced);
    for (std::size_t j = 0; j < n; ++j) size[j] = box.turned(j, point[j], outward(y[j], reach * part(j, 1) * size[j]));
    return find_pattern(f, t, point, value, size, search, stopped);
  }
  return {};
}

std::optional<std::pair<std::size_t, std::size_t>> find_entry_outside(Callback& f, double t,
                                                                      const std::vector<double>& y,
                                                                      const std::vector<double>& value,
                                                                      const std::vector<double>& displacement,
                                                                      const Pattern& known, bool& stopped) {
  const std::size_t n = y.size();
  std::vector<double> point = y, moved(n);
  std::vector<char> holds(n);
  std::size_t first = 0, last = n;  // the columns among which one changes a row in which none of them has an entry
  std::size_t row = n;
  const auto changes = [&](std::size_t from, std::size_t to) {
    for (std::size_t j = from; j < to; ++j) point[j] = y[j] + displacement[j];
    stopped = stopped || f(t, point.data(), moved.data()) == Status::stop;
    for (std::size_t j = from; j < to; ++j) point[j] = y[j];
    std::fill(holds.begin(), holds.end(), 0);
    for (int p = known.starts[from]; p < known.starts[to]; ++p)
      holds[static_cast<std::size_t>(known.rows[static_cast<std::size_t>(p)])] = 1;
    for (std::size_t i = 0; i < n && !stopped; ++i) {
      if (holds[i] != 0 || moved[i] == value[i]) continue;
      row = i;
      return true;
    }
    return false;
  };
  const std::size_t part = std::max<std::size_t>(1, n / first_blocks);
  for (first = 0; first < n && !stopped; first += part) {
    last = std::min(first + part, n);
    if (changes(first, last)) break;
  }
  while (first < n && last - first > 1 && !stopped) {
    const std::size_t middle = first + (last - first) / 2;
    if (changes(first, middle))
      last = middle;
    else if (changes(middle, last))
      first = middle;
    else
      return {};  // only both together change f_row by more than roundoff
  }
  if (stopped || first >= n) return {};
  return std::pair(row, first);
}

Pattern united(const Pattern& a, const Pattern& b) {
  assert(a.n() == b.n());
  Pattern both{.starts = {0}, .rows = {}};
  both.rows.reserve(a.rows.size() + b.rows.size());
  for (std::size_t j = 0; j < a.n(); ++j) {
    std::set_union(a.rows.begin() + a.starts[j], a.rows.begin() + a.starts[j + 1], b.rows.begin() + b.starts[j],
                   b.rows.begin() + b.starts[j + 1], std::back_inserter(both.rows));
    both.starts.push_back(static_cast<int>(both.rows.size()));
  }
  return both;
}

}  // namespace invariode
