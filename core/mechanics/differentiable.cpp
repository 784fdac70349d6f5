#include "mechanics/differentiable.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "weights.hpp"

namespace invariode {
namespace {

constexpr double tiny = 1e-40;  // a complex increment: its square is nothing beside 1, and products of it do not vanish
// Relative increments of differences of order 4, where their error h⁴ meets roundoff ε / h, or ε / h² of the second
// one.
const double first_increment = std::pow(eps, 1.0 / 5);
const double second_increment = std::pow(eps, 1.0 / 6);
const double second_error = std::sqrt(eps);  // what is left of them, with the terms of φ itself, which cancel
constexpr double smallest_part = 0.1;        // of the largest component: smaller ones have increments of this size
// The rotated complex step begins with this part of the size of x, and is halved until two extrapolations agree to
// `settled` of their terms; or, once they agree to `agreement`, until halving it gains nothing more: what is left is
// roundoff of φ. (The better of the two is off by far less than the other.)
constexpr double widest = 0.1;
constexpr double settled = 1e-13;
constexpr double agreement = 1e-6;
constexpr int halvings = 30;
constexpr std::size_t orders = 4;  // |s|⁴, |s|⁸, … that extrapolation removes; with more roundoff decides

bool moves(const double* dx, std::size_t n) {
  return std::any_of(dx, dx + n, [](double d) { return d != 0; });
}

}  // namespace

SparseColumns::SparseColumns(const SparseMatrix& pattern, std::size_t first_component)
    : matrix(pattern), first(first_component) {
  matrix.makeCompressed();
  if (matrix.nonZeros() == matrix.rows() * matrix.cols()) {  // each column by itself
    for (Eigen::Index j = 0; j < matrix.cols(); ++j) groups.push_back({static_cast<std::size_t>(j)});
    return;
  }
  groups = group_columns(static_cast<std::size_t>(matrix.rows()), static_cast<std::size_t>(matrix.cols()),
                         matrix.outerIndexPtr(), matrix.innerIndexPtr());
}

void fill_sizes(const double* x, std::size_t n, double* size) {
  double largest = 0;
  for (std::size_t j = 0; j < n; ++j) largest = std::max(largest, std::abs(x[j]));
  for (std::size_t j = 0; j < n; ++j) size[j] = largest > 0 ? std::max(std::abs(x[j]), smallest_part * largest) : 1;
}

double reach(double t, const double* x, std::size_t n, double dt, const double* dx) {
  const double at_rest = std::max(std::abs(t), 1.0) / std::abs(dt);
  if (!moves(dx, n)) return at_rest;
  double largest = 0, least = std::numeric_limits<double>::infinity();
  for (std::size_t j = 0; j < n; ++j) largest = std::max(largest, std::abs(x[j]));
  for (std::size_t j = 0; j < n; ++j) {
    const double size = largest > 0 ? std::max(std::abs(x[j]), smallest_part * largest) : 1;
    if (dx[j] != 0) least = std::min(least, size / std::abs(dx[j]));
  }
  return std::isfinite(least) ? least : at_rest;  // a subnormal dx does not move x
}

Differentiable::Differentiable(const Forms& forms, std::size_t n, std::size_t m)
    : forms_(forms),
      n_(n),
      m_(m),
      point_(n),
      direction_(n),
      column_(m),
      plus_(m),
      minus_(m),
      near_(m),
      far_(m),
      terms_(m),
      here_(m),
      table_(orders, std::vector<double>(m)),
      z_(2 * (1 + n)),
      w_(2 * m) {}

Status Differentiable::derived(Callback& form, double t, const double* x, double dt, const double* dx, double* out) {
  std::copy(x, x + n_, z_.begin());
  z_[n_] = dt;
  std::copy(dx, dx + n_, z_.begin() + static_cast<std::ptrdiff_t>(n_) + 1);
  return form(t, z_.data(), out);
}

/// w = form(t + s dt, x + s dx) with a complex s.
Status Differentiable::complex_at(Callback& form, double t, const double* x, double dt, const double* dx, double re,
                                  double im) {
  z_[0] = t + re * dt, z_[1] = im * dt;
  for (std::size_t j = 0; j < n_; ++j) z_[2 * j + 2] = x[j] + re * dx[j], z_[2 * j + 3] = im * dx[j];
  return form(z_[0], z_.data(), w_.data());
}

Status Differentiable::slope(double t, const double* x, double dt, const double* dx, double* out) {
  if (exact()) return derived(forms_.slope, t, x, dt, dx, out);
  if (by_complex_steps()) {
    if (complex_at(forms_.complex, t, x, dt, dx, 0, tiny) == Status::stop) return Status::stop;
    for (std::size_t i = 0; i < m_; ++i) out[i] = w_[2 * i + 1] / tiny;
    return Status::ok;
  }
  const double h = first_increment * reach(t, x, n_, dt, dx);
  for (std::size_t j = 0; j < n_; ++j) direction_[j] = h * dx[j];
  if (odd_difference(t, x, h * dt, direction_.data(), near_.data()) == Status::stop) return Status::stop;
  for (std::size_t j = 0; j < n_; ++j) direction_[j] = 2 * h * dx[j];
  if (odd_difference(t, x, 2 * h * dt, direction_.data(), far_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m_; ++i) out[i] = (8 * near_[i] - far_[i]) / (12 * h);
  return Status::ok;
}

/// function(t + dt, x + dx) − function(t − dt, x − dx)
Status Differentiable::odd_difference(double t, const double* x, double dt, const double* dx, double* out) {
  move(x, dx, 1);
  if (forms_.function(t + dt, point_.data(), plus_.data()) == Status::stop) return Status::stop;
  move(x, dx, -1);
  if (forms_.function(t - dt, point_.data(), minus_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m_; ++i) out[i] = plus_[i] - minus_[i];
  return Status::ok;
}

void Differentiable::move(const double* x, const double* dx, double s) {
  for (std::size_t j = 0; j < n_; ++j) point_[j] = x[j] + s * dx[j];
}

/// With s complex of argument π/4, φ(s) + φ(−s) = 2φ + s²φ″ + O(s⁴): as s² is imaginary and s⁴ real, the imaginary part
/// is |s|²φ″ up to O(|s|⁶), and φ itself does not cancel. What is left is a series in |s|⁴, which extrapolation from
/// |s|, |s|/2, |s|/4, … removes power by power.
Status Differentiable::curvature(double t, const double* x, double dt, const double* dx, double* out,
                                 const double* sizes) {
  if (dt == 0 && !moves(dx, n_)) {
    std::fill(out, out + m_, 0.0);
    return Status::ok;
  }
  if (exact()) return derived(forms_.curvature, t, x, dt, dx, out);
  if (!by_complex_steps()) return second_difference(t, x, dt, dx, out);
  double h = widest * reach(t, x, n_, dt, dx), before = std::numeric_limits<double>::infinity();
  std::size_t rows = 0;  // of the table, since φ was last not finite
  for (int k = 0; k <= halvings; ++k, h /= 2) {
    if (rotated(t, x, dt, dx, h, sizes, near_.data()) == Status::stop) return Status::stop;
    const bool finite = all_finite(near_.data(), m_);
    const double error = extrapolate(finite ? std::min(rows, orders) : 0);
    rows = finite ? rows + 1 : 0;
    const bool no_gain = before <= agreement && error >= before;
    if (!no_gain) std::copy(near_.begin(), near_.end(), out);
    if (rows < 2) continue;
    if (no_gain || error <= settled) return Status::ok;
    before = error;
  }
  return Status::ok;
}

/// The next row of Neville's table, from its first column in `near_` and the row before in `table_`, which it replaces;
/// its last column is then in `near_`. Returns by how much the last two columns differ, in units of the terms.
double Differentiable::extrapolate(std::size_t columns) {
  double worst = 0;
  for (std::size_t i = 0; i < m_; ++i) {
    double power = 1, last = near_[i], change = 0;
    for (std::size_t l = 0; l < columns; ++l) {
      power *= 16;
      const double next = (power * last - table_[l][i]) / (power - 1);
      table_[l][i] = last;
      change = std::abs(next - last);
      last = next;
    }
    near_[i] = last;
    if (columns < table_.size()) table_[columns][i] = last;
    if (change > 0) worst = std::max(worst, change / terms_[i]);
  }
  return worst;
}

/// The second derivative with |s| = h, and in `terms_` the size of what it is the sum of.
Status Differentiable::rotated(double t, const double* x, double dt, const double* dx, double h, const double* sizes,
                               double* out) {
  const double s = h / std::numbers::sqrt2;
  if (complex_at(forms_.quiet, t, x, dt, dx, s, s) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m_; ++i) plus_[i] = w_[2 * i + 1];
  if (complex_at(forms_.quiet, t, x, dt, dx, -s, -s) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m_; ++i) {
    const double minus = w_[2 * i + 1];
    out[i] = (plus_[i] + minus) / (h * h);
    terms_[i] = (std::abs(plus_[i]) + std::abs(minus)) / (h * h) + (sizes != nullptr ? sizes[i] / h : 0);
  }
  return Status::ok;
}

double Differentiable::relative_error() const { return exact() || by_complex_steps() || m_ == 0 ? 0 : second_error; }

Status Differentiable::second_difference(double t, const double* x, double dt, const double* dx, double* out) {
  const double h = second_increment * reach(t, x, n_, dt, dx);
  if (forms_.function(t, x, here_.data()) == Status::stop) return Status::stop;
  for (std::size_t j = 0; j < n_; ++j) direction_[j] = h * dx[j];
  if (even_difference(t, x, h * dt, direction_.data(), near_.data()) == Status::stop) return Status::stop;
  for (std::size_t j = 0; j < n_; ++j) direction_[j] = 2 * h * dx[j];
  if (even_difference(t, x, 2 * h * dt, direction_.data(), far_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m_; ++i) out[i] = (16 * near_[i] - far_[i]) / (12 * h * h);
  return Status::ok;
}

/// (φ(s) − φ) − (φ − φ(−s))
Status Differentiable::even_difference(double t, const double* x, double dt, const double* dx, double* out) {
  move(x, dx, 1);
  if (forms_.function(t + dt, point_.data(), plus_.data()) == Status::stop) return Status::stop;
  move(x, dx, -1);
  if (forms_.function(t - dt, point_.data(), minus_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m_; ++i) out[i] = (plus_[i] - here_[i]) - (here_[i] - minus_[i]);
  return Status::ok;
}

Status Differentiable::jacobian(double t, const double* x, const double* size, SparseColumns& columns) {
  std::vector<double> direction(n_);
  SparseMatrix& J = columns.matrix;
  for (const std::vector<std::size_t>& group : columns.groups) {
    for (const std::size_t j : group) direction[columns.first + j] = size[columns.first + j];
    if (slope(t, x, 0, direction.data(), column_.data()) == Status::stop) return Status::stop;
    for (const std::size_t j : group) {
      direction[columns.first + j] = 0;
      const int first = J.outerIndexPtr()[j], last = J.outerIndexPtr()[j + 1];
      for (int p = first; p < last; ++p)
        J.valuePtr()[p] = column_[static_cast<std::size_t>(J.innerIndexPtr()[p])] / size[columns.first + j];
    }
  }
  return Status::ok;
}

}  // namespace invariode
