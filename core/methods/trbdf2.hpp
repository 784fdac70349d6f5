#pragma once
// The trapezoidal rule followed by the backward differentiation formula of order 2, in one step (docs/algorithms.md,
// 'TR-BDF2'; Hosea & Shampine, Analysis and implementation of TR-BDF2, Appl. Numer. Math. 20 (1996) 21-37).

#include <vector>

#include "methods/newton.hpp"
#include "step.hpp"

namespace invariode {

/// Two cubic Hermite interpolants that meet at θ = γ. data = [y | z | y_γ | z_γ | y₁ | z₁], z = h y'.
void two_hermite_cubics(const double* data, std::size_t size, std::size_t n, double theta, double* out);

/// The code ode23tb, for M y' = f(t, y): L-stable, and as long as h and J stay one matrix serves both stages and the
/// error estimate.
class TrBdf2 final : public Step {
 public:
  static constexpr int formula_order = 2;

  /// The mass matrix, if there is one, belongs to the caller and outlives this.
  TrBdf2(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  bool errors(double* out) const override;
  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return 3; }
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;
  void end_attempts() override { newton_.end_attempts(); }
  void state(Archive& archive) override;

  [[nodiscard]] Interpolate interpolate() const override { return two_hermite_cubics; }
  [[nodiscard]] std::size_t extension_size() const override { return 6 * n(); }
  [[nodiscard]] std::size_t max_extension_size() const override { return extension_size(); }
  [[nodiscard]] int degree() const override { return 6; }  // 3 in each part
  Status extension(double* data) override;

  [[nodiscard]] int order() const override { return formula_order; }
  [[nodiscard]] const double* slope() const override { return slope_.data(); }
  [[nodiscard]] int undefined_component() const override { return newton_.undefined_component(); }
  [[nodiscard]] LinearWork linear_work() const override { return newton_.work(); }
  [[nodiscard]] const Matrix* jacobian() const override { return &newton_.jacobian(); }

 private:
  Newton::Result solve_stage(double t, double* y, double* z);
  void predict_first();
  void predict_second();
  Newton::Result estimate();

  Newton newton_;
  InitialSlopes initial_;
  std::vector<double> slope_;         // y' at the point reached
  std::vector<double> z0_, z1_, z2_;  // h y' at the start, at θ = γ and at the end of the step
  std::vector<double> middle_, candidate_;
  std::vector<double> base_;  // what the formula of a stage takes from the stages before
  std::vector<double> last_y_, last_slope_;
  std::vector<double> weight_, predictor_, psi_, d_, error_vector_;
  double signed_h_ = 0, t1_ = 0;
  double last_h_ = 0;  // signed, of the last accepted step; 0: there was none
  double error_ = 0;
  bool failed_ = false;  // an attempt of this step
};

}  // namespace invariode
