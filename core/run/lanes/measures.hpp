#pragma once
// What is measured in all lanes at once: sizes in the weights of the error test, and whether numbers are finite.
// (INVARIODE_LANES: see pack.hpp.)

#include <cstddef>
#include <limits>

#include "run/lanes/lanes.hpp"
#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

inline constexpr double infinity = std::numeric_limits<double>::infinity();

/// MaxNorm of packs: NaN gets through.
template <int W>
class LaneNorm {
 public:
  INVARIODE_EACH void add(const Pack<W>& a) {
    const Pack<W> size = absolute(a);
    max_ = larger(max_, size);
    undefined_ += 0.0 * size;  // of infinity too, which no error test passes either
  }
  [[nodiscard]] Pack<W> value() const { return max_ + undefined_; }

 private:
  Pack<W> max_{0}, undefined_{0};
};

/// `Weights::at` of |y_i|, of the state.
template <int W>
INVARIODE_EACH Pack<W> weight(const Job& job, std::size_t i, const Pack<W>& size) {
  return larger(job.scale != nullptr ? job.scale[i] * size : size, Pack<W>(job.threshold[i]));
}

/// Returns the weights of a step from y0 to y1.
template <int W>
auto weight_of(const Job& job, const Pack<W>* y0, const Pack<W>* y1) {
  return [&job, y0, y1](std::size_t i) { return weight(job, i, larger(absolute(y0[i]), absolute(y1[i]))); };
}

/// The steps that lanes make: from (t0, y0), with parameters p, by stages of the signed size h to (t1, y1), `purified`
/// = t1 − t0; and the points that they have reached: their ends, unless an event cuts them.
template <int W>
struct LaneStep {
  Pack<W> t0, t1, h, purified, reached_t;
  const Pack<W>*y0, *y1, *p, *reached_y;
};

/// Writes values at θ of the extension of a method, a polynomial with these coefficients.
template <int W>
using LaneExtension = void(const Pack<W>* coefficients, std::size_t size, std::size_t n, const Pack<W>& theta,
                           Pack<W>* out);

template <int W>
Pack<W>* take(Host& host, std::size_t rows) {
  return static_cast<Pack<W>*>(host.allocate(rows * sizeof(Pack<W>)));
}

template <int W>
Mask<W> no_lane() {
  return to_mask<W>(0);
}

/// The lanes in which one of n numbers is not finite: 0 · x is 0 where x is, and NaN where it is not.
template <int W>
INVARIODE_EACH Mask<W> not_finite(const Pack<W>* v, std::size_t n) {
  Pack<W> sum(0);
  for (std::size_t i = 0; i < n; ++i) sum += 0.0 * v[i];
  return ~(sum <= Pack<W>(0));
}

template <int W>
INVARIODE_SHARED void replace(const Mask<W>& where, Pack<W>* v, const Pack<W>* instead, std::size_t n) {
  for (std::size_t i = 0; i < n; ++i) v[i] = choose(where, instead[i], v[i]);
}

/// Functions are never asked at points that are not finite: in such lanes the numbers of `instead` take their place.
/// Returns which they are.
template <int W>
INVARIODE_EACH Mask<W> mend(Pack<W>* v, const Pack<W>* instead, std::size_t n) {
  const Mask<W> odd = not_finite(v, n);
  if (any(odd)) replace(odd, v, instead, n);
  return odd;
}

/// Returns whether whole numbers that are not negative are multiples of a power of two.
template <int W>
Mask<W> multiple_of(const Pack<W>& x, double power) {
  constexpr double to_integer = 4503599627370496;  // 2⁵²: what is added to it is rounded to an integer
  const Pack<W> part = (1 / power) * x, whole = (part + Pack<W>(to_integer)) - Pack<W>(to_integer);
  return (part <= whole) & (whole <= part);
}

/// A function in all lanes.
template <int W>
INVARIODE_EACH void evaluate(const Called& f, const Pack<W>& t, const Pack<W>* y, Pack<W>* out, const Pack<W>* p) {
  f.function(f.context, t.lanes(), y->lanes(), out->lanes(), reinterpret_cast<const double*>(p));
}

}  // namespace invariode::lanes::INVARIODE_LANES
