// Landings: the times at which f switches with t alone, and what functions see beside them.

#include "landings.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "breaks.hpp"
#include "check.hpp"
#include "functions/piece.hpp"
#include "problems.hpp"

namespace invariode::test::landings_laws {

/// All of them between two times, in the order of integration.
std::vector<double> between(const Landings& landings, double from, double to) {
  const double forward = to > from ? 1 : -1;
  std::vector<double> found;
  for (double t = landings.beyond(from, forward); forward * (to - t) > 0; t = landings.beyond(t, forward))
    found.push_back(t);
  return found;
}

TEST(the_next_landing_is_the_nearest_of_all_in_both_directions) {
  const Landings landings({-3, 0.5, 1, 7.25}, {{.first = 0.25, .period = 2}, {.first = 100.1, .period = 0.3}});
  std::vector<double> expected = {-3, 0.5, 1, 7.25};
  for (int k = -10; k <= 10; ++k) expected.push_back(0.25 + k * 2.0);
  for (int k = -400; k <= 0; ++k) expected.push_back(100.1 + k * 0.3);
  std::ranges::sort(expected);
  expected.erase(std::unique(expected.begin(), expected.end()), expected.end());
  std::erase_if(expected, [](double t) { return t <= -4 || t >= 9; });
  CHECK(between(landings, -4, 9) == expected);
  std::ranges::reverse(expected);
  CHECK(between(landings, 9, -4) == expected);
}

TEST(there_is_none_beyond_the_last_and_none_where_doubles_are_farther_apart_than_the_period) {
  CHECK(Landings().beyond(0, 1) == infinity);
  CHECK(Landings({1}, {}).beyond(1, 1) == infinity);
  CHECK(Landings({1}, {}).beyond(1, -1) == -infinity);
  CHECK(Landings({}, {{.first = 0, .period = 1e-3}}).beyond(1e300, 1) == infinity);
}

TEST(functions_are_called_half_of_the_smallest_step_beside_a_landing_and_one_ulp_beside_a_breakpoint) {
  double seen = NaN;
  const auto note = [](void* self, double t, const double*, double*) {
    *static_cast<double*>(self) = t;
    return Status::ok;
  };
  for (const double forward : {1.0, -1.0}) {
    Piece piece;
    Callback f = piece.within(Callback(note, &seen));
    Breaks breaks({{.t = forward * 3, .action = {}, .jump = {}}}, Landings({-2, -1, 1, 2}, {}), &piece, forward * 10,
                  forward);
    const auto at = [&](double t) {
      CHECK(f(t, nullptr, nullptr) == Status::ok);
      return seen;
    };
    breaks.start(0);
    breaks.begin_piece(0);
    CHECK(breaks.target() == forward && at(0) == 0);
    CHECK(at(forward) == forward - forward * 8 * ulp(1));
    CHECK(breaks.at(forward) && breaks.at_landing(forward) && !breaks.at_breakpoint(forward));
    breaks.begin_piece(forward);
    CHECK(breaks.target() == 2 * forward && at(forward) == forward + forward * 8 * ulp(1));
    breaks.begin_piece(2 * forward);
    CHECK(breaks.target() == 3 * forward && at(3 * forward) == std::nextafter(3 * forward, 0.0));
    CHECK(breaks.at_breakpoint(3 * forward) && !breaks.at_landing(3 * forward));
  }
}

}  // namespace invariode::test::landings_laws
