#pragma once
// The step contract: five operations that every method obeys, and its memory as data, so that the loop, the projection,
// the events and the output exist once, and a run can go on in another process.

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include "archive.hpp"
#include "callback.hpp"
#include "linear/misfit.hpp"
#include "weights.hpp"

namespace invariode {

struct Matrix;

/// How an operation of a step ended. `not_finite`: a needed value of f is NaN or infinite.
enum class [[nodiscard]] Outcome { ok, not_finite, stop };

/// Why GMRES did not solve a linear system: it stagnates; a product of a user's function, or a difference of f in its
/// place, is not finite; what the preconditioner returns is not finite, or 0 of something else.
enum class Unsolved { none, slow, product, difference, preconditioner, preconditioner_zero };
/// Users' functions are why.
constexpr bool undefined_function(Unsolved why) { return why != Unsolved::none && why != Unsolved::slow; }

/// Jacobians, factorisations (or set-ups of a preconditioner) and solves so far, products with the Jacobian and
/// iterations of GMRES; whether the last attempt met a linear system that GMRES did not solve (with a J or a
/// preconditioner of that t), a singular iteration matrix, or a Jacobian or a mass matrix that is not finite.
struct LinearWork {
  std::int64_t jacobians = 0, factorizations = 0, solves = 0, products = 0, iterations = 0;
  Unsolved unsolved = Unsolved::none;
  double unsolved_t = 0;
  std::int64_t complex_calls = 0;                                        ///< of f at complex y, for Jacobians
  double left_complex_steps = std::numeric_limits<double>::quiet_NaN();  ///< t at which differences replaced them
  std::int64_t enlargements = 0;                                         ///< of a sparsity pattern that was found,
  std::int64_t entries = 0, groups = 0;  ///< its entries, and the evaluations of f that differences take with it
  std::int64_t checks = 0;               ///< evaluations of f that tested Jacobians
  std::optional<Misfit> misfit;
  bool singular = false;
  bool undefined_jacobian = false;
  bool undefined_mass = false;
};

/// Why an attempt was rejected.
/// `bounds`: the candidate is outside of them.
enum class Cause { error, newton, projection, not_finite, bounds };

/// Evaluates the raw continuous extension that `Step::extension` wrote to `data`, at θ ∈ [0, 1], into out (n,). A plain
/// function of the data alone, so that a step can be interpolated long after the method has moved on.
using Interpolate = void (*)(const double* data, std::size_t size, std::size_t n, double theta, double* out);

/// One attempted or accepted step of a method, and the method's memory.
///
/// Between calls, (t, y) is the point reached: `attempt` proposes from it, `accept` alone moves it. A rejected attempt
/// leaves no trace in (t, y) and the stored data; only the controller learns from it. An accepted step stays
/// interpolable until the next attempt. Steps know nothing of invariants: `accept` is told the value to commit.
class Step {
 public:
  /// What bounds the first step.
  struct Span {
    double tf;
    double hmax;
    double hmin;
  };

  /// A proposal: the candidate y* at t1 and its error in the norm of the error test (NaN or infinite if f was), unless
  /// the iteration for an implicit formula did not converge.
  struct Attempt {
    Outcome outcome;
    double error;
    const double* y;
    bool converged = true;
  };

  Step(Callback& f, const Weights& weights) : f_(f), weights_(weights), y_(weights.size()) {}
  Step(const Step&) = delete;
  Step& operator=(const Step&) = delete;
  virtual ~Step() = default;

  /// Builds the memory at (t, y), also after a jump: evaluates f there and chooses the first |h|.
  virtual Outcome start(double t, const double* y, const Span& span) = 0;

  /// Between two steps: a method that consists of several goes on with another one where that suits the problem better.
  /// The next |h| may change.
  virtual Outcome hand_over(const Span&) { return Outcome::ok; }

  /// Proposes a step of signed size h that ends at t1: fl(t + h), or the end of the interval, assigned exactly.
  virtual Attempt attempt(double h, double t1) = 0;

  /// The estimated error of the attempt, component by component, into out (n,). False: the method has none.
  virtual bool errors(double*) const { return false; }

  /// What the attempt is made of, slopes or differences of the solution, as vectors (n) that stay until the next
  /// operation: every linear function that f keeps vanishes on them. Returns how many, at most `max_directions`. None:
  /// the method does not tell.
  virtual std::size_t directions(const double**) const { return 0; }
  [[nodiscard]] virtual std::size_t max_directions() const { return 0; }

