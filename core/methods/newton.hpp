#pragma once
// The simplified Newton iteration of implicit methods: one iteration matrix for several steps, and one rule for when an
// iteration has converged (docs/algorithms.md, 'Newton'; Shampine & Reichelt, The MATLAB ODE Suite, 1997, section 2).

#include <algorithm>
#include <cstddef>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "linear/mass.hpp"
#include "linear/matrix_free.hpp"
#include "methods/factor_cache.hpp"
#include "methods/jacobian_age.hpp"
#include "methods/jacobian_audit.hpp"
#include "sensitivity/block_system.hpp"
#include "step.hpp"

namespace invariode {

/// Judges an iteration by the sizes of its updates, in the norm of the error test. The rate of convergence is kept from
/// step to step while the iteration matrix stays.
class Convergence {
 public:
  /// The number of iterations allowed, and the error that they may leave, in units of rtol: the last one, and the
  /// first, where the rate is an old one. An update up to the jump's goal that has not shrunk is no sign of divergence:
  /// f may jump between the iterates.
  struct Rules {
    int most_iterations;
    double goal;
    double first_goal;
    double jump_goal = 0;

    /// The rules for sensitivities, of which an iteration costs less than a step that is given up with the state known.
    [[nodiscard]] Rules for_sensitivities() const { return {2 * most_iterations, goal, first_goal, jump_goal}; }
  };
  enum class [[nodiscard]] Verdict { go_on, converged, diverged };
  // The constants of the suite (Shampine & Reichelt, 1997, section 2, and the codes).
  static constexpr double slowest_rate = 0.9;
  static constexpr double roundoff_units = 100;  ///< of ε: an update of this size relative to y is roundoff

  explicit Convergence(const Rules& rules) : rules_(rules) {}

  /// Forgets the rate: the iteration matrix is another one.
  void forget() { rate_known_ = false; }
  /// Starts an iteration. `careful`: it may leave a thousandth of what it may otherwise.
  void begin(double rtol, bool careful = false);
  /// Judges the iteration after an update of that size. One of size `roundoff` or less ends it at once.
  Verdict judge(double size, double roundoff);
  /// Ends an iteration whose next update would have this size at most.
  void settle(double size);
  /// The error that an iteration may leave, in units of the weights.
  [[nodiscard]] double goal() const { return rules_.goal * rtol_; }
  /// Iterations since `begin`, and the rate of convergence, if two of them have told it.
  [[nodiscard]] int iterations() const { return iteration_; }
  [[nodiscard]] double rate() const { return rate_; }
  [[nodiscard]] bool rate_known() const { return rate_known_; }
  void state(Archive& archive) { archive(iteration_, rate_, rate_known_); }

 private:
  Rules rules_;
  double rtol_ = 0;
  int iteration_ = 0, most_iterations_ = 0;
  double previous_ = 0;
  double rate_ = 0;
  bool rate_known_ = false;
};

/// f and its Jacobian J as implicit formulas use them: J serves several steps, and is taken anew where it is too old or
/// was not good enough. Knows M, and for which c the factors of M − c J were made. Where J is known by its products
/// alone, it is always that of the iterate at hand, and a preconditioner takes the part of J and of the factors.
///
/// Where the method integrates a state with its sensitivities, J and M are the state's, and every vector consists of
/// blocks of its size, which are multiplied by them and solved for one by one.
class AgingJacobian {
 public:
  /// `f` and the weights are of all that the method integrates. `complex`: see MatrixFree.
  AgingJacobian(Callback& f, const Weights& weights, const LinearAlgebra& linear, bool complex = false);
  AgingJacobian(const AgingJacobian&) = delete;
  AgingJacobian& operator=(const AgingJacobian&) = delete;

  /// Memory as it is before any step.
  void forget();
  /// J at (t, y), where f is `slope`.
  Status take_jacobian(double t, const double* y, const double* slope);
  /// Prepares J before an attempt from (t, y). If `renew` has asked for a new J, takes it there, where f is `slope`.
  /// Null: f is evaluated if J comes from differences.
  Status repair(double t, const double* y, const double* slope = nullptr);
  /// J v of the state, with J at (t, y), where f is `slope`; of a matrix, with the J at hand.
  Status multiply(double t, const double* y, const double* slope, const double* v, double* out);
  /// M at t₁ and, by `factor()`, the factors for c, unless they are at hand, for this c or one that differs by no more
  /// than the tolerated part of it. `not_finite`: M − c J is singular.
  template <class Factor>
  Outcome prepare(double c, double t1, Factor&& factor, double tolerated = 0);
  /// Prepares a matrix-free attempt: M at t₁, and a preconditioner for this c or one near it.
  Outcome prepare_preconditioner(double c, double t1);
  /// factor(c) of `state`, matrix-free.
  bool set_up_again(double c, Archive& archive);

