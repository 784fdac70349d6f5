#include "linear/sparse_lu.hpp"

#include <Eigen/OrderingMethods>
#include <Eigen/SparseCore>
#include <algorithm>
#include <array>
#include <cmath>
#include <complex>
#include <numeric>
#include <utility>

#include "linear/index.hpp"
#include "linear/side_by_side.hpp"

namespace invariode {
namespace {

constexpr double least_pivot = 0.1;  // of the largest entry in its column
constexpr std::size_t panel = 32;    // columns that are eliminated before the rest of a front is updated

/// c − a b. (The standard's product of complex numbers looks for infinities.)
inline double minus_product(double c, double a, double b) { return c - a * b; }
inline std::complex<double> minus_product(std::complex<double> c, std::complex<double> a, std::complex<double> b) {
  return {c.real() - a.real() * b.real() + a.imag() * b.imag(), c.imag() - a.real() * b.imag() - a.imag() * b.real()};
}
inline double magnitude(double a) { return std::abs(a); }
inline double magnitude(std::complex<double> a) { return std::abs(a.real()) + std::abs(a.imag()); }

std::size_t at(int i) { return static_cast<std::size_t>(i); }

/// The pattern of A + Aᵀ below the diagonal, by columns, in another order of rows and columns.
/// Rows are neither in order nor unique.
Pattern lower_part(const Pattern& A, const std::vector<int>& place) {
  const std::size_t n = A.n();
  Pattern lower{std::vector<int>(n + 1, 0), {}};
  const auto each = [&](auto&& visit) {
    for (std::size_t j = 0; j < n; ++j)
      for (std::size_t p = at(A.starts[j]); p < at(A.starts[j + 1]); ++p) {
        const int one = place[j], other = place[at(A.rows[p])];
        if (one != other) visit(at(std::min(one, other)), std::max(one, other));
      }
  };
  each([&](std::size_t j, int) { ++lower.starts[j + 1]; });
  std::partial_sum(lower.starts.begin(), lower.starts.end(), lower.starts.begin());
  lower.rows.resize(at(lower.starts[n]));
  std::vector<int> next(lower.starts.begin(), lower.starts.end() - 1);
  each([&](std::size_t j, int i) { lower.rows[at(next[j]++)] = i; });
  return lower;
}

/// The place of each row and column in the minimum degree order of A + Aᵀ.
std::vector<int> minimum_degree(const Pattern& A) {
  const std::vector<double> values(A.rows.size());
  const Eigen::SparseMatrix<double> matrix = Eigen::Map<const Eigen::SparseMatrix<double>>(
      index(A.n()), index(A.n()), index(A.rows.size()), A.starts.data(), A.rows.data(), values.data());
  Eigen::PermutationMatrix<Eigen::Dynamic, Eigen::Dynamic, int> order;
  Eigen::AMDOrdering<int>()(matrix, order);  // order.indices()[k]: which comes k-th
  std::vector<int> place(A.n());
  for (std::size_t k = 0; k < place.size(); ++k) place[at(order.indices()[index(k)])] = static_cast<int>(k);
  return place;
}

/// The elimination tree (Liu): the parent of column j is the first row below it in L; n: it has none.
std::vector<int> elimination_tree(const Pattern& lower) {
  const std::size_t n = lower.n();
  // By rows: L(i, j) ≠ 0 for the columns j on the way from entries of row i to i.
  std::vector<int> parent(n, -1), ancestor(n, -1), starts(n + 1, 0), columns(lower.rows.size());
  for (const int i : lower.rows) ++starts[at(i) + 1];
  std::partial_sum(starts.begin(), starts.end(), starts.begin());
  std::vector<int> next(starts.begin(), starts.end() - 1);
  for (std::size_t j = 0; j < n; ++j)
    for (std::size_t p = at(lower.starts[j]); p < at(lower.starts[j + 1]); ++p)
      columns[at(next[at(lower.rows[p])]++)] = static_cast<int>(j);
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t p = at(starts[i]); p < at(starts[i + 1]); ++p)
      for (int j = columns[p]; j != -1 && at(j) < i;) {
        const int up = std::exchange(ancestor[at(j)], static_cast<int>(i));
        if (up == -1) parent[at(j)] = static_cast<int>(i);
        j = up;
      }
  return parent;
}

/// The columns so that those of each subtree follow each other, and their root follows them: place of each.
std::vector<int> postorder(const std::vector<int>& parent) {
  const std::size_t n = parent.size();
  std::vector<int> child(n, -1), sibling(n, -1), place(n), stack;
  for (std::size_t j = n; j-- > 0;)
    if (parent[j] >= 0) sibling[j] = std::exchange(child[at(parent[j])], static_cast<int>(j));
  int next = 0;
  for (std::size_t root = 0; root < n; ++root) {
    if (parent[root] >= 0) continue;
    stack.push_back(static_cast<int>(root));
    while (!stack.empty()) {
      const std::size_t j = at(stack.back());
      if (child[j] >= 0) {
        stack.push_back(std::exchange(child[j], sibling[at(child[j])]));
        continue;
      }
      place[j] = next++;
      stack.pop_back();
    }
  }
  return place;
}

/// Returns whether two fronts, of so many columns, with this part of zeros, are worth eliminating together. (The rule
/// of CHOLMOD: Chen, Davis, Hager and Rajamanickam, ACM Trans. Math. Softw. 35 (2008) 22.)
bool joined(std::size_t columns, double zeros) {
  return zeros == 0 || (columns <= 16 && zeros < 0.25) || (columns <= 48 && zeros < 0.1) || zeros < 0.05;
}

/// Columns that are eliminated together, and the rows below them.
struct Group {
  std::size_t first, last;
  std::vector<int> below;
  double zeros = 0;  // entries that are stored for nothing
  [[nodiscard]] std::size_t columns() const { return last + 1 - first; }
};

/// The columns of L with the same rows below, each from its own entries and the columns whose parent it is.
std::vector<Group> groups_of(const Pattern& lower) {
  const std::size_t n = lower.n();
  std::vector<Group> groups;         // fronts so far
  std::vector<std::size_t> waiting;  // of columns, their last groups, that wait for their parent: a stack
  std::vector<int> mark(n, -1);
  std::vector<int> below;
  for (std::size_t j = 0; j < n; ++j) {
    below.clear();
    mark[j] = static_cast<int>(j);
    const auto add = [&](int i) {
      if (std::exchange(mark[at(i)], static_cast<int>(j)) != static_cast<int>(j)) below.push_back(i);
    };
    for (std::size_t p = at(lower.starts[j]); p < at(lower.starts[j + 1]); ++p) add(lower.rows[p]);
    bool leaf = true;
    while (!waiting.empty() && at(groups[waiting.back()].below.front()) == j) {
      for (const int i : groups[waiting.back()].below) add(i);
      waiting.pop_back();
      leaf = false;
    }
    std::ranges::sort(below);
    Group* before = leaf ? nullptr : &groups.back();
    if (before != nullptr && before->below.size() == below.size() + 1) {
      before->last = j;
      before->below = below;
    } else {
      groups.push_back({j, j, below});
    }
    if (!below.empty()) waiting.push_back(groups.size() - 1);
  }
  return groups;
}

/// The groups, with last children joined to them where that is worth it.
std::vector<Group> with_joined(std::vector<Group> groups) {
  std::vector<Group> kept;
  for (Group& one : groups) {
    while (!kept.empty()) {
      Group& child = kept.back();
      if (child.below.empty() || at(child.below.front()) > one.last) break;
      const auto k = static_cast<double>(child.columns()), all = k + static_cast<double>(one.columns()),
                 m = static_cast<double>(one.below.size());
      const double zeros = one.zeros + child.zeros +
                           k * (static_cast<double>(one.columns()) + m - static_cast<double>(child.below.size()));
      if (!joined(child.columns() + one.columns(), zeros / (all * (all + 1) / 2 + all * m))) break;
      one.first = child.first;
      one.zeros = zeros;
      kept.pop_back();
    }
    kept.push_back(std::move(one));
  }
  return kept;
}

}  // namespace