  /// Chooses the |h| (order, repairs) of the retry. False: at |h| <= hmin there is nothing left to try.
  virtual bool reject(Cause cause, double hmin) = 0;

  /// Evaluates what is left to evaluate at y1 (the candidate, projected where invariants are imposed), then commits
  /// (t1, y1) and chooses the next |h| and order. If the outcome is not `ok`, nothing was committed.
  virtual Outcome accept(const double* y1) = 0;

  /// Raw continuous extension of the step just accepted: its evaluator, the doubles that it reads, and how many they
  /// are, in this step and at most. `extension` may evaluate f, and is asked once per step, if at all.
  [[nodiscard]] virtual Interpolate interpolate() const = 0;
  virtual Status extension(double* data) = 0;
  [[nodiscard]] virtual std::size_t extension_size() const = 0;
  [[nodiscard]] virtual std::size_t max_extension_size() const = 0;
  /// Its degree, in this step and at most: so many roots inside a step has a linear event function.
  [[nodiscard]] virtual int degree() const = 0;
  [[nodiscard]] virtual int max_degree() const { return degree(); }

  [[nodiscard]] virtual int order() const = 0;
  /// An estimate of |h λ| in the step just accepted, λ the dominant eigenvalue of ∂f/∂y, in units of what the formula
  /// is stable for on the negative real axis. 0: nobody knows, or there is no such limit.
  [[nodiscard]] virtual double stability() const { return 0; }
  /// So long is its interval of stability on the negative real axis; 0: nobody knows, or there is no limit.
  [[nodiscard]] virtual double real_limit() const { return 0; }
  /// y' at the end of the accepted step as the method has it, without another evaluation; after an implicit step only
  /// to the accuracy of its iteration.
  [[nodiscard]] virtual const double* slope() const = 0;
  /// The first component of f that was not finite in the last attempt (or at the start), or -1.
  [[nodiscard]] virtual int undefined_component() const = 0;
  /// What the linear algebra of an implicit method did, and what went wrong with it in the last attempt.
  [[nodiscard]] virtual LinearWork linear_work() const { return {}; }
  /// ∂f/∂y as an implicit method has it; null: it needs none.
  [[nodiscard]] virtual const Matrix* jacobian() const { return nullptr; }
  /// ∂f/∂y at the point reached, where f is `slope`, times v, both (n,), of a method that knows ∂f/∂y by its products.
  virtual Status multiply_jacobian(const double*, const double*, double*) { return Status::ok; }
  /// Of a method that consists of several: which of them made the last step, and how often they have changed.
  [[nodiscard]] virtual int member() const { return 0; }
  [[nodiscard]] virtual std::int64_t switches() const { return 0; }

  /// There will be no further attempt: memory that only attempts need may be given back.
  virtual void end_attempts() {}

  /// The memory between two steps: all that the next `attempt` and those after it read. Methods archive this part and
  /// then their own.
  virtual void state(Archive& archive) = 0;

  [[nodiscard]] std::size_t n() const { return y_.size(); }
  [[nodiscard]] double t() const { return t_; }
  [[nodiscard]] const double* y() const { return y_.data(); }
  /// |h| proposed for the next attempt.
  [[nodiscard]] double h() const { return h_; }
  void set_h(double h) { h_ = h; }
  /// The candidate about to be accepted was moved onto bounds: what the next step takes from f at its end is evaluated
  /// at y₁, not at the candidate.
  void moved_onto_bounds(bool moved) { moved_onto_bounds_ = moved; }

 protected:
  /// The first |h|: 1 / reciprocal, as far as the span allows.
  static double first_h(double reciprocal, double t, const Span& span) {
    double h = std::min(span.hmax, std::abs(span.tf - t));
    if (h * reciprocal > 1) h = 1 / reciprocal;
    if (std::isinf(h)) h = 1e-3 * std::max(1.0, std::abs(t));  // infinite interval and f0 = 0: no scale is known
    return std::max(h, span.hmin);
  }

  Callback& f_;
  const Weights& weights_;
  double t_ = 0;
  std::vector<double> y_;
  double h_ = 0;
  bool moved_onto_bounds_ = false;
};

inline void Step::state(Archive& archive) {
  archive(t_, y_, h_, moved_onto_bounds_);
  archive.require(std::isfinite(t_) && h_ >= 0);
}

}  // namespace invariode
