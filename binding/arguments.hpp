#pragma once
// What users give, in the forms in which most of them give it, read past NumPy's and nanobind's general ways: those
// take longer than a short run. Everything else is left to Python, which tells what is wrong.

#include <nanobind/nanobind.h>

#include <span>

namespace nb = nanobind;

namespace invariode::binding {

/// The numbers of a contiguous array of float64 or complex128. Throws a TypeError for anything else.
std::span<const double> numbers_of(nb::handle array);

void define_arguments(nb::module_& module);

}  // namespace invariode::binding
