#include "methods/taylor.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <cassert>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>
#include <utility>

#include "methods/initial_step.hpp"

namespace invariode {
namespace {

constexpr double margin = 0.7;  // h is e^{−0.7/(p−1)} of the length that the last coefficients allow (Jorba and Zou)
constexpr double safety = 0.8;  // of the predicted optimal step, after a failure
constexpr double floor_after_failure = 0.1;  // of h
constexpr double halved = 0.5;               // after further failures
constexpr double largest_growth = 5;         // of h: the last coefficients may be small by chance, where one vanishes
constexpr double least_tested = 4 * eps;     // rtol of the acceptance test: smaller errors of the slope are roundoff
constexpr double shortened = 0x1p-32;        // the unit of time, where coefficients overflow

/// Where 1 − x + x²/2 − … ± x^p/p! leaves [−1, 1] for x > 0, by the order p.
constexpr auto real_limits = [] {
  constexpr double step = 1. / 16;
  constexpr double roundoff = 1e-8;  // of terms up to e^x
  std::array<double, Taylor::highest_order + 1> limits{};
  for (int p = 1; p <= Taylor::highest_order; ++p) {
    double value = 1;
    for (double& x = limits[static_cast<std::size_t>(p)]; value <= 1 + roundoff && value >= -1 - roundoff;) {
      x += step;
      value = 1;
      for (int k = p; k > 0; --k) value = 1 - value * x / k;
    }
  }
  return limits;
}();

/// log₂ x of a normal x > 0, to 1e-7: h needs no more, and is the same on every processor.
double logarithm(double x) {
  constexpr std::uint64_t mantissa = (std::uint64_t{1} << 52U) - 1, sqrt_half = 0x3FE6A09E667F3BCDU;
  const std::uint64_t bits = std::bit_cast<std::uint64_t>(x), shifted = bits - sqrt_half;
  const auto exponent = static_cast<double>(static_cast<std::int64_t>(shifted) >> 52);
  const double m = std::bit_cast<double>((shifted & mantissa) + sqrt_half);  // in [√½, √2)
  const double z = (m - 1) / (m + 1), z2 = z * z;
  return exponent + 2 * std::numbers::log2e * z * (1 + z2 * (1. / 3 + z2 * (1. / 5 + z2 * (1. / 7))));
}

/// 2^x, to 2e-7, of an x for which it is a normal number.
double power_of_two(double x) {
  constexpr double lowest = -1022, highest = 1023;
  const double inside = std::clamp(x, lowest, highest), whole = std::nearbyint(inside);
  const double u = std::numbers::ln2 * (inside - whole);
  const double fraction = 1 + u * (1 + u * (1. / 2 + u * (1. / 6 + u * (1. / 24 + u * (1. / 120 + u / 720)))));
  return std::ldexp(fraction, static_cast<int>(whole));
}

/// The power of two nearest to h.
double unit_near(double h) {
  assert(h > 0);
  int exponent = 0;
  const double fraction = std::frexp(h, &exponent);  // in [½, 1)
  const double unit = std::ldexp(1, fraction < std::numbers::sqrt2 / 2 ? exponent - 1 : exponent);
  return std::clamp(unit, std::numeric_limits<double>::min(), 0x1p1022);
}

/// Σ c_k s^k and its derivative in s less c_0: of `Width` components beside each other, in registers.
template <std::size_t Width>
void evaluate_beside(const double* c, std::size_t n, std::size_t order, double s, double* rise, double* slope) {
  const double* row = c + order * n;
  double p[Width], d[Width];
  for (std::size_t i = 0; i < Width; ++i) p[i] = row[i], d[i] = 0;
  for (std::size_t k = order; --k > 0;) {
    row -= n;
    for (std::size_t i = 0; i < Width; ++i) d[i] = d[i] * s + p[i];
    for (std::size_t i = 0; i < Width; ++i) p[i] = p[i] * s + row[i];
  }
  for (std::size_t i = 0; i < Width; ++i) slope[i] = d[i] * s + p[i];
  for (std::size_t i = 0; i < Width; ++i) rise[i] = p[i] * s;
}

/// The same of all n.
void evaluate_polynomial(const double* c, std::size_t n, std::size_t order, double s, double* rise, double* slope) {
  std::size_t i = 0;
  for (; i + 8 <= n; i += 8) evaluate_beside<8>(c + i, n, order, s, rise + i, slope + i);
  for (; i + 4 <= n; i += 4) evaluate_beside<4>(c + i, n, order, s, rise + i, slope + i);
  for (; i + 2 <= n; i += 2) evaluate_beside<2>(c + i, n, order, s, rise + i, slope + i);
  if (i < n) evaluate_beside<1>(c + i, n, order, s, rise + i, slope + i);
}

/// Σ c_k θ^k
void power_series(const double* data, std::size_t size, std::size_t n, double theta, double* out) {
  if (n == 0) return;
  const double* c = data + (size - n);
  for (std::size_t i = 0; i < n; ++i) out[i] = c[i];
  while (c != data) {
    c -= n;
    for (std::size_t i = 0; i < n; ++i) out[i] = c[i] + theta * out[i];
  }
}

}  // namespace

Taylor::Taylor(Callback& f, const Weights& weights, Series& series, bool projected)
    : Step(f, weights),
      series_(series),
      projected_(projected),
      order_(static_cast<std::size_t>(series.order())),
      exponent_(1.0 / (series.order() + 1)),
      factor_(std::exp((std::log(weights.rtol()) - margin) / (series.order() - 1))),
      rtol_(std::max(weights.rtol(), least_tested)),
      current_{.c = std::vector<double>((order_ + 1) * weights.size())},
      next_{.c = std::vector<double>((order_ + 1) * weights.size())},
      values_(5 * weights.size()) {
  assert(lowest_order <= series.order() && series.order() <= highest_order);
  double* next = values_.data();
  for (double** v : {&candidate_, &end_slope_, &end_f_, &weight_, &slope_}) *v = std::exchange(next, next + n());
}

Outcome Taylor::start(double t, const double* y, const Span& span) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  accepted_ = failed_ = false;
  undefined_ = {};
  if (f_(t, y, end_f_) == Status::stop) return Outcome::stop;
  if (!all_finite(end_f_, n())) {
    undefined_.component = first_undefined(end_f_);
    return Outcome::not_finite;
  }
  weights_.fill(y, weight_);
  h_ = initial_step(max_norm(n(), [this](std::size_t i) { return end_f_[i] / weight_[i]; }), t, span);
  if (expand(t, y, current_) == Status::stop) return Outcome::stop;
  if (!current_.finite) return Outcome::not_finite;
  h_ = initial_step(1 / reach(current_), t, span);
  return Outcome::ok;
}

