#pragma once
// A method that chooses itself: an explicit one where the problem is not stiff, an implicit one where it is
// (docs/algorithms.md, 'Auto'; Petzold, Automatic selection of methods for solving stiff and nonstiff systems of
// ordinary differential equations, SIAM J. Sci. Stat. Comput. 4 (1983) 136-148).

#include <algorithm>
#include <cstdint>
#include <memory>
#include <vector>

#include "composite_interface.hpp"
#include "delay_interface.hpp"
#include "implicit_interface.hpp"
#include "methods/extensions.hpp"

namespace invariode {

/// Two methods that take turns. At a hand-over the other one starts anew at the point reached; until its first step is
/// accepted, the one before could continue as if nothing had happened.
///
/// Costs are counted in evaluations of f. The explicit member hands over when it has spent as much on steps that
/// stability limits as a trial of the implicit one takes, so that waiting and trying cost about the same. The implicit
/// member hands back when the explicit one, with the longest step that is stable for the Jacobian at hand, would be
/// cheaper. A turn that was no faster than the steps before it makes the next one harder to begin.
class Switching final : public Step, public CompositeInterface, public DelayInterface {
 public:
  /// One of them may be null: the other one is then alone. `jacobian_cost`: evaluations of f that a Jacobian takes.
  /// `matrix_free`: the implicit one knows the Jacobian by its products, which are differences of f or cost as much.
  struct Members {
    std::unique_ptr<Step> explicit_one, implicit_one;
    double jacobian_cost = 0;
    bool matrix_free = false, differences = false;
    const Callback* state_f = nullptr;  ///< f of the state alone, if they integrate its sensitivities too
  };

  Switching(Callback& f, const Weights& weights, Members members);

  Outcome start(double t, const double* y, const Span& span) override;
  Outcome hand_over(const Span& span) override;
  void stay_explicit() override { stays_ = true; }
  Attempt attempt(double h, double t1) override { return active_->attempt(h, t1); }
  Attempt inspect_extension(const Attempt& attempt) override { return active_->inspect_extension(attempt); }
  [[nodiscard]] double parts_seen() const override { return explicit_ ? explicit_->parts_seen() : 0; }
  Attempt inspect_inside(const Attempt& attempt, double gap) override { return active_->inspect_inside(attempt, gap); }
  [[nodiscard]] Trust trust() const override { return active_->trust(); }
  bool errors(double* out) const override { return active_->errors(out); }
  bool reject(Cause cause, double hmin) override;
  Outcome accept(const double* y1) override;
  void end_attempts() override;
  [[nodiscard]] CompositeInterface* composite() override { return this; }
  void state(Archive& archive) override;

  std::size_t directions(const double** vectors) const override { return active_->directions(vectors); }
  [[nodiscard]] std::size_t max_directions() const override;

  [[nodiscard]] Interpolate interpolate() const override { return numbered_extension; }
  [[nodiscard]] std::size_t extension_size() const override { return 1 + active_->extension_size(); }
  [[nodiscard]] std::size_t max_extension_size() const override;
  [[nodiscard]] int degree() const override { return active_->degree(); }
  [[nodiscard]] int max_degree() const override;
  Status extension(double* data) override;
  Status extension_of_attempt(double* data, std::size_t& size) override;
  [[nodiscard]] bool stages_on_extension() const override { return delayed().stages_on_extension(); }
  [[nodiscard]] bool remembers_slopes() const override { return true; }

  [[nodiscard]] int order() const override { return active_->order(); }
  [[nodiscard]] double stability() const override { return implicit_ ? 0 : explicit_->stability(); }
  [[nodiscard]] const double* slope() const override { return active_->slope(); }
  [[nodiscard]] int undefined_component() const override { return active_->undefined_component(); }
  [[nodiscard]] LinearWork linear_work() const override { return implicit_ ? implicit_->linear_work() : LinearWork(); }
  [[nodiscard]] int member() const override { return active_ == explicit_.get() ? 0 : 1; }
  [[nodiscard]] std::int64_t switches() const override { return switches_; }

 private:
  /// The work of the active member since it took over, or since the start.
  struct Turn {
    std::int64_t steps = 0;
    std::int64_t calls = 0;  // of f, and what costs as much, before it
    double t = 0;            // where it began
    bool handed_over = false;
    double h_before = 0;      // |h| of the other member
    double speed_before = 0;  // of that one: |h| per evaluation of f
    int failures = 0;         // of its first step
    double last_h = 0;        // |h| that the step before proposed
    double spent = 0;         // on explicit steps that stability limits, in a row
    int free = 0;             // explicit steps in a row that it does not limit
    int favourable = 0;       // implicit steps in a row after which the explicit member would be cheaper
  };

  /// The larger one of what the members have.
  template <class Of>
  [[nodiscard]] auto most_of(Of of) const {
    if (!implicit_) return of(*explicit_);
    return explicit_ ? std::max(of(*explicit_), of(*implicit_)) : of(*implicit_);
  }
  [[nodiscard]] DelayInterface& delayed() const { return dynamic_cast<DelayInterface&>(*active_); }
  [[nodiscard]] std::int64_t cost() const;
  void begin_turn();
  void watch_explicit(double calls);
  void watch_implicit(double calls);
  void judge_implicit_turn();
  void raise_trial_threshold();
  [[nodiscard]] bool pays(double distance) const;
  [[nodiscard]] double initial_step_after(const Step& next, double before) const;
  [[nodiscard]] double stable_h() const;
  Status find_radius();
  Status multiply_vector();

  std::unique_ptr<Step> explicit_, implicit_;
  ImplicitInterface* algebra_;  // of the implicit member; null without one
  Step* active_;
  const bool matrix_free_, differences_;
  const Callback* state_f_;
  Turn turn_;
  bool wanted_ = false;  // the other member
  bool stays_ = false;   // with the explicit member; the loop says so in every step
  std::int64_t switches_ = 0;
  double least_trial_threshold_, trial_threshold_;  // evaluations of f before a trial of the implicit member
  double explicit_calls_ = 0, implicit_calls_ = 0;  // per step, lately; 0: there was none
  std::int64_t calls_ = 0;                          // of f, and what costs as much, after the last step
  double radius_ = 0;                               // ρ(J)
  double reach_ = 0;                                // ρ(J) |h| of the explicit member when it last handed over
  std::int64_t jacobians_ = 0;                      // up to the one of `radius_`
  std::vector<double> start_y_;                     // of the step accepted last
  std::vector<double> vector_, product_;            // for powers of J
  std::vector<double> f_value_;                     // at the point reached, for differences of f
};

}  // namespace invariode
