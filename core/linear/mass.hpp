#pragma once
// The mass matrix M of M y' = f(t, y). Singular, it makes some of the equations algebraic: Zᵀ f(t, y) = 0, where the
// columns of Z span the left null space (docs/algorithms.md, 'Mass matrices').

#include <Eigen/SparseCore>
#include <cassert>
#include <cstddef>
#include <memory>
#include <optional>
#include <utility>
#include <vector>

#include "callback.hpp"
#include "linear/jacobian.hpp"
#include "linear/matrix.hpp"
#include "manifold/slope.hpp"
#include "weights.hpp"

namespace invariode {

class Mass {
 public:
  using Basis = Eigen::SparseMatrix<double>;

  /// A constant M, or, with a function, M(t), whose first argument is its structure. `null_basis`: Z (n, r), the same
  /// for all t, where each column has a row in which the others are zero; r = 0 for a regular M.
  Mass(Matrix matrix, MatrixFunction function, const Basis& null_basis);

  /// M(t) is to be called by way of what `wrap` makes of it.
  template <class Wrap>
  void wrap(Wrap&& wrap) {
    if (function_) function_ = wrap(function_);
  }

  /// Takes M at t, if it depends on t.
  Status evaluate(double t) { return function_ ? function_(t, nullptr, matrix_) : Status::ok; }

  [[nodiscard]] const Matrix& matrix() const { return matrix_; }
  [[nodiscard]] bool constant() const { return !function_; }
  /// Returns the diagonal of a constant diagonal M, else nothing.
  [[nodiscard]] std::optional<std::vector<double>> diagonal() const;
  [[nodiscard]] bool singular() const { return Z_.cols() > 0; }
  /// r, the number of algebraic equations.
  [[nodiscard]] std::size_t equations() const { return static_cast<std::size_t>(Z_.cols()); }

  /// Zᵀ f into r (r,).
  void algebraic_part(const double* f, double* r) const;
  /// Zᵀ J into out (r, n), row-major.
  void algebraic_part(const Matrix& J, double* out) const;
  /// The row of M that follows from the others by column k of Z, and that algebraic equation k takes.
  [[nodiscard]] std::size_t own_row(std::size_t k) const {
    assert(k < own_.size());
    return own_[k];
  }
  /// M with Zᵀ J in the rows of the algebraic equations: regular where the index is 1. Dense if M is, else sparse.
  [[nodiscard]] Matrix completed(const Matrix& J) const;

 private:
  Matrix matrix_;
  MatrixFunction function_;
  Basis Z_;
  std::vector<std::size_t> own_;
};

struct KrylovTerms;
class BlockEquations;

/// ∂f/∂y, M and the linear algebra of an implicit method, which belong to the caller. Those who evaluate the Jacobian
/// take a copy, with increments of its own. Null: M is the identity; LAPACK is not at hand; the Jacobian is a matrix.
struct LinearAlgebra {
  const Jacobian* jacobian = nullptr;
  Mass* mass = nullptr;
  const Lapack* lapack = nullptr;
  const KrylovTerms* krylov = nullptr;  ///< if the Jacobian is known by its products alone
  BlockEquations* blocks = nullptr;     ///< with sensitivities: J and M are of the state
};

/// Solves M y' = f for y', with Zᵀ f = 0 kept along it: in the rows of the algebraic equations Zᵀ J y' = −Zᵀ f_t.
class MassSolver {
 public:
  /// Factorises `Mass::completed`, equilibrated: units of y and of f say nothing about its rank. False: singular, so M
  /// y' = f has no unique y', or the index is above 1.
  [[nodiscard]] bool factor(const Mass& mass, const Matrix& J, const Lapack* lapack);
  /// y' from f, in place. ft may be null: 0.
  void slope(const Mass& mass, const double* ft, double* f);
  /// The change of y that solves the linearised algebraic equations, M δ = 0 and Zᵀ J δ = −Zᵀ f, from f, in place.
  void correction(const Mass& mass, double* f);

 private:
  void solve(double* b);

  std::unique_ptr<Factorization> lu_;
  std::vector<double> row_scale_, column_scale_;
};

/// The end of the search for consistent initial values. `undetermined`: the algebraic equations do not determine the
/// components that M leaves free, as far as differences of f can tell; with derivatives, `index_too_high`.
enum class Consistency { consistent, corrected, not_found, undetermined, index_too_high, undefined, stop };

/// Moves y, in its components that M leaves undetermined, until the algebraic equations hold to roundoff.
Consistency make_consistent(Callback& f, const LinearAlgebra& linear, const Weights& weights, double t, double* y);

/// The algebraic equations as constraints that projection imposes together with the invariants.
class AlgebraicConstraints {
 public:
  AlgebraicConstraints(Callback& f, Jacobian jacobian, const Mass& mass);

  [[nodiscard]] std::size_t count() const { return mass_.equations(); }
  void state(Archive& archive) { jacobian_.state(archive); }
  Callback residual() { return {&AlgebraicConstraints::residual_entry, this}; }
  Callback jacobian() { return {&AlgebraicConstraints::jacobian_entry, this}; }

 private:
  static Status residual_entry(void* self, double t, const double* y, double* out);
  static Status jacobian_entry(void* self, double t, const double* y, double* out);

  Callback& f_;
  Jacobian jacobian_;
  const Mass& mass_;
  std::vector<double> slope_;
};

/// y' of M y' = f where M alone tells it: of all components if M is regular, else of those whose columns differ from
/// zero, if there are as many of them as differential equations. Components without a column come out 0.
class DifferentialRate {
 public:
  /// `lapack` may be null.
  DifferentialRate(Mass mass, const Lapack* lapack) : mass_(std::move(mass)), lapack_(lapack) {}

  /// Takes M at t, for what follows. `told`: y' follows from M alone there.
  Status enter(double t, bool& told);
  /// y' from f, in its place.
  void solve(double* f);
  /// f ← f − M y'
  void subtract(const double* rate, double* f);

 private:
  [[nodiscard]] bool factor();

  Mass mass_;
  const Lapack* lapack_;
  std::unique_ptr<Factorization> factors_;
  std::optional<double> t_;  // of the factors
  bool told_ = false;
  std::vector<double> product_;
};

/// y'(t, y) of M y' = f.
class MassSlope final : public Slope {
 public:
  MassSlope(const Callback& f, const LinearAlgebra& linear);

  Status evaluate(double t, const double* y, double h, double* out) override;
  /// A singular M needs ∂f/∂y and ∂f/∂t, which may be forward differences.
  [[nodiscard]] double relative_error() const override { return mass_.singular() ? std::sqrt(eps) : 0; }
  [[nodiscard]] std::int64_t evaluations() const override { return f_.calls(); }
  void state(Archive& archive) override;

 private:
  Callback f_;
  Jacobian jacobian_;
  Mass mass_;
  MassSolver solver_;
  const Lapack* lapack_;
  /// The factors, where they serve for the whole run.
  [[nodiscard]] bool factors_stay() const { return !mass_.singular() && mass_.constant(); }

  std::vector<double> rate_;
  bool factored_ = false;
};

}  // namespace invariode
