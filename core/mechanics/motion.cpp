#include "mechanics/motion.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <utility>

#include "linear/index.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

using Eigen::Index;
using Rows = Eigen::SparseMatrix<double, Eigen::RowMajor>;

constexpr double undefined = std::numeric_limits<double>::quiet_NaN();
constexpr double along_increment = cbrt_eps;  // relative, of the central difference of Φ along the motion
// Sparse factors are faster from this size on, where at most that part of A can be other than 0 (benchmarks/chains.py).
constexpr std::size_t least_sparse = 24;
constexpr double densest = 0.25;
// A position is nearly singular where rows of A, of norm 1, are so close to depending on each other: what is off the
// constraints by e then changes accelerations by e divided by the square of that.
constexpr double nearly_singular = 0.05;
// At a distance of σ from a singular position, roundoff of the constraints changes accelerations by ε / σ³. Nearer than
// `too_near` they are interpolated, as functions that are smooth along the motion, between points on both sides, at √1,
// √2, √3 and √4 times the `spacing`: there, what roundoff and interpolation leave are both about 1e-11 of their size.
constexpr double too_near = 0.01, far_enough = 0.005, spacing = 0.03;
constexpr std::array<double, 4> interpolation = {2, -3, 2, -0.5};  // Lagrange's polynomial in the square, at 0
constexpr int most_corrections = 6;       // Newton's iteration, which starts near, squares its errors
constexpr double last_correction = 1e-8;  // of q: its square is roundoff

SparseMatrix columns_from(const SparseMatrix& A, std::size_t first) { return A.rightCols(A.cols() - index(first)); }

/// A product's pattern, which does not depend on values that happen to cancel.
SparseMatrix pattern_of_product(SparseMatrix A, SparseMatrix B) {
  std::fill_n(A.valuePtr(), A.nonZeros(), 1.0);
  std::fill_n(B.valuePtr(), B.nonZeros(), 1.0);
  return A * B;
}

std::vector<std::size_t> indices(const char* kept, std::size_t count) {
  std::vector<std::size_t> found;
  for (std::size_t i = 0; i < count; ++i)
    if (kept[i] != 0) found.push_back(i);
  return found;
}

/// A among zeros, in a matrix of `width` columns, from column `first` on.
SparseMatrix placed(const SparseMatrix& A, Index first, Index width) {
  SparseMatrix wide(A.rows(), width);
  for (Index j = 0; j < width; ++j) {
    wide.startVec(j);
    if (j < first || j >= first + A.cols()) continue;
    for (SparseMatrix::InnerIterator it(A, j - first); it; ++it) wide.insertBack(it.row(), j) = it.value();
  }
  wide.finalize();
  return wide;
}

}  // namespace

Motion::Motion(MotionTerms terms) : terms_(std::move(terms)) {
  const std::size_t n_q = terms_.n_q, n_v = terms_.n_v, n = n_q + n_v;
  const std::size_t m_phi = terms_.constraints.m(), m_psi = terms_.velocity_constraints.m();
  const auto fits = [](const SparseMatrix& A, std::size_t rows, std::size_t columns) {
    return A.rows() == index(rows) && A.cols() == index(columns);
  };
  const bool map = terms_.kinematics.m() > 0;
  if (terms_.kept.size() != m_phi + m_psi || !fits(terms_.mass.matrix, n_v, n_v) ||
      !fits(terms_.phi_pattern, m_phi, n_q) || !fits(terms_.psi_pattern, m_psi, n) ||
      (map ? !fits(terms_.kinematics_pattern, n_q, n) || terms_.kinematics.m() != n_q : n_q != n_v) || !terms_.force)
    throw std::invalid_argument("the sizes of a mechanical system do not match");
  kept_phi_ = indices(terms_.kept.data(), m_phi);
  kept_psi_ = indices(terms_.kept.data() + m_phi, m_psi);
  place_phi_.assign(m_phi, -1);
  place_psi_.assign(m_psi, -1);
  for (std::size_t i = 0; i < kept_phi_.size(); ++i) place_phi_[kept_phi_[i]] = static_cast<int>(i);
  for (std::size_t i = 0; i < kept_psi_.size(); ++i) place_psi_[kept_psi_[i]] = static_cast<int>(kept_phi_.size() + i);
  choose_patterns();
  force_.resize(index(n_v));
  gamma_.resize(A_.rows());
  q_dot_.resize(n_q);
  along_.resize(n);
  bend_.resize(std::max({n_q, m_phi, m_psi}));
  values_.resize(bend_.size());
  size_.resize(n);
  ones_.assign(n, 1.0);
  beside_.resize(n_q);
  terms_of_rate_.resize(m_phi);
  satisfying_.resize(n);
  shifted_.resize(n);
  nothing_ = Eigen::VectorXd::Zero(index(n_v));
  rest_.resize(A_.rows());
  entries_.resize(most_entries());
}

