#pragma once
// The modified Rosenbrock formulas of orders 2 and 3 (docs/algorithms.md, 'Rosenbrock'; Shampine & Reichelt, The MATLAB
// ODE Suite, 1997, section 3).

#include <memory>
#include <vector>

#include "methods/implicit_base.hpp"

namespace invariode {

/// The code ode23s, for M y' = f(t, y) with a constant regular M: linearly implicit, one factorisation and three
/// solutions a step, no iteration. J and ∂f/∂t are taken anew in every step.
class Rosenbrock final : public ImplicitBase<AgingJacobian> {
 public:
  static constexpr int formula_order = 2;

  Rosenbrock(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  bool errors(double* out) const override;
  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return 3; }
  bool reject(Cause cause, double hmin) override { return retry_of_order_two(cause, hmin); }
  Outcome accept(const double* y1) override;
  void state(Archive& archive) override;

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override { return 3 * n(); }
  [[nodiscard]] int degree() const override { return formula_order; }
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;

  [[nodiscard]] int order() const override { return formula_order; }
  [[nodiscard]] Trust trust() const override { return bent_ ? Trust::never : Trust::unless_suspicious; }

 private:
  Outcome linearize();
  Outcome stages();
  Status solve(std::vector<double>& b);
  bool looks_like_jump();
  void parabola(const std::vector<double>& start, double* data) const;
  [[nodiscard]] const double* times_mass(const std::vector<double>& k);

  std::unique_ptr<Factorization> lu_;
  std::vector<double> f0_, f1_, f2_, ft_;  // f at the start, in the middle and at the end of the step; ∂f/∂t
  std::vector<double> k1_, k2_, k3_;
  std::vector<double> scratch_, bend_;
  bool ft_known_ = false;
  bool bent_ = false;  // the slopes of the attempt look like those of an f that jumps
};

}  // namespace invariode
