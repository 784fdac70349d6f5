#pragma once
// The trapezoidal rule with a free interpolant (docs/algorithms.md, 'Trapezoidal rule'; Shampine, Reichelt & Kierzenka,
// Solving index-1 DAEs in MATLAB and Simulink, SIAM Rev. 41 (1999) 538-552; Hosea & Shampine, Analysis and
// implementation of TR-BDF2, Appl. Numer. Math. 20 (1996) 21-37).

#include <array>
#include <vector>

#include "delay_interface.hpp"
#include "methods/order_two.hpp"

namespace invariode {

/// The code ode23t, for M y' = f(t, y): A-stable, and without damping on the imaginary axis. Stiff components, and
/// those that M leaves undetermined, would ring: their part of the stored y' is smoothed.
class Trapezoidal final : public OrderTwo, public DelayInterface {
 public:
  Trapezoidal(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  void state(Archive& archive) override;

  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return 2; }

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override { return 4 * n(); }
  [[nodiscard]] int degree() const override { return 3; }
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;
  [[nodiscard]] bool stages_on_extension() const override { return true; }
  [[nodiscard]] bool remembers_slopes() const override { return true; }

 private:
  void cubic(const double* start, const double* rise, double* data) const;
  Newton::Result stages() override;
  void estimate(double* error) override;
  Status extend(double theta, double* P, double* rise) override;
  Status end_slope(double* slope) override;
  [[nodiscard]] std::array<double, 3> growth() const;
  Status smooth_if_ringing();
  [[nodiscard]] bool rings();
  Status smooth();

  static constexpr double d = 0.5;  // y₁ = y + d (z₀ + z₁), where z = h y'

  // All in units of the step: tiny steps divide by nothing.
  std::vector<double> z0_, z1_;               // h y' at both ends of the step
  std::vector<double> bent_;                  // h² y'' of the last accepted step
  std::vector<double> missed_, last_missed_;  // h³ y''' / 12, what the formula leaves out, here and in the last step
  std::vector<double> rise_[3];               // the last y* − y, less what a constant, a line, a parabola made of it
  double h2_ = 0, h3_ = 0;                    // the steps before the last one
  double last_error_ = 0;
  bool smoothed_ = false;  // z1_ is, or need not be
};

}  // namespace invariode
