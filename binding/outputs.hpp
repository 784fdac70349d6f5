#pragma once
// The points of a run as arrays, made past nanobind's general way, which takes longer than a short run.

#include <nanobind/nanobind.h>

#include <cstddef>

#include "buffer.hpp"

namespace nb = nanobind;

namespace invariode::binding {

/// The times of points, (size,).
nb::object times_array(Buffer<double>&& t);
/// `count` states of n doubles each, which are reals or pairs of them: (n or n / 2, count).
nb::object states_array(Buffer<double>&& y, std::size_t n, std::size_t count, bool complex);
/// As many rows of n doubles each: (count, n or n / 2).
nb::object rows_array(Buffer<double>&& y, std::size_t count, std::size_t n, bool complex);
/// A copy of one state, (n or n / 2,).
nb::object state_array(const double* y, std::size_t n, bool complex);

/// Loads NumPy; to be called before the first array is made.
void prepare_outputs();

}  // namespace invariode::binding
