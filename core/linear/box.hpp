#pragma once
// Where f may be evaluated, for those who look beside a point.

#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

namespace invariode {

/// lower ≤ y ≤ upper, one pair for each component; empty: everywhere.
struct Box {
  std::vector<double> lower, upper;

  explicit operator bool() const noexcept { return !lower.empty(); }
  /// y_j in the box, or the end next to it.
  [[nodiscard]] double nearest(std::size_t j, double y) const {
    return y < lower[j] ? lower[j] : y > upper[j] ? upper[j] : y;
  }
  [[nodiscard]] bool contains(std::size_t j, double y) const { return lower[j] <= y && y <= upper[j]; }
  /// An increment of y_j that stays in the box: the given one, or else the opposite one, or else the one to the farther
  /// end, which is 0 where the box is but a point wide.
  [[nodiscard]] double turned(std::size_t j, double y, double increment) const {
    if (lower.empty() || contains(j, y + increment)) return increment;
    if (contains(j, y - increment)) return (y - increment) - y;
    const double down = lower[j] - y, up = upper[j] - y;
    return std::abs(down) > std::abs(up) ? down : up;
  }
};

}  // namespace invariode