/// Returns the maximum number of values that the users' functions write at once: those of M and of Φ, if they are
/// given.
std::size_t Motion::most_entries() const {
  std::size_t mass = 0, phi = 0;
  switch (terms_.mass.writes) {
    case MassTerm::Writes::nothing: break;
    case MassTerm::Writes::diagonal: mass = terms_.n_v; break;
    case MassTerm::Writes::entries: mass = static_cast<std::size_t>(terms_.mass.matrix.nonZeros()); break;
    case MassTerm::Writes::rows: mass = terms_.n_v * terms_.n_v; break;
  }
  if (terms_.jacobian.function)
    phi = terms_.jacobian.entries ? static_cast<std::size_t>(phi_.matrix.nonZeros())
                                  : static_cast<std::size_t>(phi_.matrix.rows()) * terms_.n_q;
  return std::max(mass, phi);
}

void Motion::choose_patterns() {
  terms_.mass.matrix.makeCompressed();
  diagonal_mass_ = is_diagonal(terms_.mass.matrix);
  phi_ = SparseColumns(terms_.phi_pattern, 0);
  psi_ = SparseColumns(terms_.psi_pattern, 0);
  psi_by_v_ = SparseColumns(columns_from(terms_.psi_pattern, terms_.n_q), terms_.n_q);
  phi_by_v_ = phi_.matrix;
  if (terms_.kinematics.m() > 0) {
    kinematics_ = SparseColumns(terms_.kinematics_pattern, 0);
    kinematics_by_v_ = SparseColumns(columns_from(terms_.kinematics_pattern, terms_.n_q), terms_.n_q);
    phi_by_v_ = pattern_of_product(phi_.matrix, kinematics_by_v_.matrix);
  }
  phi_by_time_ = phi_.matrix;
  combine_rates();
  A_.resize(index(kept_phi_.size() + kept_psi_.size()), index(terms_.n_v));
  assemble();
  const auto all = static_cast<double>(A_.rows() * A_.cols());
  const auto masses = static_cast<double>(terms_.n_v * terms_.n_v);
  sparse_ = terms_.sparse && terms_.n_v >= least_sparse && static_cast<double>(A_.nonZeros()) <= densest * all &&
            static_cast<double>(terms_.mass.matrix.nonZeros()) <= densest * masses;
}

Callback Motion::callback(Part part) {
  switch (part) {
    case Part::slope: return {&entry<&Motion::slope>, this};
    case Part::mass: return {&entry<&Motion::mass_values>, this};
    case Part::positions: return {&entry<&Motion::positions>, this};
    case Part::positions_jacobian: return {&entry<&Motion::jacobian_rows<Part::positions_jacobian, true>>, this};
    case Part::rates: return {&entry<&Motion::rates>, this};
    case Part::rates_jacobian: return {&entry<&Motion::jacobian_rows<Part::rates_jacobian, true>>, this};
    case Part::velocities: return {&entry<&Motion::velocities>, this};
    case Part::velocities_jacobian: return {&entry<&Motion::jacobian_rows<Part::velocities_jacobian, true>>, this};
  }
  return {};
}

