#pragma once
// The simplified Newton iteration of implicit methods: one iteration matrix for several steps, and one rule for when an
// iteration has converged (docs/algorithms.md, 'Newton'; Shampine & Reichelt, The MATLAB ODE Suite, 1997, section 2).

#include <cstddef>
#include <memory>
#include <vector>

#include "linear/mass.hpp"
#include "step.hpp"

namespace invariode {

/// Judges an iteration by the sizes of its updates, in the norm of the error test. The rate of convergence is kept from
/// step to step while the iteration matrix stays.
class Convergence {
 public:
  static constexpr int most_iterations = 4;
  enum class [[nodiscard]] Verdict { go_on, converged, diverged };

  /// Forgets the rate: the iteration matrix is another one.
  void forget() { rate_known_ = false; }
  /// Starts an iteration. An update of size `roundoff` or less ends it at once.
  void begin(double rtol, double roundoff);
  /// After an update of that size.
  Verdict judge(double size);

 private:
  double rtol_ = 0, roundoff_ = 0;
  int iteration_ = 0;
  double previous_ = 0;
  double rate_ = 0;
  bool rate_known_ = false;
};

/// The equations of an implicit formula, c f(t₁, p + d) = M (ψ + d) for d, with the iteration matrix M − c J. It owns
/// J, knows how old it is, and factorises when c or J has changed.
class Newton {
 public:
  enum class [[nodiscard]] Result { converged, failed, stop };

  Newton(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  /// Memory as it is before any step.
  void restart();
  /// J at (t, y), where f is `slope`.
  Status take_jacobian(double t, const double* y, const double* slope);
  /// What `renew` has asked for: takes J at (t, y) anew, with an evaluation of f where J comes from differences.
  Status repair(double t, const double* y);
  /// M at t₁ and the factors of M − c J. `not_finite`: it is singular.
  Outcome prepare(double c, double t1);
  /// d from p and ψ, all (n,); y becomes p + d. `w`: the weights of the norm.
  Result solve(double c, double t1, const double* p, const double* psi, const double* w, double* d, double* y);

  /// J is no longer that of the point reached.
  void step_accepted();
  /// Asks that J is taken anew before the next attempt. False: that would change nothing.
  bool renew();
  /// The same after an iteration that failed: a J of the point reached cannot be improved, unless it was undefined.
  bool renew_if_old() { return !current_ && renew(); }
  /// The same before an attempt with c, for a J by differences that is roundoff in part, where that has begun to count.
  void renew_if_noise(double c);
  bool renew_if_undefined() { return work_.undefined_jacobian && renew(); }
  [[nodiscard]] int jacobian_age() const { return age_; }  ///< steps since it was taken
  /// Whether c ‖J‖ is large in the norm of the error test. (With a mass matrix, which would have to be inverted to
  /// tell: yes.)
  [[nodiscard]] bool stiff(double c, const double* w);

  [[nodiscard]] const Matrix& jacobian() const { return jacobian_.matrix(); }
  [[nodiscard]] LinearWork work() const;

  /// f(t, y), which must be finite; a component that is not is remembered until the next evaluation.
  Outcome evaluate(double t, const double* y, double* out);
  [[nodiscard]] int undefined_component() const;
  void forget_undefined() { undefined_ = false; }
  void note_singular() { work_.singular = true; }

 private:
  void residual(double c, const double* psi, const double* d);

  Callback& f_;
  const Weights& weights_;
  Jacobian jacobian_;
  Mass* mass_;
  std::unique_ptr<Factorization> lu_;
  Convergence convergence_;
  std::vector<double> f_value_, residual_, sum_;
  LinearWork work_;
  double factored_ = 0;   // c of the factors; 0: there are none
  double first_c_ = 0;    // |c| of the first factors with this J
  bool noisy_ = false;    // roundoff in a J of this run has counted
  bool current_ = false;  // J is that of the point reached
  bool renew_ = false;
  bool undefined_ = false;  // f, at the last evaluation
  int age_ = 0;
};

}  // namespace invariode
