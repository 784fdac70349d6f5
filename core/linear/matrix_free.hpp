#pragma once
// Newton's linear systems without matrices: products with ∂f/∂y, a user's preconditioner, and GMRES on both
// (docs/algorithms.md, 'Matrix-free').

#include <cstddef>
#include <cstdint>
#include <memory>
#include <vector>

#include "callback.hpp"
#include "linear/gmres.hpp"
#include "linear/mass.hpp"
#include "linear/preconditioner.hpp"
#include "weights.hpp"

namespace invariode {

/// What is known of ∂f/∂y without a matrix.
struct KrylovTerms {
  Callback product;  ///< J v of t and (y | v), 2 n numbers; empty: differences of f
  Preconditioner preconditioner;
  std::size_t dimension = 0;  ///< of the Krylov space
};

/// J v at a point, by a user's function or a difference of f.
class JacobianProduct {
 public:
  JacobianProduct(Callback& f, const Callback& product, const Weights& weights);

  /// J is that at (t, y) from now on, where f is `slope`. y and slope stay with the caller, unchanged while J is used.
  void at(double t, const double* y, const double* slope);
  Status multiply(const double* v, double* out);
  [[nodiscard]] std::int64_t count() const { return count_; }
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

/// Solves (M − c J) x = b. The preconditioner is applied from the left: what is then small is about the error of x.
class MatrixFree final : private LinearOperator {
 public:
  MatrixFree(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  /// Where the preconditioner is set up next; y stays with the caller.
  void reach(double t, const double* y);
  [[nodiscard]] bool preconditioned() const { return static_cast<bool>(preconditioner_); }
  /// Sets up the preconditioner for c.
  Status set_up(double c);
  /// The same where it was set up last, after `state` has read that.
  Status set_up_again(double c);

  [[nodiscard]] JacobianProduct& product() { return product_; }
  /// b becomes P⁻¹ b, which is about x.
  Status precondition(double* b);
  /// Whether P⁻¹ b is about an x within the tolerance: see `solve`, which has solved another system with this P.
  [[nodiscard]] bool negligible(const double* w, double tolerance, const double* b) const;
  /// P⁻¹ b becomes x, with J where `product()` is, M null: the identity. About the tolerance is left as its error, in
  /// units of the weights w.
  Gmres::Result solve(double c, const Matrix* mass, const double* w, double tolerance, double* b);

  /// Nothing is solved any more: gives memory back.
  void end_attempts() { gmres_.give_back(); }
  [[nodiscard]] std::int64_t products() const { return product_.count(); }
  [[nodiscard]] std::int64_t iterations() const { return gmres_.iterations(); }
  void state(Archive& archive);

 private:
  Status multiply(const double* v, double* out) override;

  JacobianProduct product_;
  Preconditioner preconditioner_;
  Gmres gmres_;
  double c_ = 0;
  const Matrix* mass_ = nullptr;
  std::vector<double> mass_times_v_;
  double t_ = 0;  // where the preconditioner is set up next,
  const double* y_ = nullptr;
  double known_t_ = 0;  // and where it was last
  std::vector<double> known_y_;
};

}  // namespace invariode