FrontTree::FrontTree(const Pattern& A) : place(minimum_degree(A)) {
  const std::size_t n = A.n();
  const std::vector<int> after = postorder(elimination_tree(lower_part(A, place)));
  for (int& one : place) one = after[at(one)];
  const Pattern lower = lower_part(A, place);

  const std::vector<Group> kept = with_joined(groups_of(lower));
  first.push_back(0);
  starts.push_back(0);
  std::vector<int> front_of(n);
  for (std::size_t f = 0; f < kept.size(); ++f) {
    for (std::size_t j = kept[f].first; j <= kept[f].last; ++j) front_of[j] = static_cast<int>(f);
    first.push_back(static_cast<int>(kept[f].last + 1));
    rows.insert(rows.end(), kept[f].below.begin(), kept[f].below.end());
    starts.push_back(static_cast<int>(rows.size()));
  }
  children.assign(kept.size(), 0);
  for (const Group& one : kept)
    if (!one.below.empty()) ++children[at(front_of[at(one.below.front())])];
}

template <class Scalar>
void SparseLu<Scalar>::analyse(const Pattern& A) {
  tree_ = FrontTree(A);
  const std::size_t n = A.n(), count = tree_.fronts();
  std::vector<int> front_of(n);
  for (std::size_t f = 0; f < count; ++f)
    std::fill(front_of.begin() + tree_.first[f], front_of.begin() + tree_.first[f + 1], static_cast<int>(f));
  entry_starts_.assign(count + 1, 0);
  const auto each = [&](auto&& visit) {
    for (std::size_t j = 0; j < n; ++j)
      for (std::size_t p = at(A.starts[j]); p < at(A.starts[j + 1]); ++p) {
        const int row = tree_.place[at(A.rows[p])], column = tree_.place[j];
        visit(p, at(front_of[at(std::min(row, column))]), row, column);
      }
  };
  each([&](std::size_t, std::size_t f, int, int) { ++entry_starts_[f + 1]; });
  std::partial_sum(entry_starts_.begin(), entry_starts_.end(), entry_starts_.begin());
  std::vector<int> next(entry_starts_.begin(), entry_starts_.end() - 1);
  for (std::vector<int>* one : {&entries_, &entry_row_, &entry_column_}) one->resize(A.rows.size());
  each([&](std::size_t p, std::size_t f, int row, int column) {
    const std::size_t to = at(next[f]++);
    entries_[to] = static_cast<int>(p);
    entry_row_[to] = row;
    entry_column_[to] = column;
  });
  row_at_.resize(n);
  column_at_.resize(n);
}

