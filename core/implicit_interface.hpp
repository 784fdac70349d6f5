#pragma once
// What the loop asks of implicit methods besides the step contract: their linear algebra. (What these methods share is
// in methods/implicit_base.)

#include "callback.hpp"
#include "step.hpp"

namespace invariode {

struct Matrix;

/// Implemented, beside Step, by methods that use ∂f/∂y.
class ImplicitInterface {
 public:
  ImplicitInterface() = default;
  ImplicitInterface(const ImplicitInterface&) = delete;
  ImplicitInterface& operator=(const ImplicitInterface&) = delete;

  /// ∂f/∂y; null: the method knows it by its products, or has none of its own.
  [[nodiscard]] virtual const Matrix* jacobian() const { return nullptr; }
  /// ∂f/∂y at the point reached, where f is `slope`, times v, both (n,), of a method that knows ∂f/∂y by its products.
  virtual Status multiply_jacobian(const double* /*slope*/, const double* /*v*/, double* /*out*/) { return Status::ok; }

 protected:
  ~ImplicitInterface() = default;
};

}  // namespace invariode
