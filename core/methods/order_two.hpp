#pragma once
// Codes of order 2 that solve implicit formulas: what ode23t and ode23tb have in common (docs/algorithms.md,
// 'Trapezoidal rule' and 'TR-BDF2').

#include <cstddef>
#include <span>
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
  Attempt inspect_extension(const Attempt& attempt) final;
  bool reject(Cause cause, double hmin) final;
  Outcome accept(const double* y1) final;
  void state(Archive& archive) override;

  [[nodiscard]] int order() const final { return formula_order; }

 protected:
  /// The continuous extension P of an attempt, as far as it is known.
  struct Extension {
    std::span<const double> theta;  ///< where it is tested, each of its polynomials once
    double error;  ///< its error in the smooth part, in units of the estimate of the step before that is damped
  };
  OrderTwo(Callback& f, const Weights& weights, const LinearAlgebra& linear, double d, const Extension& extension);

  /// y = base + d z with M z = h f(t, y), from the prediction ψ of d z.
  Newton::Result solve_stage(double t, double* y, double* z);
  /// v becomes (M − d h J)⁻¹ M v: what is stiff in it is gone. It may fail matrix-free only.
  Newton::Result damp(double* v) { return solver_.damp(v); }
  /// The norm of the error at the end of the attempt, damped.
  [[nodiscard]] double end_error() const { return end_error_; }

  std::vector<double> second_;      // y'' at the start of a first step
  std::vector<double> last_slope_;  // at the start of the last accepted step
  std::vector<double> base_, psi_;  // of the stage that is solved next; `solve_stage` makes its prediction of the base
  double last_h_ = 0;               // signed, of the last accepted step; 0: there was none

 private:
  void keep_sides();
  /// The stages of the attempt, the candidate last.
  virtual Newton::Result stages() = 0;
  /// The error of the candidate, O(h³), before it is damped by (M − d h J)⁻¹ M: of stiff components it says too much.
  virtual void estimate(double* error) = 0;
  /// P and h P' at one of the θ where it is tested.
  virtual Status extend(double theta, double* P, double* rise) = 0;
  /// y' at the end of the step, which is accepted but not committed yet. Commits what the formula itself remembers,
  /// unless it stops.
  virtual Status end_slope(double* slope) = 0;

  [[nodiscard]] double undamped_error() const;
  Newton::Result filter_defect(double theta);

  const double d_;
  const Extension extension_;
  double undamped_error_ = 0, end_error_ = 0;  // of the candidate
  double last_undamped_error_ = 0;             // of the last accepted step
  std::vector<double> increment_;
};

}  // namespace invariode
