#pragma once
// Radau IIA methods of order 5, 9 and 13 (docs/algorithms.md, 'Radau'; Hairer & Wanner, Solving Ordinary Differential
// Equations II, 2nd ed., 1996, section IV.8, and Stiff differential equations solved by Radau methods, J. Comput. Appl.
// Math. 111 (1999) 93-111).

#include <cassert>
#include <memory>
#include <vector>

#include "delay_interface.hpp"
#include "methods/implicit_base.hpp"
#include "methods/radau_formula.hpp"
#include "methods/radau_systems.hpp"

namespace invariode {

/// Radau IIA of 3, 5 or 7 stages, stiffly accurate, for M y' = f(t, y). How fast Newton's iteration converges decides
/// how many there are.
///
/// The unknowns are the increments Z_i = Y_i − y of the stages. With the eigenvalues of A⁻¹, a real one and complex
/// pairs, Newton's linear system of s n equations becomes a real and (s − 1) / 2 complex ones of n: that takes one J
/// for all stages, and matrix-free it is that at (t, y), all through the step.
class Radau final : public ImplicitBase<RadauSystems>, public DelayInterface {
 public:
  static constexpr int lowest_order = 5;
  static constexpr int highest_order = 13;
  static constexpr int highest_extension_order = 7;

  /// An order between those of two formulas counts as the lower one.
  Radau(Callback& f, const Weights& weights, const LinearAlgebra& linear, int max_order = highest_order);

  Outcome start(double t, const double* y, const Span& span) override;
  Attempt attempt(double h, double t1) override;
  Attempt inspect_extension(const Attempt& attempt) override;
  [[nodiscard]] double parts_seen() const override;
  Attempt inspect_inside(const Attempt& attempt, double gap) override;
  std::size_t directions(const double** vectors) const override;
  [[nodiscard]] std::size_t max_directions() const override { return highest_->stages; }
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;
  void state(Archive& archive) override;
  void end_attempts() override {
    ImplicitBase::end_attempts();
    give_back({&increments_, &residuals_, &end_f_, &gap_, &scratch_, &inside_, &residual_, &earlier_});
  }

  [[nodiscard]] Interpolate interpolate() const override;
  [[nodiscard]] std::size_t extension_size() const override { return (accepted_->stages + 1) * n(); }
  [[nodiscard]] std::size_t max_extension_size() const override { return (highest_->stages + 1) * n(); }
  [[nodiscard]] int degree() const override { return static_cast<int>(accepted_->stages); }
  [[nodiscard]] int max_degree() const override { return static_cast<int>(highest_->stages); }
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;
  [[nodiscard]] bool stages_on_extension() const override { return true; }

  [[nodiscard]] int order() const override { return accepted_->order(); }
  [[nodiscard]] const double* slope() const override { return slope_.empty() ? f_.data() : slope_.data(); }

 private:
  [[nodiscard]] std::size_t stages() const { return formula_->stages; }
  double* Z(std::size_t stage) {
    assert(stage < stages());
    return increments_.data() + stage * n();
  }
  [[nodiscard]] const double* last_increment() const { return increments_.data() + (stages() - 1) * n(); }
  friend struct FixedOrder;  // a test of each order

  /// M at t₁; null: the identity.
  [[nodiscard]] const Matrix* mass() const {
    return stage_masses_.empty() ? solver_.mass_matrix() : &stage_masses_[stages() - 1];
  }
  void use(const RadauFormula* formula);
  Status take_masses();
  void predict();
  Newton::Result solve();
  Newton::Result solve_stages();
  Newton::Result iterate(Convergence& convergence);
  Newton::Result solve_part(double tolerance, bool& negligible);
  [[nodiscard]] double norm_of_part(const double* v) const;
  Outcome stage_residuals();
  double update_stages(bool forgets);
  void weigh_first_update();
  Newton::Result estimate();
  Newton::Result damp(double* v);
  Newton::Result damp_again(double* v);
  Newton::Result filter_defect(double theta, double* defect);
  [[nodiscard]] double factor_of_error() const;
  [[nodiscard]] double next_h() const;
  Newton::Result look_at_end();
  void choose_order(double h);
  [[nodiscard]] bool may_raise_order() const;
  void lower_order();

  const RadauFormula *lowest_, *highest_;
  const RadauFormula* formula_;          // of the next attempt
  const RadauFormula* accepted_;         // of the last accepted step
  Part part_{};                          // that an iteration is for: the state, or its sensitivities
  const double* part_weight_ = nullptr;  // of all of Y
  Convergence convergence_, sensitivity_convergence_;
  std::vector<double> sensitivity_weight_;
  std::vector<double> increments_;    // Z_1 … Z_s, with room for the most stages so far
  std::vector<double> polynomial_;    // of the last accepted step, in nested form, 0 at θ = 0
  std::vector<double> residuals_;     // of the stages; before them h Y', afterwards the updates
  std::vector<Matrix> stage_masses_;  // M(t) at the stages
  std::vector<double> f_;             // f at (t, y): y' too, unless there is a mass matrix
  std::vector<double> end_f_;         // f at (t₁, candidate), where it is known
  bool end_known_ = false;
  std::vector<double> gap_, scratch_;
  std::vector<double> inside_;              // the polynomial of an attempt that is inspected, in nested form
  std::vector<double> residual_, earlier_;  // of the last stage, before the last update and the one before
  double memory_h_ = 0;                     // signed h of the polynomial; 0 before the first step
  double last_h_ = 0, last_error_ = 0;      // |h| and error of the last accepted step; 0: there was none
  int steps_until_raise_ = 0;               // of the order, at least
};

}  // namespace invariode
