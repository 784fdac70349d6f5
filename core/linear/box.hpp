#pragma once
// Where f may be evaluated, for those who look beside a point.

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <utility>
#include <vector>

namespace invariode {

/// lower ≤ y ≤ upper, one pair for each component; empty: everywhere.
struct Box {
  static constexpr double beyond_the_way = 100;  // an error of 1 % in a quotient over increment and way

  std::vector<double> lower, upper;

  explicit operator bool() const noexcept { return !lower.empty(); }
  /// y_j in the box, or the end next to it.
  [[nodiscard]] double nearest(std::size_t j, double y) const {
    return y < lower[j] ? lower[j] : y > upper[j] ? upper[j] : y;
  }
  [[nodiscard]] bool contains(std::size_t j, double y) const { return lower[j] <= y && y <= upper[j]; }
  /// An increment of y_j that stays in the box: the given one, or else the opposite one, or else the one to the farther
  /// end, which is 0 where the box is but a point wide. From outside, where f is that of the end next to y_j, it leads
  /// so far inside that the way to the end does not count.
  [[nodiscard]] double turned(std::size_t j, double y, double increment) const {
    if (lower.empty() || contains(j, y + increment)) return increment;
    if (!contains(j, y)) {
      const double end = nearest(j, y);
      const double inside = std::max(std::abs(increment), beyond_the_way * std::abs(y - end));
      return nearest(j, y < end ? end + inside : end - inside) - y;
    }
    if (contains(j, y - increment)) return (y - increment) - y;
    const double down = lower[j] - y, up = upper[j] - y;
    return std::abs(down) > std::abs(up) ? down : up;
  }
};

}  // namespace invariode