MotionWork Motion::work() const {
  return {.mass = terms_.mass.function.calls(),
          .force = terms_.force.calls(),
          .constraints = terms_.constraints.calls(),
          .velocity_constraints = terms_.velocity_constraints.calls(),
          .kinematics = terms_.kinematics.calls(),
          .jacobian = terms_.jacobian.function.calls(),
          .sparse = sparse_count_,
          .dense = dense_count_,
          .singular = singular_count_};
}

double Motion::relative_error() const {
  return std::max({terms_.constraints.relative_error(), terms_.velocity_constraints.relative_error(),
                   terms_.kinematics.relative_error()});
}

// ---------------------------------------------------------------------------------------------------------------------
// What the user's functions give

/// The values of a pattern, from `entries_`.
void Motion::read_entries(SparseMatrix& into, bool entries) const {
  double* value = into.valuePtr();
  const auto width = static_cast<std::size_t>(into.cols());
  for (Index j = 0; j < into.outerSize(); ++j)
    for (int p = into.outerIndexPtr()[j]; p < into.outerIndexPtr()[j + 1]; ++p) {
      const auto k = static_cast<std::size_t>(p), i = static_cast<std::size_t>(into.innerIndexPtr()[p]);
      value[p] = entries_[entries ? k : i * width + static_cast<std::size_t>(j)];
    }
}

Status Motion::mass(double t, const double* q) {
  MassTerm& mass = terms_.mass;
  if (mass.writes == MassTerm::Writes::nothing) return Status::ok;
  if (mass.function(t, q, entries_.data()) == Status::stop) return Status::stop;
  read_entries(mass.matrix, mass.writes != MassTerm::Writes::rows);  // a diagonal is its own pattern
  const auto full = static_cast<Index>(terms_.n_v * terms_.n_v);
  if (mass.writes != MassTerm::Writes::rows || mass.matrix.nonZeros() == full) return Status::ok;
  const auto zeros_in = [](const double* values, Index count) { return std::count(values, values + count, 0.0); };
  if (full - zeros_in(entries_.data(), full) ==
      mass.matrix.nonZeros() - zeros_in(mass.matrix.valuePtr(), mass.matrix.nonZeros()))
    return Status::ok;
  mass.matrix = Eigen::MatrixXd::Ones(index(terms_.n_v), index(terms_.n_v)).sparseView();  // it has others, after all
  sparse_ = false;
  read_entries(mass.matrix, false);
  return Status::ok;
}

Status Motion::q_dot(double t, const double* y, double* out) {
  if (terms_.kinematics.m() > 0) return terms_.kinematics.value(t, y, out);
  std::copy(y + terms_.n_q, y + size(), out);
  return Status::ok;
}

Status Motion::phi_jacobian(double t, const double* q) {
  if (phi_.matrix.rows() == 0) return Status::ok;
  if (!terms_.jacobian.function) {
    fill_sizes(q, terms_.n_q, size_.data());
    return terms_.constraints.jacobian(t, q, size_.data(), phi_);
  }
  if (terms_.jacobian.function(t, q, entries_.data()) == Status::stop) return Status::stop;
  read_entries(phi_.matrix, terms_.jacobian.entries);
  return Status::ok;
}

// ---------------------------------------------------------------------------------------------------------------------
// The accelerations

Status Motion::slope(double t, const double* y, double* out) {
  if (q_dot(t, y, out) == Status::stop) return Status::stop;
  if (accelerations(t, y, solution_) == Status::stop) return Status::stop;
  std::copy(solution_.a.begin(), solution_.a.end(), out + terms_.n_q);
  return Status::ok;
}