  [[nodiscard]] bool has_factors() const { return cache_.holds(); }
  [[nodiscard]] double factored_for() const { return cache_.c(); }
  void forget_factors() { cache_.forget(); }
  /// factor(c) makes the factors again that were at hand, from the same matrices: true.
  template <class Factor>
  void state(Archive& archive, Factor&& factor);

  /// J is no longer that of the point reached.
  virtual void step_accepted();
  /// Asks that J is taken anew before the next attempt. False: that would change nothing.
  bool renew() { return age_.renew(renewable()); }
  /// J at (t, y), an iterate of the step in work, where f is `slope`: once in a step.
  [[nodiscard]] bool may_take_in_place() const;
  Status take_in_place(double t, const double* y, const double* slope);
  /// Notes an iteration that failed: see `JacobianAge::fail`.
  bool renew_if_old();
  /// Renews J before an attempt with c, if it comes from differences and is roundoff in part, where that has begun to
  /// count.
  void renew_if_noise(double c);
  /// Roundoff in a J of this run has counted: a new one is not better than the old.
  [[nodiscard]] bool noisy() const { return noisy_; }
  /// An iteration had converged, and solved nothing: those of the next steps are to leave less than others.
  void be_careful();
  [[nodiscard]] bool careful() const { return careful_ > 0; }
  /// Residuals say that updates with J are much too small.
  void note_too_large() { age_.note_too_large(); }
  bool renew_if_undefined() { return work_.undefined_jacobian && renew(); }
  /// Returns whether J is to be renewed before the next attempt.
  [[nodiscard]] bool renewal_due() const { return age_.renewal_due(); }
  [[nodiscard]] int jacobian_age() const { return age_.steps(); }  ///< steps since it was taken
  /// Returns whether c ‖J‖ is large in the norm of the error test. (With a mass matrix, which would have to be inverted
  /// to tell: yes.)
  [[nodiscard]] bool stiff(double c, const double* w);

  /// Sets to 0, in an update or an error of the sensitivities, the entries that may be roundoff of S and of c J S,
  /// whose terms may cancel: a parameter that hardly acts on a component has a tolerance there that no arithmetic
  /// reaches. Returns whether there are such terms to compare with.
  bool forget_sensitivity_roundoff(double c, const double* Y, double* v);

  [[nodiscard]] const Matrix& jacobian() const { return jacobian_.matrix(); }
  /// ∂f/∂t of the state, as `Jacobian::time_derivative`.
  Status time_derivative(double t, const double* y, const double* slope, double h, double* ft) {
    return jacobian_.time_derivative(system_.state_f(), t, y, slope, h, ft);
  }
  /// M, as it was last evaluated; null: the identity.
  [[nodiscard]] Mass* mass() const { return mass_; }
  [[nodiscard]] const Matrix* mass_matrix() const { return mass_ ? &mass_->matrix() : nullptr; }
  /// The system whose iterations these are: the state, with its sensitivities if there are any.
  [[nodiscard]] BlockSystem& system() { return system_; }
  [[nodiscard]] const BlockSystem& system() const { return system_; }
  /// b becomes the solution with the factors, of each block of a part for itself.
  template <class Scalar>
  void solve_blocks(Factors<Scalar>& factors, Scalar* b, const Part& part) {
    const Part blocks = system_.coupled(part);
    if (blocks.empty()) return;
    work_.solves += static_cast<std::int64_t>(blocks.count());
    factors.solve(b + blocks.first, blocks.count());
  }
  /// Solves with the matrix of the whole system, linearized at (t, Y), where its value is `f`: M − c J, and below it
  /// the derivatives of the slopes of the sensitivities with respect to y.
  Status solve_whole(Factorization& factors, double c, double t, const double* Y, const double* f, double* b) {
    solve_blocks(factors, b, system_.state());
    if (system_.couple(c, t, Y, f, b) == Status::stop) return Status::stop;
    solve_blocks(factors, b, system_.sensitivities());
    return Status::ok;
  }
  [[nodiscard]] LinearWork work() const;
  void count_factorization() { ++work_.factorizations; }
  void count_solve() { ++work_.solves; }

