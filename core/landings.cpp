#include "landings.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <limits>
#include <utility>

#include "require.hpp"

namespace invariode {
namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();

/// Rounding of the quotient moves k by one at most. If the times are closer than doubles, no landing is possible.
double beyond_in(const Landings::Progression& one, double t, double forward) {
  double k = std::floor((t - one.first) / one.period) + (forward > 0 ? -1 : 2);
  for (int tried = 0; tried < 5; ++tried, k += forward) {
    const double time = one.first + k * one.period;
    if (forward * (time - t) > 0) return time;
  }
  return forward * infinity;
}

}  // namespace

Landings::Landings(std::vector<double> times, std::vector<Progression> progressions)
    : times_(std::move(times)), progressions_(std::move(progressions)) {
  require(std::ranges::is_sorted(times_), "landings are not in increasing order");
  require(std::ranges::all_of(progressions_, [](const Progression& one) { return one.period > 0; }),
          "a period of landings is not positive");
}

double Landings::beyond(double t, double forward) const {
  double nearest = forward * infinity;
  if (forward > 0) {
    const auto next = std::ranges::upper_bound(times_, t);
    if (next != times_.end()) nearest = *next;
  } else {
    const auto next = std::ranges::lower_bound(times_, t);
    if (next != times_.begin()) nearest = *std::prev(next);
  }
  for (const Progression& one : progressions_) {
    const double time = beyond_in(one, t, forward);
    if (forward * (nearest - time) > 0) nearest = time;
  }
  return nearest;
}

}  // namespace invariode