Status Motion::accelerations(double t, const double* y, ConstrainedSolution& found) {
  if (accelerations_at(t, y, found) == Status::stop) return Status::stop;
  if (!(found.pivot < nearly_singular) || !kept_psi_.empty() || terms_.kinematics.m() > 0) return Status::ok;
  ++singular_count_;
  if (found.pivot < too_near) {
    bool interpolated = false;
    if (interpolate(t, y, found, interpolated) == Status::stop) return Status::stop;
    if (interpolated) return Status::ok;
  }
  bool satisfied = false;
  if (satisfy(t, y, satisfied) == Status::stop) return Status::stop;
  return satisfied ? accelerations_at(t, satisfying_.data(), found) : Status::ok;
}

/// The speed at which the rows of A turn: the largest |γ_i| / (‖A_i‖ max |v|), since γ is −(dA/dt) v.
double Motion::turning() const {
  Eigen::VectorXd square = Eigen::VectorXd::Zero(A_.rows());
  for (Index j = 0; j < A_.outerSize(); ++j)
    for (SparseMatrix::InnerIterator it(A_, j); it; ++it) square[it.row()] += it.value() * it.value();
  double fastest = 0;
  for (Index i = 0; i < A_.rows(); ++i)
    if (square[i] > 0) fastest = std::max(fastest, std::abs(gamma_[i]) / std::sqrt(square[i]));
  double speed = 0;
  for (const double v : q_dot_) speed = std::max(speed, std::abs(v));
  return speed > 0 ? fastest / speed : 0;
}

/// Takes for `found` what interpolation gives from (q + s v, v), put on the constraints. Not `interpolated`: there is
/// no motion, or the positions beside are about as near to a singular one.
Status Motion::interpolate(double t, const double* y, ConstrainedSolution& found, bool& interpolated) {
  const double s = spacing / turning();
  if (!std::isfinite(s)) return Status::ok;
  ConstrainedSolution sum{.a = Eigen::VectorXd::Zero(found.a.size()),
                          .lambda = Eigen::VectorXd::Zero(found.lambda.size()),
                          .pivot = found.pivot};
  for (std::size_t k = 0; k < interpolation.size(); ++k)
    for (const double side : {1.0, -1.0}) {
      const double away = side * std::sqrt(static_cast<double>(k + 1)) * s;
      std::copy(y, y + size(), shifted_.begin());
      for (std::size_t j = 0; j < terms_.n_q; ++j) shifted_[j] += away * y[terms_.n_q + j];
      bool satisfied = false;
      if (satisfy(t + away, shifted_.data(), satisfied) == Status::stop) return Status::stop;
      if (!satisfied) return Status::ok;
      if (accelerations_at(t + away, satisfying_.data(), there_) == Status::stop) return Status::stop;
      if (!(there_.pivot >= far_enough)) return Status::ok;
      sum.a += interpolation[k] * there_.a;
      sum.lambda += interpolation[k] * there_.lambda;
      sum.rank = there_.rank;
      sum.unique = there_.unique;
    }
  found = std::move(sum);
  interpolated = true;
  return Status::ok;
}

Status Motion::accelerations_at(double t, const double* y, ConstrainedSolution& found) {
  if (mass(t, y) == Status::stop || terms_.force(t, y, force_.data()) == Status::stop || rows(t, y) == Status::stop)
    return Status::stop;
  const auto finite = [](const auto& values, Index count) {
    return all_finite(values, static_cast<std::size_t>(count));
  };
  if (!finite(M().valuePtr(), M().nonZeros()) || !finite(force_.data(), force_.size()) ||
      !finite(A_.valuePtr(), A_.nonZeros()) || !finite(gamma_.data(), gamma_.size())) {
    found = {.a = Eigen::VectorXd::Constant(index(terms_.n_v), undefined),
             .lambda = Eigen::VectorXd::Constant(A_.rows(), undefined)};
    return Status::ok;
  }
  solve(force_, gamma_, found);
  return Status::ok;
}

void Motion::solve(const Eigen::VectorXd& Q, const Eigen::VectorXd& gamma, ConstrainedSolution& found) {
  if (sparse_) {
    ++sparse_count_;
    if (saddle_.solve(M(), A_, Q, gamma, found)) return;
  }
  ++dense_count_;
  found = solve_saddle(Eigen::MatrixXd(M()), Eigen::MatrixXd(A_), Q, gamma, terms_.dependent);
}

