#pragma once
// Y = (y, S_1, …, S_k) as one system: what a method integrates, and what implicit formulas evaluate and solve of it,
// block by block (docs/algorithms.md, 'Sensitivities').

#include <algorithm>
#include <cstddef>
#include <vector>

#include "linear/jacobian.hpp"
#include "linear/mass.hpp"
#include "manifold/bounds.hpp"
#include "sensitivity/variations.hpp"
#include "step.hpp"

namespace invariode {

/// The equations that a method integrates with sensitivities: Y' is f, then the slopes of S. M S_j' = J S_j + f_pj has
/// the matrices of M y' = f; quadratures, S_j' = g_j(t, y), have J = 0 and M = I. Of components that f would lead out
/// of their bounds, and that rest there, S rests too.
class BlockEquations {
 public:
  /// f, of the state, and both weights, of the state and of Y in Newton's iteration, belong to the caller. `bounded`:
  /// whose slope f is, or null.
  BlockEquations(Callback& f, const Variations& variations, const Weights& weights, const Weights& iteration,
                 BoundedSlope* bounded);
  BlockEquations(const BlockEquations&) = delete;
  BlockEquations& operator=(const BlockEquations&) = delete;

  [[nodiscard]] Extent extent() const { return extent_; }
  /// Doubles at the beginning of Y to whose blocks J and M belong; quadratures are behind them.
  [[nodiscard]] std::size_t coupled() const { return quadratures_ ? extent_.n : extent_.size(); }
  /// Functions of (t, Y): all slopes, those of the state, and those of S alone, (k, n), after the state's at the same t
  /// and y.
  [[nodiscard]] Callback& whole() { return whole_; }
  [[nodiscard]] const Callback& whole() const { return whole_; }
  [[nodiscard]] Callback& state() { return state_; }
  [[nodiscard]] Callback& sensitivities() { return sensitivities_; }
  [[nodiscard]] const Weights& weights() const { return weights_; }
  [[nodiscard]] const Weights& iteration_weights() const { return iteration_; }

 private:
  static Status whole_entry(void* self, double t, const double* Y, double* out);
  static Status sensitivities_entry(void* self, double t, const double* Y, double* out);
  const double* at_rest(const double* Y);

  Extent extent_;
  bool quadratures_;
  Callback& state_;
  Callback f_, slope_;  // as they are called for Y, where the state's calls do not count
  Callback whole_, sensitivities_;
  const Weights& weights_;
  const Weights& iteration_;
  BoundedSlope* bounded_;
  std::vector<double> at_rest_;
};

/// Blocks of Y, one behind the other, as a range of the numbers of their first components.
struct Part {
  std::size_t first, stop, n;

  struct Iterator {
    std::size_t at, n;
    std::size_t operator*() const { return at; }
    void operator++() { at += n; }
    bool operator!=(const Iterator& other) const { return at < other.at; }
  };
  [[nodiscard]] Iterator begin() const { return {first, n}; }
  [[nodiscard]] Iterator end() const { return {stop, n}; }
  [[nodiscard]] std::size_t size() const { return stop - first; }
  [[nodiscard]] std::size_t count() const { return size() / n; }
  [[nodiscard]] bool empty() const { return first >= stop; }
  [[nodiscard]] bool of_state() const { return first == 0; }
};

/// Y as implicit formulas see it: a system whose matrix M − c J is that of the state in every block, with the slopes of
/// S, which depend on y, below it. Without sensitivities it is the state. Outside of bounds f is its linearization
/// within. A component of f that is not finite is remembered until the next evaluation.
class BlockSystem {
 public:
  /// `f` and the weights are of all that the method integrates; `jacobian` continues f outside of bounds.
  BlockSystem(Callback& f, const Weights& weights, const LinearAlgebra& linear, Jacobian& jacobian);

  [[nodiscard]] Part all() const { return {0, extent_.size(), extent_.n}; }
  [[nodiscard]] Part state() const { return {0, extent_.n, extent_.n}; }
  [[nodiscard]] Part sensitivities() const { return {extent_.n, extent_.size(), extent_.n}; }
  [[nodiscard]] bool has_sensitivities() const { return extent_.k > 0; }
  /// The blocks of a part to which J and M belong: all but quadratures.
  [[nodiscard]] Part coupled(const Part& part) const { return {part.first, std::min(part.stop, coupled_), part.n}; }

  Outcome evaluate(double t, const double* Y, double* out) { return evaluate(f_, t, Y, out, extent_.size()); }
  /// f of the state, or the slopes of its sensitivities.
  Outcome evaluate(const Part& part, double t, const double* Y, double* out) {
    return part.of_state() ? evaluate(state_f_, t, Y, out, extent_.n) : evaluate_sensitivities(t, Y, out);
  }
  /// ∂/∂t (J S_j + f_pj), (k, n) behind the state in `rate`, by a difference over part of the signed step h; with
  /// `slope` the derivative along y' is added. What the method integrates has the value `f` at (t, Y).
  Status sensitivity_rate(double t, const double* Y, const double* slope, const double* f, double h, double* rate);
  /// The right-hand sides of the sensitivities in a system for all of Y: b_j += c ∂(J S_j + f_pj)/∂y b_0, where b
  /// starts with the solution for the state.
  Status couple(double c, double t, const double* Y, const double* f, double* b);
  /// M v, block by block.
  void multiply_mass(const Matrix& M, const double* v, double* out) const;

  [[nodiscard]] int undefined_component() const { return undefined_; }
  void forget_undefined() { undefined_ = -1; }
  [[nodiscard]] Callback& state_f() const { return state_f_; }
  [[nodiscard]] const Weights& state_weights() const { return weights_; }
  /// The weights in which iterations for sensitivities converge, if there are any.
  [[nodiscard]] const Weights& sensitivity_weights() const { return equations_->iteration_weights(); }

 private:
  Outcome evaluate(Callback& f, double t, const double* Y, double* out, std::size_t count);
  Outcome evaluate_sensitivities(double t, const double* Y, double* out);

  BlockEquations* equations_;  // null without sensitivities
  Callback& f_;                // of all that the method integrates,
  Callback& state_f_;          // and of the state: the same without sensitivities
  const Weights& weights_;
  Extent extent_;
  std::size_t coupled_;
  Jacobian& jacobian_;
  std::vector<double> beyond_, changed_;  // a point beside Y, and the slopes of the sensitivities there
  int undefined_ = -1;
};

/// Makes the sensitivities of a consistent y consistent: M δ_j = 0 and Zᵀ (J (S_j + δ_j) + f_pj) = 0. Where a value is
/// not finite or a matrix is singular they stay as they are.
Status make_tangent_consistent(const LinearAlgebra& linear, double t, double* Y);

}  // namespace invariode
