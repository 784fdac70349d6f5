#pragma once
// Is an explicit step at the limit of its formula's stability? (docs/algorithms.md, 'Stability limit of an explicit
// step')

#include <cstdint>

namespace invariode {

/// The result of looking at an explicit step: whether |h λ| is at the limit of the formula's stability, and how far the
/// step has changed y, in the weights. `known` is false if it cannot tell.
struct StepLook {
  bool known = false;
  bool at_limit = false;
  double moved = 0;  // known at the limit only

  static constexpr double near = 0.5;  // of the limit: estimates there were 0.6 to 1.9 of it, in the median 0.9 to 1.1
  static constexpr double slow = 0.1;  // what may change in a step at the limit, if accuracy does not limit it
  static constexpr std::int64_t every = 64;  // steps from one look to the next: less than 1 % of the cost of a step
  static constexpr int long_streak = 10;     // looks at limited steps in a row, before anything is said
  [[nodiscard]] bool limited() const { return at_limit && moved < slow; }
};

}  // namespace invariode
