#include "delays/delays.hpp"

#include <algorithm>
#include <array>
#include <cassert>
#include <cmath>
#include <string>
#include <utility>

#include "methods/extensions.hpp"
#include "require.hpp"

namespace invariode {
namespace {

constexpr double longest_continuation = 3;  // so many times the last step it is continued: beyond, the tangent is safer
constexpr double short_beside = 5;          // delays that fit so often into h are shifted
constexpr std::size_t fewest_dropped = 64;  // segments of the past that are forgotten at once
constexpr std::array<double, 2> compared = {0.5, 1};  // where the extensions of two attempts are compared
constexpr double units_of_jump = 16;                  // of roundoff by which y0 may differ from the history

double value_of(const Lag& lag, std::span<const double> parameters) {
  if (!lag.parameter) return lag.value;
  require(*lag.parameter < parameters.size(), "a delay is a parameter that is not there");
  return parameters[*lag.parameter];
}

}  // namespace

Delays::Delays(const DelayTerms& terms, std::span<const double> parameters, Extent extent, const Bounds* bounds,
               double t0)
    : terms_(terms),
      extent_(extent),
      bounds_(bounds),
      t0_(t0),
      near_(terms.lags.size() + 1),
      in_(extent.n * (1 + terms.lags.size()) + terms.lags.size()),
      rows_(extent.k == 0 ? 0 : extent.size() * (1 + terms.lags.size())),
      value_(extent.size()),
      here_(extent.size()),
      before_(compared.size() * extent.size()),
      after_(compared.size() * extent.size()),
      beside_(extent.size()),
      rate_(extent.n) {
  require(!terms.lags.empty(), "there are no delays");
  require(terms.constant.size() == extent.n || static_cast<bool>(terms.history), "delays have no history");
  for (const Lag& lag : terms.lags) {
    const double tau = value_of(lag, parameters);
    require(tau > 0 && std::isfinite(tau), "a delay is not positive: " + std::to_string(tau));
    lags_.push_back(tau);
  }
  longest_ = *std::ranges::max_element(lags_);
  require(terms.rates.empty() || terms.rates.size() == lags_.size() * extent.k, "delays have no rates of that size");
}

Callback Delays::within(const Callback& f) { return {&Delays::entry, &functions_.emplace_back(*this, f)}; }

Status Delays::entry(void* self, double t, const double* y, double* out) {
  auto& [delays, function] = *static_cast<Delayed*>(self);
  if (delays.arguments(t, y) == Status::stop) return Status::stop;
  return function(t, delays.in_.data(), out);
}

MatrixFunction Delays::within(const MatrixFunction& derivative) {
  if (!derivative) return {};
  matrices_.push_back({*this, derivative});
  return {&Delays::matrix_entry, &matrices_.back()};
}

Status Delays::matrix_entry(void* self, double t, const double* y, Matrix& out) {
  auto& [delays, function] = *static_cast<DelayedMatrix*>(self);
  if (delays.arguments(t, y) == Status::stop) return Status::stop;
  double* along = delays.in_.data() + delays.extent_.n * (1 + delays.lags_.size());
  for (std::size_t j = 0; j < delays.lags_.size(); ++j) along[j] = delays.shifts(j) ? 1 : 0;
  return function(t, delays.in_.data(), out);
}

Callback Delays::augmented_within(const Callback& slope) {
  return {&Delays::augmented_entry, &functions_.emplace_back(*this, slope)};
}

Status Delays::augmented_entry(void* self, double t, const double* Y, double* out) {
  auto& [delays, slope] = *static_cast<Delayed*>(self);
  if (delays.rows(t, Y) == Status::stop) return Status::stop;
  return slope(t, delays.rows_.data(), out);
}

Mark Delays::image(std::size_t j, double t, int level, std::span<const double> rates) const {
  const double tau = lags_[j];
  Mark mark{.t = t + tau, .level = level + 1, .spacing = 0, .rates = {}};
  mark.spacing = std::max({ulp(t), ulp(tau), ulp(mark.t)});
  mark.rates.resize(lags_.size() * extent_.k);
  const std::span<const double> own = this->rates(j);
  for (std::size_t i = 0; i < extent_.k && level == 0; ++i)
    mark.rates[j * extent_.k + i] = (rates.empty() ? 0 : rates[i]) + (own.empty() ? 0 : own[i]);
  return mark;
}

/// Delays that are short beside the attempt are taken from y.
bool Delays::shifts(std::size_t j) const { return shift_ && h_ > short_beside * lags_[j]; }

/// (y, z_1, …) and (S_i, ∂z_1/∂p_i, …) at t.
Status Delays::rows(double t, const double* Y) {
  const std::size_t n = extent_.n, width = n * (1 + lags_.size());
  for (std::size_t r = 0; r <= extent_.k; ++r) std::copy_n(Y + r * n, n, rows_.data() + r * width);
  bool here_known = false;
  for (std::size_t j = 0; j < lags_.size(); ++j) {
    if (at(t - lags_[j], near_[j], value_.data()) == Status::stop) return Status::stop;
    if (shifts(j)) {
      if (!here_known && at(t, near_.back(), here_.data()) == Status::stop) return Status::stop;
      here_known = true;
      for (std::size_t i = 0; i < value_.size(); ++i) value_[i] = Y[i] + (value_[i] - here_[i]);
    }
    for (std::size_t r = 0; r <= extent_.k; ++r)
      std::copy_n(value_.data() + r * n, n, rows_.data() + r * width + (1 + j) * n);
    const std::span<const double> moved = rates(j);
    if (std::ranges::all_of(moved, [](double one) { return one == 0; })) continue;
    if (slope_at(t - lags_[j], near_[j]) == Status::stop) return Status::stop;
    for (std::size_t r = 1; r <= extent_.k; ++r) {
      double* dz = rows_.data() + r * width + (1 + j) * n;
      for (std::size_t i = 0; i < n; ++i) dz[i] -= rate_[i] * moved[r - 1];
    }
  }
  return Status::ok;
}

/// y' at s, from five values of the polynomial there: their truncation is O(part⁴), below their roundoff. Those of the
/// history are at times before t0.
Status Delays::slope_at(double s, std::size_t& near) {
  constexpr double part = 1e-3;
  constexpr std::array<double, 5> central = {1.0 / 12, -8.0 / 12, 0, 8.0 / 12, -1.0 / 12};
  constexpr std::array<double, 5> backward = {3.0 / 12, -16.0 / 12, 36.0 / 12, -48.0 / 12, 25.0 / 12};
  const bool before = s < t0_ || !steps_, beyond = !before && s > steps_->knots().back();
  const std::optional<Segment> segment = before || beyond ? std::nullopt : steps_->segment_at(s, near);
  std::ranges::fill(rate_, 0);
  if (before ? !terms_.constant.empty() : !beyond && !segment) return Status::ok;
  const double scale = before ? longest_ : beyond ? std::abs(h_) : segment->t1 - segment->t0;
  const double d = part * (scale > 0 ? scale : lags_.front());
  const bool ends = before && s + 2 * d > t0_;
  const std::array<double, 5>& weights = ends ? backward : central;
  for (std::size_t i = 0; i < weights.size(); ++i) {
    const double there = s + (static_cast<double>(i) - (ends ? 4 : 2)) * d;
    if (before) {
      if (history(there, beside_.data()) == Status::stop) return Status::stop;
    } else if (beyond) {
      ahead(there, beside_.data());
    } else {
      interpolant_->corrected(*segment, there, beside_.data());
    }
    for (std::size_t c = 0; c < extent_.n; ++c) rate_[c] += weights[i] / d * beside_[c];
  }
  if (beyond) looked_ahead_ = true;
  return Status::ok;
}

/// (y, z_1, …, z_k) at t.
Status Delays::arguments(double t, const double* y) {
  const std::size_t n = extent_.n;
  std::copy(y, y + n, in_.begin());
  if (!held_.empty()) {
    std::ranges::copy(held_, in_.data() + n);
    return Status::ok;
  }
  bool here_known = false;
  for (std::size_t j = 0; j < lags_.size(); ++j) {
    double* z = in_.data() + (1 + j) * n;
    double* to = extent_.k == 0 ? z : value_.data();
    if (at(t - lags_[j], near_[j], to) == Status::stop) return Status::stop;
    if (to != z) std::copy_n(to, n, z);
    if (!shifts(j)) continue;
    if (!here_known && at(t, near_.back(), here_.data()) == Status::stop) return Status::stop;
    here_known = true;
    for (std::size_t i = 0; i < n; ++i) z[i] = y[i] + (z[i] - here_[i]);
  }
  return Status::ok;
}

Status Delays::values(double t, double* z) {
  for (std::size_t j = 0; j < lags_.size(); ++j) {
    if (at(t - lags_[j], near_[j], value_.data()) == Status::stop) return Status::stop;
    std::copy_n(value_.data(), extent_.n, z + j * extent_.n);
  }
  return Status::ok;
}

/// Y at s.
Status Delays::at(double s, std::size_t& near, double* Y) {
  if (s < t0_ || !steps_) return history(s, Y);
  if (s > steps_->knots().back()) {
    looked_ahead_ = true;
    ahead(s, Y);
    return Status::ok;
  }
  const std::optional<Segment> segment = steps_->segment_at(s, near);
  if (segment)
    interpolant_->corrected(*segment, s, Y);
  else
    std::copy(y_.begin(), y_.end(), Y);
  return Status::ok;
}

Status Delays::history(double s, double* Y) {
  if (!terms_.history_varies) std::fill(Y + extent_.n, Y + extent_.size(), 0);
  if (!terms_.constant.empty()) {
    std::ranges::copy(terms_.constant, Y);
    return Status::ok;
  }
  Callback uncounted = terms_.history;
  return uncounted(s, in_.data(), Y);
}

void Delays::ahead(double s, double* Y) {
  switch (ahead_) {
    case Ahead::constant: std::copy(y_.begin(), y_.end(), Y); break;
    case Ahead::tangent:
      for (std::size_t i = 0; i < y_.size(); ++i) Y[i] = y_[i] + (s - t_) * slope_[i];
      break;
    case Ahead::continued: {
      std::size_t last = steps_->knots().size() - 1;
      interpolant_->corrected(*steps_->segment_at(steps_->knots().back(), last), s, Y);
      return;
    }
    case Ahead::attempt: {
      const double theta = (s - t_) / h_;
      steps_->kind().raw(data_.data(), data_size_, extent_.size(), {&theta, 1}, Y);
      break;
    }
  }
  if (bounds_ != nullptr) clip(*bounds_, {Y, extent_.size()});
}

// ---------------------------------------------------------------------------------------------------------------------
// What the loop does with it

Status Delays::begin(DenseOutput no_steps, const double* y, bool& jumps) {
  interpolant_.emplace(no_steps.kind(), nullptr, nullptr, bounds_);
  steps_.emplace(std::move(no_steps));
  y_.assign(y, y + extent_.size());
  steps_->start(t0_, y);
  if (history(t0_, value_.data()) == Status::stop) return Status::stop;
  jumps = extent_.k > 0;  // of S, which the history does not have
  for (std::size_t i = 0; i < extent_.n; ++i)
    jumps = jumps || !(std::abs(value_[i] - y[i]) <= units_of_jump * eps * std::max(std::abs(y[i]), smallest_scale));
  t_ = t0_;
  return Status::ok;
}

void Delays::jump(double t, const double* y) {
  steps_->start(t, y);
  t_ = t;
  y_.assign(y, y + extent_.size());
  ahead_ = Ahead::constant;
  continues_ = false;
}

void Delays::begin_step(double t, const double* y, const double* slope, bool shift) {
  t_ = t;
  shift_ = shift;
  y_.assign(y, y + extent_.size());
  slope_.assign(slope, slope + extent_.size());
}

void Delays::begin_attempt(double h) {
  h_ = h;
  looked_ahead_ = false;
  const Buffer<double>& t = steps_->knots();
  const bool near = continues_ && t.size() > 1 && h <= longest_continuation * (t.back() - t[t.size() - 2]);
  ahead_ = near ? Ahead::continued : Ahead::tangent;
}

double* Delays::room(std::size_t size) {
  next_.resize(size);
  return next_.data();
}

double Delays::agree(std::size_t size, const double* candidate, const Weights& weights) {
  const std::size_t Y = extent_.size();
  for (std::size_t p = 0; p < compared.size(); ++p) ahead(t_ + compared[p] * h_, before_.data() + p * Y);
  data_.swap(next_);
  data_size_ = size;
  ahead_ = Ahead::attempt;
  looked_ahead_ = false;
  for (std::size_t p = 0; p < compared.size(); ++p) ahead(t_ + compared[p] * h_, after_.data() + p * Y);
  MaxNorm change;
  for (std::size_t p = 0; p < compared.size(); ++p)
    for (std::size_t i = 0; i < extent_.n; ++i)
      change.add((after_[p * Y + i] - before_[p * Y + i]) / weights.at(i, y_[i], candidate[i]));
  return change.value();
}

void Delays::add(const Segment& segment, double t, const double* y) {
  steps_->add(segment, t, y);
  continues_ = true;
  ahead_ = Ahead::continued;
  t_ = t;
  h_ = 0;
  y_.assign(y, y + extent_.size());
  forget_before(t - longest_);
}

/// Drops segments that no delay reaches any more, once they are half of all: each is copied once on average.
void Delays::forget_before(double t) {
  const Buffer<double>& knots = steps_->knots();
  const std::size_t middle = knots.size() / 2;
  if (middle < fewest_dropped || !(knots[middle] < t)) return;
  steps_.emplace(steps_->from(middle));
  for (std::size_t& near : near_) near -= std::min(near, middle);
}

void Delays::state(Archive& archive) {
  archive(t_, h_, continues_, shift_);
  archive.require(std::isfinite(t_) && std::isfinite(h_));
  archive.resizable(y_);
  archive.resizable(slope_);
  if (archive.reading()) archive.require(y_.size() == extent_.size());
  if (archive.reading()) archive.require(slope_.empty() || slope_.size() == extent_.size());
  assert(steps_);
  steps_->state(archive);
  if (!archive.reading()) return;
  std::ranges::fill(near_, 0);
  ahead_ = continues_ ? Ahead::continued : Ahead::constant;
}

}  // namespace invariode
