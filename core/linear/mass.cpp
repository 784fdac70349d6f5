#include "linear/mass.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

namespace invariode {
namespace {

constexpr double singular_growth = 1e13;  // of a solution over its right-hand side, with rows and columns scaled
constexpr int equilibrating_sweeps = 3;   // over rows and columns; each halves what the logarithms of scales are off
constexpr int consistency_iterations = 25;
constexpr int consistency_halvings = 10;
constexpr double consistent_to = 1e-11;  // weighted size of a last correction: what it leaves is of its square

Eigen::Map<const Eigen::VectorXd> as_vector(const double* v, Eigen::Index n) { return {v, n}; }
Eigen::Map<Eigen::VectorXd> as_vector(double* v, Eigen::Index n) { return {v, n}; }

/// The rows of Z in which one column k alone has an entry: for each k the one of its largest entry. M is as well
/// determined by the other rows as by all.
std::vector<std::size_t> own_rows(const Mass::Basis& Z) {
  constexpr std::size_t none = std::numeric_limits<std::size_t>::max();
  const Eigen::SparseMatrix<double, Eigen::RowMajor> rows(Z);
  std::vector<std::size_t> own(static_cast<std::size_t>(Z.cols()), none);
  std::vector<double> largest(own.size(), 0);
  for (Eigen::Index i = 0; i < rows.outerSize(); ++i) {
    const decltype(rows)::InnerIterator z(rows, i);
    if (rows.innerVector(i).nonZeros() != 1) continue;
    const auto k = static_cast<std::size_t>(z.col());
    if (std::abs(z.value()) <= largest[k]) continue;
    largest[k] = std::abs(z.value());
    own[k] = static_cast<std::size_t>(i);
  }
  if (std::ranges::find(own, none) != own.end())
    throw std::invalid_argument("a column of the null basis has no row in which the others are zero");
  return own;
}

/// Scales the rows and columns of A by powers of 2, which change no digits, until the largest entries of all of them
/// are between 1/2 and 2. False: a row or column is zero, or not finite.
bool equilibrate(Matrix& A, std::vector<double>& row_scale, std::vector<double>& column_scale) {
  const std::size_t n = A.n();
  row_scale.assign(n, 1);
  column_scale.assign(n, 1);
  std::vector<double> largest(n);
  const auto scale = [&](std::vector<double>& scales, auto place) {
    std::fill(largest.begin(), largest.end(), 0);
    A.for_each([&](std::size_t i, std::size_t j, double a) {
      double& most = largest[place(i, j)];
      most = std::abs(a) <= most ? most : std::abs(a);  // NaN stays
    });
    for (std::size_t k = 0; k < n; ++k) {
      if (!(largest[k] > 0) || !std::isfinite(largest[k])) return false;
      largest[k] = std::ldexp(1.0, -std::ilogb(largest[k]));
      scales[k] *= largest[k];
    }
    A.for_each([&](std::size_t i, std::size_t j, double& a) { a *= largest[place(i, j)]; });
    return true;
  };
  for (int sweep = 0; sweep < equilibrating_sweeps; ++sweep)
    if (!scale(row_scale, [](std::size_t i, std::size_t) { return i; }) ||
        !scale(column_scale, [](std::size_t, std::size_t j) { return j; }))
      return false;
  return true;
}

}  // namespace

Mass::Mass(Matrix matrix, MatrixFunction function, const Basis& null_basis)
    : matrix_(std::move(matrix)), function_(function), Z_(null_basis), own_(own_rows(Z_)) {}

std::optional<std::vector<double>> Mass::diagonal() const {
  if (!constant()) return {};
  std::vector<double> entries(matrix_.n());
  bool diagonal = true;
  matrix_.for_each([&](std::size_t i, std::size_t j, double m) {
    if (i == j) entries[i] = m;
    diagonal = diagonal && (i == j || m == 0);
  });
  return diagonal ? std::optional(std::move(entries)) : std::nullopt;
}

void Mass::algebraic_part(const double* f, double* r) const {
  as_vector(r, Z_.cols()) = Z_.transpose() * as_vector(f, Z_.rows());
}

void Mass::algebraic_part(const Matrix& J, double* out) const {
  const std::size_t n = J.n();
  assert(static_cast<Eigen::Index>(n) == Z_.rows());
  std::fill(out, out + equations() * n, 0);
  const Eigen::SparseMatrix<double, Eigen::RowMajor> rows(Z_);
  J.for_each([&](std::size_t i, std::size_t j, double value) {
    for (decltype(rows)::InnerIterator z(rows, static_cast<Eigen::Index>(i)); z; ++z)
      out[static_cast<std::size_t>(z.col()) * n + j] += z.value() * value;
  });
}

Matrix Mass::completed(const Matrix& J) const {
  const auto n = static_cast<Eigen::Index>(matrix_.n());
  std::vector<char> replaced(matrix_.n(), 0);
  for (const std::size_t row : own_) replaced[row] = 1;
  std::vector<Eigen::Triplet<double>> entries;
  const auto add = [&entries](std::size_t i, std::size_t j, double a) {
    if (a != 0) entries.emplace_back(static_cast<int>(i), static_cast<int>(j), a);
  };
  matrix_.for_each([&](std::size_t i, std::size_t j, double m) {
    if (!replaced[i]) add(i, j, m);
  });
  const Eigen::SparseMatrix<double, Eigen::RowMajor> rows(Z_);
  J.for_each([&](std::size_t i, std::size_t j, double value) {
    for (decltype(rows)::InnerIterator z(rows, static_cast<Eigen::Index>(i)); z; ++z)
      add(own_[static_cast<std::size_t>(z.col())], j, z.value() * value);
  });
  Basis sum(n, n);
  sum.setFromTriplets(entries.begin(), entries.end());
  Matrix out(
      {.kind = matrix_.structure.kind == Structure::Kind::dense ? Structure::Kind::dense : Structure::Kind::sparse,
       .n = matrix_.n()});
  if (out.structure.kind == Structure::Kind::dense) {
    for (Eigen::Index j = 0; j < sum.cols(); ++j)
      for (Basis::InnerIterator e(sum, j); e; ++e)
        out.values[static_cast<std::size_t>(e.row()) * out.n() + static_cast<std::size_t>(j)] = e.value();
  } else {
    out.starts.assign(sum.outerIndexPtr(), sum.outerIndexPtr() + sum.cols() + 1);
    out.rows.assign(sum.innerIndexPtr(), sum.innerIndexPtr() + sum.nonZeros());
    out.values.assign(sum.valuePtr(), sum.valuePtr() + sum.nonZeros());
  }
  return out;
}

bool MassSolver::factor(const Mass& mass, const Matrix& J, const Lapack* lapack) {
  Matrix A = mass.completed(J);
  if (!equilibrate(A, row_scale_, column_scale_)) return false;
  const std::size_t n = A.n();
  lu_ = make_factorization(A.structure, lapack);
  if (!lu_->factor(&A, 0, Matrix(A.structure))) return false;
  std::vector<double> probe(n);
  for (std::size_t i = 0; i < n; ++i) probe[i] = (i * i + i / 2) % 2 == 0 ? 1 : -1;
  lu_->solve(probe.data());
  MaxNorm growth;
  for (const double x : probe) growth.add(x);
  return growth.value() < singular_growth;
}

void MassSolver::solve(double* b) {
  for (std::size_t i = 0; i < row_scale_.size(); ++i) b[i] *= row_scale_[i];
  lu_->solve(b);
  for (std::size_t i = 0; i < row_scale_.size(); ++i) b[i] *= column_scale_[i];
}

void MassSolver::slope(const Mass& mass, const double* ft, double* f) {
  if (mass.singular()) {
    std::vector<double> rate(mass.equations(), 0);
    if (ft) mass.algebraic_part(ft, rate.data());
    for (std::size_t k = 0; k < rate.size(); ++k) f[mass.own_row(k)] = -rate[k];
  }
  solve(f);
}

void MassSolver::correction(const Mass& mass, double* f) {
  std::vector<double> residual(mass.equations());
  mass.algebraic_part(f, residual.data());
  std::fill(f, f + row_scale_.size(), 0);
  for (std::size_t k = 0; k < residual.size(); ++k) f[mass.own_row(k)] = -residual[k];
  solve(f);
}

Consistency make_consistent(Callback& f, const LinearAlgebra& linear, const Weights& weights, double t, double* y) {
  const std::size_t n = weights.size();
  Mass& mass = *linear.mass;
  Jacobian jacobian = *linear.jacobian;
  std::vector<double> slope(n), w(n), delta(n), trial(n), beyond(n);
  MassSolver solver;
  if (mass.evaluate(t) == Status::stop) return Consistency::stop;
  if (f(t, y, slope.data()) == Status::stop) return Consistency::stop;
  if (!all_finite(slope.data(), n)) return Consistency::undefined;
  const auto size = [&](const std::vector<double>& v) {
    MaxNorm norm;
    for (std::size_t i = 0; i < n; ++i) norm.add(v[i] / w[i]);
    return norm.value();
  };
  for (int iteration = 0; iteration < consistency_iterations; ++iteration) {
    weights.fill(y, w.data());
    if (jacobian.evaluate(f, t, y, slope.data()) == Status::stop) return Consistency::stop;
    bool regular = solver.factor(mass, jacobian.matrix(), linear.lapack);
    if (!regular && jacobian.kind() == Jacobian::Kind::differences) {
      // Increments on the scale of y may have changed f by less than its roundoff.
      if (jacobian.evaluate_boldly(f, t, y, slope.data()) == Status::stop) return Consistency::stop;
      regular = solver.factor(mass, jacobian.matrix(), linear.lapack);
      if (!regular) return Consistency::undetermined;
    }
    if (!regular) return Consistency::index_too_high;
    delta = slope;
    solver.correction(mass, delta.data());
    const double distance = size(delta);
    if (distance <= consistent_to) return iteration == 0 ? Consistency::consistent : Consistency::corrected;
    // A step of Newton's method, halved until the same linearization finds the next distance smaller.
    double fraction = 1;
    for (int halving = 0;; ++halving, fraction /= 2) {
      if (halving > consistency_halvings || !std::isfinite(distance)) return Consistency::not_found;
      for (std::size_t i = 0; i < n; ++i) trial[i] = y[i] + fraction * delta[i];
      if (f(t, trial.data(), slope.data()) == Status::stop) return Consistency::stop;
      jacobian.extend(trial.data(), slope.data());
      beyond = slope;
      solver.correction(mass, beyond.data());
      if (size(beyond) <= (1 - fraction / 4) * distance) break;
    }
    std::copy(trial.begin(), trial.end(), y);
  }
  return Consistency::not_found;
}

AlgebraicConstraints::AlgebraicConstraints(Callback& f, Jacobian jacobian, const Mass& mass)
    : f_(f), jacobian_(std::move(jacobian)), mass_(mass), slope_(mass.matrix().n()) {}

Status AlgebraicConstraints::residual_entry(void* self, double t, const double* y, double* out) {
  auto& me = *static_cast<AlgebraicConstraints*>(self);
  if (me.f_(t, y, me.slope_.data()) == Status::stop) return Status::stop;
  me.jacobian_.extend(y, me.slope_.data());
  me.mass_.algebraic_part(me.slope_.data(), out);
  return Status::ok;
}

/// Projection asks for the Jacobian where it has just asked for the residual: f is at hand.
Status AlgebraicConstraints::jacobian_entry(void* self, double t, const double* y, double* out) {
  auto& me = *static_cast<AlgebraicConstraints*>(self);
  if (me.jacobian_.evaluate(me.f_, t, y, me.slope_.data()) == Status::stop) return Status::stop;
  me.mass_.algebraic_part(me.jacobian_.matrix(), out);
  return Status::ok;
}

Status DifferentialRate::enter(double t, bool& told) {
  if (!t_ || (!mass_.constant() && *t_ != t)) {
    t_.reset();
    if (mass_.evaluate(t) == Status::stop) return Status::stop;
    told_ = factor();
    t_ = t;
  }
  told = told_;
  return Status::ok;
}

/// M with units in the rows of the algebraic equations, for the components without a column.
bool DifferentialRate::factor() {
  const Matrix& M = mass_.matrix();
  const std::size_t n = M.n();
  Matrix A = M;
  if (mass_.singular()) {
    std::vector<char> has_column(n, 0), algebraic(n, 0);
    M.for_each([&](std::size_t, std::size_t j, double m) {
      if (m != 0) has_column[j] = 1;
    });
    if (static_cast<std::size_t>(std::ranges::count(has_column, 0)) != mass_.equations()) return false;
    for (std::size_t k = 0; k < mass_.equations(); ++k) algebraic[mass_.own_row(k)] = 1;
    A = Matrix({.kind = Structure::Kind::dense, .n = n});
    M.for_each([&](std::size_t i, std::size_t j, double m) {
      if (algebraic[i] == 0) A.values[i * n + j] = m;
    });
    std::size_t row = 0;
    for (std::size_t j = 0; j < n; ++j) {
      if (has_column[j] != 0) continue;
      while (algebraic[row] == 0) ++row;
      A.values[row++ * n + j] = 1;
    }
  }
  factors_ = make_factorization(A.structure, lapack_);
  return factors_->factor(&A, 0, Matrix(A.structure));
}

void DifferentialRate::solve(double* f) {
  for (std::size_t k = 0; k < mass_.equations(); ++k) f[mass_.own_row(k)] = 0;
  factors_->solve(f);
}

void DifferentialRate::subtract(const double* rate, double* f) {
  product_.resize(mass_.matrix().n());
  mass_.matrix().multiply(rate, product_.data());
  for (std::size_t i = 0; i < product_.size(); ++i) f[i] -= product_[i];
}

MassSlope::MassSlope(const Callback& f, const LinearAlgebra& linear)
    : f_(f), jacobian_(*linear.jacobian), mass_(*linear.mass), lapack_(linear.lapack), rate_(mass_.matrix().n()) {
  jacobian_.provide();  // with a regular M its values do not matter, and are never evaluated
}

Status MassSlope::evaluate(double t, const double* y, double h, double* out) {
  if (f_(t, y, out) == Status::stop) return Status::stop;
  const double* ft = nullptr;
  if (mass_.singular()) {
    if (jacobian_.evaluate(f_, t, y, out) == Status::stop) return Status::stop;
    if (jacobian_.time_derivative(f_, t, y, out, h, rate_.data()) == Status::stop) return Status::stop;
    ft = rate_.data();
  }
  if (!factored_ || !factors_stay()) {
    if (mass_.evaluate(t) == Status::stop) return Status::stop;
    factored_ = solver_.factor(mass_, jacobian_.matrix(), lapack_);
  }
  if (factored_)
    solver_.slope(mass_, ft, out);
  else
    std::fill(out, out + rate_.size(), std::numeric_limits<double>::quiet_NaN());
  return Status::ok;
}

void MassSlope::state(Archive& archive) {
  f_.state(archive);
  jacobian_.state(archive);
  archive(factored_);
  if (archive.reading() && factored_ && factors_stay()) factored_ = solver_.factor(mass_, jacobian_.matrix(), lapack_);
}

}  // namespace invariode
