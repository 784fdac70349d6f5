#pragma once
// W doubles that behave like one, in as many vector registers as they need. Whoever includes this defines
// INVARIODE_LANES, the name of an instruction set: each has types of its own, so that no function that was compiled for
// one is linked in place of another's.

#include <bit>
#include <cmath>
#include <cstdint>

#include "number.hpp"

namespace invariode::lanes::INVARIODE_LANES {

// Doubles in a vector register; 1: the compiler knows no vectors, or the target has none.
#if defined(__GNUC__) && defined(__AVX512F__)
inline constexpr int native = 8;
#elif defined(__GNUC__) && defined(__AVX__)
inline constexpr int native = 4;
#elif defined(__GNUC__) && (defined(__SSE2__) || defined(__aarch64__))
inline constexpr int native = 2;
#else
inline constexpr int native = 1;
#endif

/// A register of L doubles, or as many integers: of masks all bits or none, as comparisons of vectors give them.
template <int L>
struct Register;
#if defined(__GNUC__)
template <int L>
struct Register {
  // NOLINTBEGIN(modernize-use-using): gcc 12 ignores the attribute of a dependent size otherwise
  typedef double Numbers __attribute__((vector_size(L * sizeof(double))));
  typedef std::int64_t Bits __attribute__((vector_size(L * sizeof(double))));
  typedef std::uint64_t Word __attribute__((vector_size(L * sizeof(double))));
  // NOLINTEND(modernize-use-using)
  static Bits less(Numbers a, Numbers b) { return a < b; }
  static Bits no_more(Numbers a, Numbers b) { return a <= b; }
  static Numbers choose(Bits mask, Numbers yes, Numbers no) { return mask ? yes : no; }
  static Numbers all(double x) { return x - Numbers{}; }
};
#endif
template <>
struct Register<1> {
  using Numbers = double;
  using Bits = std::uint64_t;
  using Word = std::uint64_t;
  static Bits less(Numbers a, Numbers b) { return a < b ? ~Bits{0} : 0; }
  static Bits no_more(Numbers a, Numbers b) { return a <= b ? ~Bits{0} : 0; }
  static Numbers choose(Bits mask, Numbers yes, Numbers no) { return mask != 0 ? yes : no; }
  static Numbers all(double x) { return x; }
};

/// The registers of W doubles.
template <int W_>
struct Layout {
  static constexpr int W = W_, in_register = W < native ? W : native, registers = W / in_register;
};
template <int W>
using RegisterOf = Register<Layout<W>::in_register>;
// NOLINTBEGIN(readability-redundant-typename): clang 14 asks for it
template <int W>
using NumbersOf = typename RegisterOf<W>::Numbers;
template <int W>
using BitsOf = typename RegisterOf<W>::Bits;
template <int W>
using WordOf = typename RegisterOf<W>::Word;
// NOLINTEND(readability-redundant-typename)

template <int W>
struct Mask : Layout<W> {
  BitsOf<W> v[Layout<W>::registers];

  [[nodiscard]] std::int64_t* lanes() { return reinterpret_cast<std::int64_t*>(v); }
  [[nodiscard]] const std::int64_t* lanes() const { return reinterpret_cast<const std::int64_t*>(v); }
};

/// Aligned as functions in lanes are promised, wherever it is.
template <int W>
struct alignas(W < 8 ? W * sizeof(double) : 64) Pack : Layout<W> {
  NumbersOf<W> v[Layout<W>::registers];

