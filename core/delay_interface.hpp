#pragma once
// What a method has besides the step contract if f may take values of the solution at earlier times.

namespace invariode {

/// Implemented, beside Step, by methods whose steps may be longer than a delay: f then depends on the attempt itself,
/// and the loop repeats `Step::attempt` from the same (t, y), with the same h and t1, until it agrees with its
/// extension.
class DelayInterface {
 public:
  DelayInterface() = default;
  DelayInterface(const DelayInterface&) = delete;
  DelayInterface& operator=(const DelayInterface&) = delete;

  /// Returns whether the stages are values of that extension, to the order of the step.
  [[nodiscard]] virtual bool stages_on_extension() const { return false; }
  /// Returns whether the step after the next one still uses what f was before it: values of steps, of which a formula
  /// or an estimate is made.
  [[nodiscard]] virtual bool remembers_slopes() const { return false; }

 protected:
  ~DelayInterface() = default;
};

}  // namespace invariode
