#pragma once
// The invariants as functions: residual, Jacobian, derivative with respect to t.

#include <algorithm>
#include <cassert>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "callback.hpp"
#include "functions/piece.hpp"
#include "linear/rows.hpp"
#include "manifold/metric.hpp"
#include "weights.hpp"

namespace invariode {

/// The source of ∂g/∂y: a user function; Im g(t, y + i h e_j) / h, to roundoff; differences on both sides or on one.
enum class Derivative { given, complex_step, central, forward };

/// m invariants that one user function computes: g(t, y) -> (m,), its Jacobian -> (m, n) row-major, or the entries of
/// its pattern, if given, and g of a complex y, pairs of reals in and out, for the complex step.
struct InvariantBlock {
  Callback g;
  Callback jacobian;
  Callback complex_g;
  Derivative derivative = Derivative::central;  ///< where there is no `jacobian`
  RowPattern pattern;                           ///< of the Jacobian that is given; none: it is full
  bool users = false;  ///< `jacobian` is the user's, whose NaN nobody replaces; otherwise its formula is ours
  std::size_t m = 0;
  bool held = false;               ///< its value is what g was, not one that is demanded
  int sense = 0;                   ///< 0: it keeps its value; −1: in the direction of integration it never rises above
                                   ///< it; 1: never falls below it
  bool untested = false;           ///< true of every solution, as algebraic equations are: not tested
  bool along_steps = false;        ///< its correction is sought among the directions that its step is made of
  int level = 0;                   ///< lower ones are imposed first, and later ones leave them alone
  std::vector<std::size_t> moves;  ///< the components that its correction may move; empty: all
  Metric metric;                   ///< in which its correction is the least; none: that of the error test
  Callback tangent;                ///< (t, Y) -> G S_j + g_pj, (k, m), where there are sensitivities
};

/// All invariants of a run: r(t, y) = g(t, y) − value, J = ∂g/∂y, g_t.
class Invariants {
 public:
  Invariants(std::size_t n, std::vector<InvariantBlock> blocks, std::vector<double> value, const Weights& weights);

  [[nodiscard]] std::size_t n() const { return n_; }
  [[nodiscard]] std::size_t m() const { return value_.size(); }
  [[nodiscard]] const std::vector<double>& value() const { return value_; }
  void set_value(const std::vector<double>& value) {
    assert(value.size() == m());
    value_ = value;
  }
  /// Holds what is held, not demanded, at its values at (t, y) from now on.
  Status hold(double t, const double* y);
  /// Fixes the invariants that may only increase or decrease at their values at (t, y) from now on.
  Status hold_one_sided(double t, const double* y);
  /// From now on invariants that may only increase or decrease do not go back behind g (m).
  void tighten(const double* g);
  [[nodiscard]] const std::vector<InvariantBlock>& blocks() const { return blocks_; }
  [[nodiscard]] std::int64_t calls() const;
  [[nodiscard]] std::int64_t jacobian_calls() const;
  /// Evaluations of g for Jacobians by differences, which `calls` includes.
  [[nodiscard]] std::int64_t derivative_calls() const { return derivative_calls_; }
  /// Returns whether the Jacobian of invariant i is a difference quotient, good to ε^{2/3} or ε^{1/2} only.
  [[nodiscard]] bool by_differences(std::size_t i) const {
    assert(i < m());
    return increment_[i] != 0;
  }
  [[nodiscard]] bool all_by_differences() const;
  /// Relative error of the worst derivatives, in units of the terms of their row: ε^{2/3}, ε^{1/2}, or 0 without
  /// differences.
  [[nodiscard]] double relative_error_of_derivatives() const { return derivative_error_; }
  /// From now on the block of invariant i has differences instead of complex steps; false: it had none.
  bool abandon_complex_steps(std::size_t i);
  /// Values, kinds of derivatives, counts.
  void state(Archive& archive);
  [[nodiscard]] bool untested(std::size_t i) const {
    assert(i < m());
    return untested_[i] != 0;
  }
  /// The sense of invariant i: 0, −1 or 1, as of its block.
  [[nodiscard]] int sense(std::size_t i) const { return sense_[i]; }
  [[nodiscard]] bool any_one_sided() const { return any_one_sided_; }
  /// Returns whether corrections are sought among the directions that the step is made of.
  [[nodiscard]] bool along_steps() const { return along_steps_; }
  /// Returns by how much a residual of invariant i violates it.
  [[nodiscard]] double excess(std::size_t i, double residual) const {
    return sense_[i] == 0 ? std::abs(residual) : std::max(0.0, -sense_[i] * residual);
  }
  /// Returns whether a rate of invariant i in the direction of integration contradicts it.
  [[nodiscard]] bool contradicts(std::size_t i, double rate) const {
    return sense_[i] == 0 ? rate != 0 : sense_[i] * rate < 0;
  }

