#pragma once
// x^(1/q) as std::pow gives it, to the last bit, in all lanes at once. (INVARIODE_LANES: see pack.hpp.)

#include <cmath>
#include <cstdint>
#include <numbers>

#include "run/lanes/pack.hpp"

namespace invariode::lanes::INVARIODE_LANES {

// A result is that of pow if it is farther than this from the middle of two doubles, in units of their distance: its
// own error before rounding is at most 0.005 (tests/native/lanes.cpp), that of glibc's pow at most 0.012 (the comment
// at the head of its sysdeps/ieee754/dbl-64/e_pow.c, for exponents below 1 and such x). Others are left to pow, which
// of other libraries is not known to be as accurate.
inline constexpr double doubt = 0.02;
#if defined(__GLIBC__)
inline constexpr bool pow_is_accurate = true;
#else
inline constexpr bool pow_is_accurate = false;
#endif

/// z^Q
template <int Q, class Real>
Real power(const Real& z) {
  if constexpr (Q == 1)
    return z;
  else if constexpr (Q % 2 == 0)
    return power<Q / 2>(z * z);
  else
    return power<Q / 2>(z * z) * z;
}

/// The binomial coefficient (1/Q over k)
constexpr double binomial(int Q, int k) {
  double c = 1;
  for (int j = 0; j < k; ++j) c *= (1.0 / Q - j) / (j + 1);
  return c;
}

/// fl(1/Q) − 1/Q, from 1 − Q fl(1/Q), which 27 bits of the factor at a time give without roundoff.
constexpr double excess_of_exponent(int Q) {
  constexpr double splitter = 134217729;  // 2^27 + 1
  const double x = 1.0 / Q, high = x * splitter - (x * splitter - x), low = x - high;
  return ((Q * high - 1) + Q * low) / Q;
}

/// x^(-1/Q) to 4 %. The high word of a double is, but for a scale and an offset, a piecewise linear approximation of
/// its logarithm, which is multiplied by −1/Q.
template <int Q, int W>
Pack<W> first_inverse_root(const Pack<W>& x) {
  constexpr double two52 = 0x1p52, high_of_one = 0x3FF00000;
  constexpr double shift = Q == 3 ? 70000 : Q == 5 ? 62000 : 56000;  // of least largest error, by a search
  const Pack<W> high = on_bits(x, [](auto word) { return (word >> 32) | bits_of_two52; }) - Pack<W>(two52);
  const Pack<W> root = Pack<W>(high_of_one * (1 + 1.0 / Q) - shift + two52) - (1.0 / Q) * high;
  return on_bits(root, [](auto word) { return word << 32; });
}

/// x − y^Q of y of ten bits near x^(1/Q), but for a rounding error of its own. y^Q is exact for Q ≤ 5. Otherwise it is
/// the product of two exact powers, which are cut in two so that the product of their heads, of 26 bits each, is exact.
template <int Q, int W>
Pack<W> residual(const Pack<W>& x, const Pack<W>& y) {
  if constexpr (Q <= 5) return x - power<Q>(y);
  constexpr std::uint64_t tail_bits = (std::uint64_t{1} << 27U) - 1;
  const auto head = [](const Pack<W>& v) { return on_bits(v, [](auto word) { return word & ~tail_bits; }); };
  const Pack<W> a = power<Q / 2>(y), b = power<Q - Q / 2>(y), ah = head(a), bh = head(b), al = a - ah, bl = b - bh;
  return (x - ah * bh) - ((ah * bl + al * bh) + al * bl);
}

/// x^fl(1/Q) before it is rounded, as the sum of `short_part`, of ten bits, and `rest`: y (1 + u)^(1/Q) by the binomial
/// series, u = (x − y^Q) / y^Q, |u| < 2^-6.
template <int Q, int W>
void split_root(const Pack<W>& x, Pack<W>& short_part, Pack<W>& rest) {
  using P = Pack<W>;
  P z = first_inverse_root<Q>(x);
  if constexpr (Q > 5) {  // z ← z (1 + e/Q + (1 + Q) e²/(2 Q²)), e = 1 − x z^Q
    const P e = P(1) - x * power<Q>(z);
    z += z * e * (P(1.0 / Q) + (1.0 + Q) / (2.0 * Q * Q) * e);
  }
  const P most = x * power<Q - 1>(z), e = P(1) - most * z;
  constexpr double a = (Q - 1.0) / Q;  // x z^(Q−1) (1 − e)^−a
  constexpr double a2 = a * (a + 1) / 2, a3 = a2 * (a + 2) / 3;
  const P near = most * (P(1) + e * (P(a) + e * (P(a2) + a3 * e)));
  constexpr unsigned dropped = 53 - 10;
  constexpr std::uint64_t half = std::uint64_t{1} << (dropped - 1);
  const P y = on_bits(near, [](auto word) { return (word + half) & ~(2 * half - 1); });

  const P u = residual<Q>(x, y) / power<Q>(y), u2 = u * u, u4 = u2 * u2;
  const auto c = [](int k) { return binomial(Q, k); };
  const P tail = (P(c(2)) + c(3) * u) + (P(c(4)) + c(5) * u) * u2 + ((P(c(6)) + c(7) * u) + c(8) * u2) * u4;
  const P exponent_is_rounded = std::numbers::ln2 * excess_of_exponent(Q) * rough_log2(x);
  short_part = y;
  rest = y * ((1.0 / Q) * u + (u2 * tail + exponent_is_rounded));
}

/// Returns the root rounded, and where its rounding is doubtful.
template <int Q, int W>
Pack<W> rounded_root(const Pack<W>& x, Mask<W>& doubtful) {
  using P = Pack<W>;
  P y, rest;
  split_root<Q>(x, y, rest);
  const P root = y + rest;
  const P lost = absolute((y - root) + rest);                                             // exact, since |y| > |rest|
  const P power_of_two = on_bits(root, [](auto word) { return word & ~mantissa_bits; });  // spacing changes there
  doubtful = ~((lost < (0.5 - doubt) * 0x1p-52 * power_of_two) & (power_of_two < root));
  return root;
}

/// std::pow(x, 1.0 / Q)
template <int Q, int W>
Pack<W> root_by_pow(const Pack<W>& x) {
  Pack<W> root;
  Mask<W> doubtful = to_mask<W>(one_lane(W) - 1);
  if constexpr (W > 1 && pow_is_accurate) root = rounded_root<Q>(x, doubtful);
  const unsigned left = bits(doubtful);
  for (int l = 0; left != 0 && l < W; ++l)
    if (has(left, l)) root.lanes()[l] = std::pow(x.lanes()[l], 1.0 / Q);
  return root;
}

}  // namespace invariode::lanes::INVARIODE_LANES
