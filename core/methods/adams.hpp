#pragma once
// Adams-Bashforth-Moulton PECE methods of order 1 to 12 with local extrapolation, in the variable-step form of modified
// divided differences (docs/algorithms.md, 'Adams'; Shampine & Gordon, Computer Solution of ODEs, 1975, chapter 10).

#include <array>
#include <cassert>
#include <memory>
#include <vector>

#include "delay_interface.hpp"
#include "methods/initial_step.hpp"
#include "step.hpp"

namespace invariode {

/// The code ode113. Projection comes between the corrector and the last evaluation, so that everything stored is data
/// of the projected solution. Its continuous extension is the polynomial of [SG] 'INTRP', the integral of the
/// polynomial that interpolates f at t₁ and at the k points before it, in powers of θ.
class Adams final : public Step, public DelayInterface {
 public:
  static constexpr int highest_order = 12;

  /// `parts_seen`: see `Step::parts_seen`. As ode113 is published, f is seen at the ends of steps only.
  Adams(Callback& f, const Weights& weights, int max_order = highest_order, double parts_seen = 0);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  [[nodiscard]] double parts_seen() const override { return parts_seen_; }
  Attempt inspect_inside(const Attempt& attempt, double gap) override;
  bool errors(double* out) const override;
  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return static_cast<std::size_t>(max_order_) + 1; }
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;
  void trust_first_step() override { rest_.accept(); }
  void state(Archive& archive) override;

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override;
  [[nodiscard]] std::size_t max_extension_size() const override;
  [[nodiscard]] bool extends_by_powers() const override { return true; }
  [[nodiscard]] int degree() const override { return previous_order_ + 1; }
  [[nodiscard]] int max_degree() const override { return max_order_ + 1; }
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;
  [[nodiscard]] bool remembers_slopes() const override { return true; }

  [[nodiscard]] int order() const override { return previous_order_; }
  [[nodiscard]] double stability() const override;
  [[nodiscard]] double real_limit() const override;
  [[nodiscard]] const double* slope() const override { return slope_; }
  [[nodiscard]] int undefined_component() const override;

 private:
  // Indices are those of the book: they start at 1.
  static constexpr std::size_t most = highest_order + 3;
  using Coefficients = std::array<double, most>;

  friend struct FixedOrder;  // a test of each order

  double* phi(int i) { return phi_.data() + at(i); }
  [[nodiscard]] const double* phi(int i) const { return phi_.data() + at(i); }
  /// Returns where difference i begins; one past the last is the end.
  [[nodiscard]] std::size_t at(int i) const {
    assert(i >= 1 && static_cast<std::size_t>(i - 1) * n() <= phi_.size());
    return static_cast<std::size_t>(i - 1) * n();
  }

  void update_coefficients();
  void predict();
  void restore();
  double compare_orders();
  void choose_order_and_step();
  void extend_attempt(double* difference, double* data) const;
  template <class Difference>
  void integrate_differences(std::size_t terms, double h, Difference difference, double* data) const;
  [[nodiscard]] double norm(const double* v) const;
  Outcome evaluate(double t, const double* y, double* out);
  template <class Work>
  void for_each_block(Work work);

  int max_order_;
  double parts_seen_;
  int order_ = 1;           // k of the next attempt
  int previous_order_ = 1;  // of the accepted step
  double previous_h_ = 0;   // signed; 0: forgotten
  Coefficients psi_{};      // ψ_i = h_n + … + h_{n+1−i}
  double signed_h_ = 0;
  double t1_ = 0;
  int steps_at_h_ = 0;  // ns: steps in a row with the present h, so many coefficients stay what they are
  RestingStart rest_;
  bool phase1_ = true;  // the start: order and step are raised in every step
  bool predicted_ = false;
  int failures_ = 0;  // in this step
  Coefficients alpha_{}, beta_{}, sigma_{}, g_{}, v_{}, w_{};
  double erk_ = 0, erkm1_ = 0;  // estimated errors of orders k and k − 1
  int lower_ = 1;               // order that these estimates ask for: k, or less
  std::vector<double> phi_;     // φ_i, one after the other
  std::vector<double> inside_;  // of an attempt that is inspected: its powers of θ, a point, f and a difference there
  std::vector<double> values_;
  double* weight_ = nullptr;     // w, of the start of the step
  double* candidate_ = nullptr;  // p, then y*
  double* defect_ = nullptr;     // f(t₁, p), and from it d = f(t₁, p) − φ₁ (predicted)
  double* slope_ = nullptr;      // f at the last point reached
  double* next_slope_ = nullptr;
  const double* evaluated_ = nullptr;  // f as last evaluated
};

}  // namespace invariode