  Outcome evaluate(double t, const double* y, double* out) { return system_.evaluate(t, y, out); }
  void note_singular() { work_.singular = true; }
  /// The audit of J; null if J is known by its products alone.
  [[nodiscard]] JacobianAudit* audit() { return audit_ ? &*audit_ : nullptr; }
  /// The solver by products; null if J is a matrix.
  [[nodiscard]] MatrixFree* matrix_free() { return free_ ? &*free_ : nullptr; }
  /// See `Step::end_attempts`.
  virtual void end_attempts() {
    if (free_) free_->end_attempts();
    jacobian_.end();
  }
  /// Shorter steps will not help: see MatrixFree.
  [[nodiscard]] bool hopeless() const { return free_ && free_->hopeless(); }

 private:
  [[nodiscard]] bool renewable() const;
  bool defined_mass();
  bool needs_factors(double c, double tolerated);
  Outcome factored(double c, double t1, bool regular);
  void fields(Archive& archive);

  Jacobian jacobian_;
  BlockSystem system_;
  Mass* mass_;
  std::optional<MatrixFree> free_;
  std::optional<JacobianAudit> audit_;  // unless matrix-free
  JacobianAge age_;
  FactorCache cache_;
  std::vector<double> scratch_;  // empty if matrix-free
  LinearWork work_;
  bool noisy_ = false;  // roundoff in a J of this run has counted
  int careful_ = 0;     // so many steps yet are to leave little
};

template <class Factor>
Outcome AgingJacobian::prepare(double c, double t1, Factor&& factor, double tolerated) {
  if (mass_ && mass_->evaluate(t1) == Status::stop) return Outcome::stop;
  if (!defined_mass()) return Outcome::not_finite;
  return needs_factors(c, tolerated) ? factored(c, t1, factor()) : Outcome::ok;
}

template <class Factor>
void AgingJacobian::state(Archive& archive, Factor&& factor) {
  fields(archive);
  if (!archive.reading() || !archive.whole()) return;
  if (!free_ && !jacobian_.provided()) {  // a member of auto that has not begun
    archive.require(!cache_.holds());
    age_.renew();
  }
  if (!cache_.holds()) return;
  if (mass_ && mass_->evaluate(cache_.t()) == Status::stop) return archive.stop();
  archive.require(factor(cache_.c()));
}

/// y' and y'' at the start, of M y' = f(t, y).
class InitialSlopes {
 public:
  explicit InitialSlopes(const LinearAlgebra& linear) : lapack_(linear.lapack) {}

  /// J, and f and y' at (t, y), all (n,).
  Outcome first(AgingJacobian& jacobian, double t, const double* y, double* f, double* slope);
  /// y'' from f; f_t by a difference in the direction of the step h. What f_t adds to y' where M is singular enters y'
  /// too.
  Status second(AgingJacobian& jacobian, double t, const double* y, double h, const double* f, double* slope,
                double* ft, double* second);

  /// (y'(t + δ, y + δ y') − y') / δ from f and y' = `slope`, both at (t, y); NaN if f is not finite there. `rates`:
  /// what f at t + δ adds to y' where M is singular, else 0.
  Status beside(AgingJacobian& jacobian, double t, const double* y, double delta, const double* f, const double* slope,
                double* rates, double* quotient);

 private:
  const Lapack* lapack_;
  MassSolver solver_;
};

/// Returns the error that an iteration has left, if the last update had that size and residuals decrease at that rate:
/// no more than the residual, in components that f does not drive apart.
inline double left_by(double size, double rate, double residual) {
  return rate < 1 ? std::min(size * rate / (1 - rate), residual) : residual;
}
inline constexpr double little = 0.5;  // of a residual
/// Returns whether the last update, with a J that is much too large, was too small to solve anything: of the residual
/// `before` it, without the components that are 0 there, it has changed no more than that part, and leaves more than
/// `least` in the weights.
bool unmoved(std::span<const double> before, const double* after, const double* w, double least, double part = little);

/// The part of the error that Newton's iteration may leave, which GMRES may leave in its last linear system
/// (Brown & Hindmarsh, 1989, and CVODE's default).
inline constexpr double linear_part = 0.05;

/// The equations of an implicit formula, c f(t₁, p + d) = M (ψ + d) for d, with the iteration matrix M − c J, which is
/// factorised when c or J has changed, or by GMRES (docs/algorithms.md, 'Matrix-free'). Those of sensitivities, which
/// are linear, are solved when the state is known, with the same matrix and an iteration of their own.
class Newton : public AgingJacobian {
 public:
  enum class [[nodiscard]] Result { converged, failed, stop };

