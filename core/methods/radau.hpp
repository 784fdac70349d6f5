#pragma once
// The Radau IIA method of order 5 (docs/algorithms.md, 'Radau'; Hairer & Wanner, Solving Ordinary Differential
// Equations II, 2nd ed., 1996, section IV.8).

#include <complex>
#include <memory>
#include <vector>

#include "methods/newton.hpp"
#include "step.hpp"

namespace invariode {

/// Radau IIA of three stages, stiffly accurate, for M y' = f(t, y).
///
/// The unknowns are the increments Z_i = Y_i − y of the stages. With the eigenvalues of A⁻¹, one real and a complex
/// pair, Newton's linear system of 3 n equations becomes a real and a complex one of n.
class Radau final : public Step {
 public:
  static constexpr int formula_order = 5;
  static constexpr int extension_order = 3;
  static constexpr std::size_t stages = 3;

  /// The mass matrix, if there is one, belongs to the caller and outlives this.
  Radau(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  bool errors(double* out) const override;
  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return stages; }
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;
  void state(Archive& archive) override;

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override { return (stages + 1) * n(); }
  [[nodiscard]] std::size_t max_extension_size() const override { return extension_size(); }
  [[nodiscard]] int degree() const override { return static_cast<int>(stages); }
  Status extension(double* data) override;

  [[nodiscard]] int order() const override { return formula_order; }
  [[nodiscard]] const double* slope() const override { return slope_.data(); }
  [[nodiscard]] int undefined_component() const override { return jacobian_.undefined_component(); }
  [[nodiscard]] LinearWork linear_work() const override { return jacobian_.work(); }
  [[nodiscard]] const Matrix* jacobian() const override { return &jacobian_.jacobian(); }

 private:
  using Complex = std::complex<double>;

  double* Z(std::size_t stage) { return increments_.data() + stage * n(); }
  [[nodiscard]] double norm(const double* v) const;
  Outcome factor();
  bool factorize();
  Status take_masses();
  void predict();
  Newton::Result solve_stages();
  Outcome stage_residuals();
  double update_stages();
  void weigh_first_update();
  Outcome estimate();
  void solve_for_error(const double* f);
  [[nodiscard]] double factor_of_error() const;
  [[nodiscard]] double next_h() const;

  AgingJacobian jacobian_;
  InitialSlopes initial_;
  std::unique_ptr<Factorization> real_lu_;
  std::unique_ptr<ComplexFactorization> complex_lu_;
  Convergence convergence_;
  std::vector<double> increments_;         // Z_1 Z_2 Z_3
  std::vector<double> polynomial_;         // a_1 a_2 a_3 of the last accepted step, Z = Σ a_k θ^k; y at θ = 1 is known
  std::vector<double> residuals_;          // of the three stages
  std::vector<Complex> complex_residual_;  // of the transformed system
  std::vector<Matrix> stage_masses_;       // M(t) at the stages
  std::vector<double> f_, slope_;          // f and y' at (t, y)
  std::vector<double> last_y_, candidate_, weight_, error_vector_, gap_, scratch_;
  double signed_h_ = 0, t1_ = 0;
  double memory_h_ = 0;                 // signed h of the polynomial; 0: there is none
  double error_ = 0;                    // of the last attempt
  double last_h_ = 0, last_error_ = 0;  // |h| and error of the last accepted step; 0: there was none
  bool failed_ = false;                 // an attempt of this step
};

}  // namespace invariode
