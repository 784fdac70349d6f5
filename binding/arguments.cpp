#define NPY_NO_DEPRECATED_API NPY_1_22_API_VERSION
#include "arguments.hpp"

#include <Python.h>
#include <numpy/arrayobject.h>
#include <numpy/arrayscalars.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <vector>

#include "callables.hpp"
#include "interpreter.hpp"
#include "weights.hpp"

namespace invariode::binding {
namespace {

/// A float or an int, of these very types, or a float64 of NumPy. Nothing: something else.
std::optional<double> plain_number(PyObject* one) {
  if (PyFloat_CheckExact(one) || PyArray_IsScalar(one, Double)) return PyFloat_AS_DOUBLE(one);
  if (!PyLong_CheckExact(one)) return {};
  int overflow = 0;
  const long long whole = PyLong_AsLongLongAndOverflow(one, &overflow);
  if (overflow != 0) return {};
  return static_cast<double>(whole);
}

/// The items of a list or a tuple, in a tuple. Null: it is something else, perhaps a class derived from them.
nb::object plain_items(nb::handle given) {
  if (PyTuple_CheckExact(given.ptr())) return nb::borrow(given);
  return PyList_CheckExact(given.ptr()) ? nb::steal(PyList_AsTuple(given.ptr())) : nb::object();
}

nb::object new_vector(std::size_t size) {
  const npy_intp shape[] = {static_cast<npy_intp>(size)};
  PyObject* array = PyArray_SimpleNew(1, shape, NPY_DOUBLE);
  if (array == nullptr) throw nb::python_error();
  return nb::steal(array);
}

bool all_numbers_finite(nb::handle array) {
  const std::span<const double> all = numbers_of(array);
  return all_finite(all.data(), all.size());
}

double* data_of(const nb::object& vector) {
  return static_cast<double*>(PyArray_DATA(reinterpret_cast<PyArrayObject*>(vector.ptr())));
}

/// A new array of float64 with the numbers of an array of one dimension, a list or a tuple. Null: it is something else.
nb::object plain_vector(nb::handle given) {
  if (PyArray_CheckExact(given.ptr())) {
    auto* array = reinterpret_cast<PyArrayObject*>(given.ptr());
    const bool usual = PyArray_NDIM(array) == 1 && PyArray_TYPE(array) == NPY_DOUBLE && PyArray_ISCARRAY_RO(array);
    if (!usual) return {};
    nb::object copy = new_vector(static_cast<std::size_t>(PyArray_SIZE(array)));
    std::copy_n(static_cast<const double*>(PyArray_DATA(array)), PyArray_SIZE(array), data_of(copy));
    return copy;
  }
  const nb::object items = plain_items(given);
  if (!items) return {};
  const auto size = static_cast<std::size_t>(PyTuple_GET_SIZE(items.ptr()));
  nb::object vector = new_vector(size);
  double* out = data_of(vector);
  for (std::size_t i = 0; i < size; ++i) {
    const std::optional<double> value = plain_number(PyTuple_GET_ITEM(items.ptr(), static_cast<Py_ssize_t>(i)));
    if (!value) return {};
    out[i] = *value;
  }
  return vector;
}

/// 1 where each number is above the one before, −1 where each is below, 0 where neither holds.
int order_of(std::span<const double> v) {
  if (std::ranges::adjacent_find(v, [](double a, double b) { return !(a < b); }) == v.end()) return 1;
  return std::ranges::adjacent_find(v, [](double a, double b) { return !(a > b); }) == v.end() ? -1 : 0;
}

/// (t0, tf), y0 and args as problems have them: floats, none of which is −0, an array that nobody changes, a tuple.
/// None: one of them was given in another form, or is wrong.
nb::object plainly_posed(nb::handle t_span, nb::handle y0, nb::handle args) {
  const nb::object ends = plain_items(t_span);
  if (!ends || PyTuple_GET_SIZE(ends.ptr()) != 2) return nb::none();
  const std::optional<double> t0 = plain_number(PyTuple_GET_ITEM(ends.ptr(), 0));
  const std::optional<double> tf = plain_number(PyTuple_GET_ITEM(ends.ptr(), 1));
  if (!t0 || !tf || !std::isfinite(*t0) || std::isnan(*tf)) return nb::none();
  const nb::object y = plain_vector(y0);
  if (!y || !all_numbers_finite(y)) return nb::none();
  PyArray_CLEARFLAGS(reinterpret_cast<PyArrayObject*>(y.ptr()), NPY_ARRAY_WRITEABLE);
  const nb::object extra = args.is_none() ? nb::object(nb::tuple()) : plain_items(args);
  if (!extra) return nb::none();
  return nb::make_tuple(nb::make_tuple(*t0 + 0.0, *tf + 0.0), y, extra);
}

/// Times of output as a new array. None: they were given in another form, or are not in order within the interval.
nb::object plain_times(nb::handle given, double t0, double tf) {
  const nb::object times = plain_vector(given);
  if (!times) return nb::none();
  const std::span<const double> t = numbers_of(times);
  const auto inside = [&](double at) { return std::min(t0, tf) <= at && at <= std::max(t0, tf); };
  const bool in_order = t.size() < 2 || order_of(t) == (tf >= t0 ? 1 : -1);
  return in_order && (t.empty() || (inside(t.front()) && inside(t.back()))) ? times : nb::none();
}

/// Times of output as a new array, with the first and the last. None: they were given in another form, are not finite,
/// repeat, or are no times at all.
nb::object plain_course(nb::handle given) {
  const nb::object times = plain_vector(given);
  if (!times) return nb::none();
  const std::span<const double> t = numbers_of(times);
  if (t.empty() || order_of(t) == 0 || !all_numbers_finite(times)) return nb::none();
  return nb::make_tuple(times, nb::make_tuple(t.front(), t.back()));
}

/// Times of breakpoints as a new array in the order of integration: those from t0 to tf, or with `ends` false those
/// between them. None: they were given in another form.
nb::object plain_breakpoints(nb::handle given, double t0, double tf, bool ends) {
  const nb::object times = plain_vector(given);
  if (!times || !all_numbers_finite(times)) return nb::none();
  std::vector<double> kept;
  for (const double t : numbers_of(times))
    if (std::min(t0, tf) <= t && t <= std::max(t0, tf) && (ends || (t != t0 && t != tf))) kept.push_back(t);
  if (tf >= t0)
    std::ranges::sort(kept);
  else
    std::ranges::sort(kept, std::greater());
  nb::object sorted = new_vector(kept.size());
  std::ranges::copy(kept, data_of(sorted));
  return sorted;
}

bool plain_and_finite(nb::handle given) {
  const nb::object vector = plain_vector(given);
  return vector && all_numbers_finite(vector);
}

/// Names and values of options, with the types of the values, since 1, 1.0 and True are equal; of t_eval, of
/// breakpoints without actions, and of a StepLimit, only that they were given, by an ellipsis, which nobody gives.
/// None: a value is of another kind, and could change.
nb::object plain_options(const nb::dict& options) {
  const std::array<const PyObject*, 5> kinds = {
      reinterpret_cast<PyObject*>(&PyBool_Type), reinterpret_cast<PyObject*>(&PyLong_Type),
      reinterpret_cast<PyObject*>(&PyFloat_Type), reinterpret_cast<PyObject*>(&PyUnicode_Type),
      reinterpret_cast<PyObject*>(Py_TYPE(Py_None))};
  nb::object all = nb::steal(PyTuple_New(static_cast<Py_ssize_t>(3 * options.size())));
  if (!all) throw nb::python_error();
  Py_ssize_t next = 0;
  const auto put = [&](nb::handle one) { PyTuple_SET_ITEM(all.ptr(), next++, one.inc_ref().ptr()); };
  for (const auto& [name, given] : options) {
    const auto is = [&](const char* one) {
      return PyUnicode_Check(name.ptr()) && PyUnicode_CompareWithASCIIString(name.ptr(), one) == 0;
    };
    const bool exchanged = !given.is_none() && (is("t_eval") || (is("breakpoints") && plain_and_finite(given)) ||
                                                nb::isinstance<StepLimit>(given));
    const nb::handle value = exchanged ? nb::handle(Py_Ellipsis) : given;
    const auto* type = reinterpret_cast<PyObject*>(Py_TYPE(value.ptr()));
    if (!exchanged && std::ranges::find(kinds, type) == kinds.end()) return nb::none();
    put(name);
    put(value);
    put(value.type());
  }
  return all;
}

}  // namespace

std::span<const double> numbers_of(nb::handle given) {
  auto* array = reinterpret_cast<PyArrayObject*>(given.ptr());
  const bool known = PyArray_Check(given.ptr()) && PyArray_IS_C_CONTIGUOUS(array) &&
                     (PyArray_TYPE(array) == NPY_DOUBLE || PyArray_TYPE(array) == NPY_CDOUBLE);
  if (!known) throw nb::type_error("not a contiguous array of float64 or complex128");
  return {static_cast<const double*>(PyArray_DATA(array)),
          static_cast<std::size_t>(PyArray_NBYTES(array)) / sizeof(double)};
}

void define_arguments(nb::module_& module) {
  if (_import_array() < 0) throw nb::python_error();
  module.def(
      "all_finite", [](nb::handle values) { return all_numbers_finite(values); }, nb::arg("values"),
      "Return whether all numbers of a contiguous array of float64 or complex128 are finite.");
  module.def(
      "plainly_posed", &plainly_posed, nb::arg("t_span").none(), nb::arg("y0").none(), nb::arg("args").none(),
      nb::sig("def plainly_posed(t_span: object, y0: object, args: object) -> tuple[tuple[float, float], "
              "numpy.ndarray, tuple[object, ...]] | None"),
      "The three as a problem has them, where they are floats, lists and tuples of these, and arrays of float64; "
      "otherwise None.");
  module.def("plain_times", &plain_times, nb::arg("times").none(), nb::arg("t0"), nb::arg("tf"),
             nb::sig("def plain_times(times: object, t0: float, tf: float) -> numpy.ndarray | None"),
             "A new array of such times, if they are in order and within the interval; otherwise None.");
  module.def("plain_course", &plain_course, nb::arg("times").none(),
             nb::sig("def plain_course(times: object) -> tuple[numpy.ndarray, tuple[float, float]] | None"),
             "A new array of such times, with the first and the last, if they rise or fall strictly; otherwise None.");
  module.def("plain_breakpoints", &plain_breakpoints, nb::arg("times").none(), nb::arg("t0"), nb::arg("tf"),
             nb::arg("ends"),
             nb::sig("def plain_breakpoints(times: object, t0: float, tf: float, ends: bool) -> numpy.ndarray | None"),
             "A new array of such finite times, in any order, with those from t0 to tf in the order of integration; "
             "`ends`: whether those at the ends too. Otherwise None.");
  module.def("plain_options", &plain_options, nb::arg("options"),
             nb::sig("def plain_options(options: object) -> tuple[object, ...] | None"),
             "Names, values and types of options that cannot change, and whether there are times of output and "
             "breakpoints without actions; otherwise None.");
}

}  // namespace invariode::binding
