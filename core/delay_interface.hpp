#pragma once
// What a method has besides the step contract if f may take values of the solution at earlier times.

#include <cstddef>

#include "callback.hpp"

namespace invariode {

/// Implemented, beside Step, by methods whose steps may be longer than a delay: f then depends on the attempt itself,
/// and the loop repeats `Step::attempt` from the same (t, y), with the same h and t1, until the two agree.
class DelayInterface {
 public:
  DelayInterface() = default;
  DelayInterface(const DelayInterface&) = delete;
  DelayInterface& operator=(const DelayInterface&) = delete;

  /// The raw continuous extension of the attempt just made, for `Step::interpolate`, and its number of doubles. It may
  /// evaluate f.
  virtual Status extension_of_attempt(double* data, std::size_t& size) = 0;
  /// Returns whether the stages are values of that extension, to the order of the step.
  [[nodiscard]] virtual bool stages_on_extension() const { return false; }
  /// Returns whether the step after the next one still uses what f was before it: values of steps, of which a formula
  /// or an estimate is made.
  [[nodiscard]] virtual bool remembers_slopes() const { return false; }

 protected:
  ~DelayInterface() = default;
};

}  // namespace invariode
