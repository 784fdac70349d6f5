#pragma once
// The one C type through which the core knows user functions.

#include <cstdint>

#include "archive.hpp"

namespace invariode {

/// The result of a user function. `stop` ends the run at once: whoever owns the context keeps the reason (an exception,
/// an interrupt). 'Cannot be evaluated here' is not a status: such a function writes NaN, and the attempt that asked
/// fails.
enum class [[nodiscard]] Status { ok, stop };

/// The outcome of an operation that calls user functions. `not_finite`: a needed value is NaN or infinite.
enum class [[nodiscard]] Outcome { ok, not_finite, stop };

/// A user function `out = function(t, y)`: a pointer, its context, and how often it was called. It may throw if
/// memory runs out, as the rest of the core may.
class Callback {
 public:
  using Function = Status(void* context, double t, const double* y, double* out);

  Callback() = default;
  Callback(Function* function, void* context) : function_(function), context_(context) {}

  Status operator()(double t, const double* y, double* out) {
    ++calls_;
    return function_(context_, t, y, out);
  }
  explicit operator bool() const noexcept { return function_ != nullptr; }
  [[nodiscard]] std::int64_t calls() const noexcept { return calls_; }
  /// The count; the function is not archived.
  void state(Archive& archive) { archive(calls_); }

 private:
  Function* function_ = nullptr;
  void* context_ = nullptr;
  std::int64_t calls_ = 0;
};

}  // namespace invariode
