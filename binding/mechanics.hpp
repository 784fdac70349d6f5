#pragma once
// The linear algebra of constrained mechanics, for Python.

#include <nanobind/nanobind.h>

namespace nb = nanobind;

namespace invariode::binding {

void define_mechanics(nb::module_& module);

}  // namespace invariode::binding
