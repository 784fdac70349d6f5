#pragma once
// Arrays between NumPy and the core.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdint>
#include <cstdlib>
#include <stdexcept>
#include <utility>
#include <vector>

#include "buffer.hpp"
#include "require.hpp"

namespace nb = nanobind;

namespace invariode::binding {

using Vector = nb::ndarray<double, nb::numpy, nb::ndim<1>, nb::c_contig>;
using Table = nb::ndarray<double, nb::numpy, nb::ndim<2>, nb::c_contig>;
using Cube = nb::ndarray<double, nb::numpy, nb::ndim<3>, nb::c_contig>;
using Integers = nb::ndarray<std::int64_t, nb::numpy, nb::ndim<1>, nb::c_contig>;
using IntegerTable = nb::ndarray<std::int64_t, nb::numpy, nb::ndim<2>, nb::c_contig>;
using Indices = nb::ndarray<int, nb::numpy, nb::ndim<1>, nb::c_contig>;
using Bytes = nb::ndarray<std::int8_t, nb::numpy, nb::ndim<1>, nb::c_contig>;

using ConstVector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using ConstMatrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using ConstOffsets = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using ConstIndices = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

inline std::vector<double> to_vector(const ConstVector& a) { return {a.data(), a.data() + a.size()}; }

/// Returns the exception of a function that hands over a value once, and is called again.
inline std::runtime_error handed_over_already() { return std::runtime_error("this has been handed over already"); }

/// Throws unless the values fill an array of this shape: they do not if they were moved away before.
template <class Array, class Values, class... Size>
void require_all(const Values& values, Size... shape) {
  const std::size_t entries = (std::size_t{1} * ... * static_cast<std::size_t>(shape));
  if (values.size() * sizeof(*values.data()) != entries * sizeof(typename Array::Scalar)) throw handed_over_already();
}

/// Hands a vector over to NumPy without copying it.
template <class Array, class T, class... Size>
Array to_array(std::vector<T>&& values, Size... shape) {
  require_all<Array>(values, shape...);
  auto* owner = new std::vector<T>(std::move(values));
  const nb::capsule free(owner, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return Array(owner->data(), {static_cast<std::size_t>(shape)...}, free);
}

template <class Array, class T, class... Size>
Array to_array(Buffer<T>&& values, Size... shape) {
  require_all<Array>(values, shape...);
  void* block = values.release();
  if (block == nullptr) return to_array<Array>(std::vector<T>(), shape...);  // a capsule must not hold null
  const nb::capsule free(block, [](void* p) noexcept { std::free(p); });
  return Array(block, {static_cast<std::size_t>(shape)...}, free);
}

}  // namespace invariode::binding
