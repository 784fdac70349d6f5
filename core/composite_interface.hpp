#pragma once
// What a method has besides the step contract if it consists of several.

#include <cstdint>

#include "step.hpp"

namespace invariode {

/// Implemented, beside Step, by a method whose members take turns.
class CompositeInterface {
 public:
  CompositeInterface() = default;
  CompositeInterface(const CompositeInterface&) = delete;
  CompositeInterface& operator=(const CompositeInterface&) = delete;

  /// Between two steps: continues with another member if that suits the problem better. The next |h| may change.
  virtual Outcome hand_over(const Step::Span& span) = 0;
  /// The solution sticks where f is discontinuous, which no Jacobian can describe: the explicit member, if there is
  /// one, goes on from the next hand-over, and stays.
  virtual void stay_explicit() = 0;
  /// `member` returns which member made the last step, `switches` how often they have changed.
  [[nodiscard]] virtual int member() const = 0;
  [[nodiscard]] virtual std::int64_t switches() const = 0;

 protected:
  ~CompositeInterface() = default;
};

}  // namespace invariode
