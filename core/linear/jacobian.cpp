#include "linear/jacobian.hpp"

#include <algorithm>
#include <bit>
#include <cassert>
#include <cmath>
#include <utility>

#include "linear/groups.hpp"
#include "linear/pattern.hpp"
#include "linear/time_derivative.hpp"

namespace invariode {
namespace {

// Salane's thresholds for |Δf| / |f| (docs/algorithms.md, 'Jacobians').
const double lost = std::pow(eps, 7.0 / 8);   // the difference is roundoff: try a larger increment at once
const double small = std::pow(eps, 3.0 / 4);  // next time a larger one
const double large = std::pow(eps, 1.0 / 4);  // next time a smaller one
const double first_factor = std::sqrt(eps);
constexpr double least_factor = 1000 * eps;
constexpr double greatest_factor = 0.1;
constexpr double factor_step = 10;
constexpr double bolder = 100;      // of increments that have to change f
constexpr double noise_units = 10;  // of ε |f_i|: a change of f_i up to this is roundoff in every digit that matters
const double wide_factor = large;   // its truncation error is far below the roundoff that it replaces
constexpr double complex_increment = 1e-40;  // its square is nothing beside 1, and products of y and it do not vanish
constexpr std::size_t most_entries = std::size_t{1} << 27U;  // of a pattern that has grown: half a gigabyte
constexpr std::size_t always_sought = 256;         // up to this n a pattern is sought even if it is rather full
constexpr std::int64_t most_calls_per_column = 4;  // of such a search: far more than columns one by one would take

/// Compressed columns of an n × n matrix, each with ascending rows.
bool well_formed(std::size_t n, const std::vector<int>& starts, const std::vector<int>& rows) {
  if (starts.size() != n + 1 || starts.front() != 0 || !std::ranges::is_sorted(starts) ||
      !std::in_range<int>(rows.size()) || starts.back() != static_cast<int>(rows.size()))
    return false;
  for (std::size_t j = 0; j < n; ++j) {
    int above = -1;
    for (int p = starts[j]; p < starts[j + 1]; ++p) {
      const int row = rows[static_cast<std::size_t>(p)];
      if (row <= above || row >= static_cast<int>(n)) return false;
      above = row;
    }
  }
  return true;
}

/// Entries of one row in all columns.
Pattern full_row(std::size_t n, std::size_t row) {
  Pattern pattern{.starts = std::vector<int>(n + 1), .rows = std::vector<int>(n, static_cast<int>(row))};
  for (std::size_t j = 0; j <= n; ++j) pattern.starts[j] = static_cast<int>(j);
  return pattern;
}

Pattern pattern_of(const Matrix& banded) {
  const auto& [kind, n, lower, upper] = banded.structure;
  Pattern pattern{.starts = {0}, .rows = {}};
  for (std::size_t j = 0; j < n; ++j) {
    for (std::size_t i = j > upper ? j - upper : 0; i <= std::min(n - 1, j + lower); ++i)
      pattern.rows.push_back(static_cast<int>(i));
    pattern.starts.push_back(static_cast<int>(pattern.rows.size()));
  }
  return pattern;
}

}  // namespace

Jacobian::Jacobian(const Source& source, Matrix matrix, const Weights& weights)
    : source_(source),
      kind_(source_.kind),
      matrix_(std::move(matrix)),
      weights_(weights),
      examined_(source_.found_pattern),
      check_(matrix_.n()) {
  if (computed() || kind_ == Kind::derived) group_columns();
}

/// Makes the vectors of evaluations. A copy that is never evaluated, as in a solver from which runs are made, has none.
void Jacobian::make_room() {
  const std::size_t n = matrix_.n();
  if (point_.size() == n || !groups_) return;
  make_factors();
  columns_.resize(n);
  point_.resize(n);
  moved_.resize(n);
  if (kind_ == Kind::complex_steps || source_.found_pattern) reach_.resize(n);
  if (kind_ == Kind::complex_steps) {
    complex_point_.resize(2 * n);
    complex_value_.resize(2 * n);
  }
}

void Jacobian::make_factors() {
  if (groups_ && factor_.empty()) factor_.assign(matrix_.n(), first_factor);
}

void Jacobian::end() {
  columns_ = std::vector<Column>();
  for (std::vector<double>* one : {&point_, &moved_, &reach_, &complex_point_, &complex_value_})
    *one = std::vector<double>();
  check_.rest();
}

/// Columns of one group have no row in common. Dense: one column a group. Banded: every (lower + upper + 1)-th, unless
/// there are entries outside.
void Jacobian::group_columns() {
  const auto& [kind, n, lower, upper] = matrix_.structure;
  const bool sparse = kind == Structure::Kind::sparse;
  if (!sparse && beyond_.starts.empty()) {
    const std::size_t count = kind == Structure::Kind::dense ? n : std::min(n, lower + upper + 1);
    std::vector<std::vector<std::size_t>> groups(count);
    for (std::size_t k = 0; k < count; ++k) groups[k].reserve((n - k + count - 1) / count);
    for (std::size_t j = 0; j < n; ++j) groups[j % count].push_back(j);
    groups_ = std::make_shared<const std::vector<std::vector<std::size_t>>>(std::move(groups));
    return;
  }
  groups_ = std::make_shared<const std::vector<std::vector<std::size_t>>>(invariode::group_columns(
      n, n, (sparse ? matrix_.starts : beyond_.starts).data(), (sparse ? matrix_.rows : beyond_.rows).data()));
}

Status Jacobian::evaluate(Callback& f, double t, const double* y, const double* slope) {
  if (kind_ == Kind::products) return Status::ok;
  matrix_.provide();
  make_room();
  switch (kind_) {
    case Kind::products:
    case Kind::constant: return Status::ok;
    case Kind::function: {
      ++count_;
      constexpr double nowhere = 0;  // the state of no components, which may have no address: M(t) alone is without one
      return source_.function(t, y != nullptr ? y : &nowhere, matrix_);
    }
    case Kind::derived: return derive(f, t, y, slope);
    case Kind::differences:
      ++count_;
      return examined_ ? difference_in_found_pattern(f, t, y, slope) : difference(f, t, y, slope);
    case Kind::complex_steps: return examined_complex_steps(f, t, y, slope);
  }
  return Status::ok;
}

Status Jacobian::time_derivative(Callback& f, double t, const double* y, const double* slope, double h, double* ft) {
  const std::size_t n = matrix_.n();
  if (!source_.rate) return invariode::time_derivative(f, t, y, slope, h, n, ft);
  if (source_.rate(t, y, ft) == Status::stop) return Status::stop;
  if (!all_finite(ft, n)) std::fill(ft, ft + n, 0.0);
  return Status::ok;
}

bool Jacobian::needs_slope() const {
  return kind_ == Kind::differences || (kind_ == Kind::complex_steps && examination_due());
}

/// Complex steps are examined at the evaluations 1, 2, 4, 8, …, so that errors that begin at some t are found before
/// they have lasted longer than the correct part, and after a failure.
bool Jacobian::examination_due() const {
  return doubtful_now_ || examined_ || std::has_single_bit(static_cast<std::uint64_t>(count_ + 1));
}

/// Forms complex steps, and differences from now on if f is not finite at complex y or does not agree, unless entries
/// are missing in a given structure.
Status Jacobian::examined_complex_steps(Callback& f, double t, const double* y, const double* slope) {
  const bool due = examination_due();
  ++count_;
  doubtful_now_ = false;
  bool finite = true;
  if (step_complex(t, y, finite) == Status::stop) return Status::stop;
  if (!finite) return abandon_complex_steps(f, t, y, slope);
  if (!due) return Status::ok;
  switch (examine(f, t, y, slope)) {
    case JacobianCheck::Verdict::stop: return Status::stop;
    case JacobianCheck::Verdict::wrong: break;
    case JacobianCheck::Verdict::right: return Status::ok;
  }
  bool larger = false;
  const bool structured = matrix_.structure.kind != Structure::Kind::dense && !source_.found_pattern;
  if (structured && enlarge_pattern(f, t, y, slope, reach_, larger) == Status::stop) return Status::stop;
  if (larger) return step_complex(t, y, finite);
  return misfit_ ? Status::ok
                 : abandon_complex_steps(f, t, y, slope);  // bands are known to miss entries: so it must be
}

Status Jacobian::step_complex(double t, const double* y, bool& finite) {
  const std::size_t n = matrix_.n();
  for (std::size_t j = 0; j < n; ++j) complex_point_[2 * j] = y[j], complex_point_[2 * j + 1] = 0;
  for (const std::vector<std::size_t>& group : *groups_) {
    for (const std::size_t j : group) complex_point_[2 * j + 1] = complex_increment * scale(j, y);
    if (source_.complex_f(t, complex_point_.data(), complex_value_.data()) == Status::stop) return Status::stop;
    finite = finite && all_finite(complex_value_.data(), complex_value_.size());
    for (const std::size_t j : group) {
      const double h = std::exchange(complex_point_[2 * j + 1], 0);
      for_each_in_column(j, [&](std::size_t i, double& value) { value = complex_value_[2 * i + 1] / h; });
    }
  }
  return Status::ok;
}

/// Forms differences where derivatives are not finite, as at the edge of a domain (√y at 0).
Status Jacobian::derive(Callback& f, double t, const double* y, const double* slope) {
  ++count_;
  noise_ = 0;
  const Status formed = source_.product ? multiply_groups(t, y) : source_.function(t, y, matrix_);
  if (formed == Status::stop) return Status::stop;
  if (all_finite(matrix_.values.data(), matrix_.values.size())) return Status::ok;
  return difference_anywhere(f, t, y, slope);
}

/// J v with v = 1 in the columns of a group, which share no row, holds the entries of all of them.
Status Jacobian::multiply_groups(double t, const double* y) {
  const std::size_t n = matrix_.n();
  std::vector<double> both(2 * n, 0.0);
  std::copy(y, y + n, both.begin());
  for (const std::vector<std::size_t>& columns : *groups_) {
    for (const std::size_t j : columns) both[n + j] = 1;
    if (source_.product(t, both.data(), moved_.data()) == Status::stop) return Status::stop;
    for (const std::size_t j : columns) {
      both[n + j] = 0;
      for_each_in_column(j, [&](std::size_t i, double& value) { value = moved_[i]; });
    }
  }
  return Status::ok;
}

Status Jacobian::abandon_complex_steps(Callback& f, double t, const double* y, const double* slope) {
  kind_ = Kind::differences;
  abandoned_complex_steps_ = t;
  return difference_anywhere(f, t, y, slope);
}

/// f(t, y) is at hand only where it was needed.
Status Jacobian::difference_anywhere(Callback& f, double t, const double* y, const double* slope) {
  std::vector<double> own;
  if (slope == nullptr) {
    own.resize(matrix_.n());
    if (f(t, y, own.data()) == Status::stop) return Status::stop;
    slope = own.data();
  }
  return examined_ ? difference_in_found_pattern(f, t, y, slope) : difference(f, t, y, slope);
}

/// Complex steps tell no increments: √ε of the weights. Differences: their own, which have been seen to change f.
JacobianCheck::Verdict Jacobian::examine(Callback& f, double t, const double* y, const double* slope) {
  for (std::size_t j = 0; j < matrix_.n(); ++j)
    reach_[j] = kind_ == Kind::complex_steps ? first_factor * scale(j, y) : std::abs(columns_[j].increment);
  return check_.examine(f, t, y, slope, matrix_, reach_.data(), static_cast<std::size_t>(count_), box_);
}

void Jacobian::extend(const double* y, double* f) {
  if (!box_ || matrix_.values.empty()) return;
  for (std::size_t j = 0; j < matrix_.n(); ++j)
    if (const double outside = y[j] - box_.nearest(j, y[j]); outside != 0)
      for_each_in_column(j, [&](std::size_t i, double& value) { f[i] += value * outside; });
}

/// Each time: a direction costs one evaluation of f. Where an entry is missing, the pattern is sought anew at (t, y),
/// once.
Status Jacobian::difference_in_found_pattern(Callback& f, double t, const double* y, const double* slope) {
  if (difference(f, t, y, slope) == Status::stop) return Status::stop;
  switch (examine(f, t, y, slope)) {
    case JacobianCheck::Verdict::stop: return Status::stop;
    case JacobianCheck::Verdict::right: return Status::ok;
    case JacobianCheck::Verdict::wrong: break;
  }
  std::vector<double> displacement(matrix_.n());
  for (std::size_t j = 0; j < matrix_.n(); ++j) displacement[j] = columns_[j].increment;
  if (enlarge_pattern(f, t, y, slope, displacement, examined_) == Status::stop) return Status::stop;
  return examined_ ? difference(f, t, y, slope) : Status::ok;
}

Status Jacobian::enlarge_pattern(Callback& f, double t, const double* y, const double* slope,
                                 const std::vector<double>& displacement, bool& larger) {
  const std::size_t n = matrix_.n();
  const std::vector<double> at(y, y + n), value(slope, slope + n);
  bool stopped = false;
  std::optional<Pattern> here = find_pattern(f, t, at, value, displacement,
                                             {.most_calls = most_calls_per_column * static_cast<std::int64_t>(n),
                                              .sparse_only = n > always_sought,
                                              .most_entries = most_entries},
                                             stopped);
  larger = false;
  if (stopped) return Status::stop;
  const bool banded = matrix_.structure.kind == Structure::Kind::banded;
  const Pattern known = !banded                  ? Pattern{.starts = matrix_.starts, .rows = matrix_.rows}
                        : beyond_.starts.empty() ? pattern_of(matrix_)
                                                 : beyond_;
  const bool full = !here;
  if (full) {  // as one full row does, it leaves no two columns that can be differenced together
    const auto entry = find_entry_outside(f, t, at, value, displacement, known, stopped);
    if (stopped) return Status::stop;
    if (!entry) return Status::ok;
    here = full_row(n, entry->first);
    note_misfit(t, *here, entry->second);
    if (misfit_) misfit_->lower = misfit_->upper = 0;
  }
  Pattern all = united(known, *here);
  if (all.rows.size() == known.rows.size()) return Status::ok;
  if (!full) note_misfit(t, *here, 0);
  larger = true;
  ++enlargements_;
  if (banded) {
    beyond_ = std::move(all);
  } else {
    matrix_.starts = std::move(all.starts);
    matrix_.rows = std::move(all.rows);
    matrix_.values.assign(matrix_.rows.size(), 0);
  }
  group_columns();
  return Status::ok;
}

/// Returns whether an entry is stored.
bool Jacobian::holds(std::size_t i, std::size_t j) const {
  const auto& [kind, n, lower, upper] = matrix_.structure;
  if (kind == Structure::Kind::dense) return true;
  if (kind == Structure::Kind::banded) return i <= j + lower && j <= i + upper;
  const auto first = matrix_.rows.begin() + matrix_.starts[j], last = matrix_.rows.begin() + matrix_.starts[j + 1];
  return std::binary_search(first, last, static_cast<int>(i));
}

/// Notes which of the entries seen, from a column on, the given structure lacks.
void Jacobian::note_misfit(double t, const Pattern& seen, std::size_t first) {
  if (source_.found_pattern) return;
  const auto& [kind, n, lower, upper] = matrix_.structure;
  Misfit found{.kind = kind == Structure::Kind::banded ? Misfit::Kind::bands : Misfit::Kind::pattern, .t = t};
  found.lower = lower, found.upper = upper;
  bool located = false;
  for (std::size_t j = 0; j < n; ++j)
    for (int p = seen.starts[j]; p < seen.starts[j + 1]; ++p) {
      const auto i = static_cast<std::size_t>(seen.rows[static_cast<std::size_t>(p)]);
      if (i > j) found.lower = std::max(found.lower, i - j);
      if (j > i) found.upper = std::max(found.upper, j - i);
      if (located || j < first || holds(i, j)) continue;
      located = true;
      found.row = i, found.column = j;
    }
  if (!misfit_) misfit_ = found;
}

Status Jacobian::complete(Callback& f, double t, const double* y, const double* slope,
                          const std::vector<double>& displacement) {
  bool larger = false;
  if (matrix_.structure.kind == Structure::Kind::dense)
    widen_increments();
  else if (enlarge_pattern(f, t, y, slope, displacement, larger) == Status::stop)
    return Status::stop;
  else if (!larger)
    return Status::ok;
  return evaluate(f, t, y, slope);
}

Status Jacobian::difference(Callback& f, double t, const double* y, const double* slope) {
  assert(slope != nullptr || matrix_.n() == 0);
  make_room();
  drowned_.reserve(matrix_.n());  // once: a copy has no room yet, and later evaluations are not to allocate
  std::copy(y, y + matrix_.n(), point_.begin());
  for (const std::vector<std::size_t>& group : *groups_) {
    if (difference_group(f, t, y, slope, group) == Status::stop) return Status::stop;
    drowned_.clear();
    for (const std::size_t j : group)
      if (columns_[j].change <= lost * columns_[j].size && factor_[j] < greatest_factor) drowned_.push_back(j);
    if (drowned_.empty()) continue;
    for (const std::size_t j : drowned_) factor_[j] = std::min(std::sqrt(factor_[j]), greatest_factor);
    if (difference_group(f, t, y, slope, drowned_, true) == Status::stop) return Status::stop;
  }
  adapted_ = false;
  for (std::size_t j = 0; j < matrix_.n(); ++j) {
    const Column& column = columns_[j];
    const double ratio = std::abs(column.increment / increment(j, y, slope[j], first_factor));
    adapted_ = adapted_ || ratio > factor_step || ratio * factor_step < 1;
    if (column.change <= small * column.size) factor_[j] = std::min(factor_step * factor_[j], greatest_factor);
    if (column.change > large * column.size) factor_[j] = std::max(factor_[j] / factor_step, least_factor);
  }
  measure_noise(y, slope);
  return Status::ok;
}

Status Jacobian::evaluate_boldly(Callback& f, double t, const double* y, const double* slope) {
  assert(kind_ == Kind::differences);
  const std::size_t n = matrix_.n();
  if (difference(f, t, y, slope) == Status::stop) return Status::stop;
  std::copy(y, y + n, point_.begin());  // the measurement of the noise has used it
  double largest = 1;
  for (std::size_t j = 0; j < n; ++j) largest = std::max(largest, std::abs(y[j]));
  std::vector<double> before;  // entries of the column, and whether they stand above roundoff
  std::vector<char> stands;
  for (std::size_t j = 0; j < n; ++j) {
    const double factor = factor_[j], first = std::abs(columns_[j].increment);
    std::size_t missing = 0;
    stands.clear();
    for_each_in_column(j, [&](std::size_t i, double& value) {
      stands.push_back(std::abs(value) * first > small * std::abs(slope[i]));
      missing += stands.back() == 0;
    });
    for (double reached = first; missing > 0 && reached > 0 && reached < largest;) {
      before.clear();
      for_each_in_column(j, [&](std::size_t, double& value) { before.push_back(value); });
      factor_[j] *= bolder;
      drowned_.assign(1, j);
      if (difference_group(f, t, y, slope, drowned_) == Status::stop) return Status::stop;
      if (!(std::abs(columns_[j].increment) > reached)) break;
      reached = std::abs(columns_[j].increment);
      std::size_t k = 0;
      for_each_in_column(j, [&](std::size_t i, double& value) {
        if (stands[k] != 0 || !std::isfinite(value)) {
          value = before[k];
        } else if (std::abs(value) * reached > small * std::abs(slope[i])) {
          stands[k] = 1;
          --missing;
        }
        ++k;
      });
    }
    factor_[j] = factor;
  }
  drowned_.clear();
  measure_noise(y, slope);
  return Status::ok;
}

Status Jacobian::evaluate_plainly(Callback& f, double t, const double* y, const double* slope) {
  if (kind_ != Kind::differences) return evaluate(f, t, y, slope);
  ++count_;
  adapted_ = false;
  make_room();
  std::copy(y, y + matrix_.n(), point_.begin());
  std::fill(factor_.begin(), factor_.end(), first_factor);
  for (const std::vector<std::size_t>& group : *groups_)
    if (difference_group(f, t, y, slope, group) == Status::stop) return Status::stop;
  measure_noise(y, slope);
  return Status::ok;
}

/// max_i Σ_j |J_ij| w_j / w_i over the entries whose Δf_i is roundoff. Salane's rules look at one row of a column; in
/// another row, with larger terms, the same increment may have changed nothing but the last digits. (Entries that came
/// out as 0 do no harm: they slow Newton's iteration, and cannot make it look converged.)
void Jacobian::measure_noise(const double* y, const double* slope) {
  const std::size_t n = matrix_.n();
  weights_.fill(y, point_.data());
  std::fill(moved_.begin(), moved_.end(), 0);
  for (std::size_t j = 0; j < n; ++j) {
    const double increment = std::abs(columns_[j].increment);
    for_each_in_column(j, [&](std::size_t i, double value) {
      const double entry = std::abs(value);
      if (entry * increment <= noise_units * eps * std::abs(slope[i])) moved_[i] += entry * point_[j];
    });
  }
  noise_ = max_norm(n, [this](std::size_t i) { return moved_[i] / point_[i]; });
}

/// A constant one is part of the problem. A function may have replaced the pattern, and a given one may have grown.
void Jacobian::matrix_state(Archive& archive) {
  if (kind_ == Kind::constant) return;
  const bool sparse = matrix_.structure.kind == Structure::Kind::sparse;
  if (sparse) {
    archive.resizable(matrix_.starts);
    archive.resizable(matrix_.rows);
  }
  archive.resizable(beyond_.starts);
  archive.resizable(beyond_.rows);
  const bool kept = archive.matrix(matrix_.values);
  if (!archive.reading()) return;
  const std::size_t n = matrix_.n();
  archive.require(!sparse || well_formed(n, matrix_.starts, matrix_.rows));
  archive.require(beyond_.starts.empty() || well_formed(n, beyond_.starts, beyond_.rows));
  if (!kept) matrix_.values.clear();  // it will be evaluated before it is needed
  archive.require(matrix_.values.empty() || provided());
  if (computed()) group_columns();
}

void Jacobian::state(Archive& archive) {
  make_factors();
  archive(count_, noise_, factor_, adapted_, kind_, abandoned_complex_steps_, enlargements_, doubtful_now_, examined_,
          misfit_);
  source_.complex_f.state(archive);
  archive.require(kind_ == source_.kind || (source_.kind == Kind::complex_steps && kind_ == Kind::differences));
  archive.require(!examined_ || source_.found_pattern);
  archive.require(!misfit_ || (misfit_->row < matrix_.n() && misfit_->column < matrix_.n()));
}

void Jacobian::widen_increments() {
  make_factors();
  for (double& factor : factor_) factor = std::max(factor, wide_factor);
}

/// y_j changes by factor · max(|y_j|, atol_j), in the direction in which f moves it; where that has changed nothing at
/// all, by factor · max(|y_j|, atol_j / rtol), but not beyond the tolerance: there f may have other derivatives.
double Jacobian::increment(std::size_t j, const double* y, double slope, double factor, bool again) const {
  double scale = std::max(std::abs(y[j]), weights_.absolute_tolerance(j));
  if (again && columns_[j].change == 0) {
    scale = weights_.at(j, y[j]);
    factor = std::min(factor, std::max(first_factor, weights_.rtol()));
  }
  const double moved = y[j] + (slope >= 0 ? factor : -factor) * defined_scale(scale, y);
  return box_.turned(j, y[j], moved - y[j]);
}

/// The scale, or where it is too small to tell one that of the largest component.
double Jacobian::defined_scale(double scale, const double* y) const {
  if (scale >= smallest_scale) return scale;
  for (std::size_t i = 0; i < matrix_.n(); ++i) scale = std::max(scale, std::abs(y[i]));
  return scale < smallest_scale ? 1 : scale;
}

/// The columns together, with one evaluation of f; where it is not finite, once more to the other side. `again`: they
/// have been tried before.
Status Jacobian::difference_group(Callback& f, double t, const double* y, const double* slope,
                                  const std::vector<std::size_t>& columns, bool again) {
  for (const double side : {1, -1}) {
    for (const std::size_t j : columns) {
      columns_[j].increment = increment(j, y, side * slope[j], factor_[j], again);
      point_[j] = y[j] + columns_[j].increment;
    }
    const Status status = f(t, point_.data(), moved_.data());
    for (const std::size_t j : columns) point_[j] = y[j];
    if (status == Status::stop) return Status::stop;
    if (all_finite(moved_.data(), moved_.size())) break;
  }
  for (const std::size_t j : columns) {
    Column& column = columns_[j];
    column.change = column.size = 0;
    for_each_in_column(j, [&](std::size_t i, double& value) {
      const double change = moved_[i] - slope[i];
      value = column.increment == 0 ? 0 : change / column.increment;  // 0: y_j has one value
      if (std::abs(change) <= column.change) return;
      column.change = std::abs(change);
      column.size = std::max(std::abs(slope[i]), std::abs(moved_[i]));
    });
  }
  return Status::ok;
}

template <class Visit>
void Jacobian::for_each_in_column(std::size_t j, Visit&& visit) {
  const auto& [kind, n, lower, upper] = matrix_.structure;
  if (kind == Structure::Kind::dense) {
    for (std::size_t i = 0; i < n; ++i) visit(i, matrix_.values[i * n + j]);
  } else if (kind == Structure::Kind::banded) {
    for (std::size_t i = j > upper ? j - upper : 0; i <= std::min(n - 1, j + lower); ++i)
      visit(i, matrix_.values[(upper + i - j) * n + j]);
  } else {
    for (int p = matrix_.starts[j]; p < matrix_.starts[j + 1]; ++p) {
      const auto q = static_cast<std::size_t>(p);
      visit(static_cast<std::size_t>(matrix_.rows[q]), matrix_.values[q]);
    }
  }
}

}  // namespace invariode
