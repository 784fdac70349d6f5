#pragma once
// Many trajectories of one problem, on threads and in lanes.

#include <nanobind/nanobind.h>

namespace nb = nanobind;

namespace invariode::binding {

void define_ensemble(nb::module_& module);

}  // namespace invariode::binding