/// The expansion at (t, y), in a unit of time near h. (Beside a singularity that is much closer than h coefficients
/// overflow: the unit becomes shorter then.)
Status Taylor::expand(double t, const double* y, Expansion& into) {
  undefined_ = {};
  for (double unit = unit_near(h_); unit >= std::numeric_limits<double>::min(); unit *= shortened) {
    if (series_(t, unit, y, into.c.data()) == Status::stop) return Status::stop;
    into.unit = unit;
    into.finite = all_finite(row(into, order_ - 1), 2 * n());  // what is not finite makes all after it so too
    if (into.finite || !all_finite(row(into, 1), n())) break;
  }
  for (std::size_t k = 1; k <= order_ && !into.finite && undefined_.component < 0; ++k)
    undefined_ = {.component = first_undefined(row(into, k)), .coefficient = static_cast<int>(k)};
  return Status::ok;
}

int Taylor::first_undefined(const double* v) const {
  for (std::size_t i = 0; i < n(); ++i)
    if (!std::isfinite(v[i])) return static_cast<int>(i);
  return -1;
}

/// The |h| for which the last two coefficients that do not vanish are small enough, in the weights: ‖c_k‖ |h|^k ≤
/// (rtol e^{−0.7})^{k/(p−1)}. Infinite where all vanish.
double Taylor::reach(const Expansion& expansion) const {
  double rate = -std::numeric_limits<double>::infinity();
  int seen = 0;
  for (std::size_t k = order_; k > 0 && seen < 2; --k) {
    const double* c = row(expansion, k);
    const double size = max_norm(n(), [this, c](std::size_t i) { return c[i] / weight_[i]; });
    if (size < std::numeric_limits<double>::min()) continue;
    rate = std::max(rate, logarithm(size) / static_cast<double>(k));
    ++seen;
  }
  return seen > 0 ? expansion.unit * factor_ * power_of_two(-rate) : std::numeric_limits<double>::infinity();
}