  /// Functions of t are called by way of a piece of the interval, which outlives this: differences with respect to t
  /// stay inside it.
  void keep_within(const Piece& piece) { piece_ = &piece; }
  /// How far a difference of this size may reach from t to either side: as far on both, or, at an edge of the piece, on
  /// one side alone, and no farther than the piece does.
  struct Reach {
    double back, ahead;
    [[nodiscard]] bool one_sided() const { return back == 0 || ahead == 0; }
  };
  [[nodiscard]] Reach reach(double t, double size) const;

  /// g(t, y)
  Status evaluate(double t, const double* y, double* g);
  /// g(t, y) − value
  Status residual(double t, const double* y, double* r);
  /// The gradients, in their layout.
  Status jacobian(double t, const double* y, double* J);
  [[nodiscard]] const RowLayout& layout() const { return layout_; }
  [[nodiscard]] Row row(std::size_t i, const double* J) const { return layout_.row(i, J); }
  /// Central differences, increments ε^{1/3} `sizes` times `factor`, of all invariants: (m, n).
  Status difference_jacobian(double t, const double* y, double* J, double factor = 1);
  /// Differences of the second order with `time_increment`, central ones, at an edge of the piece one-sided ones; what
  /// is below their roundoff counts as 0. J and y tell the size of the terms that g sums.
  Status time_derivative(double t, double h, const double* y, const double* J, double* gt, double factor = 1);

  /// s_j = max(|y_j|, min(thr_j, max_i |y_i|)): sizes of the components for increments. thr can be far above all of y,
  /// where the tolerance is tight. They stay until the next call of a member.
  const double* sizes(const double* y);
  /// (ε max(|t|, |h|) h²)^{1/3}: the solution changes in times like h, t has roundoff.
  [[nodiscard]] static double time_increment(double t, double h);
  /// Roundoff of g over this is what it does to g_t: that increment, less where differences are one-sided.
  [[nodiscard]] double resolution_in_time(double t, double h) const;
  /// Size below which the residual of invariant i is roundoff: 10 ε (|value_i| + Σ_j |J_ij y_j|).
  [[nodiscard]] double roundoff(std::size_t i, const double* y, const double* J) const;
  /// Its part that is known without J.
  [[nodiscard]] double roundoff_of_value(std::size_t i) const;
  /// Returns the change of invariant i by roundoff of the point, 10 ε s_j in each component; `size`: its `sizes`.
  double resolution(std::size_t i, const double* size, const double* J) const;
  /// Returns the change of J_i f by roundoff of the point, where J_i comes from differences.
  double roundoff_of_rate(std::size_t i, const double* y, const double* J, const double* f);

 private:
  Status one_sided_time_derivative(double t, double length, const double* y, const double* J, double* gt);
  void note_kinds();
  Status difference_block(InvariantBlock& block, double t, const double* y, double factor, double* rows);
  Status complex_step(InvariantBlock& block, double t, const double* y, double* rows, bool& finite);
  Status forward_differences(InvariantBlock& block, double t, const double* y, double* rows);
  Status difference_column(InvariantBlock& block, double t, const double* y, std::size_t j, double factor,
                           double* column);
  Status one_sided_column(InvariantBlock& block, double t, const double* y, std::size_t j, double delta,
                          double* column);

  std::size_t n_;
  std::vector<InvariantBlock> blocks_;
  std::vector<double> value_;
  const Weights& weights_;
  const Piece* piece_ = nullptr;  // null: all times
  RowLayout layout_;
  double derivative_error_ = 0;
  std::vector<double> increment_;  // of the differences for each invariant, relative; 0: it has none
  std::vector<char> untested_;
  std::vector<int> sense_;
  bool any_one_sided_ = false, along_steps_ = false;
  std::int64_t derivative_calls_ = 0;
  std::vector<double> point_, plus_, minus_, sizes_;
  std::vector<double> complex_point_, complex_value_;
};

}  // namespace invariode
