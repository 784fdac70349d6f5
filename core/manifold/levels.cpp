#include "manifold/levels.hpp"

#include <algorithm>
#include <cmath>
#include <numeric>

#include "require.hpp"

namespace invariode {
namespace {

// A row of which less than this is left in the components that may move does not depend on them: roundoff.
constexpr double roundoff_share = 1e-13;
// Rows of which less is left than this nearly depend on others: roundoff of their residuals makes corrections of ε / σ
// in q, and of ε / σ² in v.
constexpr double nearly_dependent = 0.01;
// From this many rows on, sparse factors take less time than a dense basis (benchmarks/manifolds.py).
constexpr std::size_t many_rows = 30;

std::vector<char> mask_of(const InvariantBlock& block, std::size_t n) {
  std::vector<char> mask(n, block.moves.empty() ? 1 : 0);
  for (const std::size_t j : block.moves) {
    require(j < n, "an invariant may move components that the state does not have");
    mask[j] = 1;
  }
  return mask;
}

}  // namespace

bool Levels::needed(const Invariants& invariants) {
  if (invariants.layout().sparse() && invariants.m() >= many_rows && !invariants.along_steps() &&
      !invariants.any_one_sided())
    return true;
  return told(invariants.blocks());
}

bool Levels::told(const std::vector<InvariantBlock>& blocks) {
  return std::ranges::any_of(
      blocks, [](const InvariantBlock& block) { return block.level != 0 || !block.moves.empty() || block.metric; });
}

Levels::Levels(const Invariants& invariants)
    : layout_(invariants.layout()),
      n_(invariants.n()),
      m_(invariants.m()),
      norm_(m_),
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
    require(known.moves == mask, "invariants of one level may move different components");
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

void Levels::keep(const char* fixed) {
  for (Level& level : levels_)
    if (level.metric) level.metric->keep(fixed);
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

/// Solves, with sparse factors, the equations (0, …, 0, r_l) of the levels up to l. False: some depend on others, or a
/// metric is not diagonal, or a part of a level is idle (the order of its factors is that of all its rows).
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
  basis_.provide(n_, m_);
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
    const std::size_t before = add_to_basis(threshold);
    waiting_.clear();
    for (const std::size_t row : levels_[l].rows) {
      if (idle(row)) continue;
      if (norm_[row] > 0) waiting_.push_back(row);
      left_out_[row] = 1;  // unless it becomes a pivot
    }
    const std::size_t added = add_to_basis(threshold);
    for (std::size_t k = 0; k < added; ++k) left_out_[waiting_[k]] = 0;
    rank += added;
    correct(levels_[l], before, J, r, noise, w, delta);
  }
  return rank;
}

/// The waiting rows, as long as one is left with more than `threshold` of its length.
std::size_t Levels::add_to_basis(double threshold) {
  return basis_.add(waiting_, [threshold](std::size_t, double length) { return length <= threshold; });
}

/// The rows of J W, or those in the level's metric, cut to the components that it may move, scaled to norm 1; norm 0:
/// nothing is left of the row.
void Levels::take_rows(const double* J, const double* w, Level& level) {
  for (std::size_t i = 0; i < m_; ++i) {
    double* row = basis_.vector(i).data();
    double all = 0;
    std::fill(row, row + n_, 0);
    layout_.row(i, J).for_each([&](std::size_t j, double value) {
      row[j] = value * w[j];
      all = std::max(all, std::abs(row[j]));
      if (level.moves[j] == 0) row[j] = 0;
    });
    norm_[i] = basis_.vector(i).stableNorm();
    if (norm_[i] <= roundoff_share * all) norm_[i] = 0;
    if (norm_[i] > 0 && level.by_metric()) apply_metric(J, i, level);
    if (norm_[i] > 0) basis_.vector(i) /= norm_[i];
  }
}

void Levels::apply_metric(const double* J, std::size_t row, Level& level) {
  std::fill(gradient_.begin(), gradient_.end(), 0);
  layout_.row(row, J).for_each([&](std::size_t j, double value) { gradient_[j] = value; });
  level.metric->divide(gradient_.data(), basis_.vector(row).data());
  norm_[row] = basis_.vector(row).stableNorm();
}

/// Returns the roundoff of the combination of rows that is basis vector i: of its own residual, of the residual it
/// leaves in the levels before, and in the combinations before, from member `first` on.
double Levels::noise_of(std::size_t i, std::size_t first, const double* J, const double* noise) const {
  double sum = noise[i];
  layout_.row(i, J).for_each([&](std::size_t j, double value) { sum += std::abs(value) * open_[j]; });
  sum /= norm_[i];
  const std::vector<std::size_t>& members = basis_.members();
  for (std::size_t l = first; members[l] != i; ++l) sum += std::abs(basis_.R(members[l], i)) * doubt_[members[l]];
  return sum;
}

/// δ += δ_l, in the part of the basis from `first` on: what is before belongs to earlier levels.
void Levels::correct(Level& level, std::size_t first, const double* J, const double* r, const double* noise,
                     const double* w, double* delta) {
  const bool by_metric = level.by_metric();
  std::fill(delta_l_.begin(), delta_l_.end(), 0);
  std::fill(open_l_.begin(), open_l_.end(), 0);
  const auto rest = [&](std::size_t i) {  // of row i, after the levels before
    double left = r[i];
    layout_.row(i, J).for_each([&](std::size_t j, double value) { left -= value * delta[j]; });
    return left / norm_[i];
  };
  basis_.solve(first, rest, [&](std::size_t i, double& z) {
    const double pivot = basis_.R(i, i), roundoff = noise_of(i, first, J, noise);
    const bool doubtful = pivot < nearly_dependent;
    doubt_[i] = roundoff / pivot;
    if (doubtful && std::abs(z) <= doubt_[i]) z = 0;
    const auto q = basis_.vector(i);
    for (std::size_t j = 0; j < n_; ++j) {
      const double direction = (by_metric ? 1 : w[j]) * q[index(j)];
      delta_l_[j] += direction * z;
      if (doubtful) open_l_[j] += direction * doubt_[i];
    }
  });
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
