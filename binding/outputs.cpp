#define NPY_NO_DEPRECATED_API NPY_1_22_API_VERSION
#include "outputs.hpp"

#include <Python.h>
#include <numpy/arrayobject.h>

#include <algorithm>
#include <cstdlib>
#include <span>
#include <utility>

#include "arrays.hpp"

namespace invariode::binding {
namespace {

/// Doubles that are copied in less time than it takes to hand them over.
constexpr std::size_t copied_up_to = 512;

/// How the values of an array follow one another.
enum class Order { columns, rows };

/// An array. `data` null: of its own memory, for which NumPy takes any flags as a wish for columns.
nb::object new_array(std::span<const npy_intp> shape, bool complex, void* data, Order order) {
  const int flags = order == Order::columns ? NPY_ARRAY_FARRAY : data != nullptr ? NPY_ARRAY_CARRAY : 0;
  PyObject* array = PyArray_New(&PyArray_Type, static_cast<int>(shape.size()), shape.data(),
                                complex ? NPY_CDOUBLE : NPY_DOUBLE, nullptr, data, 0, flags, nullptr);
  if (array == nullptr) throw nb::python_error();
  return nb::steal(array);
}

nb::object copied(std::span<const npy_intp> shape, bool complex, const double* from, std::size_t size,
                  Order order = Order::columns) {
  nb::object array = new_array(shape, complex, nullptr, order);
  std::copy_n(from, size, static_cast<double*>(PyArray_DATA(reinterpret_cast<PyArrayObject*>(array.ptr()))));
  return array;
}

/// The values, without copying them if they are many.
nb::object handed_over(std::span<const npy_intp> shape, bool complex, Buffer<double>&& values,
                       Order order = Order::columns) {
  if (values.size() <= copied_up_to) return copied(shape, complex, values.data(), values.size(), order);
  void* block = values.release();
  nb::capsule owner(block, [](void* p) noexcept { std::free(p); });
  nb::object array = new_array(shape, complex, block, order);
  if (PyArray_SetBaseObject(reinterpret_cast<PyArrayObject*>(array.ptr()), owner.release().ptr()) < 0)
    throw nb::python_error();
  return array;
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

nb::object rows_array(Buffer<double>&& y, std::size_t count, std::size_t n, bool complex) {
  const npy_intp shape[] = {static_cast<npy_intp>(count), components(n, complex)};
  return handed_over(shape, complex, std::move(y), Order::rows);
}

nb::object state_array(const double* y, std::size_t n, bool complex) {
  const npy_intp shape[] = {components(n, complex)};
  return copied(shape, complex, y, n);
}

void prepare_outputs() {
  if (_import_array() < 0) throw nb::python_error();
}

}  // namespace invariode::binding
