#pragma once
// Numerical differentiation formulas of order 1 to 5 (and backward differentiation formulas) in backward differences at
// a quasi-constant step (docs/algorithms.md, 'NDF'; Shampine & Reichelt, The MATLAB ODE Suite, 1997, section 2).

#include <cassert>
#include <vector>

#include "delay_interface.hpp"
#include "methods/implicit_base.hpp"

namespace invariode {

/// y₁ + Σ_{j≤k} D_j Π_{m<j} (s + m)/(m + 1), s = (t − t₁)/h. data = [y₁ | D_1 … D_k].
void newton_backward(const double* data, std::size_t size, std::size_t n, double theta, double* out);

/// The code ode15s, for M y' = f(t, y).
class Ndf final : public ImplicitBase<Newton>, public DelayInterface {
 public:
  static constexpr int highest_order = 5;

  struct Options {
    int max_order = highest_order;
    bool bdf = false;             ///< κ = 0
    bool renew_on_error = false;  ///< an error failure renews an old Jacobian: projection may hide it from Newton
  };

  Ndf(Callback& f, const Weights& weights, const LinearAlgebra& linear, const Options& options);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  bool errors(double* out) const override;
  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return static_cast<std::size_t>(options_.max_order) + 1; }
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;
  void state(Archive& archive) override;
  void end_attempts() override {
    ImplicitBase::end_attempts();
    give_back({&predictor_, &psi_, &d_, &scratch_});
  }

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override;
  [[nodiscard]] std::size_t max_extension_size() const override;
  [[nodiscard]] int degree() const override { return memory_order_; }
  [[nodiscard]] int max_degree() const override { return options_.max_order; }
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;
  [[nodiscard]] bool stages_on_extension() const override { return true; }
  [[nodiscard]] bool remembers_slopes() const override { return true; }

  [[nodiscard]] int order() const override { return memory_order_; }

 private:
  friend struct FixedOrder;  // a test of each order

  double* D(int j) { return differences_.data() + at(j); }
  [[nodiscard]] const double* D(int j) const { return differences_.data() + at(j); }
  /// Returns where difference j begins; one past the last is the end.
  [[nodiscard]] std::size_t at(int j) const {
    assert(j >= 1 && static_cast<std::size_t>(j - 1) * n() <= differences_.size());
    return static_cast<std::size_t>(j - 1) * n();
  }
  void rescale_memory(double h);
  void predict();
  double retry_order_and_h();
  void choose_order_and_step();
  [[nodiscard]] double error_constant(int k) const;
  [[nodiscard]] double gamma_inverse(int k) const;
  /// |h| that formula k would choose, if its error at the present |h| is `error`.
  [[nodiscard]] double optimal_h(int k, double error, double safety) const;
  [[nodiscard]] bool misleading_jacobian();

  Options options_;
  int order_ = 1;                    // k of the next attempt
  int memory_order_ = 1;             // k to which D_1 … D_k belong
  double memory_h_ = 0;              // |h| at which they are taken
  int steps_at_h_ = 0;               // in a row with this h and k
  std::vector<double> differences_;  // D_j = ∇^j y, one after the other
  std::vector<double> predictor_, psi_, d_, scratch_;
};

}  // namespace invariode