template <class Scalar>
bool SparseLu<Scalar>::factor(const std::vector<Scalar>& values) {
  fronts_.clear();
  factors_.clear();
  labels_.clear();
  left_.clear();
  left_values_.clear();
  left_labels_.clear();
  for (std::size_t f = 0; f < tree_.fronts(); ++f) {
    assemble(f, values);
    const std::size_t complete = row_of_.size() - at(tree_.starts[f + 1] - tree_.starts[f]);
    const std::size_t pivots = eliminate(complete);
    const bool root = tree_.starts[f] == tree_.starts[f + 1];
    if (root && pivots < complete) return false;
    left_.push_back({row_of_.size() - pivots, column_of_.size() - pivots, complete - pivots, 0, 0});
    keep(pivots, root);
  }
  return true;
}

/// The front with the entries of A and what its children have left. Complete rows and columns come first: its own, then
/// those that its children could not eliminate.
template <class Scalar>
void SparseLu<Scalar>::assemble(std::size_t f, const std::vector<Scalar>& values) {
  row_of_.clear();
  for (int j = tree_.first[f]; j < tree_.first[f + 1]; ++j) row_of_.push_back(j);
  column_of_ = row_of_;
  const std::size_t children = at(tree_.children[f]);
  for (std::size_t c = left_.size() - children; c < left_.size(); ++c) {
    const Left& child = left_[c];
    const auto labels = left_labels_.begin() + static_cast<std::ptrdiff_t>(child.labels);
    const auto late = static_cast<std::ptrdiff_t>(child.late);
    row_of_.insert(row_of_.end(), labels, labels + late);
    column_of_.insert(column_of_.end(), labels + static_cast<std::ptrdiff_t>(child.rows),
                      labels + static_cast<std::ptrdiff_t>(child.rows) + late);
  }
  for (std::vector<int>* one : {&row_of_, &column_of_})
    one->insert(one->end(), tree_.rows.begin() + tree_.starts[f], tree_.rows.begin() + tree_.starts[f + 1]);
  for (std::size_t i = 0; i < row_of_.size(); ++i) {
    row_at_[at(row_of_[i])] = static_cast<int>(i);
    column_at_[at(column_of_[i])] = static_cast<int>(i);
  }
  front_.assign(row_of_.size() * column_of_.size(), Scalar(0));
  for (std::size_t e = at(entry_starts_[f]); e < at(entry_starts_[f + 1]); ++e)
    column(at(column_at_[at(entry_column_[e])]))[row_at_[at(entry_row_[e])]] += values[at(entries_[e])];
  for (std::size_t c = 0; c < children; ++c) {
    const Left child = left_.back();
    const int* rows = left_labels_.data() + child.labels;
    const int* columns = rows + child.rows;
    const Scalar* from = left_values_.data() + child.values;
    saved_rows_.resize(child.rows);
    for (std::size_t i = 0; i < child.rows; ++i) saved_rows_[i] = row_at_[at(rows[i])];
    for (std::size_t j = 0; j < child.columns; ++j, from += child.rows) {
      Scalar* to = column(at(column_at_[at(columns[j])]));
      for (std::size_t i = 0; i < child.rows; ++i) to[saved_rows_[i]] += from[i];
    }
    left_values_.resize(child.values);
    left_labels_.resize(child.labels);
    left_.pop_back();
  }
}

