#pragma once
// Newton's linear systems without matrices: products with ∂f/∂y, a user's preconditioner, and GMRES on both
// (docs/algorithms.md, 'Matrix-free').

#include <complex>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "callback.hpp"
#include "linear/gmres.hpp"
#include "linear/mass.hpp"
#include "linear/preconditioner.hpp"
#include "linear/work.hpp"
#include "weights.hpp"

namespace invariode {

/// ∂f/∂y without a matrix: its products and its preconditioner.
struct KrylovTerms {
  Callback product;  ///< J v of t and (y | v), 2 n numbers; empty: differences of f
  Preconditioner preconditioner;
  std::size_t dimension = 0;  ///< of the Krylov space; 0: see MatrixFree
};

/// J v at a point, by a user's function or a difference of f.
class JacobianProduct {
 public:
  JacobianProduct(Callback& f, const Callback& product, const Weights& weights);

  /// J is that at (t, y) from now on, where f is `slope`. y and slope stay with the caller, unchanged while J is used.
  void at(double t, const double* y, const double* slope);
  Status multiply(const double* v, double* out);
  [[nodiscard]] std::int64_t count() const { return count_; }
  /// `given` returns whether a user's function forms the product, `t` where J is.
  [[nodiscard]] bool given() const { return static_cast<bool>(product_); }
  [[nodiscard]] double t() const { return t_; }
  void state(Archive& archive);

 private:
  Status difference(const double* v, double* out);

  Callback& f_;
  Callback product_;
  const Weights& weights_;
  double t_ = 0;
  const double *y_ = nullptr, *slope_ = nullptr;
  std::vector<double> point_;  // y + σ v; of a user's function: y and v, one behind the other
  std::int64_t count_ = 0;
};

/// Solves (M − c J) x = b, also for complex c, x and b with one real preconditioner. It is applied from the left: what
/// is then small is close to the error of x.
class MatrixFree final : private LinearOperator<double>, private LinearOperator<Complex> {
 public:
  /// `complex`: complex systems are to be solved too. A vector of their space takes the memory of two: by default it
  /// has 5 of them, otherwise 10.
  MatrixFree(Callback& f, const Weights& weights, const LinearAlgebra& linear, bool complex = false);

  /// Two vectors (n,) of the caller's, which complex systems overwrite.
  void take_scratch(double* part, double* product);
  /// Sets the point where the preconditioner is set up next; y stays with the caller.
  void reach(double t, const double* y);
  [[nodiscard]] bool preconditioned() const { return static_cast<bool>(preconditioner_); }
  /// Sets up the preconditioner for c.
  Status set_up(double c);
  /// Sets up the preconditioner again where it was set up last, after `state` has read that.
  Status set_up_again(double c);

  [[nodiscard]] JacobianProduct& product() { return product_; }
  /// b becomes P⁻¹ b, which is about x. `not_finite`: it holds NaN or infinity, or is 0 where b is not; see `unsolved`.
  template <class Scalar>
  Outcome precondition(Scalar* b);
  /// Returns whether P⁻¹ b is below the tolerance: see `solve`, which has solved another such system with this P.
  [[nodiscard]] bool negligible(const double* w, double tolerance, const double* b) const;
  [[nodiscard]] bool negligible(const double* w, double tolerance, const Complex* b) const;
  /// P⁻¹ b becomes x, with J where `product()` is, M null: the identity. About the tolerance is left as its error, in
  /// units of the weights w.
  GmresResult solve(double c, const Matrix* mass, const double* w, double tolerance, double* b);
  GmresResult solve(Complex c, const Matrix* mass, const double* w, double tolerance, Complex* b);

  /// Why the last system was not solved, and where J or the preconditioner belonged to.
  [[nodiscard]] Unsolved unsolved() const { return unsolved_; }
  [[nodiscard]] double unsolved_t() const { return unsolved_t_; }
  /// A new attempt begins: nothing is unsolved.
  void begin_attempt();
  /// A step was accepted, or the run starts anew.
  void forget_failures() { unsolved_ = Unsolved::none, undefined_ = 0; }
  /// Users' functions have returned NaN, infinity or 0 in so many attempts in a row that shorter steps will not help.
  [[nodiscard]] bool hopeless() const;

  /// Gives memory back: nothing is solved any more.
  void end_attempts() { memory_.give_back(); }
  [[nodiscard]] std::int64_t products() const { return product_.count(); }
  [[nodiscard]] std::int64_t iterations() const;
  void state(Archive& archive);

 private:
  Status multiply(const double* v, double* out) override;
  Status multiply(const Complex* v, Complex* out) override;
  const double* mass_times(const double* v);
  Status apply(double* b);
  Status apply(Complex* b);
  template <class Scalar>
  GmresResult explained(const Gmres<Scalar>& gmres, GmresResult result);
  void note(Unsolved why, double t);

  JacobianProduct product_;
  Preconditioner preconditioner_;
  KrylovMemory memory_;
  Gmres<double> gmres_;
  std::optional<Gmres<Complex>> complex_gmres_;
  double c_ = 0;
  Complex complex_c_;
  const Matrix* mass_ = nullptr;
  std::vector<double> mass_times_v_;
  double *part_ = nullptr, *part_product_ = nullptr;  // the real or the imaginary part of a vector, and J times it
  double t_ = 0;                                      // where the preconditioner is set up next,
  const double* y_ = nullptr;
  double known_t_ = 0;  // and where it was last
  std::vector<double> known_y_;
  Unsolved unsolved_ = Unsolved::none;
  double unsolved_t_ = 0;
  int undefined_ = 0;  // attempts in a row before this one: see `hopeless`
};

}  // namespace invariode
