#pragma once
// Solvers, their runs step by step or at once, and what comes out of them.

#include <nanobind/nanobind.h>

namespace nb = nanobind;

namespace invariode::binding {

void define_run(nb::module_& module);

}  // namespace invariode::binding