/// Eliminates as many of the complete columns as there are pivots for, which come first. Returns their number.
template <class Scalar>
std::size_t SparseLu<Scalar>::eliminate(std::size_t complete) {
  std::size_t done = 0;
  for (std::size_t before = 1; before != 0 && done < complete;) {  // columns that had no pivot may get one later
    before = done;
    std::size_t tried = complete;  // those from here on have failed
    while (done < tried) {
      const std::size_t from = done, end = std::min(from + panel, tried);
      while (done < std::min(end, tried)) {
        saved_.assign(column(done), column(done) + row_of_.size());
        update_column(done, from, done);
        std::size_t row = 0;
        if (!find_pivot(done, complete, row)) {
          std::copy(saved_.begin(), saved_.end(), column(done));
          exchange_columns(done, --tried);
          continue;
        }
        exchange_rows(done, row);
        Scalar* own = column(done);
        const Scalar reciprocal = Scalar(1) / own[done];
        for (std::size_t i = done + 1; i < row_of_.size(); ++i) own[i] *= reciprocal;
        ++done;
      }
      update_rest(from, done);
    }
    before = done - before;
  }
  return done;
}

template <class Scalar>
bool SparseLu<Scalar>::find_pivot(std::size_t j, std::size_t complete, std::size_t& row) const {
  const Scalar* own = column(j);
  double largest = 0, largest_complete = -1;
  for (std::size_t i = j; i < row_of_.size(); ++i) {
    const double size = magnitude(own[i]);
    largest = std::max(largest, size);
    if (i < complete && size > largest_complete) {
      largest_complete = size;
      row = i;
    }
  }
  const int label = column_of_[j];
  const std::size_t diagonal = at(row_at_[at(label)]);
  if (diagonal >= j && diagonal < complete && row_of_[diagonal] == label &&
      magnitude(own[diagonal]) >= least_pivot * largest)
    row = diagonal;
  return largest > 0 && magnitude(own[row]) >= least_pivot * largest;
}

/// Column j by the pivots from … to − 1.
template <class Scalar>
void SparseLu<Scalar>::update_column(std::size_t j, std::size_t from, std::size_t to) {
  Scalar* own = column(j);
  for (std::size_t p = from; p < to; ++p) {
    const Scalar* l = column(p);
    const Scalar u = own[p];
    for (std::size_t i = p + 1; i < row_of_.size(); ++i) own[i] = minus_product(own[i], l[i], u);
  }
}

