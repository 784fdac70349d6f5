#pragma once
// What the loop asks of implicit methods besides the step contract: their linear algebra. (What these methods share is
// in methods/implicit_base.)

#include "callback.hpp"
#include "linear/work.hpp"
#include "step.hpp"

namespace invariode {

struct Matrix;

/// Implemented, beside Step, by methods that use ∂f/∂y.
class ImplicitInterface {
 public:
  ImplicitInterface() = default;
  ImplicitInterface(const ImplicitInterface&) = delete;
  ImplicitInterface& operator=(const ImplicitInterface&) = delete;

  /// The work of the linear algebra so far, and the cause of its failure in the last attempt.
  [[nodiscard]] virtual LinearWork linear_work() const = 0;
  /// ∂f/∂y; null: the method knows it by its products, or has none of its own.
  [[nodiscard]] virtual const Matrix* jacobian() const { return nullptr; }
  /// ∂f/∂y at the point reached, where f is `slope`, times v, both (n,), of a method that knows ∂f/∂y by its products.
  virtual Status multiply_jacobian(const double* /*slope*/, const double* /*v*/, double* /*out*/) { return Status::ok; }
  /// There will be no further attempt: memory that only attempts need may be given back.
  virtual void end_attempts() {}

 protected:
  ~ImplicitInterface() = default;
};

/// Returns the linear work of a step; of an explicit method none.
inline LinearWork linear_work(const Step& step) {
  const auto* implicit = dynamic_cast<const ImplicitInterface*>(&step);
  return implicit != nullptr ? implicit->linear_work() : LinearWork{};
}

}  // namespace invariode
