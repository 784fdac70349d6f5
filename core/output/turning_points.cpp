#include "output/turning_points.hpp"

#include <algorithm>
#include <cmath>

#include "output/bernstein.hpp"
#include "weights.hpp"

namespace invariode {
namespace {

constexpr std::size_t most_halvings = 6;   // halvings of a step: beside a singularity the rest is left to signs there
constexpr double closest_roots = 0x1p-26;  // √ε, of the step: roots of the slope that are closer are not told apart
constexpr double converged = 0x1p-30;      // the last coefficients in these units: turning points are known to √ε then
constexpr double width_of_root = 0x1p-34;  // width of a turning point, of the part
constexpr double level = 0x1p-30;          // the slope at the end of the step, in units of its largest coefficient

/// The coefficients of a part's first half.
void shrink(const double* c, std::size_t rows, std::size_t n, double* half) {
  double power = 1;
  for (std::size_t k = 0; k < rows; ++k, power *= 0.5)
    for (std::size_t i = 0; i < n; ++i) *half++ = power * *c++;
}

/// c(θ) becomes c(1 + θ).
void shift(double* c, std::size_t rows, std::size_t n) {
  for (std::size_t low = 0; low + 1 < rows; ++low)
    for (std::size_t k = rows - 1; k-- > low;)
      for (std::size_t i = 0; i < n; ++i) c[k * n + i] += c[(k + 1) * n + i];
}

double largest(const double* b, std::size_t count) {
  return max_norm(count, [b](std::size_t j) { return b[j]; });
}

}  // namespace

Status TurningPoints::find(Series& series, double t0, double length, const double* c, std::size_t n,
                           std::vector<double>& points) {
  series_ = &series;
  t0_ = t0;
  length_ = length;
  n_ = n;
  order_ = static_cast<std::size_t>(series.order());
  points_ = &points;
  points.clear();
  turns_at_end_ = false;
  size_ = 0;
  g_.resize(order_ + 1);
  bernstein_.resize(order_ + 1);
  if (c_.empty()) c_.resize(most_halvings + 1);
  c_[0].assign(c, c + (order_ + 1) * n);
  const Status status = examine({.depth = 0, .start = 0, .width = 1});
  std::ranges::sort(points);
  return status;
}

Status TurningPoints::examine(const Part& part) {
  const std::size_t p = order_;
  if ((*series_)(t0_ + part.start * length_, part.width * length_, c_[part.depth].data(), g_.data()) == Status::stop)
    return Status::stop;
  if (!all_finite(g_.data(), p + 1)) return halve(part);
  double size = 0;
  for (const double a : g_) size += std::abs(a);
  size_ = std::max(size_, size);
  const double tail = std::abs(g_[p - 1]) + std::abs(g_[p]);
  bernstein::from_powers(g_, bernstein_);
  if (bernstein::on_one_side(bernstein_.data(), p + 1, tail + bernstein::roundoff * size)) return Status::ok;
  for (std::size_t j = 0; j < p; ++j) bernstein_[j] = bernstein_[j + 1] - bernstein_[j];  // p times these: of the slope
  if (part.start + part.width == 1)
    turns_at_end_ = std::abs(bernstein_[p - 1]) <= level * largest(bernstein_.data(), p);
  if (bernstein::on_one_side(bernstein_.data(), p, tail)) return Status::ok;
  if (tail > converged * size && part.depth < most_halvings) return halve(part);
  take_apart(part);
  return Status::ok;
}

/// The middle counts as a turning point: one that is just there would be seen on neither side.
Status TurningPoints::halve(const Part& part) {
  if (part.depth == most_halvings) return Status::ok;
  const Part first{.depth = part.depth + 1, .start = part.start, .width = part.width / 2};
  const Part second{.depth = first.depth, .start = part.start + first.width, .width = first.width};
  std::vector<double>& c = c_[first.depth];
  c.resize((order_ + 1) * n_);
  shrink(c_[part.depth].data(), order_ + 1, n_, c.data());
  if (examine(first) == Status::stop) return Status::stop;
  points_->push_back(second.start);
  shift(c.data(), order_ + 1, n_);
  return examine(second);
}

/// The roots of the slope, whose Bernstein coefficients on the part are there.
void TurningPoints::take_apart(const Part& part) {
  const std::size_t count = order_;
  const double flat = bernstein::roundoff * largest(bernstein_.data(), count);
  bernstein::isolate(bernstein_.data(), count, closest_roots / part.width, flat, boxes_,
                     [&](const bernstein::Isolated& found) {
                       if (found.unresolved || found.low == found.high)
                         points_->push_back(part.start + part.width * 0.5 * (found.low + found.high));
                       else
                         take_root(part, found.low, found.high);
                       return true;
                     });
}

/// The one root of the slope between two places of the part. (Where roundoff has moved it beyond them: the nearer one.)
void TurningPoints::take_root(const Part& part, double low, double high) {
  const double at_low = slope(low), at_high = slope(high);
  double root = std::abs(at_low) < std::abs(at_high) ? low : high;
  const auto e = [this](double theta, double& value) {
    value = slope(theta);
    return true;
  };
  if (at_low * at_high < 0) (void)find_root(e, low, at_low, high, at_high, width_of_root, root);
  const double theta = part.start + part.width * root;
  if (theta > 0 && theta < 1) points_->push_back(theta);
}

double TurningPoints::slope(double theta) const {
  double value = 0;
  for (std::size_t k = order_; k > 0; --k) value = value * theta + static_cast<double>(k) * g_[k];
  return value;
}

}  // namespace invariode
