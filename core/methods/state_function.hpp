#pragma once
// f as implicit formulas evaluate it: for a state, and for its sensitivities behind it.

#include <algorithm>
#include <cstddef>
#include <optional>
#include <vector>

#include "linear/jacobian.hpp"
#include "linear/matrix_free.hpp"
#include "sensitivity/extent.hpp"
#include "step.hpp"

namespace invariode {

/// f of all that a method integrates, Y = (y, S_1, …, S_k), and of its parts. Outside of bounds it is the linearization
/// of f within. A component that is not finite is remembered until the next evaluation.
class StateFunction {
 public:
  /// `f` and the weights are of all that the method integrates; `jacobian` continues f outside of bounds.
  StateFunction(Callback& f, const Weights& weights, const LinearAlgebra& linear, Jacobian& jacobian);

  Outcome evaluate(double t, const double* y, double* out);
  /// Evaluate f for the state alone, and for its sensitivities, which are Y's.
  Outcome evaluate_state(double t, const double* y, double* out);
  Outcome evaluate_sensitivities(double t, const double* Y, double* out);
  /// ∂/∂t (J S_j + f_pj), (k, n) behind the state in `rate`, by a difference over part of the signed step h; with
  /// `slope` the derivative along y' is added. What the method integrates has the value `f` at (t, Y).
  Status sensitivity_rate(double t, const double* Y, const double* slope, const double* f, double h, double* rate);
  /// The right-hand sides of the sensitivities in a system for all of Y: b_j += c ∂(J S_j + f_pj)/∂y b_0, where b
  /// starts with the solution for the state.
  Status couple(double c, double t, const double* Y, const double* f, double* b);

  [[nodiscard]] int undefined_component() const { return undefined_; }
  void forget_undefined() { undefined_ = -1; }
  [[nodiscard]] Callback& of_state() const { return state_f_; }
  [[nodiscard]] const Weights& state_weights() const { return weights_; }
  [[nodiscard]] const Extent& extent() const { return extent_; }
  /// Doubles at the beginning of Y to whose blocks J and M belong; quadratures are behind them, with 0 and the
  /// identity.
  [[nodiscard]] std::size_t coupled() const { return coupled_; }
  /// The weights in which iterations for sensitivities converge, if there are any.
  [[nodiscard]] const Weights& sensitivity_weights() const { return *sensitivity_weights_; }

 private:
  Outcome finite_or_noted(const double* out, std::size_t count);

  Callback& f_;        // of all that the method integrates,
  Callback& state_f_;  // and of the state: the same without sensitivities
  const Weights& weights_;
  Extent extent_;
  std::size_t coupled_;
  std::optional<Callback> sensitivities_;
  const Weights* sensitivity_weights_;  // null without them
  Jacobian& jacobian_;
  std::vector<double> beyond_, changed_;  // a point beside Y, and the slopes of the sensitivities there
  int undefined_ = -1;
};

}  // namespace invariode