/// The (q, v) with φ = 0 and φ' = 0 that is nearest to y, in the metric of M, in `satisfying_`. Not found: Newton's
/// iteration does not converge.
Status Motion::satisfy(double t, const double* y, bool& found) {
  found = false;
  std::copy(y, y + size(), satisfying_.begin());
  double size = std::numeric_limits<double>::infinity(), before = size;
  for (int k = 0; k < most_corrections; ++k) {
    if (correct_positions(t, size) == Status::stop) return Status::stop;
    if (!(size < before)) break;  // roundoff, or nothing to converge to
    before = size;
  }
  const auto q = Eigen::Map<const Eigen::VectorXd>(satisfying_.data(), index(terms_.n_q));
  if (!(before <= last_correction * q.cwiseAbs().maxCoeff())) return Status::ok;
  found = true;
  return correct_velocities(t);
}

/// One iteration, by the system of the accelerations without forces: M δ = Φᵀ μ, Φ δ = −φ. `size`: max |δ|.
Status Motion::correct_positions(double t, double& size) {
  double* q = satisfying_.data();
  if (mass(t, q) == Status::stop || row_values(t, q) == Status::stop) return Status::stop;
  if (positions(t, q, rest_.data()) == Status::stop) return Status::stop;
  rest_ = -rest_;
  solve(nothing_, rest_, correction_);
  size = correction_.a.cwiseAbs().maxCoeff();
  if (std::isfinite(size)) Eigen::Map<Eigen::VectorXd>(q, index(terms_.n_q)) += correction_.a;
  return Status::ok;
}

Status Motion::correct_velocities(double t) {
  double* q = satisfying_.data();
  if (mass(t, q) == Status::stop || row_values(t, q) == Status::stop) return Status::stop;
  if (rates(t, q, rest_.data()) == Status::stop) return Status::stop;
  rest_ = -rest_;
  solve(nothing_, rest_, correction_);
  Eigen::Map<Eigen::VectorXd>(q + terms_.n_q, index(terms_.n_v)) += correction_.a;
  return Status::ok;
}

/// A v' = γ, where A = (Φ K_v, ψ_v).
Status Motion::rows(double t, const double* y) {
  if (A_.rows() == 0) return Status::ok;
  return row_values(t, y) == Status::stop ? Status::stop : curvatures(t, y);
}

Status Motion::row_values(double t, const double* y) {
  if (phi_jacobian(t, y) == Status::stop) return Status::stop;
  if (terms_.kinematics.m() > 0 && !kept_phi_.empty()) {
    if (terms_.kinematics.jacobian(t, y, ones_.data(), kinematics_by_v_) == Status::stop) return Status::stop;
    phi_by_v_ = phi_.matrix * kinematics_by_v_.matrix;
  } else {
    std::copy_n(phi_.matrix.valuePtr(), phi_.matrix.nonZeros(), phi_by_v_.valuePtr());
  }
  if (!kept_psi_.empty() && terms_.velocity_constraints.jacobian(t, y, ones_.data(), psi_by_v_) ==
                                Status::stop)  // linear in v: any increment
    return Status::stop;
  assemble();
  return Status::ok;
}

/// The rows that are kept, those of φ before those of ψ.
void Motion::assemble() {
  const bool first = A_.nonZeros() == 0;
  std::vector<Eigen::Triplet<double>> entries;
  double* value = A_.valuePtr();
  const auto take = [&](const SparseMatrix& from, const std::vector<int>& place, Index j) {
    for (SparseMatrix::InnerIterator it(from, j); it; ++it) {
      const int row = place[static_cast<std::size_t>(it.row())];
      if (row < 0) continue;
      if (first)
        entries.emplace_back(row, static_cast<int>(j), 1.0);
      else
        *value++ = it.value();
    }
  };
  for (Index j = 0; j < A_.cols(); ++j) {
    take(phi_by_v_, place_phi_, j);
    take(psi_by_v_.matrix, place_psi_, j);
  }
  if (first) A_.setFromTriplets(entries.begin(), entries.end());
}