/// The columns behind by the pivots from … to − 1: their upper rows, then the rest by products of four columns at a
/// time.
template <class Scalar>
void SparseLu<Scalar>::update_rest(std::size_t from, std::size_t to) {
  const std::size_t m = row_of_.size();
  for (std::size_t j = to; j < column_of_.size(); ++j) {
    Scalar* own = column(j);
    for (std::size_t p = from; p < to; ++p) {
      const Scalar* l = column(p);
      const Scalar u = own[p];
      for (std::size_t i = p + 1; i < to; ++i) own[i] = minus_product(own[i], l[i], u);
    }
  }
  constexpr std::size_t wide = 4;
  constexpr std::size_t high = 256;
  for (std::size_t top = to; top < m; top += high) {
    const std::size_t bottom = std::min(top + high, m);
    std::size_t j = to;
    for (; j + wide <= column_of_.size(); j += wide) {
      Scalar* __restrict c0 = column(j), * __restrict c1 = column(j + 1);
      Scalar* __restrict c2 = column(j + 2), * __restrict c3 = column(j + 3);
      std::size_t p = from;
      for (; p + 2 <= to; p += 2) {
        const Scalar* __restrict l0 = column(p), * __restrict l1 = column(p + 1);
        const Scalar u00 = c0[p], u01 = c1[p], u02 = c2[p], u03 = c3[p];
        const Scalar u10 = c0[p + 1], u11 = c1[p + 1], u12 = c2[p + 1], u13 = c3[p + 1];
        for (std::size_t i = top; i < bottom; ++i) {
          c0[i] = minus_product(minus_product(c0[i], l0[i], u00), l1[i], u10);
          c1[i] = minus_product(minus_product(c1[i], l0[i], u01), l1[i], u11);
          c2[i] = minus_product(minus_product(c2[i], l0[i], u02), l1[i], u12);
          c3[i] = minus_product(minus_product(c3[i], l0[i], u03), l1[i], u13);
        }
      }
      for (; p < to; ++p) {
        const Scalar* __restrict l0 = column(p);
        const Scalar u00 = c0[p], u01 = c1[p], u02 = c2[p], u03 = c3[p];
        for (std::size_t i = top; i < bottom; ++i) {
          c0[i] = minus_product(c0[i], l0[i], u00);
          c1[i] = minus_product(c1[i], l0[i], u01);
          c2[i] = minus_product(c2[i], l0[i], u02);
          c3[i] = minus_product(c3[i], l0[i], u03);
        }
      }
    }
    for (; j < column_of_.size(); ++j) {
      Scalar* c0 = column(j);
      for (std::size_t p = from; p < to; ++p) {
        const Scalar *l0 = column(p), u00 = c0[p];
        for (std::size_t i = top; i < bottom; ++i) c0[i] = minus_product(c0[i], l0[i], u00);
      }
    }
  }
}

template <class Scalar>
void SparseLu<Scalar>::exchange_rows(std::size_t a, std::size_t b) {
  if (a == b) return;
  for (std::size_t j = 0; j < column_of_.size(); ++j) std::swap(column(j)[a], column(j)[b]);
  std::swap(row_of_[a], row_of_[b]);
  std::swap(row_at_[at(row_of_[a])], row_at_[at(row_of_[b])]);
}

template <class Scalar>
void SparseLu<Scalar>::exchange_columns(std::size_t a, std::size_t b) {
  if (a == b) return;
  std::swap_ranges(column(a), column(a) + row_of_.size(), column(b));
  std::swap(column_of_[a], column_of_[b]);
}

