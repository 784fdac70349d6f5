#pragma once
// The ready manifolds as user functions that are the core's own.

#include <nanobind/nanobind.h>

#include "callables.hpp"
#include "manifold/quadratic.hpp"

namespace nb = nanobind;

namespace invariode::binding {

/// Quadratic equations, or their Jacobian, where Python gives a function.
struct QuadraticSpec {
  Quadratic equations;
  bool gradient;
};

/// That as a callback of the core, which needs no interpreter.
class QuadraticFunction final : public Callable {
 public:
  explicit QuadraticFunction(QuadraticSpec spec) : spec_(std::move(spec)) {}

  [[nodiscard]] Callback callback() { return {spec_.gradient ? &gradients : &values, this}; }
  int visit(visitproc, void*) const override { return 0; }

 private:
  static Status values(void* self, double, const double* y, double* out) noexcept {
    static_cast<QuadraticFunction*>(self)->spec_.equations.values(y, out);
    return Status::ok;
  }
  static Status gradients(void* self, double, const double* y, double* out) noexcept {
    static_cast<QuadraticFunction*>(self)->spec_.equations.gradients(y, out);
    return Status::ok;
  }

  QuadraticSpec spec_;
};

void define_manifolds(nb::module_& module);

}  // namespace invariode::binding
