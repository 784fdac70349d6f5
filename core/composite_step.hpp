#pragma once
// What a method has besides the step contract if it consists of several.

#include <cstdint>

#include "step.hpp"

namespace invariode {

/// Implemented, beside Step, by a method whose members take turns.
class CompositeStep {
 public:
  CompositeStep() = default;
  CompositeStep(const CompositeStep&) = delete;
  CompositeStep& operator=(const CompositeStep&) = delete;

  /// Between two steps: continues with another member if that suits the problem better. The next |h| may change.
  virtual Outcome hand_over(const Step::Span& span) = 0;
  /// Which member made the last step, and how often they have changed.
  [[nodiscard]] virtual int member() const = 0;
  [[nodiscard]] virtual std::int64_t switches() const = 0;

 protected:
  ~CompositeStep() = default;
};

}  // namespace invariode
