#pragma once
// LU factors of sparse matrices with nearly symmetric patterns, by dense fronts (docs/algorithms/jacobians.md, 'Sparse
// factors'; after I. S. Duff and J. K. Reid, The multifrontal solution of unsymmetric sets of linear equations,
// SIAM J. Sci. Stat. Comput. 5 (1984) 633–641).

#include <cstddef>
#include <vector>

#include "linear/pattern.hpp"

namespace invariode {

/// The order and the groups in which the columns of a matrix are eliminated. Columns of a front have nearly the same
/// pattern below it; what their elimination changes in the rest of the matrix is added to the front of its parent.
struct FrontTree {
  std::vector<int> place;     ///< of each row and column of the matrix among those that are eliminated
  std::vector<int> first;     ///< (fronts + 1,): front f has the columns first[f] … first[f + 1] − 1
  std::vector<int> children;  ///< (fronts,): how many fronts before it are added to it
  std::vector<int> starts;    ///< (fronts + 1,): where the rows below front f start in `rows`
  std::vector<int> rows;      ///< ascending

  FrontTree() = default;
  /// Makes the tree of the minimum degree order of A + Aᵀ.
  explicit FrontTree(const Pattern& A);

  [[nodiscard]] std::size_t fronts() const { return children.size(); }
};

/// The factors. Whatever they need of memory is in vectors: where an allocation fails, the object stays as it is, and
/// can be used again. Pivots are taken from the diagonal of a front where they are at least a tenth of the largest
/// entry in their column, else from those of its rows that are complete. A column without such a pivot waits for the
/// next front.
template <class Scalar>
class SparseLu {
 public:
  /// Matrices of this pattern are factored from now on.
  void analyse(const Pattern& A);
  /// `values`: the entries of A, in the order of the pattern, and finite. False: A is singular.
  [[nodiscard]] bool factor(const std::vector<Scalar>& values);
  /// B becomes A⁻¹ B, m columns of n numbers one behind the other.
  void solve(Scalar* b, std::size_t m);

 private:
  struct Front {
    std::size_t rows, columns, pivots;  // of the front; how many of them were eliminated in it
    std::size_t values, labels;         // where its factors and labels are
  };

  template <std::size_t C>
  void solve_few(Scalar* b);
  void assemble(std::size_t f, const std::vector<Scalar>& values);

  std::size_t eliminate(std::size_t complete);
  bool find_pivot(std::size_t j, std::size_t complete, std::size_t& row) const;
  void update_column(std::size_t j, std::size_t from, std::size_t to);
  void update_rest(std::size_t from, std::size_t to);
  void exchange_rows(std::size_t a, std::size_t b);
  void exchange_columns(std::size_t a, std::size_t b);
  void keep(std::size_t pivots, bool root);

  [[nodiscard]] Scalar* column(std::size_t j) { return front_.data() + j * row_of_.size(); }
  [[nodiscard]] const Scalar* column(std::size_t j) const { return front_.data() + j * row_of_.size(); }

  FrontTree tree_;
  std::vector<int> entry_starts_;  // of the entries of A that belong to a front
  std::vector<int> entries_, entry_row_, entry_column_;

  std::vector<Front> fronts_;
  std::vector<Scalar> factors_;  // of all fronts: their first columns, then the rest of their first rows
  std::vector<int> labels_;      // the places of their rows, then of their columns

  // The front in work, by columns, and the places of its rows and columns; where places are in it.
  std::vector<Scalar> front_, saved_;
  std::vector<int> row_of_, column_of_, row_at_, column_at_;
  // What is left of fronts and waits for its parent: rows and columns, those that were to be eliminated first.
  struct Left {
    std::size_t rows, columns, late, values, labels;
  };
  std::vector<Left> left_;
  std::vector<Scalar> left_values_;
  std::vector<int> left_labels_;
  std::vector<int> saved_rows_;
  std::vector<Scalar> x_, y_;  // of columns side by side
};

}  // namespace invariode
