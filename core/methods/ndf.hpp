#pragma once
// Numerical differentiation formulas of order 1 to 5 (and backward differentiation formulas) in backward differences at
// a quasi-constant step (docs/algorithms.md, 'NDF'; Shampine & Reichelt, The MATLAB ODE Suite, 1997, section 2).

#include <memory>
#include <optional>
#include <vector>

#include "linear/jacobian.hpp"
#include "linear/mass.hpp"
#include "linear/matrix.hpp"
#include "step.hpp"

namespace invariode {

/// y₁ + Σ_{j≤k} D_j Π_{m<j} (s + m)/(m + 1), s = (t − t₁)/h. data = [y₁ | D_1 … D_k].
void newton_backward(const double* data, std::size_t size, std::size_t n, double theta, double* out);

/// The code ode15s, for M y' = f(t, y).
class Ndf : public Step {
 public:
  static constexpr int highest_order = 5;

  struct Options {
    int max_order = highest_order;
    bool bdf = false;             ///< κ = 0
    bool renew_on_error = false;  ///< an error failure renews an old Jacobian: projection may hide it from Newton
    const Lapack* lapack = nullptr;
  };

  /// `mass` may be null: the identity. It belongs to the caller and outlives this.
  Ndf(Callback& f, const Weights& weights, Jacobian jacobian, Mass* mass, const Options& options);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override;
  [[nodiscard]] std::size_t max_extension_size() const override;
  [[nodiscard]] int degree() const override { return memory_order_; }
  [[nodiscard]] int max_degree() const override { return options_.max_order; }
  Status extension(double* data) override;

  [[nodiscard]] int order() const override { return memory_order_; }
  [[nodiscard]] const double* slope() const override { return slope_.data(); }
  [[nodiscard]] int undefined_component() const override;
  [[nodiscard]] LinearWork linear_work() const override;

 protected:
  void restart(double t, const double* y, double h, int order);
  double* D(int j) { return differences_.data() + static_cast<std::size_t>(j - 1) * n(); }
  [[nodiscard]] const double* D(int j) const { return differences_.data() + static_cast<std::size_t>(j - 1) * n(); }

  Options options_;
  int order_ = 1;         ///< k of the next attempt
  int memory_order_ = 1;  ///< k to which D_1 … D_k belong
  double memory_h_ = 0;   ///< |h| at which they are taken
  int steps_at_h_ = 0;    ///< in a row with this h and k

 private:
  enum class Newton { converged, failed, stop };

  void rescale_memory(double h);
  Status renew_jacobian();
  Outcome factor(double c);
  Newton iterate(double c, double t1);
  Outcome evaluate(double t, const double* y, double* out);
  void choose_order_and_step();
  bool stiff();
  [[nodiscard]] double norm(const double* v) const;
  [[nodiscard]] double error_constant(int k) const;
  [[nodiscard]] double gamma_inverse(int k) const;
  /// |h| that formula k would choose, if its error at the present |h| is `error`.
  [[nodiscard]] double optimal_h(int k, double error, double safety) const;

  Jacobian jacobian_;
  Mass* mass_;
  std::unique_ptr<Factorization> lu_;
  std::vector<double> differences_;  // D_j = ∇^j y, one after the other
  std::vector<double> weight_, predictor_, psi_, d_, candidate_, residual_, slope_, f_value_, scratch_;
  double signed_h_ = 0;
  double t1_ = 0;
  double factored_ = 0;  // h invGa_k of the factors; 0: there are none
  double rate_ = 0;      // of convergence of Newton's iteration
  bool rate_known_ = false;
  bool jacobian_current_ = false;  // it is that of (t, y)
  bool renew_ = false;             // before the next attempt
  int jacobian_age_ = 0;           // steps since it was evaluated
  bool failed_ = false;            // an error test in this step
  double error_ = 0;
  LinearWork work_;
  bool undefined_ = false;  // f, in the last attempt
};

}  // namespace invariode