/// γ: minus what the second derivatives along the motion leave, −(φ″ + Φ κ) with the rate κ of K at fixed v, and
/// −dψ/dt at fixed v.
Status Motion::curvatures(double t, const double* y) {
  const std::size_t n_q = terms_.n_q;
  if (q_dot(t, y, q_dot_.data()) == Status::stop) return Status::stop;
  std::copy(q_dot_.begin(), q_dot_.end(), along_.begin());
  std::fill(along_.begin() + static_cast<std::ptrdiff_t>(n_q), along_.end(), 0.0);
  if (!kept_phi_.empty()) {
    std::fill(terms_of_rate_.begin(), terms_of_rate_.end(), 0.0);
    for (Index j = 0; j < phi_.matrix.outerSize(); ++j)
      for (SparseMatrix::InnerIterator it(phi_.matrix, j); it; ++it)
        terms_of_rate_[static_cast<std::size_t>(it.row())] +=
            std::abs(it.value() * q_dot_[static_cast<std::size_t>(j)]);
    if (terms_.constraints.curvature(t, y, 1, q_dot_.data(), values_.data(), terms_of_rate_.data()) == Status::stop)
      return Status::stop;
    if (terms_.kinematics.m() > 0) {
      if (terms_.kinematics.slope(t, y, 1, along_.data(), bend_.data()) == Status::stop) return Status::stop;
      Eigen::Map<Eigen::VectorXd> curvature(values_.data(), phi_.matrix.rows());
      curvature += phi_.matrix * Eigen::Map<const Eigen::VectorXd>(bend_.data(), index(n_q));
    }
    keep_values(kept_phi_, gamma_.data(), -1);
  }
  if (kept_psi_.empty()) return Status::ok;
  if (terms_.velocity_constraints.slope(t, y, 1, along_.data(), values_.data()) == Status::stop) return Status::stop;
  keep_values(kept_psi_, gamma_.data() + m_phi(), -1);
  return Status::ok;
}

// ---------------------------------------------------------------------------------------------------------------------
// The laws

Status Motion::mass_values(double t, const double* y, double* out) {
  if (mass(t, y) == Status::stop) return Status::stop;
  const std::size_t n = terms_.n_v;
  std::fill(out, out + mass_size(), 0.0);
  for (Index j = 0; j < M().outerSize(); ++j)
    for (SparseMatrix::InnerIterator it(M(), j); it; ++it) {
      const auto row = static_cast<std::size_t>(it.row()), column = static_cast<std::size_t>(j);
      if (!diagonal_mass_) out[row * n + column] = it.value();
      if (diagonal_mass_ && row == column) out[row] = it.value();
    }
  return Status::ok;
}

Status Motion::positions(double t, const double* y, double* out) {
  if (terms_.constraints.value(t, y, values_.data()) == Status::stop) return Status::stop;
  keep_values(kept_phi_, out);
  return Status::ok;
}

void Motion::keep_values(const std::vector<std::size_t>& kept, double* out, double sign) const {
  for (const std::size_t i : kept) *out++ = sign * values_[i];
}

/// φ' along the motion.
Status Motion::rates(double t, const double* y, double* out) {
  if (q_dot(t, y, q_dot_.data()) == Status::stop) return Status::stop;
  if (terms_.constraints.slope(t, y, 1, q_dot_.data(), values_.data()) == Status::stop) return Status::stop;
  keep_values(kept_phi_, out);
  return Status::ok;
}