  /// The rules of the suite.
  static constexpr Convergence::Rules suite{.most_iterations = 4, .goal = 0.5, .first_goal = 0.05};

  Newton(Callback& f, const Weights& weights, const LinearAlgebra& linear, const Convergence::Rules& rules = suite);

  /// See `Step::end_attempts`.
  void end_attempts() override {
    AgingJacobian::end_attempts();
    lu_.reset();
    for (std::vector<double>* one : {&f_value_, &residual_, &sum_, &before_, &earlier_}) *one = std::vector<double>();
  }
  /// Memory as it is before any step.
  void restart();
  /// Forgets what was decided for one step.
  void step_accepted() override;
  /// The iteration has failed in the shortest step: until one is accepted each iterate has a J of its own. False: that
  /// has failed too, or would change nothing.
  bool iterate_fully();
  /// From now on factors of sparse matrices, of which each costs as much as many steps, serve while c changes little
  /// (CVODE's rule). Not with sensitivities, nor for `damp`.
  void keep_factors();
  /// M at t₁ and the factors of M − c J, or the preconditioner. `not_finite`: it is singular.
  Outcome prepare(double c, double t1);
  /// Forgets the factors if the iteration that failed had those for another c. Returns whether it had.
  bool forget_other_factors();
  /// d from p and ψ, all (n,); y becomes p + d. `w`: the weights of the norm.
  Result solve(double c, double t1, const double* p, const double* psi, const double* w, double* d, double* y);
  /// v becomes (M − c J)⁻¹ v, with the factors at hand, or with J where `solve` has ended.
  Result filter(double* v);
  /// v becomes (M − c J)⁻¹ M v: what is stiff in it is gone.
  Result damp(double* v);
  void state(Archive& archive);

 private:
  /// The position of an iteration: all of this stays with the caller.
  struct Place {
    double c, t;
    const double *y, *w;
  };

  [[nodiscard]] double norm_in_attempt(const double* v) const;
  void begin_iteration(const double* p, double* d, double* y);
  [[nodiscard]] double roundoff(const double* p) const;
  Result solve_fully(const double* p, const double* psi, double* d, double* y);
  Result solve_state(const double* p, const double* psi, double* d, double* y);
  Result solve_sensitivities(const double* p, const double* psi, double* d, double* y);
  Result evaluate_state();
  void residual(const Part& part, const double* psi, const double* d);
  Result confirm(const double* psi, const double* d, double size);
  Result doubt(bool soft);
  [[nodiscard]] bool solved(double size, double last, double residual) const;
  [[nodiscard]] double tolerated_residual() const;
  Result renew_in_place();
  Result solve_linear(double tolerance, double* b);
  Result look_at_product();
  Result solve_columns(double goal, double* b);
  Outcome precondition(double* b);
  void correct_for_c(double* b) const;

  const Weights& weights_;
  std::unique_ptr<Factorization> lu_;  // null: matrix-free
  Convergence convergence_, sensitivity_convergence_;
  Place place_{};
  bool keeps_factors_ = false;
  bool fully_ = false;            // each iterate has its J, in the step in work
  std::optional<double> last_c_;  // for which the rate of convergence is known
  std::vector<double> f_value_, residual_, sum_;
  std::vector<double> before_, earlier_;    // residuals before the last update, and the one before; empty: matrix-free
  std::vector<double> sensitivity_weight_;  // of the attempt
};

/// Returns the meaning of an evaluation, or of a solve by GMRES, to the iteration.
inline Newton::Result newton_result(Outcome outcome) {
  if (outcome == Outcome::ok) return Newton::Result::converged;
  return outcome == Outcome::stop ? Newton::Result::stop : Newton::Result::failed;
}
inline Newton::Result newton_result(GmresResult result) {
  if (result == GmresResult::converged) return Newton::Result::converged;
  return result == GmresResult::stop ? Newton::Result::stop : Newton::Result::failed;
}

}  // namespace invariode
