#pragma once
// Numbers without structure, the same on every platform, for directions in which nothing cancels.

#include <cmath>
#include <cstddef>
#include <cstdint>

namespace invariode {

/// Numbers spread evenly over [0, 1): the multiples of the golden ratio modulo 1.
inline double spread(std::size_t j) { return std::fmod(0.6180339887498949 * static_cast<double>(j + 1), 1.0); }

/// Numbers scattered over [0, 1): no small linear combination of successive ones vanishes, as it does with multiples of
/// an irrational number. SplitMix64 (Steele, Lea and Flood, OOPSLA 2014) at k.
inline double scattered(std::uint64_t k) {
  std::uint64_t z = (k + 1) * 0x9e3779b97f4a7c15U;
  z = (z ^ (z >> 30U)) * 0xbf58476d1ce4e5b9U;
  z = (z ^ (z >> 27U)) * 0x94d049bb133111ebU;
  z ^= z >> 31U;
  return static_cast<double>(z >> 11U) * 0x1p-53;
}

}  // namespace invariode