/// ∂φ'/∂(q, v). By the symmetry of second derivatives ∂/∂q (Φ K + φ_t) = dΦ/dt along the motion + Φ K_q.
Status Motion::differentiate_rates(double t, const double* y) {
  const std::size_t n_q = terms_.n_q;
  if (q_dot(t, y, q_dot_.data()) == Status::stop) return Status::stop;
  const double h = along_increment * reach(t, y, n_q, 1, q_dot_.data());
  for (const double side : {1.0, -1.0}) {
    for (std::size_t j = 0; j < n_q; ++j) beside_[j] = y[j] + side * h * q_dot_[j];
    if (phi_jacobian(t + side * h, beside_.data()) == Status::stop) return Status::stop;
    double* value = phi_by_time_.valuePtr();
    for (Index p = 0; p < phi_.matrix.nonZeros(); ++p)
      value[p] = side > 0 ? phi_.matrix.valuePtr()[p] : (value[p] - phi_.matrix.valuePtr()[p]) / (2 * h);
  }
  if (phi_jacobian(t, y) == Status::stop) return Status::stop;
  if (terms_.kinematics.m() > 0) {
    fill_sizes(y, size(), size_.data());
    if (terms_.kinematics.jacobian(t, y, size_.data(), kinematics_) == Status::stop) return Status::stop;
  }
  combine_rates();
  return Status::ok;
}

/// (dΦ/dt, Φ), or (dΦ/dt, 0) + Φ K_(q, v).
void Motion::combine_rates() {
  const SparseMatrix by_time = placed(phi_by_time_, 0, index(size()));
  if (terms_.kinematics.m() == 0)
    rates_ = by_time + placed(phi_.matrix, index(terms_.n_q), index(size()));
  else
    rates_ = by_time + SparseMatrix(phi_.matrix * kinematics_.matrix);
}

Status Motion::velocities(double t, const double* y, double* out) {
  if (terms_.velocity_constraints.value(t, y, values_.data()) == Status::stop) return Status::stop;
  keep_values(kept_psi_, out);
  return Status::ok;
}

Status Motion::differentiate(Part jacobian, double t, const double* y) {
  if (jacobian == Part::positions_jacobian) return phi_jacobian(t, y);
  if (jacobian == Part::rates_jacobian) return differentiate_rates(t, y);
  fill_sizes(y, size(), size_.data());
  return terms_.velocity_constraints.jacobian(t, y, size_.data(), psi_);
}

const SparseMatrix& Motion::derivative(Part jacobian) const {
  if (jacobian == Part::velocities_jacobian) return psi_.matrix;
  return jacobian == Part::positions_jacobian ? phi_.matrix : rates_;
}

void Motion::write_rows(const SparseMatrix& from, const std::vector<std::size_t>& kept, bool all, double* out) const {
  const Rows rows(from);
  if (all) std::fill(out, out + kept.size() * size(), 0.0);
  for (const std::size_t i : kept) {
    for (Rows::InnerIterator it(rows, index(i)); it; ++it) {
      if (all)
        out[it.col()] = it.value();
      else
        *out++ = it.value();
    }
    if (all) out += size();
  }
}

RowPattern Motion::pattern(Part jacobian) const {
  const Rows all(derivative(jacobian));
  RowPattern pattern{.starts = {0}, .columns = {}};
  for (const std::size_t i : kept(jacobian)) {
    const int* columns = all.innerIndexPtr();
    pattern.columns.insert(pattern.columns.end(), columns + all.outerIndexPtr()[i],
                           columns + all.outerIndexPtr()[i + 1]);
    pattern.starts.push_back(pattern.columns.size());
  }
  return pattern;
}

Callback Motion::entries(Part jacobian) {
  switch (jacobian) {
    case Part::positions_jacobian: return {&entry<&Motion::jacobian_rows<Part::positions_jacobian, false>>, this};
    case Part::rates_jacobian: return {&entry<&Motion::jacobian_rows<Part::rates_jacobian, false>>, this};
    case Part::velocities_jacobian: return {&entry<&Motion::jacobian_rows<Part::velocities_jacobian, false>>, this};
    default: return {};
  }
}

}  // namespace invariode
