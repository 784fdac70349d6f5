#pragma once
// The invariants as functions: residual, Jacobian, derivative with respect to t.

#include <cstddef>
#include <cstdint>
#include <vector>

#include "callback.hpp"
#include "weights.hpp"

namespace invariode {

/// m invariants that one user function computes: g(t, y) -> (m,), and its Jacobian -> (m, n) row-major, or none.
struct InvariantBlock {
  Callback g;
  Callback jacobian;
  std::size_t m = 0;
  bool certain = false;  ///< true of every solution, as algebraic equations are: not tested
};

/// All invariants of a run: r(t, y) = g(t, y) − value, J = ∂g/∂y, g_t.
class Invariants {
 public:
  Invariants(std::size_t n, std::vector<InvariantBlock> blocks, std::vector<double> value, const Weights& weights);

  [[nodiscard]] std::size_t n() const { return n_; }
  [[nodiscard]] std::size_t m() const { return value_.size(); }
  [[nodiscard]] const std::vector<double>& value() const { return value_; }
  [[nodiscard]] const std::vector<InvariantBlock>& blocks() const { return blocks_; }
  [[nodiscard]] std::int64_t calls() const;
  [[nodiscard]] std::int64_t jacobian_calls() const;
  /// True where the Jacobian of invariant i is a difference quotient, good to ε^{2/3} only.
  [[nodiscard]] bool by_differences(std::size_t i) const { return by_differences_[i] != 0; }

  [[nodiscard]] bool all_by_differences() const;
  [[nodiscard]] bool certain(std::size_t i) const { return certain_[i] != 0; }

  Status residual(double t, const double* y, double* r);
  Status jacobian(double t, const double* y, double* J);
  /// Central differences, increments ε^{1/3} max(|y_i|, thr_i) (docs/algorithms.md, 'Projection') times `factor`. Fills
  /// the rows that have no user Jacobian, or all of them.
  Status difference_jacobian(double t, const double* y, double* J, bool all_rows, double factor = 1);
  /// Central differences with increment ε^{1/3} max(|t|, |h|) times `factor`; what is below their roundoff counts as 0.
  /// J and y tell the size of the terms that g sums.
  Status time_derivative(double t, double h, const double* y, const double* J, double* gt, double factor = 1);

  /// Size below which the residual of invariant i is roundoff: 10 ε (|value_i| + Σ_j |J_ij y_j|).
  [[nodiscard]] double roundoff(std::size_t i, const double* y, const double* J) const;

 private:
  Status difference_column(InvariantBlock& block, double t, const double* y, std::size_t j, double factor,
                           double* column);
  [[nodiscard]] double increment(std::size_t j, const double* y) const;

  std::size_t n_;
  std::vector<InvariantBlock> blocks_;
  std::vector<double> value_;
  const Weights& weights_;
  std::vector<char> by_differences_, certain_;
  std::vector<double> point_, plus_, minus_;
};

}  // namespace invariode
