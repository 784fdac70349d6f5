#include "manifold/invariants.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <utility>

#include "manifold/gradient.hpp"

namespace invariode {
namespace {

const double sqrt_eps = std::sqrt(eps);      // optimal relative increment of a forward difference
constexpr double complex_increment = 1e-40;  // its square is nothing beside 1, and products of y and it do not vanish
constexpr int smaller_increments = 6;        // tried where g is not defined, each a tenth of the one before
constexpr double smaller_increment = 10;
constexpr double part_of_step = 1.0 / 8;  // with which a one-sided difference is repeated,
constexpr double growth = 1.01;           // and the factor by which it may grow where a derivative exists
constexpr double one_sided_noise = 4;     // of one-sided differences in t of the second order, in units of central ones

}  // namespace

Invariants::Invariants(std::size_t n, std::vector<InvariantBlock> blocks, std::vector<double> value,
                       const Weights& weights)
    : n_(n),
      blocks_(std::move(blocks)),
      value_(std::move(value)),
      weights_(weights),
      layout_(n),
      plus_(value_.size()),
      minus_(value_.size()),
      sizes_(n) {
  for (InvariantBlock& block : blocks_) {
    if (block.jacobian) block.derivative = Derivative::given;
    layout_.add(block.m, block.pattern);
    sense_.insert(sense_.end(), block.m, block.sense);
    any_one_sided_ = any_one_sided_ || block.sense != 0;
    along_steps_ = along_steps_ || block.along_steps;
  }
  assert(sense_.size() == m() && weights.size() == n_);
  note_kinds();
}

void Invariants::note_kinds() {
  derivative_error_ = 0;
  increment_.clear();
  untested_.clear();
  for (const InvariantBlock& block : blocks_) {
    const double increment = block.derivative == Derivative::central   ? cbrt_eps
                             : block.derivative == Derivative::forward ? sqrt_eps
                                                                       : 0;
    if (increment > 0) derivative_error_ = std::max(derivative_error_, eps / increment);
    increment_.insert(increment_.end(), block.m, increment);
    untested_.insert(untested_.end(), block.m, block.untested);
  }
}

void Invariants::state(Archive& archive) {
  archive(value_, derivative_calls_);
  for (InvariantBlock& block : blocks_) {
    const Derivative before = block.derivative;
    archive(block.derivative);
    archive.require(block.derivative == before ||
                    (before == Derivative::complex_step && block.derivative == Derivative::central));
    block.g.state(archive);
    block.jacobian.state(archive);
    block.complex_g.state(archive);
  }
  if (archive.reading()) note_kinds();
}

Status Invariants::hold(double t, const double* y) {
  double* value = value_.data();
  for (InvariantBlock& block : blocks_) {
    if (block.held && block.g(t, y, value) == Status::stop) return Status::stop;
    value += block.m;
  }
  return Status::ok;
}

Status Invariants::hold_one_sided(double t, const double* y) {
  if (evaluate(t, y, plus_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m(); ++i)
    if (sense_[i] != 0) value_[i] = plus_[i];
  return Status::ok;
}

void Invariants::tighten(const double* g) {
  for (std::size_t i = 0; i < m(); ++i) {
    if (sense_[i] < 0) value_[i] = std::min(value_[i], g[i]);
    if (sense_[i] > 0) value_[i] = std::max(value_[i], g[i]);
  }
}

std::int64_t Invariants::calls() const {
  std::int64_t sum = 0;
  for (const InvariantBlock& block : blocks_) sum += block.g.calls() + block.complex_g.calls();
  return sum;
}

std::int64_t Invariants::jacobian_calls() const {
  std::int64_t sum = 0;
  for (const InvariantBlock& block : blocks_) sum += block.jacobian.calls();
  return sum;
}

bool Invariants::all_by_differences() const {
  return std::all_of(increment_.begin(), increment_.end(), [](double d) { return d != 0; });
}

bool Invariants::abandon_complex_steps(std::size_t i) {
  auto block = blocks_.begin();
  for (std::size_t end = block->m; end <= i; end += block->m) ++block;
  if (block->derivative != Derivative::complex_step) return false;
  block->derivative = Derivative::central;
  note_kinds();
  return true;
}

Status Invariants::evaluate(double t, const double* y, double* g) {
  for (InvariantBlock& block : blocks_) {
    if (block.g(t, y, g) == Status::stop) return Status::stop;
    g += block.m;
  }
  return Status::ok;
}

Status Invariants::residual(double t, const double* y, double* r) {
  if (evaluate(t, y, r) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m(); ++i) r[i] -= value_[i];
  return Status::ok;
}

Status Invariants::jacobian(double t, const double* y, double* J) {
  std::size_t first = 0;
  for (InvariantBlock& block : blocks_) {
    double* rows = J + layout_.start(first);
    bool finite = true;
    Status status = Status::ok;
    if (block.derivative == Derivative::given) {
      status = block.jacobian(t, y, rows);
      if (status == Status::ok && !block.pattern && !block.users && !all_finite(rows, block.m * n_)) {
        // Entries that are not finite though g is, such as 0 · ∞ of a formula of ours, are replaced by differences.
        std::vector<double> differences(block.m * n_);
        status = difference_block(block, t, y, 1, differences.data());
        for (std::size_t e = 0; e < differences.size(); ++e)
          if (!std::isfinite(rows[e])) rows[e] = differences[e];
      }
    }
    if (block.derivative == Derivative::complex_step) status = complex_step(block, t, y, rows, finite);
    if (block.derivative == Derivative::forward) status = forward_differences(block, t, y, rows);
    if (status == Status::stop) return status;
    if (!finite) {  // g does not take complex y here: from now on differences
      block.derivative = Derivative::central;
      note_kinds();
    }
    if (block.derivative == Derivative::central) status = difference_block(block, t, y, 1, rows);
    if (status == Status::stop) return status;
    first += block.m;
  }
  return Status::ok;
}

const double* Invariants::sizes(const double* y) {
  take_sizes(y, weights_.threshold().data(), n_, sizes_.data());
  return sizes_.data();
}

Status Invariants::complex_step(InvariantBlock& block, double t, const double* y, double* rows, bool& finite) {
  const double* size = sizes(y);
  complex_value_.resize(2 * m());
  complex_point_.assign(2 * n_, 0);
  for (std::size_t j = 0; j < n_; ++j) complex_point_[2 * j] = y[j];
  for (std::size_t j = 0; j < n_; ++j) {
    const double h = complex_increment * size[j];
    complex_point_[2 * j + 1] = h;
    ++derivative_calls_;
    if (block.complex_g(t, complex_point_.data(), complex_value_.data()) == Status::stop) return Status::stop;
    complex_point_[2 * j + 1] = 0;
    for (std::size_t i = 0; i < block.m; ++i) rows[i * n_ + j] = complex_value_[2 * i + 1] / h;
    finite = finite && all_finite(complex_value_.data(), 2 * block.m);
  }
  return Status::ok;
}

Status Invariants::forward_differences(InvariantBlock& block, double t, const double* y, double* rows) {
  const double* size = sizes(y);
  point_.assign(y, y + n_);
  derivative_calls_ += static_cast<std::int64_t>(n_) + 1;
  if (block.g(t, y, minus_.data()) == Status::stop) return Status::stop;
  for (std::size_t j = 0; j < n_; ++j) {
    for (const double side : {1, -1}) {  // backwards where g is not defined ahead
      point_[j] = y[j] + side * sqrt_eps * size[j];
      if (block.g(t, point_.data(), plus_.data()) == Status::stop) return Status::stop;
      if (side < 0 || all_finite(plus_.data(), block.m)) break;
      ++derivative_calls_;
    }
    for (std::size_t i = 0; i < block.m; ++i) rows[i * n_ + j] = (plus_[i] - minus_[i]) / (point_[j] - y[j]);
    point_[j] = y[j];
  }
  return Status::ok;
}

Status Invariants::difference_jacobian(double t, const double* y, double* J, double factor) {
  for (InvariantBlock& block : blocks_) {
    if (difference_block(block, t, y, factor, J) == Status::stop) return Status::stop;
    J += block.m * n_;
  }
  return Status::ok;
}

Status Invariants::difference_block(InvariantBlock& block, double t, const double* y, double factor, double* rows) {
  sizes(y);
  point_.assign(y, y + n_);
  for (std::size_t j = 0; j < n_; ++j)
    if (difference_column(block, t, y, j, factor, rows + j) == Status::stop) return Status::stop;
  return Status::ok;
}

/// Column j of a block's Jacobian, into entries n apart. Where g is not defined that far away (log y_j, with y_j below
/// its thr_j), the increment is taken relative to y_j itself, then ever smaller: the end of the domain need not be at
/// 0.
Status Invariants::difference_column(InvariantBlock& block, double t, const double* y, std::size_t j, double factor,
                                     double* column) {
  double delta = factor * cbrt_eps * sizes_[j];
  const double relative = factor * cbrt_eps * std::abs(y[j]);
  for (int smaller = 0; smaller <= smaller_increments; ++smaller) {
    if (smaller == 1 && relative > 0) delta = std::min(delta, relative);
    if (smaller > 1) delta /= smaller_increment;
    const double up = y[j] + delta, down = y[j] - delta;
    if (up == down) break;
    point_[j] = up;
    derivative_calls_ += 2;
    if (block.g(t, point_.data(), plus_.data()) == Status::stop) return Status::stop;
    point_[j] = down;
    if (block.g(t, point_.data(), minus_.data()) == Status::stop) return Status::stop;
    point_[j] = y[j];
    for (std::size_t i = 0; i < block.m; ++i) column[i * n_] = (plus_[i] - minus_[i]) / (up - down);
    if (all_finite(plus_.data(), block.m) && all_finite(minus_.data(), block.m)) return Status::ok;
  }
  return one_sided_column(block, t, y, j, factor * cbrt_eps * sizes_[j], column);
}

/// Replaces the entries of a column that are not finite, at the edge of the domain of g, by one-sided differences from
/// the parabola through three values. An entry that grows as the increment shrinks, such as that of √y_j at 0, stays.
Status Invariants::one_sided_column(InvariantBlock& block, double t, const double* y, std::size_t j, double delta,
                                    double* column) {
  std::vector<double> here(block.m), wide(block.m), narrow(block.m);
  if (block.g(t, y, here.data()) == Status::stop) return Status::stop;
  ++derivative_calls_;
  for (const double side : {1.0, -1.0}) {
    for (const double part : {1.0, part_of_step}) {
      const double h = side * part * delta;
      derivative_calls_ += 2;
      point_[j] = y[j] + h;
      if (block.g(t, point_.data(), plus_.data()) == Status::stop) return Status::stop;
      point_[j] = y[j] + 2 * h;
      if (block.g(t, point_.data(), minus_.data()) == Status::stop) return Status::stop;
      std::vector<double>& slope = part == 1.0 ? wide : narrow;
      for (std::size_t i = 0; i < block.m; ++i) slope[i] = (4 * plus_[i] - minus_[i] - 3 * here[i]) / (2 * h);
    }
    for (std::size_t i = 0; i < block.m; ++i)
      if (!std::isfinite(column[i * n_]) && std::abs(narrow[i]) <= growth * std::abs(wide[i]))
        column[i * n_] = narrow[i];
  }
  point_[j] = y[j];
  return Status::ok;
}

Invariants::Reach Invariants::reach(double t, double size) const {
  if (piece_ == nullptr) return {size, size};
  const double back = t - piece_->low(), ahead = piece_->high() - t;
  if (back >= size && ahead >= size) return {size, size};
  if (ahead >= back) return {0, std::clamp(ahead, 0.0, size)};
  return {std::clamp(back, 0.0, size), 0};
}

Status Invariants::time_derivative(double t, double h, const double* y, const double* J, double* gt, double factor) {
  const double delta = factor * time_increment(t, h);
  if (reach(t, delta).one_sided()) return one_sided_time_derivative(t, 2 * delta, y, J, gt);
  const double later = t + delta, earlier = t - delta;
  if (residual(later, y, plus_.data()) == Status::stop) return Status::stop;
  if (residual(earlier, y, minus_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m(); ++i) {
    const double change = plus_[i] - minus_[i];
    gt[i] = std::abs(change) <= roundoffs_of_change * roundoff(i, y, J) ? 0 : change / (later - earlier);
  }
  return Status::ok;
}

/// (4 (g(t + L/2) − g(t)) − (g(t + L) − g(t))) / L, of |L| up to `length`.
Status Invariants::one_sided_time_derivative(double t, double length, const double* y, const double* J, double* gt) {
  const auto [back, ahead] = reach(t, length);
  const double far = t + (ahead - back), middle = t + (ahead - back) / 2;
  if (residual(t, y, minus_.data()) == Status::stop) return Status::stop;
  if (residual(middle, y, plus_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m(); ++i) gt[i] = 4 * (plus_[i] - minus_[i]);
  if (residual(far, y, plus_.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < m(); ++i) {
    const double change = gt[i] - (plus_[i] - minus_[i]);
    const bool lost = far == t || std::abs(change) <= one_sided_noise * roundoffs_of_change * roundoff(i, y, J);
    gt[i] = lost ? 0 : change / (far - t);
  }
  return Status::ok;
}

double Invariants::resolution_in_time(double t, double h) const {
  const double delta = time_increment(t, h);
  return reach(t, delta).one_sided() ? delta / one_sided_noise : delta;
}

double Invariants::time_increment(double t, double h) {
  return std::cbrt(eps * std::max(std::abs(t), std::abs(h))) * std::cbrt(h * h);
}

double Invariants::roundoff_of_rate(std::size_t i, const double* y, const double* J, const double* f) {
  if (!by_differences(i)) return 0;
  const double* size = sizes(y);
  double sum = 0;
  for (std::size_t j = 0; j < n_; ++j) sum += std::abs(f[j]) / size[j];
  return sum * roundoff(i, y, J) / increment_[i];
}

double Invariants::resolution(std::size_t i, const double* size, const double* J) const {
  double change = 0;
  row(i, J).for_each([&](std::size_t j, double value) { change += std::abs(value) * size[j]; });
  return roundoff_of_g * eps * change;
}

double Invariants::roundoff_of_value(std::size_t i) const { return roundoff_of_g * eps * std::abs(value_[i]); }

double Invariants::roundoff(std::size_t i, const double* y, const double* J) const {
  return roundoff_of_terms(value_[i], row(i, J), y);
}

}  // namespace invariode
