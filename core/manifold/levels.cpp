#include "manifold/levels.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <stdexcept>

namespace invariode {
namespace {

// A row of which less than this is left in the components that may move does not depend on them: roundoff.
constexpr double least_share = 1e-13;
// Rows of which less is left than this nearly depend on others: roundoff of their residuals makes corrections of ε / σ
// in q, and of ε / σ² in v.
constexpr double nearly_dependent = 0.01;

Eigen::Index index(std::size_t i) { return static_cast<Eigen::Index>(i); }

std::vector<char> mask_of(const InvariantBlock& block, std::size_t n) {
  std::vector<char> mask(n, block.moves.empty() ? 1 : 0);
  for (const std::size_t j : block.moves) {
    if (j >= n) throw std::invalid_argument("an invariant may move components that the state does not have");
    mask[j] = 1;
  }
  return mask;
}

}  // namespace

bool Levels::needed(const Invariants& invariants) {
  return std::any_of(invariants.blocks().begin(), invariants.blocks().end(), [](const InvariantBlock& block) {
    return block.level != 0 || !block.moves.empty() || block.metric;
  });
}

Levels::Levels(const Invariants& invariants)
    : layout_(invariants.layout()),
      n_(invariants.n()),
      m_(invariants.m()),
      norm_(m_),
      z_(m_),
      delta_l_(n_),
      gradient_(n_),
      scale_(n_),
      doubt_(m_),
      open_l_(n_),
      open_(n_),
      left_out_(m_) {
  std::size_t row = 0;
  for (const InvariantBlock& block : invariants.blocks()) {
    Level& level = level_of(block);
    for (std::size_t end = row + block.m; row < end; ++row) level.rows.push_back(row);
  }
  std::sort(levels_.begin(), levels_.end(), [](const Level& a, const Level& b) { return a.number < b.number; });
  const bool by_sparse_factors =
      layout_.sparse() && std::ranges::all_of(levels_, [](const Level& level) { return level.diagonal(); });
  if (!by_sparse_factors) reserve_dense();
}

/// For the dense process, which sparse factors need only where rows depend on each other.
void Levels::reserve_dense() {
  if (R_.size() > 0) return;
  scaled_.resize(index(n_), index(m_));
  R_.resize(index(m_), index(m_));
  basis_.reserve(m_);
  waiting_.reserve(m_);
}

Levels::Level& Levels::level_of(const InvariantBlock& block) {
  std::vector<char> mask = mask_of(block, n_);
  std::vector<std::size_t> components = block.moves;
  if (components.empty()) {
    components.resize(n_);
    std::iota(components.begin(), components.end(), std::size_t{0});
  }
  for (Level& known : levels_) {
    if (known.number != block.level) continue;
    if (known.moves != mask) throw std::invalid_argument("invariants of one level may move different components");
    return known;
  }
  Level& level = levels_.emplace_back(Level{block.level, std::move(mask), {}, {}, {}});
  if (block.metric) level.metric.emplace(block.metric, std::move(components));
  return level;
}

Status Levels::update(double t, const double* y) {
  for (Level& level : levels_)
    if (level.metric && level.metric->update(t, y) == Status::stop) return Status::stop;
  return Status::ok;
}

std::size_t Levels::solve(const double* J, const double* r, const double* noise, const double* w, double threshold,
                          const char* idle, double* delta) {
  std::fill(left_out_.begin(), left_out_.end(), 0);
  idle_ = idle;
  if (layout_.sparse() && solve_sparse(J, r, w, std::max(threshold, nearly_dependent), delta)) {
    std::size_t rank = m_;
    for (const Level& level : levels_) rank -= idle_rows(level);
    return rank;
  }
  return solve_dense(J, r, noise, w, threshold, delta);
}

std::size_t Levels::idle_rows(const Level& level) const {
  return static_cast<std::size_t>(
      std::count_if(level.rows.begin(), level.rows.end(), [this](std::size_t row) { return idle(row); }));
}

/// The same with sparse factors of the equations (0, …, 0, r_l) of the levels up to l. False: some depend on others, or
/// a metric is not diagonal, or a part of a level is idle (the order of its factors is that of all its rows).
bool Levels::solve_sparse(const double* J, const double* r, const double* w, double threshold, double* delta) {
  std::fill(delta, delta + n_, 0);
  std::vector<std::size_t> rows;
  std::vector<double> rest;
  for (Level& level : levels_) {
    const std::size_t resting = idle_rows(level);
    if (resting == level.rows.size()) continue;
    if (resting > 0 || !scales(level, w)) return false;
    rest.assign(rows.size(), 0);
    rows.insert(rows.end(), level.rows.begin(), level.rows.end());
    for (const std::size_t i : level.rows) rest.push_back(r[i] - layout_.row(i, J).dot(delta));
    if (!level.sparse.least_norm(layout_, J, rows, scale_, rest, threshold, delta_l_)) return false;
    for (std::size_t j = 0; j < n_; ++j) delta[j] += delta_l_[j];
  }
  return true;
}

/// W of the components that the level may move, or G^(-1/2) of its metric. False: that is not diagonal.
bool Levels::scales(Level& level, const double* w) {
  for (std::size_t j = 0; j < n_; ++j) scale_[j] = level.moves[j] != 0 ? w[j] : 0;
  if (!level.by_metric()) return true;
  if (!level.metric->diagonal()) return false;
  for (std::size_t j = 0; j < n_; ++j) gradient_[j] = level.moves[j] != 0 ? 1 : 0;
  level.metric->divide(gradient_.data(), scale_.data());
  return true;
}

std::size_t Levels::solve_dense(const double* J, const double* r, const double* noise, const double* w,
                                double threshold, double* delta) {
  reserve_dense();
  std::fill(open_.begin(), open_.end(), 0);
  std::fill(delta, delta + n_, 0);
  std::size_t rank = 0;
  for (std::size_t l = 0; l < levels_.size(); ++l) {
    take_rows(J, w, levels_[l]);
    basis_.clear();
    waiting_.clear();
    for (std::size_t k = 0; k < l; ++k)
      for (const std::size_t row : levels_[k].rows)
        if (!idle(row) && left_out_[row] == 0 && norm_[row] > 0) waiting_.push_back(row);
    orthonormalize(waiting_, threshold);
    const std::size_t before = basis_.size();
    waiting_.clear();
    for (const std::size_t row : levels_[l].rows) {
      if (idle(row)) continue;
      if (norm_[row] > 0) waiting_.push_back(row);
      left_out_[row] = 1;  // unless it becomes a pivot
    }
    orthonormalize(waiting_, threshold);
    for (std::size_t k = before; k < basis_.size(); ++k) left_out_[basis_[k]] = 0;
    rank += basis_.size() - before;
    correct(levels_[l], before, J, r, noise, w, delta);
  }
  return rank;
}

/// The rows of J W, or those in the level's metric, cut to the components that it may move, scaled to norm 1; norm 0:
/// nothing is left of the row.
void Levels::take_rows(const double* J, const double* w, Level& level) {
  R_.setZero();
  for (std::size_t i = 0; i < m_; ++i) {
    double* row = &scaled_(0, index(i));
    double all = 0;
    std::fill(row, row + n_, 0);
    layout_.row(i, J).for_each([&](std::size_t j, double value) {
      row[j] = value * w[j];
      all = std::max(all, std::abs(row[j]));
      if (level.moves[j] == 0) row[j] = 0;
    });
    norm_[i] = scaled_.col(index(i)).stableNorm();
    if (norm_[i] <= least_share * all) norm_[i] = 0;
    if (norm_[i] > 0 && level.by_metric()) apply_metric(J, i, level);
    if (norm_[i] > 0) scaled_.col(index(i)) /= norm_[i];
  }
}

void Levels::apply_metric(const double* J, std::size_t row, Level& level) {
  std::fill(gradient_.begin(), gradient_.end(), 0);
  layout_.row(row, J).for_each([&](std::size_t j, double value) { gradient_[j] = value; });
  level.metric->divide(gradient_.data(), &scaled_(0, index(row)));
  norm_[row] = scaled_.col(index(row)).stableNorm();
}

/// Adds to the basis what the rows do not have in common with it, by the modified Gram-Schmidt process with pivoting,
/// each pivot orthogonalised twice. The basis ends where a row is left with `threshold` of its length.
void Levels::orthonormalize(std::vector<std::size_t>& rows, double threshold) {
  for (const std::size_t i : rows)
    for (const std::size_t q : basis_) remove_component(i, q);
  while (!rows.empty()) {
    std::size_t pivot = 0;
    for (std::size_t k = 1; k < rows.size(); ++k)
      if (scaled_.col(index(rows[k])).norm() > scaled_.col(index(rows[pivot])).norm() * (1 + least_share)) pivot = k;
    const std::size_t i = rows[pivot];
    rows.erase(rows.begin() + static_cast<std::ptrdiff_t>(pivot));
    for (const std::size_t q : basis_) remove_component(i, q);
    const double size = scaled_.col(index(i)).norm();
    if (size <= threshold) return;
    scaled_.col(index(i)) /= size;
    R_(index(i), index(i)) = size;
    basis_.push_back(i);
    for (const std::size_t k : rows) remove_component(k, i);
  }
}

/// Takes out of a row what it has of a basis vector, and notes it in R.
void Levels::remove_component(std::size_t row, std::size_t basis_row) {
  const double component = scaled_.col(index(basis_row)).dot(scaled_.col(index(row)));
  scaled_.col(index(row)) -= component * scaled_.col(index(basis_row));
  R_(index(basis_row), index(row)) += component;
}

/// What roundoff makes of the combination of rows that is basis vector k: of its own residual, of what it leaves open
/// in the levels before, and in the combinations before.
double Levels::noise_of(std::size_t k, std::size_t first, const double* J, const double* noise) const {
  const std::size_t i = basis_[k];
  double sum = noise[i];
  layout_.row(i, J).for_each([&](std::size_t j, double value) { sum += std::abs(value) * open_[j]; });
  sum /= norm_[i];
  for (std::size_t l = first; l < k; ++l) sum += std::abs(R_(index(basis_[l]), index(i))) * doubt_[l];
  return sum;
}

/// δ += δ_l, in the part of the basis from `first` on: what is before belongs to earlier levels.
void Levels::correct(Level& level, std::size_t first, const double* J, const double* r, const double* noise,
                     const double* w, double* delta) {
  const bool by_metric = level.by_metric();
  std::fill(delta_l_.begin(), delta_l_.end(), 0);
  std::fill(open_l_.begin(), open_l_.end(), 0);
  for (std::size_t k = first; k < basis_.size(); ++k) {
    const std::size_t i = basis_[k];
    double rest = r[i];  // r_i − J_i δ of the levels before
    layout_.row(i, J).for_each([&](std::size_t j, double value) { rest -= value * delta[j]; });
    double sum = rest / norm_[i];
    for (std::size_t l = first; l < k; ++l) sum -= R_(index(basis_[l]), index(i)) * z_[l];
    const double pivot = R_(index(i), index(i)), roundoff = noise_of(k, first, J, noise);
    const bool doubtful = pivot < nearly_dependent;
    doubt_[k] = roundoff / pivot;
    z_[k] = doubtful && std::abs(sum) <= roundoff ? 0 : sum / pivot;
    for (std::size_t j = 0; j < n_; ++j) {
      const double direction = (by_metric ? 1 : w[j]) * scaled_(index(j), index(i));
      delta_l_[j] += direction * z_[k];
      if (doubtful) open_l_[j] += direction * doubt_[k];
    }
  }
  if (by_metric) {
    level.metric->divide_transposed(delta_l_.data());
    level.metric->divide_transposed(open_l_.data());
  }
  for (std::size_t j = 0; j < n_; ++j) {
    delta[j] += delta_l_[j];
    open_[j] += std::abs(open_l_[j]);
  }
}

}  // namespace invariode