Step::Attempt Taylor::attempt(double h, double t1) {
  if (accepted_) {
    std::swap(current_, next_);
    accepted_ = false;
  }
  h_ = std::abs(h);
  t1_ = t1;
  length_ = t1 - t_;
  expanded_ = false;
  error_ = std::numeric_limits<double>::quiet_NaN();
  evaluate_polynomial(current_.c.data(), n(), order_, length_ / current_.unit, candidate_, end_slope_);
  for (std::size_t i = 0; i < n(); ++i) candidate_[i] += y_[i];
  if (!all_finite(candidate_, n())) return {Outcome::not_finite, error_, candidate_};
  if (evaluate_at_candidate() == Status::stop) return {Outcome::stop, error_, candidate_};
  error_ = max_norm(n(), [this](std::size_t i) { return error_of(i) / weights_.at(i, y_[i], candidate_[i]); });
  if (weights_.rtol() < rtol_) error_ *= weights_.rtol() / rtol_;
  return {Outcome::ok, error_, candidate_};
}

/// f(t₁, y*) in units of `end_unit_`: the next expansion has it, where the candidate will not be moved.
Status Taylor::evaluate_at_candidate() {
  if (projected_) {
    end_unit_ = 1;
    undefined_ = {};
    const Status status = f_(t1_, candidate_, end_f_);
    if (status == Status::ok) undefined_.component = first_undefined(end_f_);
    return status;
  }
  expanded_ = true;
  const Status status = expand(t1_, candidate_, next_);
  end_unit_ = next_.unit;
  std::copy_n(row(next_, 1), n(), end_f_);
  return status;
}

/// y − P = c_{p+1} h^{p+1} + … and h (y′ − P′) = (p + 1) c_{p+1} h^{p+1} + …, where f(t₁, y*) is y′ but for what is
/// smaller by another factor h.
double Taylor::error_of(std::size_t i) const {
  return length_ * (end_f_[i] / end_unit_ - end_slope_[i] / current_.unit) * exponent_;
}

bool Taylor::errors(double* out) const {
  for (std::size_t i = 0; i < n(); ++i) out[i] = error_of(i);
  return true;
}

std::size_t Taylor::directions(const double** vectors) const {
  for (std::size_t k = 1; k <= order_; ++k) *vectors++ = row(current_, k);
  return order_;
}

bool Taylor::reject(Cause cause, double hmin) {
  if (h_ <= hmin) return false;
  double factor = halved;
  if (!failed_ && cause == Cause::error)
    factor = std::max(floor_after_failure, safety * std::pow(weights_.rtol() / error_, exponent_));
  h_ = std::max(hmin, h_ * factor);
  failed_ = true;
  return true;
}

Outcome Taylor::accept(const double* y1) {
  if (!expanded_ || (y1 != candidate_ && !std::equal(y1, y1 + n(), candidate_))) {
    expanded_ = false;
    if (expand(t1_, y1, next_) == Status::stop) return Outcome::stop;
  }
  if (!next_.finite && !all_finite(row(next_, 1), n())) return Outcome::not_finite;
  weights_.fill(y_.data(), y1, weight_);
  t_ = t1_;
  std::copy(y1, y1 + n(), y_.begin());
  if (next_.finite) h_ = std::min(reach(next_), failed_ ? h_ : largest_growth * h_);
  accepted_ = true;
  failed_ = false;
  return Outcome::ok;
}

void Taylor::state(Archive& archive) {
  Step::state(archive);
  if (archive.reading()) accepted_ = false;
  Expansion& expansion = at_point_reached();
  archive(expansion.c, expansion.unit, expansion.finite, failed_);
  archive.require(expansion.unit > 0);
}

Interpolate Taylor::interpolate() const { return power_series; }

Status Taylor::extension(double* data) {
  const double s = length_ / current_.unit;
  double power = 1;
  for (std::size_t k = 0; k <= order_; ++k, power *= s) {
    const double* c = row(current_, k);
    for (std::size_t i = 0; i < n(); ++i) *data++ = power * c[i];
  }
  return Status::ok;
}

double Taylor::stability() const {
  const auto size = [this](std::size_t k) {
    const double* c = row(current_, k);
    return max_norm(n(), [this, c](std::size_t i) { return c[i] / weight_[i]; });
  };
  const double before = size(order_ - 1), last = size(order_);
  const double s = std::abs(length_) / current_.unit;
  return before > 0 ? static_cast<double>(order_) * s * last / before / real_limit() : 0;
}

double Taylor::real_limit() const { return real_limits[order_]; }

const double* Taylor::slope() const {
  const Expansion& expansion = at_point_reached();
  for (std::size_t i = 0; i < n(); ++i) slope_[i] = row(expansion, 1)[i] / expansion.unit;
  return slope_;
}

}  // namespace invariode
