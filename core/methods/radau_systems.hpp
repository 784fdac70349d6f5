#pragma once
// The linear systems of Newton's iteration for the stages of a Radau IIA formula (docs/algorithms.md, 'Radau',
// 'Matrix-free').

#include <cstddef>
#include <memory>
#include <optional>
#include <vector>

#include "methods/newton.hpp"
#include "methods/radau_formula.hpp"

namespace invariode {

/// The linear systems of radau: in the basis of the eigenvectors of A⁻¹ a real one and (s − 1) / 2 complex ones, M −
/// (h/μ) J for each eigenvalue μ. Solved by factors of these matrices, or by GMRES with the J of the start of the step.
class RadauSystems : public AgingJacobian {
 public:
  RadauSystems(Callback& f, const Weights& weights, const LinearAlgebra& linear);

  /// Matrix-free, complex systems overwrite two vectors (n,) of the caller's.
  void take_scratch(double* first, double* second);
  /// The systems of that formula.
  void use(const RadauFormula& formula);
  /// J for an attempt of signed size h from (t, y), where f is `f`; all of them stay with the caller.
  Status begin(double h, double t, const double* y, const double* f);
  /// M at t₁, and factors for all eigenvalues or the preconditioner of the real one: the others are about as large, and
  /// with it their systems have eigenvalues on the segment between 1 and μ over the eigenvalue. Where they are new, the
  /// rate of convergence is forgotten. `not_finite`: a matrix is singular.
  Outcome prepare(double t1, Convergence& convergence);

  /// Residuals of the stages, s n numbers, in the blocks of a part become the updates of the increments. By GMRES about
  /// the tolerance is left as error, in units of the weights w; M is the mass matrix at t₁. Where `negligible` is true
  /// at the start, it stays so if all updates are within the tolerance, and they may be 0. `scratch`: (n,).
  Newton::Result solve(const Matrix* M, const double* w, double tolerance, const Part& part, double* residuals,
                       double* scratch, bool& negligible);
  /// b becomes (M − (h/μ) J)⁻¹ b, μ real; with sensitivities the matrix is that of the whole system at (t, Y), where it
  /// has the value `f`. By GMRES to that tolerance, in units of the weights w of the state and w_columns of the others.
  Newton::Result solve_real(const Matrix* M, const double* w, const double* w_columns, double tolerance, double t,
                            const double* Y, const double* f, double* b);

  /// Matrix-free, J is never an old one.
  [[nodiscard]] bool has_matrices() const { return static_cast<bool>(real_lu_); }
  void state(Archive& archive);
  /// See `Step::end_attempts`.
  void end_attempts() override {
    AgingJacobian::end_attempts();
    complex_lu_.clear();
  }

 private:
  bool factorize();
  template <class Scalar>
  Newton::Result solve_by_gmres(Scalar c, const Matrix* M, const double* w, double tolerance, const Part& part,
                                Scalar* b, bool may_skip, bool& negligible);
  template <class Scalar>
  Newton::Result solve_block(Scalar c, const Matrix* M, const double* w, double tolerance, Scalar* b, bool may_skip,
                             bool& negligible);

  std::size_t n_;
  const Lapack* lapack_;
  const RadauFormula* formula_ = nullptr;
  double magnification_ = 1;                                       // of errors, by its T
  std::unique_ptr<Factorization> real_lu_;                         // null: matrix-free
  std::vector<std::unique_ptr<ComplexFactorization>> complex_lu_;  // of the pairs, as many as were needed so far
  double h_ = 0;                                                   // of the attempt
  std::optional<double> last_c_;  // matrix-free: for which the rate of convergence is known
};

}  // namespace invariode
