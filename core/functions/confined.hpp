#pragma once
// The functions of a problem as they are called within bounds (docs/algorithms.md, 'Bounds').

#include <algorithm>
#include <cstddef>
#include <deque>
#include <limits>
#include <utility>
#include <vector>

#include "callback.hpp"
#include "linear/jacobian.hpp"
#include "linear/matrix.hpp"
#include "manifold/bounds.hpp"
#include "weights.hpp"

namespace invariode {

/// f and its derivatives never see a y outside of the bounds: they are called at the nearest point within. What is made
/// of functions refers to this, and to nothing else but the bounds and the weights.
class Confined {
 public:
  Confined(const Bounds& bounds, const Weights& weights) : bounds_(bounds), weights_(weights), inside_(bounds.n()) {}
  Confined(const Confined&) = delete;
  Confined& operator=(const Confined&) = delete;

  Callback within(const Callback& function) {
    if (!function) return {};
    return {&Confined::callback_entry, &functions_.emplace_back(*this, function)};
  }
  MatrixFunction within(const MatrixFunction& function) {
    if (!function) return {};
    return {&Confined::matrix_entry, &matrices_.emplace_back(*this, function)};
  }
  Jacobian::Source within(Jacobian::Source source) {
    source.function = within(source.function);
    source.complex_f = complex_within(source.complex_f);
    source.rate = within(source.rate);
    source.product = product_within(source.product);
    return source;
  }
  /// A product J v, a function of (y, v).
  Callback product_within(const Callback& function) {
    if (!function) return {};
    return {&Confined::product_entry, &functions_.emplace_back(*this, function)};
  }
  /// The slopes of sensitivities, a function of Y, which has `size` doubles.
  Callback augmented_within(const Callback& function, std::size_t size) {
    all_.resize(size);
    return {&Confined::augmented_entry, &functions_.emplace_back(*this, function)};
  }
  /// The function for tests of where f is defined: NaN beyond roundoff of the bounds.
  Callback defined(const Callback& function) {
    return {&Confined::defined_entry, &functions_.emplace_back(*this, function)};
  }

 private:
  /// f of complex y, pairs of reals.
  Callback complex_within(const Callback& function) {
    if (!function) return {};
    return {&Confined::complex_entry, &functions_.emplace_back(*this, function)};
  }

  template <class Function>
  struct BoundedFunction {
    BoundedFunction(Confined& confined_, Function function_) : confined(confined_), function(std::move(function_)) {}
    Confined& confined;
    Function function;
  };

  /// y itself, where it is inside: then nothing is copied.
  const double* nearest(const double* y) {
    if (bounds_.contain(y)) return y;
    std::copy(y, y + inside_.size(), inside_.begin());
    bounds_.clip(inside_.data());
    return inside_.data();
  }

  static Status callback_entry(void* self, double t, const double* y, double* out) {
    auto& [confined, function] = *static_cast<BoundedFunction<Callback>*>(self);
    return function(t, confined.nearest(y), out);
  }
  static Status matrix_entry(void* self, double t, const double* y, Matrix& out) {
    auto& [confined, function] = *static_cast<BoundedFunction<MatrixFunction>*>(self);
    return function(t, confined.nearest(y), out);
  }
  static Status product_entry(void* self, double t, const double* y_and_v, double* out) {
    auto& [confined, function] = *static_cast<BoundedFunction<Callback>*>(self);
    if (confined.bounds_.contain(y_and_v)) return function(t, y_and_v, out);
    confined.both_.assign(y_and_v, y_and_v + 2 * confined.inside_.size());
    confined.bounds_.clip(confined.both_.data());
    return function(t, confined.both_.data(), out);
  }
  static Status augmented_entry(void* self, double t, const double* Y, double* out) {
    auto& [confined, function] = *static_cast<BoundedFunction<Callback>*>(self);
    if (confined.bounds_.contain(Y)) return function(t, Y, out);
    std::copy_n(Y, confined.all_.size(), confined.all_.begin());
    confined.bounds_.clip(confined.all_.data());
    return function(t, confined.all_.data(), out);
  }
  static Status complex_entry(void* self, double t, const double* y, double* out) {
    auto& [confined, function] = *static_cast<BoundedFunction<Callback>*>(self);
    confined.both_.assign(y, y + 2 * confined.inside_.size());
    for (const auto& [i, lower, upper] : confined.bounds_.intervals())
      confined.both_[2 * i] = std::clamp(y[2 * i], lower, upper);
    return function(t, confined.both_.data(), out);
  }
  static Status defined_entry(void* self, double t, const double* y, double* out) {
    auto& [confined, function] = *static_cast<BoundedFunction<Callback>*>(self);
    if (confined.bounds_.excess(y, confined.weights_).size <= roundoff_at_bound)
      return function(t, confined.nearest(y), out);
    std::fill_n(out, confined.inside_.size(), std::numeric_limits<double>::quiet_NaN());
    return Status::ok;
  }

  const Bounds& bounds_;
  const Weights& weights_;
  std::vector<double> inside_, both_, all_;          // y; y and v, or complex y; Y
  std::deque<BoundedFunction<Callback>> functions_;  // which stay where they are when there are more of them
  std::deque<BoundedFunction<MatrixFunction>> matrices_;
};

}  // namespace invariode
