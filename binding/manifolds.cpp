#include "manifolds.hpp"

#include <nanobind/stl/vector.h>

#include <cstddef>
#include <utility>
#include <vector>

namespace invariode::binding {

void define_manifolds(nb::module_& module) {
  nb::class_<QuadraticSpec>(module, "Quadratic",
                            "Sums of products of two components, or their Jacobian, as a function of the core.")
      .def(
          "__init__",
          [](QuadraticSpec* self, std::size_t n, std::size_t terms, std::vector<std::size_t> first,
             std::vector<std::size_t> second, bool gradient) {
            new (self) QuadraticSpec{Quadratic(n, terms, std::move(first), std::move(second)), gradient};
          },
          nb::arg("n"), nb::arg("terms"), nb::arg("first"), nb::arg("second"), nb::arg("gradient"));
}

}  // namespace invariode::binding