  Pack() = default;
  Pack(double x) {  // NOLINT(misc-explicit-constructor): a number is the pack of that number
    for (auto& one : v) one = RegisterOf<W>::all(x);
  }
  Pack& operator+=(const Pack& a) { return *this = *this + a; }
  [[nodiscard]] double* lanes() { return reinterpret_cast<double*>(v); }
  [[nodiscard]] const double* lanes() const { return reinterpret_cast<const double*>(v); }
};

/// Sets of lanes, a bit for each.
constexpr unsigned one_lane(int lane) { return 1U << static_cast<unsigned>(lane); }
constexpr bool has(unsigned set, int lane) { return (set & one_lane(lane)) != 0; }

template <class F>
void for_each_lane(unsigned set, F f) {
  for (; set != 0; set &= set - 1) f(std::countr_zero(set));
}

/// The result of a function of registers, register by register.
template <class Result, class F>
Result each(F f) {
  Result r;
  for (int c = 0; c < Result::registers; ++c) r.v[c] = f(c);
  return r;
}

template <int W>
Pack<W> operator+(const Pack<W>& a, const Pack<W>& b) {
  return each<Pack<W>>([&](int c) { return a.v[c] + b.v[c]; });
}
template <int W>
Pack<W> operator-(const Pack<W>& a, const Pack<W>& b) {
  return each<Pack<W>>([&](int c) { return a.v[c] - b.v[c]; });
}
template <int W>
Pack<W> operator*(const Pack<W>& a, const Pack<W>& b) {
  return each<Pack<W>>([&](int c) { return a.v[c] * b.v[c]; });
}
template <int W>
Pack<W> operator/(const Pack<W>& a, const Pack<W>& b) {
  return each<Pack<W>>([&](int c) { return a.v[c] / b.v[c]; });
}
template <int W>
Pack<W> operator*(double a, const Pack<W>& b) {
  return each<Pack<W>>([&](int c) { return a * b.v[c]; });
}
template <int W>
Mask<W> operator<(const Pack<W>& a, const Pack<W>& b) {
  return each<Mask<W>>([&](int c) { return RegisterOf<W>::less(a.v[c], b.v[c]); });
}
template <int W>
Mask<W> operator<=(const Pack<W>& a, const Pack<W>& b) {
  return each<Mask<W>>([&](int c) { return RegisterOf<W>::no_more(a.v[c], b.v[c]); });
}
template <int W>
Mask<W> operator&(const Mask<W>& a, const Mask<W>& b) {
  return each<Mask<W>>([&](int c) { return a.v[c] & b.v[c]; });
}
template <int W>
Mask<W> operator|(const Mask<W>& a, const Mask<W>& b) {
  return each<Mask<W>>([&](int c) { return a.v[c] | b.v[c]; });
}
template <int W>
Mask<W> operator~(const Mask<W>& a) {
  return each<Mask<W>>([&](int c) { return ~a.v[c]; });
}
template <int W>
Pack<W> choose(const Mask<W>& mask, const Pack<W>& yes, const Pack<W>& no) {
  return each<Pack<W>>([&](int c) { return RegisterOf<W>::choose(mask.v[c], yes.v[c], no.v[c]); });
}
template <int W>
Pack<W> absolute(const Pack<W>& a) {
  return each<Pack<W>>(
      [&](int c) { return __builtin_bit_cast(NumbersOf<W>, __builtin_bit_cast(BitsOf<W>, a.v[c]) & INT64_MAX); });
}
/// A number's bits, changed one register after the other.
template <int W, class F>
Pack<W> on_bits(const Pack<W>& x, F f) {
  return each<Pack<W>>(
      [&](int c) { return __builtin_bit_cast(NumbersOf<W>, f(__builtin_bit_cast(WordOf<W>, x.v[c]))); });
}
/// Spacing of doubles at |t|.
template <int W>
Pack<W> ulp(const Pack<W>& t) {
  const Pack<W> a = absolute(t);
  return each<Pack<W>>(
             [&](int c) { return __builtin_bit_cast(NumbersOf<W>, __builtin_bit_cast(BitsOf<W>, a.v[c]) + 1); }) -
         a;
}
template <int W>
Pack<W> square_root(const Pack<W>& a) {
  Pack<W> r;
  for (int l = 0; l < W; ++l) r.lanes()[l] = std::sqrt(a.lanes()[l]);
  return r;
}

/// The lanes in which the mask is set.
template <int W>
unsigned bits(const Mask<W>& mask) {
  unsigned r = 0;
  for (int c = 0; c < Mask<W>::registers; ++c) {
    constexpr int L = Mask<W>::in_register;
#if defined(__AVX512DQ__)
    using Eight = long long __attribute__((vector_size(64)));
    if constexpr (L == 8)
      r |= unsigned{__builtin_ia32_cvtq2mask512(__builtin_bit_cast(Eight, mask.v[c]))}
           << (8U * static_cast<unsigned>(c));
#elif defined(__AVX__)
    using Four = double __attribute__((vector_size(32)));
    if constexpr (L == 4)
      r |= static_cast<unsigned>(__builtin_ia32_movmskpd256(__builtin_bit_cast(Four, mask.v[c])))
           << (4U * static_cast<unsigned>(c));
#elif defined(__GNUC__) && defined(__SSE2__)
    using Two = double __attribute__((vector_size(16)));
    if constexpr (L == 2)
      r |= static_cast<unsigned>(__builtin_ia32_movmskpd(__builtin_bit_cast(Two, mask.v[c])))
           << (2U * static_cast<unsigned>(c));
    if constexpr (L == 1) r |= mask.v[c] != 0 ? one_lane(c) : 0;
#else
    for (int l = 0; l < L; ++l) r |= mask.lanes()[c * L + l] != 0 ? one_lane(c * L + l) : 0;
#endif
  }
  return r;
}
template <int W>
bool any(const Mask<W>& mask) {
  return bits(mask) != 0;
}
template <int W>
Mask<W> to_mask(unsigned bits) {
  Mask<W> mask;
  for (int l = 0; l < W; ++l) mask.lanes()[l] = has(bits, l) ? -1 : 0;
  return mask;
}

}  // namespace invariode::lanes::INVARIODE_LANES
