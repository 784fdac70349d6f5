#pragma once
// Several right-hand sides at once: numbers of a few columns stand side by side, so that one instruction serves them
// and none waits for the division of another. Each column takes the operations that it takes alone, in their order.

#include <cstddef>
#include <type_traits>

namespace invariode {

template <std::size_t C>
using Count = std::integral_constant<std::size_t, C>;

inline constexpr std::size_t most_side_by_side = 4;

/// Calls solve(j, Count<C>()) for the columns j … j + C − 1 of m, as many at once as there may be.
template <class Solve>
void side_by_side(std::size_t m, Solve&& solve) {
  if (m == 1) return solve(std::size_t{0}, Count<1>());
  std::size_t j = 0;
  for (; j + most_side_by_side <= m; j += most_side_by_side) solve(j, Count<most_side_by_side>());
  switch (m - j) {
    case 3: return solve(j, Count<3>());
    case 2: return solve(j, Count<2>());
    case 1: return solve(j, Count<1>());
    default: return;
  }
}

}  // namespace invariode
