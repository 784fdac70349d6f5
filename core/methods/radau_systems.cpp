#include "methods/radau_systems.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>

namespace invariode {
namespace {

/// Returns the factor by which T magnifies errors.
double magnification(const RadauFormula& formula) {
  double largest = 0;
  for (std::size_t i = 0; i < formula.stages; ++i) {
    double sum = 0;
    for (std::size_t k = 0; k < formula.stages; ++k) sum += std::abs(formula.T[i * formula.stages + k]);
    largest = std::max(largest, sum);
  }
  return largest;
}

/// v = [real parts | imaginary parts], 2 n numbers, becomes the complex numbers (real − i imaginary) / μ, and they
/// become [real parts | −imaginary parts], in these components alone. An array of complex numbers is one of twice as
/// many reals.
Complex* to_complex(double* v, std::size_t n, const Part& of, Complex mu, double* scratch) {
  auto* z = reinterpret_cast<Complex*>(v);
  const double size = std::norm(mu), p = mu.real() / size, q = -mu.imag() / size;
  std::copy(v + of.first, v + of.stop, scratch + of.first);
  for (std::size_t i = of.first; i < of.stop; ++i) {
    const double x = scratch[i], y = -v[n + i];  // i < n: v[n + i] is still there
    z[i] = Complex(x * p - y * q, x * q + y * p);
  }
  return z;
}
void from_complex(double* v, std::size_t n, const Part& of, double* scratch) {
  for (std::size_t i = of.first; i < of.stop; ++i) {
    const double real = v[2 * i], imaginary = v[2 * i + 1];
    v[i] = real;
    scratch[i] = -imaginary;
  }
  std::copy(scratch + of.first, scratch + of.stop, v + n + of.first);
}

}  // namespace

RadauSystems::RadauSystems(Callback& f, const Weights& weights, const LinearAlgebra& linear)
    : AgingJacobian(f, weights, linear, true),
      n_(weights.size()),
      lapack_(linear.lapack),
      real_lu_(linear.krylov ? nullptr : make_factors<double>(jacobian().structure, linear.lapack)) {}

void RadauSystems::take_scratch(double* first, double* second) {
  if (!has_matrices()) matrix_free()->take_scratch(first, second);
}

void RadauSystems::use(const RadauFormula& formula) {
  formula_ = &formula;
  magnification_ = magnification(formula);
  forget_factors();
  while (has_matrices() && complex_lu_.size() < formula.pairs.size())
    complex_lu_.push_back(make_factors<Complex>(jacobian().structure, lapack_));
}

Status RadauSystems::begin(double h, double t, const double* y, const double* f) {
  h_ = h;
  renew_if_noise(h / formula_->mu);
  if (repair(t, y, f) == Status::stop) return Status::stop;
  if (!has_matrices()) matrix_free()->product().at(t, y, f);
  return Status::ok;
}

Outcome RadauSystems::prepare(double t1, Convergence& convergence) {
  const double c = h_ / formula_->mu;
  if (!has_matrices()) {
    if (c != last_c_) convergence.forget();
    last_c_ = c;
    return prepare_preconditioner(c, t1);
  }
  return AgingJacobian::prepare(c, t1, [&] {
    convergence.forget();
    const bool regular = factorize();
    for (std::size_t k = 0; k <= formula_->pairs.size(); ++k) count_factorization();  // unless they were given up
    return regular;
  });
}

bool RadauSystems::factorize() {
  if (!real_lu_->factor(mass_matrix(), h_ / formula_->mu, jacobian())) return false;
  for (std::size_t k = 0; k < formula_->pairs.size(); ++k)
    if (!complex_lu_[k]->factor(mass_matrix(), h_ / formula_->pairs[k], jacobian())) return false;
  return true;
}

/// T ω, where (M − (h/μ) J) ω = (1/μ) T⁻¹ residuals for each eigenvalue μ.
Newton::Result RadauSystems::solve(const Matrix* M, const double* w, double tolerance, const Part& part,
                                   double* residuals, double* scratch, bool& negligible) {
  assert(formula_ != nullptr && (!has_matrices() || has_factors()));
  tolerance /= magnification_;
  const bool may_skip = negligible;
  const auto one = [&](auto mu, auto* b, auto* lu) {
    if (lu == nullptr) return solve_by_gmres(h_ / mu, M, w, tolerance, part, b, may_skip, negligible);
    solve_blocks(*lu, b, part);
    negligible = false;
    return Newton::Result::converged;
  };
  const auto [first, end, n] = part;
  formula_->transform(formula_->T_inverse, n_, first, end, residuals, residuals);
  for (std::size_t i = first; i < end; ++i) residuals[i] /= formula_->mu;
  Newton::Result result = one(formula_->mu, residuals, real_lu_.get());
  for (std::size_t k = 0; k < formula_->pairs.size() && result == Newton::Result::converged; ++k) {
    double* pair = residuals + (2 * k + 1) * n_;
    Complex* b = to_complex(pair, n_, part, formula_->pairs[k], scratch);
    result = one(formula_->pairs[k], b, has_matrices() ? complex_lu_[k].get() : nullptr);
    from_complex(pair, n_, part, scratch);
  }
  formula_->transform(formula_->T, n_, first, end, residuals, residuals);
  return result;
}

Newton::Result RadauSystems::solve_real(const Matrix* M, const double* w, const double* w_columns, double tolerance,
                                        double t, const double* Y, const double* f, double* b) {
  const double c = h_ / formula_->mu;
  if (has_matrices()) {
    assert(has_factors());
    const Status status = solve_whole(*real_lu_, c, t, Y, f, b);
    return status == Status::stop ? Newton::Result::stop : Newton::Result::converged;
  }
  bool negligible = false;
  const Newton::Result result = solve_by_gmres(c, M, w, tolerance, system().state(), b, false, negligible);
  if (result != Newton::Result::converged || !system().has_sensitivities()) return result;
  if (system().couple(c, t, Y, f, b) == Status::stop) return Newton::Result::stop;
  return solve_by_gmres(c, M, w_columns, tolerance, system().sensitivities(), b, false, negligible);
}

/// b becomes the solution of (M − c J) x = b in each block of a part, or 0 where it may be skipped and is negligible.
template <class Scalar>
Newton::Result RadauSystems::solve_by_gmres(Scalar c, const Matrix* M, const double* w, double tolerance,
                                            const Part& part, Scalar* b, bool may_skip, bool& negligible) {
  for (const std::size_t i : system().coupled(part))
    if (const Newton::Result result = solve_block(c, M, w + i, tolerance, b + i, may_skip, negligible);
        result != Newton::Result::converged)
      return result;
  return Newton::Result::converged;
}

template <class Scalar>
Newton::Result RadauSystems::solve_block(Scalar c, const Matrix* M, const double* w, double tolerance, Scalar* b,
                                         bool may_skip, bool& negligible) {
  MatrixFree& free = *matrix_free();
  count_solve();
  const Newton::Result ready = newton_result(free.precondition(b));
  if (ready != Newton::Result::converged) return ready;
  if (may_skip && free.negligible(w, tolerance, b)) {
    std::fill_n(b, system().state().size(), 0);
    return Newton::Result::converged;
  }
  negligible = false;
  return newton_result(free.solve(c, M, w, tolerance, b));
}

void RadauSystems::state(Archive& archive) {
  archive(h_);
  if (!has_matrices()) archive(last_c_);
  AgingJacobian::state(archive, [&](double c) { return has_matrices() ? factorize() : set_up_again(c, archive); });
}

}  // namespace invariode
