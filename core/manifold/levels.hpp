#pragma once
// Corrections in levels: what must hold first is imposed first, and what comes later leaves it alone
// (docs/algorithms.md, 'Corrections in levels').

#include <cstddef>
#include <optional>
#include <vector>

#include "linear/least_norm.hpp"
#include "manifold/invariants.hpp"
#include "manifold/metric.hpp"

namespace invariode {

/// The Newton correction δ = Σ δ_l of invariants in levels l = 0, 1, 2, …: δ_l is the one of least norm with
///
///   J_l (δ_0 + … + δ_l) = r_l,   J_k δ_l = 0 for every level k < l,
///
/// and zero in the components that level l may not move. The norm is that of the level's metric, else ‖W⁻¹δ_l‖. One
/// linearization serves all levels: iterated, the correction converges as Newton's does.
class Levels {
 public:
  /// Throws std::invalid_argument where invariants of one level may move different components, or a metric does not
  /// fit.
  explicit Levels(const Invariants& invariants);

  /// Returns whether the invariants have levels at all, or are so many and their gradients so sparse that one level
  /// with sparse factors takes less time; without them the correction is that of the paper, of all together.
  [[nodiscard]] static bool needed(const Invariants& invariants);
  /// Returns whether any invariant specifies a level, a metric, or the components that its correction may move.
  [[nodiscard]] static bool told(const std::vector<InvariantBlock>& blocks);

  /// Takes the metrics at (t, y).
  Status update(double t, const double* y);
  /// The components marked in `fixed` do not move in the metrics: their weights are 0. Null: none.
  void keep(const char* fixed);
  /// Writes δ. J (m, n) and r (m) are the linearization, w (n) the weights. Rows that depend on others of their level
  /// and those before to within `threshold` are left out. `noise` (m): the size below which a residual is roundoff;
  /// combinations of rows that nearly depend on each other are not corrected for it. `idle`: which rows take no part;
  /// null: none. Returns the rank.
  std::size_t solve(const double* J, const double* r, const double* noise, const double* w, double threshold,
                    const char* idle, double* delta);
  /// The rows that the last `solve` left out.
  [[nodiscard]] const std::vector<char>& left_out() const { return left_out_; }

 private:
  struct Level {
    int number;
    std::vector<char> moves;  // of each component
    std::vector<std::size_t> rows;
    std::optional<MetricFactor> metric;
    SparseRows sparse;

    [[nodiscard]] bool by_metric() const { return metric && metric->regular(); }
    [[nodiscard]] bool diagonal() const { return !metric || metric->diagonal(); }
  };

  Level& level_of(const InvariantBlock& block);
  bool solve_sparse(const double* J, const double* r, const double* w, double threshold, double* delta);
  std::size_t solve_dense(const double* J, const double* r, const double* noise, const double* w, double threshold,
                          double* delta);
  [[nodiscard]] bool idle(std::size_t row) const { return idle_ != nullptr && idle_[row] != 0; }
  [[nodiscard]] std::size_t idle_rows(const Level& level) const;
  bool scales(Level& level, const double* w);
  void take_rows(const double* J, const double* w, Level& level);
  void apply_metric(const double* J, std::size_t row, Level& level);
  std::size_t add_to_basis(double threshold);
  void correct(Level& level, std::size_t first, const double* J, const double* r, const double* noise, const double* w,
               double* delta);
  double noise_of(std::size_t i, std::size_t first, const double* J, const double* noise) const;

  const RowLayout& layout_;
  std::size_t n_, m_;
  std::vector<Level> levels_;
  PivotedBasis basis_;  // of the rows of J W, or J L⁻ᵀ, cut to what moves, of norm 1; empty if sparse factors suffice
  std::vector<double> norm_;          // of the rows before they were scaled
  std::vector<std::size_t> waiting_;  // rows that are to join the basis
  std::vector<double> delta_l_, gradient_, scale_;
  std::vector<double> doubt_;          // of z, by roundoff of the residuals
  std::vector<double> open_l_, open_;  // (n): what roundoff leaves open in δ_l, and in the levels so far
  std::vector<char> left_out_;
  const char* idle_ = nullptr;  // of the latest `solve`
};

}  // namespace invariode
