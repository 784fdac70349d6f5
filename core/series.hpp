#pragma once
// Taylor coefficients along a solution, from the expression graph of a function: as functions that are called.

#include <cstddef>
#include <cstdint>

#include "archive.hpp"
#include "callback.hpp"

namespace invariode {

class Bounds;

/// A function (t, unit, in, out) that writes Taylor coefficients in s at t + unit s, those of the powers 0 … order one
/// after the other. Of a system y' = f(t, y): `in` is y (n,), and `out` are the coefficients of the solution through
/// it, (order + 1, n); the first two are y and unit · f(t, y). Of a function g(t, y) of m values: `in` are the
/// coefficients of some y(t + unit s), (order + 1, n), and `out` are those of g along it, (order + 1, m).
///
/// `unit` is a power of two near the length in t over which the coefficients are used: they neither overflow nor
/// underflow then, whatever the unit of t, and are the same but for their scale.
class Series {
 public:
  using Function = Status(void* context, double t, double unit, const double* in, double* out);

  Series() = default;
  Series(Function* function, void* context, int order) : function_(function), context_(context), order_(order) {}

  Status operator()(double t, double unit, const double* in, double* out) {
    ++calls_;
    return function_(context_, t, unit, in, out);
  }
  explicit operator bool() const noexcept { return function_ != nullptr; }
  [[nodiscard]] int order() const noexcept { return order_; }
  [[nodiscard]] std::int64_t calls() const noexcept { return calls_; }
  /// The count; the function is not archived.
  void state(Archive& archive) { archive(calls_); }

 private:
  Function* function_ = nullptr;
  void* context_ = nullptr;
  int order_ = 0;
  std::int64_t calls_ = 0;
};

/// The series of a system y' = f(t, y), whose f may change from one branch to another: there one of the conditions, a
/// function of (t, y) with `count` values, changes its sign.
struct SystemSeries {
  Series solution;
  Series conditions{};  // NOLINT(readability-redundant-member-init): those without conditions leave it out
  std::size_t count = 0;
  const Bounds* bounds = nullptr;  ///< within which the solution is kept; null: none
};

}  // namespace invariode
