#pragma once
// What a template on the number asks of it: of doubles here, of packs of them by functions of the same names
// (run/lanes/pack.hpp). Where something is true is a bool of doubles, and a mask of packs.

#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>

// Functions of which the code for packs shares one, and those that are a part of each caller: the compiler would take
// its decision for both by their number.
#if defined(__GNUC__)
#define INVARIODE_SHARED [[gnu::noinline]]
#define INVARIODE_EACH [[gnu::always_inline]] inline
#else
#define INVARIODE_SHARED
#define INVARIODE_EACH inline
#endif

namespace invariode {

/// Two doubles in a register of every processor of 64 bits, where the compiler knows such.
#if defined(__GNUC__)
typedef double Pair __attribute__((vector_size(2 * sizeof(double))));  // NOLINT(modernize-use-using): as in pack.hpp
#else
using Pair = double;
#endif
inline constexpr std::size_t in_pair = sizeof(Pair) / sizeof(double);

inline bool any(bool condition) { return condition; }
inline double choose(bool condition, double yes, double no) { return condition ? yes : no; }
inline double absolute(double x) { return std::abs(x); }
inline double square_root(double x) { return std::sqrt(x); }

/// A number's bits, changed.
template <class F>
double on_bits(double x, F f) {
  return std::bit_cast<double>(f(std::bit_cast<std::uint64_t>(x)));
}
constexpr std::uint64_t mantissa_bits = (std::uint64_t{1} << 52U) - 1;
constexpr std::uint64_t bits_of_one = std::uint64_t{1023} << 52U;
constexpr std::uint64_t bits_of_two52 = std::uint64_t{0x433} << 52U;  // 2^52: its low word is an integer's

/// log₂ x of a normal x > 0, to 0.005, the same on every processor.
template <class Real>
INVARIODE_EACH Real rough_log2(const Real& x) {
  constexpr double parabola = 0.3436;  // log₂(1 + f) ≈ f + 0.3436 f (1 − f)
  const Real f = on_bits(x, [](auto word) { return (word & mantissa_bits) | bits_of_one; }) - Real(1);
  const Real exponent = on_bits(x, [](auto word) { return (word >> 52U) | bits_of_two52; }) - Real(0x1p52 + 1023);
  return exponent + f * (Real(1 + parabola) - parabola * f);
}

/// std::max(a, b), std::min(a, b): the first where they do not compare.
template <class Real>
Real larger(const Real& a, const Real& b) {
  return choose(a < b, b, a);
}
template <class Real>
Real smaller(const Real& a, const Real& b) {
  return choose(b < a, b, a);
}

}  // namespace invariode