/// The factors of the front, and what is left of it for its parent.
template <class Scalar>
void SparseLu<Scalar>::keep(std::size_t pivots, bool root) {
  const std::size_t m = row_of_.size(), n = column_of_.size();
  fronts_.push_back({m, n, pivots, factors_.size(), labels_.size()});
  factors_.insert(factors_.end(), column(0), column(0) + pivots * m);
  for (std::size_t j = pivots; j < n; ++j) factors_.insert(factors_.end(), column(j), column(j) + pivots);
  labels_.insert(labels_.end(), row_of_.begin(), row_of_.end());
  labels_.insert(labels_.end(), column_of_.begin(), column_of_.end());
  Left& left = left_.back();
  if (root) {
    left_.pop_back();
    return;
  }
  left.values = left_values_.size();
  left.labels = left_labels_.size();
  for (std::size_t j = pivots; j < n; ++j) left_values_.insert(left_values_.end(), column(j) + pivots, column(j) + m);
  left_labels_.insert(left_labels_.end(), row_of_.begin() + static_cast<std::ptrdiff_t>(pivots), row_of_.end());
  left_labels_.insert(left_labels_.end(), column_of_.begin() + static_cast<std::ptrdiff_t>(pivots), column_of_.end());
}

template <class Scalar>
void SparseLu<Scalar>::solve(Scalar* b, std::size_t m) {
  side_by_side(m, [&]<std::size_t C>(std::size_t j, Count<C>) { solve_few<C>(b + j * tree_.place.size()); });
}

template <class Scalar>
template <std::size_t C>
void SparseLu<Scalar>::solve_few(Scalar* b) {
  using Group = std::array<Scalar, C>;
  const std::size_t n = tree_.place.size();
  const auto subtract = [](Scalar* __restrict from, std::size_t rows, const Scalar* __restrict l, const Group& x) {
    for (std::size_t i = 0; i < rows; ++i)
      for (std::size_t c = 0; c < C; ++c) from[i * C + c] = minus_product(from[i * C + c], l[i], x[c]);
  };
  const auto group = [](const Scalar* x) {
    Group g;
    std::copy_n(x, C, g.begin());
    return g;
  };
  x_.resize(std::max(x_.size(), n * C));
  y_.resize(std::max(y_.size(), n * C));
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t c = 0; c < C; ++c) x_[at(tree_.place[i]) * C + c] = b[c * n + i];
  std::size_t next = 0;  // of y: one group for each pivot
  for (const Front& one : fronts_) {
    const int* rows = labels_.data() + one.labels;
    front_.resize(std::max(front_.size(), one.rows * C));
    Scalar* x = front_.data();
    for (std::size_t i = 0; i < one.rows; ++i) std::copy_n(&x_[at(rows[i]) * C], C, x + i * C);
    for (std::size_t p = 0; p < one.pivots; ++p) {
      const Scalar* l = factors_.data() + one.values + p * one.rows;
      subtract(x + (p + 1) * C, one.rows - p - 1, l + p + 1, group(x + p * C));
    }
    std::copy_n(x, one.pivots * C, y_.data() + next * C);
    for (std::size_t i = one.pivots; i < one.rows; ++i) std::copy_n(x + i * C, C, &x_[at(rows[i]) * C]);
    next += one.pivots;
  }
  for (auto front = fronts_.rbegin(); front != fronts_.rend(); ++front) {
    const Front& one = *front;
    next -= one.pivots;
    const int* columns = labels_.data() + one.labels + one.rows;
    Scalar* y = y_.data() + next * C;
    const Scalar* u = factors_.data() + one.values + one.pivots * one.rows;
    for (std::size_t j = one.pivots; j < one.columns; ++j, u += one.pivots)
      subtract(y, one.pivots, u, group(&x_[at(columns[j]) * C]));
    for (std::size_t p = one.pivots; p-- > 0;) {
      const Scalar* own = factors_.data() + one.values + p * one.rows;
      for (std::size_t c = 0; c < C; ++c) y[p * C + c] /= own[p];
      subtract(y, p, own, group(y + p * C));
      std::copy_n(y + p * C, C, &x_[at(columns[p]) * C]);
    }
  }
  for (std::size_t i = 0; i < n; ++i)
    for (std::size_t c = 0; c < C; ++c) b[c * n + i] = x_[at(tree_.place[i]) * C + c];
}

template class SparseLu<double>;
template class SparseLu<std::complex<double>>;

}  // namespace invariode
