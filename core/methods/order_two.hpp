#pragma once
// Codes of order 2 that solve implicit formulas: what ode23t and ode23tb have in common (docs/algorithms.md,
// 'Trapezoidal rule' and 'TR-BDF2').

#include <cstddef>
#include <vector>

#include "methods/implicit_base.hpp"

namespace invariode {

/// A step of M y' = f(t, y) whose stages are y = base + d z with M z = h f, for one d, so that one matrix, M − d h J,
/// serves all of them and the error estimate. The formula derives from it: what it takes as base, predicts as ψ = d z,
/// and estimates.
class OrderTwo : public ImplicitBase<Newton> {
 public:
  static constexpr int formula_order = 2;

  Outcome start(double t, const double* y, const Span& span) final;
  Attempt attempt(double h, double t1) final;
  bool reject(Cause cause, double hmin) final;
  Outcome accept(const double* y1) final;
  void state(Archive& archive) override;

  [[nodiscard]] int order() const final { return formula_order; }

 protected:
  OrderTwo(Callback& f, const Weights& weights, const LinearAlgebra& linear, double d);

  /// y = base + d z with M z = h f(t, y), from the prediction ψ of d z.
  Newton::Result solve_stage(double t, double* y, double* z);
  /// v becomes (M − d h J)⁻¹ M v: what is stiff in it is gone. It may fail matrix-free only.
  Newton::Result damp(double* v) { return solver_.damp(v); }
  /// The norm of the error of the attempt, damped.
  [[nodiscard]] double error() const { return error_; }

  std::vector<double> second_;      // y'' at the start of a first step
  std::vector<double> last_slope_;  // at the start of the last accepted step
  std::vector<double> base_, psi_;  // of the stage that is solved next; `solve_stage` makes its prediction of the base
  double last_h_ = 0;               // signed, of the last accepted step; 0: there was none

 private:
  /// The stages of the attempt, the candidate last.
  virtual Newton::Result stages() = 0;
  /// The error of the candidate, O(h³), before it is damped by (M − d h J)⁻¹ M: of stiff components it says too much.
  virtual void estimate(double* error) = 0;
  /// y' at the end of the step, which is accepted but not committed yet. Commits what the formula itself remembers,
  /// unless it stops.
  virtual Status end_slope(double* slope) = 0;

  const double d_;
  std::vector<double> increment_;
};

}  // namespace invariode
