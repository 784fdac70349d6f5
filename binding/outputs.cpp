#define NPY_NO_DEPRECATED_API NPY_1_22_API_VERSION
#include "outputs.hpp"

#include <Python.h>
#include <numpy/arrayobject.h>

#include <algorithm>
#include <cstdlib>
#include <span>
#include <utility>

#include "arrays.hpp"
#include "weights.hpp"

namespace invariode::binding {
namespace {

/// Doubles that are copied in less time than it takes to hand them over.
constexpr std::size_t copied_up_to = 512;

/// An array in Fortran's order. `data` null: of its own memory.
nb::object new_array(std::span<const npy_intp> shape, bool complex, void* data) {
  PyObject* array =
      PyArray_New(&PyArray_Type, static_cast<int>(shape.size()), shape.data(), complex ? NPY_CDOUBLE : NPY_DOUBLE,
                  nullptr, data, 0, NPY_ARRAY_F_CONTIGUOUS | NPY_ARRAY_ALIGNED | NPY_ARRAY_WRITEABLE, nullptr);
  if (array == nullptr) throw nb::python_error();
  return nb::steal(array);
}

nb::object copied(std::span<const npy_intp> shape, bool complex, const double* from, std::size_t size) {
  nb::object array = new_array(shape, complex, nullptr);
  std::copy_n(from, size, static_cast<double*>(PyArray_DATA(reinterpret_cast<PyArrayObject*>(array.ptr()))));
  return array;
}

/// The values, without copying them if they are many.
nb::object handed_over(std::span<const npy_intp> shape, bool complex, Buffer<double>&& values) {
  if (values.size() <= copied_up_to) return copied(shape, complex, values.data(), values.size());
  void* block = values.release();
  nb::capsule owner(block, [](void* p) noexcept { std::free(p); });
  nb::object array = new_array(shape, complex, block);
  if (PyArray_SetBaseObject(reinterpret_cast<PyArrayObject*>(array.ptr()), owner.release().ptr()) < 0)
    throw nb::python_error();
  return array;
}

bool finite_numbers(nb::handle values) {
  auto* array = reinterpret_cast<PyArrayObject*>(values.ptr());
  const bool known = PyArray_Check(values.ptr()) && PyArray_IS_C_CONTIGUOUS(array) &&
                     (PyArray_TYPE(array) == NPY_DOUBLE || PyArray_TYPE(array) == NPY_CDOUBLE);
  if (!known) throw nb::type_error("not a contiguous array of float64 or complex128");
  const auto size = static_cast<std::size_t>(PyArray_NBYTES(array)) / sizeof(double);
  return all_finite(static_cast<const double*>(PyArray_DATA(array)), size);
}

/// 1 where each number is above the one before, −1 where each is below, 0 where neither holds.
int order(const ConstVector& values) {
  const double* v = values.data();
  const auto count = static_cast<std::ptrdiff_t>(values.size());
  if (std::adjacent_find(v, v + count, [](double a, double b) { return !(a < b); }) == v + count) return 1;
  return std::adjacent_find(v, v + count, [](double a, double b) { return !(a > b); }) == v + count ? -1 : 0;
}

npy_intp components(std::size_t n, bool complex) { return static_cast<npy_intp>(complex ? n / 2 : n); }

}  // namespace

nb::object times_array(Buffer<double>&& t) {
  const npy_intp shape[] = {static_cast<npy_intp>(t.size())};
  return handed_over(shape, false, std::move(t));
}

nb::object states_array(Buffer<double>&& y, std::size_t n, std::size_t count, bool complex) {
  const npy_intp shape[] = {components(n, complex), static_cast<npy_intp>(count)};
  return handed_over(shape, complex, std::move(y));
}

nb::object state_array(const double* y, std::size_t n, bool complex) {
  const npy_intp shape[] = {components(n, complex)};
  return copied(shape, complex, y, n);
}

void define_outputs(nb::module_& module) {
  if (_import_array() < 0) throw nb::python_error();
  module.def("all_finite", &finite_numbers, nb::arg("values"),
             "Whether all numbers of a contiguous array of float64 or complex128 are finite.");
  module.def("order", &order, nb::arg("values"), "1: they rise strictly; -1: they fall strictly; 0: neither.");
}

}  // namespace invariode::binding
