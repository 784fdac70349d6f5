#pragma once
// The trapezoidal rule followed by the backward differentiation formula of order 2, in one step (docs/algorithms.md,
// 'TR-BDF2'; Hosea & Shampine, Analysis and implementation of TR-BDF2, Appl. Numer. Math. 20 (1996) 21-37).

#include <numbers>
#include <vector>

#include "delay_interface.hpp"
#include "methods/order_two.hpp"

namespace invariode {

/// Two cubic Hermite interpolants that meet at θ = γ. data = [y | z | y_γ | z_γ | y₁ | z₁], z = h y'.
void two_hermite_cubics(const double* data, std::size_t size, std::size_t n, double theta, double* out);

/// The code ode23tb, for M y' = f(t, y): L-stable.
class TrBdf2 final : public OrderTwo, public DelayInterface {
 public:
  static constexpr double gamma = 2 - std::numbers::sqrt2;  ///< where the first part of a step ends

  TrBdf2(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return 3; }

  [[nodiscard]] Interpolate interpolate() const override { return in_turn<two_hermite_cubics>; }
  static constexpr std::size_t extension_rows = 6;
  [[nodiscard]] std::size_t extension_size() const override { return extension_rows * n(); }
  [[nodiscard]] int degree() const override { return 6; }  // 3 in each part
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;
  [[nodiscard]] bool stages_on_extension() const override { return true; }

 private:
  void cubics(const std::vector<double>& start, double* data) const;
  Newton::Result stages() override;
  void estimate(double* error) override;
  Status extend(double theta, double* P, double* rise) override;
  Status end_slope(double* slope) override;
  void predict_first();
  void predict_second();

  // y_γ = y + d (z₀ + z₁) and y₁ = y + w (z₀ + z₁) + d z₂, where z = h y'. γ makes the factors of both stages the same.
  static constexpr double d = gamma / 2;
  static constexpr double w = std::numbers::sqrt2 / 4;
  /// The difference from the formula of order 3 on the same stages.
  static constexpr double e[] = {(1 - 4 * w) / 3, 1.0 / 3, -2 * d / 3};

  std::vector<double> z0_, z1_, z2_;  // h y' at the start, at θ = γ and at the end of the step
  std::vector<double> middle_;
};

}  // namespace invariode
