#include "methods/taylor.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>

#include "aim.hpp"
#include "manifold/bounds.hpp"
#include "methods/initial_step.hpp"
#include "number.hpp"
#include "output/polynomial.hpp"

namespace invariode {

using namespace taylor;

namespace {

constexpr double shortly = 0x1p-20;    // of the reach: the solution may slide along a condition zero so soon
constexpr int most_close = 8;          // cuts in a row so shortly after the start, each twice as far as the last
constexpr double beyond = 4;           // ulp of t, from the root of a condition to the end of the step
constexpr double shortened = 0x1p-32;  // the unit of time, where coefficients overflow

/// Calls act(n), with a constant for n up to 8: loops over few components become straight code.
template <std::size_t N = 1, class Act>
INVARIODE_EACH auto with_size(std::size_t n, const Act& act) {
  if constexpr (N > 8)
    return act(n);
  else
    return n == N ? act(std::integral_constant<std::size_t, N>()) : with_size<N + 1>(n, act);
}

/// The shortest step that a condition is given: roundoff of t, also where t is 0.
double shortest(double t, double length) { return hmin_ulps * ulp(std::max(std::abs(t), length)); }

}  // namespace

Taylor::Taylor(Callback& f, const Weights& weights, SystemSeries& series, bool projected)
    : Step(f, weights),
      series_(series.solution),
      bounds_(series.bounds),
      conditions_(series),
      projected_(projected),
      order_(static_cast<std::size_t>(series_.order())),
      exponent_(1.0 / (series_.order() + 1)),
      factor_(std::exp((std::log(weights.rtol()) - margin) / (series_.order() - 1))),
      remainder_(weights.size()),
      values_(5 * weights.size()) {
  assert(lowest_order <= series_.order() && series_.order() <= highest_order);
  double* next = values_.data();
  for (Expansion& one : expansions_) one.c.resize((order_ + 1) * n());
  for (double** v : {&candidate_, &end_slope_, &f_value_, &inverse_weight_, &slope_})
    *v = std::exchange(next, next + n());
}

Outcome Taylor::start(double t, const double* y, const Span& span) {
  t_ = t;
  std::copy(y, y + n(), y_.begin());
  accepted_ = failed_ = crosses_ = false;
  remainder_.clear();
  undefined_ = {};
  if (f_(t, y, f_value_) == Status::stop) return Outcome::stop;
  if (!all_finite(f_value_, n())) {
    undefined_.component = first_undefined(f_value_);
    return Outcome::not_finite;
  }
  for (std::size_t i = 0; i < n(); ++i) inverse_weight_[i] = 1 / weights_.at(i, y[i]);
  h_ = with_exact_square(initial_step(norm(f_value_), t, span));
  if (expand(t, y, *current_) == Status::stop) return Outcome::stop;
  if (!current_->finite) return Outcome::not_finite;
  h_ = with_exact_square(initial_step(1 / reach(*current_), t, span));
  close_ = 0;
  return look_ahead(t, *current_, span.tf >= t ? h_ : -h_, h_) == Status::stop ? Outcome::stop : Outcome::ok;
}

/// The next step, from t along an expansion, is to have this signed length, unless a condition changes its sign before.
/// The reach of the coefficients measures how soon that is: after sliding, the length has the size of the tolerance.
INVARIODE_EACH Status Taylor::look_ahead(double t, const Expansion& expansion, double length, double reach) {
  h_ = free_ = std::abs(length);
  if (!conditions_.any()) return Status::ok;
  if (find_cut(t, expansion, length) == Status::stop) return Status::stop;
  const double least = shortest(t, free_);
  const bool close = cut_ <= shortly * reach + least, slides = close_ > most_close;
  close_ = slides ? (cut_ < free_ ? close_ : 0) : close ? close_ + 1 : 0;
  if (close_ > most_close)
    cut_ = std::numeric_limits<double>::infinity();  // the acceptance test limits h
  else if (close_ > 1)
    cut_ = std::max(cut_, std::ldexp(least, close_));  // it is on the same side as before
  h_ = std::min(free_, cut_);
  return Status::ok;
}

Status Taylor::find_cut(double t, const Expansion& expansion, double length) {
  searched_ = std::abs(length);
  cut_ = std::numeric_limits<double>::infinity();
  std::optional<double> root;
  const Status status = conditions_.first(t, expansion.unit, expansion.c.data(), length / expansion.unit, root);
  if (!root) return status;
  const double at = *root * searched_;
  cut_ = std::max(shortest(t, searched_), at + beyond * ulp(std::abs(t) + at));
  return status;
}

/// The expansion at (t, y), in a unit of time near h, that without a condition. (Beside a singularity that is much
/// closer than h coefficients overflow: the unit becomes shorter then.)
INVARIODE_EACH Status Taylor::expand(double t, const double* y, Expansion& into) {
  undefined_ = {};
  double unit = unit_near(crosses_ ? free_ : h_);
  do {
    if (series_(t, unit, y, into.c.data()) == Status::stop) return Status::stop;
    into.unit = unit;
    into.per_unit = 1 / unit;
    into.finite = all_finite(row(into, order_ - 1), 2 * n());  // what is not finite makes all after it so too
    if (into.finite || !all_finite(row(into, 1), n())) break;
    if (rest(t, y, into) == Status::stop) return Status::stop;
    if (into.finite) break;
    unit *= shortened;
  } while (unit >= std::numeric_limits<double>::min());
  for (std::size_t k = 1; k <= order_ && !into.finite && undefined_.component < 0; ++k)
    undefined_ = {.component = first_undefined(row(into, k)), .coefficient = static_cast<int>(k)};
  return Status::ok;
}

/// Components that have no series where y' is 0, as √y and y^1.5 at y = 0, are constants of the polynomial: the error
/// test tells whether they stay at rest.
Status Taylor::rest(double t, const double* y, Expansion& into) {
  if (!projected_ && std::find(row(into, 1), row(into, 2), 0.0) == row(into, 2)) return Status::ok;
  std::vector<double> slope(n());
  if (f_(t, y, slope.data()) == Status::stop) return Status::stop;
  for (std::size_t i = 0; i < n(); ++i) {
    bool defined = true;
    for (std::size_t k = 1; k <= order_; ++k) defined = defined && std::isfinite(row(into, k)[i]);
    for (std::size_t k = 1; !defined && slope[i] == 0 && k <= order_; ++k) into.c[k * n() + i] = 0;
  }
  into.finite = all_finite(row(into, order_ - 1), 2 * n());
  return Status::ok;
}

int Taylor::first_undefined(const double* v) const {
  for (std::size_t i = 0; i < n(); ++i)
    if (!std::isfinite(v[i])) return static_cast<int>(i);
  return -1;
}

/// Returns the norm of v in the weights of the last attempt, at both its ends.
double Taylor::norm(const double* v) const { return taylor::norm(v, n(), inverse_weight_); }

double Taylor::reach(const Expansion& expansion) const {
  return with_size(n(), [&](auto size) {
    return taylor::reach(expansion.c.data(), size, order_, expansion.unit, factor_, inverse_weight_);
  });
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
  if (conditions_.any() && h_ > searched_ && find_cut(t_, *current_, length_) == Status::stop)
    return {Outcome::stop, error_, candidate_};
  if (h_ > cut_) return {Outcome::ok, std::numeric_limits<double>::max(), candidate_};
  crosses_ = h_ == cut_;
  error_ = std::numeric_limits<double>::quiet_NaN();
  per_unit_ = current_->per_unit;
  unit_of_error_ = h_ * exponent_ * std::min(1.0, weights_.rtol() / least_tested);
  if (!with_size(n(), [this](auto size) { return propose(size); })) return {Outcome::not_finite, error_, candidate_};
  if (evaluate_at_candidate() == Status::stop) return {Outcome::stop, error_, candidate_};
  if (crosses_)
    error_ = norm(row(*current_, order_)) * std::pow(h_ * per_unit_, order());
  else
    error_ = unit_of_error_ * with_size(n(), [this](auto size) {
               return max_norm(size, [this](std::size_t i) { return inverse_weight_[i] * defect(i); });
             });
  if (bounds_ != nullptr && error_ <= weights_.rtol() && look_at_rest() == Status::stop)
    return {Outcome::stop, error_, candidate_};
  return {Outcome::ok, error_, candidate_};
}

/// Evaluates the polynomial at the end of the step, and the weights with it. False: it is not finite.
template <class Size>
bool Taylor::propose(Size size) {
  double sum = 0;
  evaluate_polynomial(current_->c.data(), size, order_, length_ * per_unit_,
                      [&](std::size_t i, double rise, double slope) {
                        const double y1 = remainder_.propose(i, y_[i], rise);
                        candidate_[i] = y1;
                        end_slope_[i] = slope;
                        inverse_weight_[i] = 1 / weights_.at(i, y_[i], y1);
                        sum += 0 * y1;
                      });
  return sum == 0;
}

/// A component that rests at its bound throughout the polynomial may have left it between the ends: its y' there is a
/// defect as at the end.
Status Taylor::look_at_rest() {
  std::vector<std::size_t> resting;
  for (const auto& [i, lower, upper] : bounds_->intervals()) {
    bool rests = y_[i] <= lower || y_[i] >= upper;
    for (std::size_t k = 1; rests && k <= order_; ++k) rests = row(*current_, k)[i] == 0;
    if (rests) resting.push_back(i);
  }
  const std::size_t parts = intervals_of_step(order_);
  std::vector<double> y(n()), slope(n());
  for (std::size_t j = 1; j < parts && !resting.empty(); ++j) {
    const double theta = static_cast<double>(j) / static_cast<double>(parts);
    power_series(current_->c.data(), current_->c.size(), n(), theta * length_ * per_unit_, y.data());
    if (f_(t_ + theta * length_, y.data(), slope.data()) == Status::stop) return Status::stop;
    for (const std::size_t i : resting)
      error_ = std::max(error_, unit_of_error_ * inverse_weight_[i] * std::abs(slope[i]));
  }
  return Status::ok;
}

/// f(t₁, y*), times 1 / `per_end_unit_`: the next expansion has it, where the candidate will not be moved.
INVARIODE_EACH Status Taylor::evaluate_at_candidate() {
  if (projected_) {
    per_end_unit_ = 1;
    undefined_ = {};
    end_f_ = f_value_;
    const Status status = f_(t1_, candidate_, f_value_);
    if (status == Status::ok) undefined_.component = first_undefined(end_f_);
    return status;
  }
  expanded_ = true;
  const Status status = expand(t1_, candidate_, *next_);
  per_end_unit_ = next_->per_unit;
  end_f_ = row(*next_, 1);
  return status;
}

/// y − P = c_{p+1} h^{p+1} + … and h (y′ − P′) = (p + 1) c_{p+1} h^{p+1} + …, where f(t₁, y*) is y′ but for what is
/// smaller by another factor h: the error is h / (p + 1) of this. (Where f has changed its branch at the end of the
/// step, y′ is not that of the polynomial: its last term is taken for the error.)
double Taylor::defect(std::size_t i) const { return end_f_[i] * per_end_unit_ - end_slope_[i] * per_unit_; }

bool Taylor::errors(double* out) const {
  const double last = crosses_ ? std::pow(length_ * per_unit_, order()) : 0;
  for (std::size_t i = 0; i < n(); ++i)
    out[i] = crosses_ ? last * row(*current_, order_)[i] : length_ * exponent_ * defect(i);
  return true;
}

std::size_t Taylor::directions(const double** vectors) const {
  for (std::size_t k = 1; k <= order_; ++k) *vectors++ = row(*current_, k);
  return order_;
}

bool Taylor::reject(Cause cause, double hmin) {
  if (h_ <= hmin) return false;
  if (cause == Cause::error && h_ > cut_) {
    h_ = cut_;
    return true;
  }
  double factor = halved;
  if (!failed_ && cause == Cause::error)
    factor = std::max(floor_after_failure, safety * std::pow(weights_.rtol() / error_, exponent_));
  h_ = std::max(hmin, with_exact_square(h_ * factor));
  failed_ = true;
  return true;
}

Outcome Taylor::accept(const double* y1) {
  if (!expanded_ || (y1 != candidate_ && !std::equal(y1, y1 + n(), candidate_))) {
    expanded_ = false;
    if (expand(t1_, y1, *next_) == Status::stop) return Outcome::stop;
  }
  if (!next_->finite && !all_finite(row(*next_, 1), n())) return Outcome::not_finite;
  const double longest = crosses_ ? free_ : failed_ ? h_ : largest_growth * h_;
  const double allowed = next_->finite ? reach(*next_) : h_;
  const double length = next_->finite ? with_exact_square(std::min(allowed, longest)) : h_;
  const double scale = std::isfinite(allowed) ? allowed : length;  // infinite beside polynomials
  if (look_ahead(t1_, *next_, std::copysign(length, length_), scale) == Status::stop) return Outcome::stop;
  if (moved_onto_bounds_)
    remainder_.clear();
  else
    remainder_.accept();
  t_ = t1_;
  std::copy(y1, y1 + n(), y_.begin());
  accepted_ = true;
  failed_ = false;
  return Outcome::ok;
}

void Taylor::state(Archive& archive) {
  Step::state(archive);
  if (archive.reading()) accepted_ = false;
  Expansion& expansion = at_point_reached();
  archive(expansion.c, expansion.unit, expansion.finite, remainder_, free_, searched_, cut_, close_, failed_);
  archive.require(expansion.unit > 0);
  expansion.per_unit = 1 / expansion.unit;
}

Interpolate Taylor::interpolate() const { return power_series; }

Status Taylor::extension(double* data) {
  scale_coefficients(current_->c.data(), n(), order_, length_ / current_->unit, data);
  return Status::ok;
}

/// The polynomial is that of the start of the step, accepted or not.
Status Taylor::extension_of_attempt(double* data, std::size_t& size) {
  size = extension_size();
  return extension(data);
}

double Taylor::stability() const {
  const double before = norm(row(*current_, order_ - 1)), last = norm(row(*current_, order_));
  const double s = std::abs(length_) / current_->unit;
  return before > 0 ? static_cast<double>(order_) * s * last / before / real_limit() : 0;
}

double Taylor::real_limit() const { return real_limits[order_]; }

const double* Taylor::slope() const {
  const Expansion& expansion = at_point_reached();
  for (std::size_t i = 0; i < n(); ++i) slope_[i] = row(expansion, 1)[i] / expansion.unit;
  return slope_;
}

}  // namespace invariode
