#pragma once
// The arithmetic of one step by Taylor series: the length that the coefficients allow, the polynomial and its slope at
// the end, the next length (docs/algorithms.md, 'Taylor series'). The numbers are doubles, or packs of them, one
// trajectory in each lane.

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <limits>
#include <numbers>
#include <type_traits>

#include "number.hpp"
#include "weights.hpp"

namespace invariode::taylor {

inline constexpr int highest_order = 40;
inline constexpr double margin =
    0.7;  // h is e^{−0.7/(p−1)} of the length that the last coefficients allow (Jorba, Zou)
inline constexpr double safety = 0.8;               // of the predicted optimal step, after a failure
inline constexpr double floor_after_failure = 0.1;  // of h
inline constexpr double halved = 0.5;               // after further failures
inline constexpr double largest_growth = 5;  // of h: the last coefficients may be small by chance, where one vanishes
inline constexpr double least_tested =
    4 * eps;  // rtol of the acceptance test: smaller errors of the slope are roundoff

/// The x > 0 at which 1 − x + x²/2 − … ± x^p/p! leaves [−1, 1], by the order p.
inline constexpr auto real_limits = [] {
  constexpr double step = 1. / 16;
  constexpr double roundoff = 1e-8;  // of terms up to e^x
  std::array<double, highest_order + 1> limits{};
  double x = step;  // which grows with the order
  for (int p = 1; p <= highest_order; ++p) {
    const auto value = [p](double at) {
      double sum = 1;
      for (int k = p; k > 0; --k) sum = 1 - sum * at / k;
      return sum;
    };
    while (value(x) <= 1 + roundoff && value(x) >= -1 - roundoff) x += step;
    limits[static_cast<std::size_t>(p)] = x;
  }
  return limits;
}();

inline constexpr auto reciprocals = [] {
  std::array<double, highest_order + 1> values{};
  for (std::size_t k = 1; k < values.size(); ++k) values[k] = 1 / static_cast<double>(k);
  return values;
}();

inline constexpr double smallest_normal = std::numeric_limits<double>::min(), largest_power = 0x1p1023;
inline constexpr double bias = 1023;  // of exponents

/// 2^x, to 2e-4, of an x for which it is a normal number.
template <class Real>
INVARIODE_EACH Real power_of_two(const Real& x) {
  const Real inside = larger(Real(1 - bias), smaller(Real(bias), x));
  const Real rounded = inside + Real(0x1p52 + bias);  // to the nearest integer, with the bias: the exponent
  const Real u = std::numbers::ln2 * (inside - (rounded - Real(0x1p52 + bias)));
  const Real power = on_bits(rounded, [](auto word) { return word << 52U; });
  return ((Real(1) + u) + u * u * (Real(1. / 2) + (1. / 6) * u)) * power;
}

/// A length of at most 25 bits below h, whose square is exact. Squares of s = (t₁ − t) / unit are rounded otherwise,
/// and where t is so large that t₁ − t has 27 or 28 bits, with a bias: energies drift by it.
template <class Real>
INVARIODE_EACH Real with_exact_square(const Real& h) {
  constexpr std::uint64_t last_28 = (std::uint64_t{1} << 28U) - 1;
  return on_bits(h, [](auto word) { return word & ~last_28; });
}

/// The power of two nearest to h > 0, in ratio.
template <class Real>
INVARIODE_EACH Real unit_near(const Real& h) {
  const Real power = on_bits(std::numbers::sqrt2 * h, [](auto word) { return word & ~mantissa_bits; });
  return larger(Real(smallest_normal), smaller(Real(largest_power), power));
}

/// max |v_i| ω_i
template <class Real>
INVARIODE_EACH Real norm(const Real* v, std::size_t n, const Real* inverse_weight) {
  Real largest(0);
  for (std::size_t i = 0; i < n; ++i) largest = larger(largest, absolute(v[i]) * inverse_weight[i]);
  return largest;
}

/// The largest (log₂ ‖c_k‖) / k of the last two coefficients that do not vanish; −∞ if the last two of all do.
template <class Real>
INVARIODE_SHARED Real rate_of_last_two(const Real* c, std::size_t n, std::size_t order, const Real* inverse_weight) {
  Real rate(-std::numeric_limits<double>::infinity()), seen(0);
  for (std::size_t k = order; k > 0 && any(seen < Real(2)); --k) {
    if (k + 2 == order) seen = choose(seen < Real(1), Real(2), seen);
    const Real size = norm(c + k * n, n, inverse_weight);
    const Real now = choose(size < Real(smallest_normal), seen, smaller(seen + Real(1), Real(2)));
    rate = choose(seen < now, larger(rate, reciprocals[k] * rough_log2(size)), rate);
    seen = now;
  }
  return rate;
}

/// The |h| for which the last two coefficients that do not vanish are small enough, in the weights: ‖c_k‖ |h|^k ≤
/// (rtol e^{−0.7})^{k/(p−1)}, `factor` being (rtol e^{−0.7})^{1/(p−1)}. Infinite where the last two of all vanish: the
/// solution may be a polynomial, and the acceptance test tells.
template <class Real>
INVARIODE_EACH Real reach(const Real* c, std::size_t n, std::size_t order, const Real& unit, double factor,
                          const Real* inverse_weight) {
  const Real *last_row = c + order * n, *row_before = last_row - n;
  Real last(0), before(0);
  for (std::size_t i = 0; i < n; ++i) {
    last = larger(last, absolute(last_row[i]) * inverse_weight[i]);
    before = larger(before, absolute(row_before[i]) * inverse_weight[i]);
  }
  Real rate = larger(reciprocals[order] * rough_log2(last), reciprocals[order - 1] * rough_log2(before));
  constexpr double infinity = std::numeric_limits<double>::infinity();
  if (any(smaller(last, before) < Real(smallest_normal))) rate = rate_of_last_two(c, n, order, inverse_weight);
  const Real length = larger(factor * unit * power_of_two(Real(0) - rate), Real(smallest_normal));
  return choose(Real(-infinity) < rate, length, Real(infinity));
}

/// Passes P(s) = Σ c_k s^k less c_0, and P′(s), of the components of `Width` registers beside each other to
/// each(i, P, P′). As a sum of an odd and an even polynomial, s A(s²) + s² B(s²), no number waits for more than half of
/// the others.
template <std::size_t Width, class Register, class Real, class Each>
INVARIODE_EACH void evaluate_beside(const Real* c, std::size_t n, std::size_t order, const Real& s, const Each& each) {
  constexpr std::size_t numbers = sizeof(Register) / sizeof(Real);  // NOLINT(bugprone-sizeof-expression): or 1
  const Real u = s * s;
  Register a[Width]{}, da[Width]{}, b[Width]{}, db[Width]{};
  const Real* row = c + order * n;
  const auto add = [&](Register* p, Register* d) {
    for (std::size_t i = 0; i < Width; ++i) {
      Register coefficients;
      std::memcpy(&coefficients, row + i * numbers, sizeof(Register));
      d[i] = d[i] * u + p[i];
      p[i] = p[i] * u + coefficients;
    }
    row -= n;
  };
  std::size_t k = order;
  if (k % 2 == 1) add(a, da), --k;
  for (; k > 0; k -= 2) add(b, db), add(a, da);
  for (std::size_t i = 0; i < Width; ++i) {
    const Register rise = s * a[i] + u * b[i], slope = a[i] + 2.0 * (u * da[i] + s * (b[i] + u * db[i]));
    if constexpr (numbers == 1)
      each(i, rise, slope);
    else
      for (std::size_t j = 0; j < numbers; ++j) each(i * numbers + j, rise[j], slope[j]);
  }
}

/// Evaluates the polynomials of all n components, and passes P(s) less c_0 and P′(s) of each to each(i, P, P′).
/// `Size`: n, or a constant of that value.
template <class Real, class Size, class Each>
INVARIODE_EACH void evaluate_polynomial(const Real* c, Size n, std::size_t order, const Real& s, const Each& each) {
  const auto from = [&each](std::size_t first) {
    return [&each, first](std::size_t j, const Real& rise, const Real& slope) { each(first + j, rise, slope); };
  };
  std::size_t i = 0;
  if constexpr (std::is_same_v<Real, double>) {
    for (; i + 4 <= n; i += 4) evaluate_beside<4 / in_pair, Pair>(c + i, n, order, s, from(i));
    if (i + 3 == n) return evaluate_beside<3, Real>(c + i, n, order, s, from(i));
    for (; i + 2 <= n; i += 2) evaluate_beside<2 / in_pair, Pair>(c + i, n, order, s, from(i));
  }
  for (; i < n; ++i) evaluate_beside<1, Real>(c + i, n, order, s, from(i));
}

/// The extension of a step of length s, in units of its expansion: c_k s^k.
template <class Real>
void scale_coefficients(const Real* c, std::size_t n, std::size_t order, const Real& s, Real* out) {
  Real power(1);
  for (std::size_t k = 0; k <= order; ++k, power = power * s)
    for (std::size_t i = 0; i < n; ++i) *out++ = power * *c++;
}

}  // namespace invariode::taylor
