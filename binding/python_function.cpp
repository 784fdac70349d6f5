#define NPY_NO_DEPRECATED_API NPY_1_22_API_VERSION
#include "python_function.hpp"

#include <numpy/arrayobject.h>

#include <algorithm>
#include <cassert>
#include <cstdio>
#include <limits>
#include <utility>

namespace invariode::binding {

bool PythonFunction::reusable(PyArrayObject* a, std::span<const npy_intp> shape) const {
  constexpr int flags = NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_OWNDATA | NPY_ARRAY_ALIGNED | NPY_ARRAY_WRITEABLE;
  return a != nullptr && is_unique(reinterpret_cast<PyObject*>(a)) &&
         PyArray_NDIM(a) == static_cast<int>(shape.size()) && std::equal(shape.begin(), shape.end(), PyArray_DIMS(a)) &&
         (PyArray_FLAGS(a) & ~NPY_ARRAY_F_CONTIGUOUS) == flags &&
         PyArray_TYPE(a) == (takes_.complex ? NPY_CDOUBLE : NPY_DOUBLE) && PyArray_ISNOTSWAPPED(a);
}

PyArrayObject* PythonFunction::array_for(std::size_t part, const double* y) {
  assert(part < 2);
  const std::ptrdiff_t rows = part == 0 ? takes_.rows : takes_.second_rows;
  const bool matrix = rows > 0;
  const npy_intp whole[] = {matrix ? rows : part == 0 ? takes_.n : takes_.second, takes_.n};
  const std::span<const npy_intp> shape(whole, matrix ? 2 : 1);
  const npy_intp size = matrix ? whole[0] * whole[1] : whole[0];
  PyArrayObject* a = std::exchange(spare_[part], nullptr);
  if (!reusable(a, shape)) {
    Py_XDECREF(reinterpret_cast<PyObject*>(a));
    a = reinterpret_cast<PyArrayObject*>(
        PyArray_SimpleNew(static_cast<int>(shape.size()), shape.data(), takes_.complex ? NPY_CDOUBLE : NPY_DOUBLE));
    if (a == nullptr) return nullptr;
  }
  std::copy_n(y, size * (takes_.complex ? 2 : 1), static_cast<double*>(PyArray_DATA(a)));
  return a;
}

/// An array of NaN for the values of a function that fills it: what it does not fill is then no value.
PyArrayObject* PythonFunction::array_to_fill() {
  assert(takes_.second == 0);
  const npy_intp shape[] = {returns_.size()};
  PyArrayObject* a = std::exchange(spare_[1], nullptr);
  if (!reusable(a, shape)) {
    Py_XDECREF(reinterpret_cast<PyObject*>(a));
    a = reinterpret_cast<PyArrayObject*>(PyArray_SimpleNew(1, shape, takes_.complex ? NPY_CDOUBLE : NPY_DOUBLE));
    if (a == nullptr) return nullptr;
  }
  std::fill_n(static_cast<double*>(PyArray_DATA(a)), shape[0] * (takes_.complex ? 2 : 1),
              std::numeric_limits<double>::quiet_NaN());
  return a;
}

/// t, which is the first of the complex numbers where there is a complex one; then they begin after it.
PyObject* PythonFunction::time_for(double t, const double*& y) const {
  if (!takes_.complex_time) return PyFloat_FromDouble(t);
  const double re = y[0], im = y[1];
  y += 2;
  return im == 0 ? PyFloat_FromDouble(re) : PyComplex_FromDoubles(re, im);
}

bool PythonFunction::call(double t, const double* y, double* out) {
  assert(PyGILState_Check() == 1 && PyErr_Occurred() == nullptr);
  if (!looks_for_signals_ && PyErr_CheckSignals() != 0) return false;
  PyObject* time = time_for(t, y);
  PyArrayObject* parts[2] = {array_for(0, y), nullptr};
  const std::size_t count = count_parts();
  const std::ptrdiff_t first = takes_.n * std::max<std::ptrdiff_t>(takes_.rows, 1);
  if (count == 2) parts[1] = fills_ ? array_to_fill() : array_for(1, y + first * (takes_.complex ? 2 : 1));
  PyObject* result = nullptr;
  if (time != nullptr && parts[0] != nullptr && (count == 1 || parts[1] != nullptr)) result = call_with(time, parts);
  const bool done = result == nullptr ? keep_overflow(t, out)
                    : fills_          ? read_filled(result, parts[1], out)
                                      : read(result, out);
  Py_XDECREF(result);
  Py_XDECREF(time);
  for (std::size_t k = 0; k < count; ++k) {
    if (spare_[k] == nullptr)  // else a nested call of this function has left its own
      spare_[k] = parts[k];
    else
      Py_XDECREF(reinterpret_cast<PyObject*>(parts[k]));
  }
  return done;
}

/// Instead of the exception that is set. False: it is another one.
bool PythonFunction::keep_overflow(double t, double* out) {
  if (!postpones_ || PyErr_ExceptionMatches(PyExc_OverflowError) == 0) return false;
  PyObject *type = nullptr, *error = nullptr, *traceback = nullptr;
  PyErr_Fetch(&type, &error, &traceback);
  PyErr_NormalizeException(&type, &error, &traceback);
  if (traceback != nullptr) PyException_SetTraceback(error, traceback);
  Py_XDECREF(type);
  Py_XDECREF(traceback);
  overflowed_at_ = t;
  const nb::object before = std::exchange(overflow_, nb::steal(error));  // is given up at the end
  std::fill_n(out, returns_.size() * (returns_.complex ? 2 : 1), std::numeric_limits<double>::quiet_NaN());
  return true;
}

void PythonFunction::raise_overflow() {
  assert(overflow_.is_valid());
  PyErr_SetObject(reinterpret_cast<PyObject*>(Py_TYPE(overflow_.ptr())), overflow_.ptr());
  forget_overflow();
}

void PythonFunction::forget_overflow() {
  overflowed_at_ = std::numeric_limits<double>::quiet_NaN();
  overflow_.reset();
}

PyObject* PythonFunction::call_with(PyObject* time, PyArrayObject* const* parts) {
  constexpr std::size_t on_stack = 8;
  const auto extra = static_cast<std::size_t>(PyTuple_GET_SIZE(args_.ptr()));
  if (extra > on_stack) return call_with_tuple(time, parts);
  PyObject* arguments[on_stack + 4];
  std::size_t count = 1;  // arguments[0] is the callee's to overwrite (PY_VECTORCALL_ARGUMENTS_OFFSET)
  arguments[count++] = state_first_ ? reinterpret_cast<PyObject*>(parts[0]) : time;
  arguments[count++] = state_first_ ? time : reinterpret_cast<PyObject*>(parts[0]);
  if (parts[1] != nullptr) arguments[count++] = reinterpret_cast<PyObject*>(parts[1]);
  for (std::size_t i = 0; i < extra; ++i)
    arguments[count++] = PyTuple_GET_ITEM(args_.ptr(), static_cast<Py_ssize_t>(i));
  return PyObject_Vectorcall(callable_.ptr(), arguments + 1, (count - 1) | PY_VECTORCALL_ARGUMENTS_OFFSET, nullptr);
}

/// The call with arguments that are too many for the stack.
PyObject* PythonFunction::call_with_tuple(PyObject* time, PyArrayObject* const* parts) const {
  const Py_ssize_t extra = PyTuple_GET_SIZE(args_.ptr()), own = parts[1] == nullptr ? 2 : 3;
  PyObject* arguments = PyTuple_New(own + extra);
  if (arguments == nullptr) return nullptr;
  PyTuple_SET_ITEM(arguments, state_first_ ? 1 : 0, Py_NewRef(time));
  PyTuple_SET_ITEM(arguments, state_first_ ? 0 : 1, Py_NewRef(reinterpret_cast<PyObject*>(parts[0])));
  if (own == 3) PyTuple_SET_ITEM(arguments, 2, Py_NewRef(reinterpret_cast<PyObject*>(parts[1])));
  for (Py_ssize_t i = 0; i < extra; ++i)
    PyTuple_SET_ITEM(arguments, own + i, Py_NewRef(PyTuple_GET_ITEM(args_.ptr(), i)));
  PyObject* result = PyObject_Call(callable_.ptr(), arguments, nullptr);
  Py_DECREF(arguments);
  return result;
}

/// Copies what was returned into out, the common kinds without NumPy's generic paths.
bool PythonFunction::read(PyObject* result, double* out) {
  if (returns_.kind == Returns::Kind::truth) return read_truth(result, out);
  if ((!returns_.matrix || returns_.rows == 1) && read_sequence(result, out)) return true;
  if (!PyArray_CheckExact(result) && !has_no_unit(result)) return false;
  if (PyArray_Check(result)) return read_array(reinterpret_cast<PyArrayObject*>(result), out);
  PyObject* array = result == Py_None ? nullptr : PyArray_FromAny(result, nullptr, 0, 0, 0, nullptr);
  if (array == nullptr) {
    if (PyErr_Occurred() != nullptr && PyErr_ExceptionMatches(PyExc_ValueError) == 0) return false;
    complain(result);
    return false;
  }
  auto* values = reinterpret_cast<PyArrayObject*>(array);
  const bool something_else = PyArray_NDIM(values) == 0 && PyArray_ISOBJECT(values);  // a generator, a dict
  if (something_else) complain(result);
  const bool done = !something_else && read_array(values, out);
  Py_DECREF(array);
  return done;
}

/// Copies what a function has written to its last argument; it returns None, or that array.
bool PythonFunction::read_filled(PyObject* result, PyArrayObject* filled, double* out) const {
  if (result != Py_None && result != reinterpret_cast<PyObject*>(filled)) {
    PyErr_Format(PyExc_TypeError,
                 "%s returned a %s, and with inplace=True its values are those that it writes to its third argument: "
                 "assign to out[...] and return nothing",
                 name_.c_str(), Py_TYPE(result)->tp_name);
    return false;
  }
  std::copy_n(static_cast<const double*>(PyArray_DATA(filled)), returns_.size() * (returns_.complex ? 2 : 1), out);
  return true;
}

/// Reads a Python value as true or false; an array of several values is neither.
bool PythonFunction::read_truth(PyObject* result, double* out) const {
  if (PyArray_Check(result) && PyArray_SIZE(reinterpret_cast<PyArrayObject*>(result)) != 1) {
    PyObject* shape = PyObject_GetAttrString(result, "shape");
    PyErr_Format(PyExc_ValueError, "%s returned an array of shape %S, expected True to stop, or False or None to go on",
                 name_.c_str(), shape);
    Py_XDECREF(shape);
    return false;
  }
  const int truth = PyObject_IsTrue(result);
  out[0] = truth;
  return truth >= 0;
}

/// Lists and tuples of Python or NumPy floats and ints, and a bare float where one number is expected. False: try as an
/// array.
bool PythonFunction::read_sequence(PyObject* result, double* out) const {
  const auto number = [this](PyObject* item, double* to) {
    if (PyFloat_Check(item)) {
      to[0] = PyFloat_AS_DOUBLE(item);
      if (returns_.complex) to[1] = 0;
      return true;
    }
    if (returns_.complex && PyComplex_Check(item)) {
      const Py_complex z = PyComplex_AsCComplex(item);
      to[0] = z.real;
      to[1] = z.imag;
      return true;
    }
    if (PyLong_CheckExact(item)) {
      to[0] = PyLong_AsDouble(item);
      if (returns_.complex) to[1] = 0;
      if (to[0] != -1.0 || PyErr_Occurred() == nullptr) return true;
      PyErr_Clear();
    }
    if (returns_.kind == Returns::Kind::conditions && (PyBool_Check(item) || PyArray_IsScalar(item, Bool))) {
      to[0] = PyObject_IsTrue(item) == 1 ? 1 : -1;
      return true;
    }
    return false;
  };
  const npy_intp size = returns_.size();
  const npy_intp stride = returns_.complex ? 2 : 1;
  const bool list = PyList_CheckExact(result);
  if (!list && !PyTuple_CheckExact(result)) return size == 1 && number(result, out);
  const ListLock lock(result);
  if ((list ? PyList_GET_SIZE(result) : PyTuple_GET_SIZE(result)) != size) return false;
  for (npy_intp i = 0; i < size; ++i)
    if (!number(list ? PyList_GET_ITEM(result, i) : PyTuple_GET_ITEM(result, i), out + i * stride)) return false;
  return true;
}

bool PythonFunction::fits(PyArrayObject* array) const {
  const int nd = PyArray_NDIM(array);
  const npy_intp* shape = PyArray_DIMS(array);
  if (PyArray_SIZE(array) != returns_.size()) return false;
  if (returns_.size() == 1) return true;
  if (returns_.matrix && nd == 2) return shape[0] == returns_.rows && shape[1] == returns_.columns;
  return nd == 1 && (!returns_.matrix || returns_.rows == 1);
}

bool PythonFunction::read_array(PyArrayObject* array, double* out) {
  const int type = returns_.complex ? NPY_CDOUBLE : NPY_DOUBLE;
  if (!fits(array)) {
    complain(reinterpret_cast<PyObject*>(array));
    return false;
  }
  if (!PyArray_CheckExact(reinterpret_cast<PyObject*>(array)) && !has_values(reinterpret_cast<PyObject*>(array)))
    return false;
  const auto copy = [&](PyArrayObject* from) {
    assert(PyArray_SIZE(from) == returns_.size());
    std::copy_n(static_cast<const double*>(PyArray_DATA(from)), returns_.size() * (returns_.complex ? 2 : 1), out);
  };
  if (PyArray_TYPE(array) == type && PyArray_ISCARRAY_RO(array)) {
    copy(array);
    return true;
  }
  const bool numeric = PyArray_ISNUMBER(array) || PyArray_ISBOOL(array) || PyArray_ISOBJECT(array);
  if (!numeric || (PyArray_ISCOMPLEX(array) && !returns_.complex)) {
    PyErr_Format(PyExc_TypeError, "%s returned values of type %S, expected %s numbers%s", name_.c_str(),
                 reinterpret_cast<PyObject*>(PyArray_DESCR(array)), returns_.complex ? "complex" : "real",
                 PyArray_ISCOMPLEX(array) && !takes_.complex ? " (for a complex problem give a complex y0)" : "");
    return false;
  }
  if (PyArray_ISOBJECT(array)) return read_objects(array, out);
  const bool conditions = returns_.kind == Returns::Kind::conditions && PyArray_ISBOOL(array);
  PyObject* converted = PyArray_FromAny(reinterpret_cast<PyObject*>(array), PyArray_DescrFromType(type), 0, 0,
                                        NPY_ARRAY_CARRAY_RO | NPY_ARRAY_FORCECAST, nullptr);
  if (converted == nullptr) return false;
  copy(reinterpret_cast<PyArrayObject*>(converted));
  Py_DECREF(converted);
  if (conditions)
    for (npy_intp i = 0; i < returns_.size(); ++i) out[i] = 2 * out[i] - 1;
  return true;
}

/// An error if a value is a quantity of a package for units, which NumPy takes for its number in whatever unit.
bool PythonFunction::has_no_unit(PyObject* value) const {
  if (PyObject_HasAttrString(value, "to_value") == 0 && PyObject_HasAttrString(value, "magnitude") == 0) return true;
  for (const char* attribute : {"unit", "units"}) {
    PyObject* unit = PyObject_GetAttrString(value, attribute);
    if (unit == nullptr) PyErr_Clear();
    if (unit != nullptr && unit != Py_None)
      PyErr_Format(PyExc_TypeError,
                   "%s returned a quantity with unit '%S', and problems are of plain numbers: return its number in the "
                   "unit that y, t or the equation has",
                   name_.c_str(), unit);
    Py_XDECREF(unit);
    if (PyErr_Occurred() != nullptr) return false;
  }
  return true;
}

/// An error if entries of an array are masked, as in numpy.ma: behind the mask anything may stand.
bool PythonFunction::has_values(PyObject* array) const {
  PyObject* mask = PyObject_GetAttrString(array, "mask");
  PyObject* any = mask == nullptr ? nullptr : PyObject_CallMethod(mask, "any", nullptr);
  const bool masked = any != nullptr && PyObject_IsTrue(any) == 1;
  Py_XDECREF(any);
  Py_XDECREF(mask);
  PyErr_Clear();  // an array of another kind, which has no mask
  if (masked)
    PyErr_Format(PyExc_ValueError, "%s returned masked entries, which have no values: return numbers for all of them",
                 name_.c_str());
  return !masked;
}

/// An error if what is no number at all (None, which NumPy would read as NaN) is among the items.
bool PythonFunction::holds_numbers(PyObject* items) const {
  for (Py_ssize_t i = 0; i < PyList_GET_SIZE(items); ++i) {
    PyObject* item = PyList_GET_ITEM(items, i);
    if (PyNumber_Check(item) != 0) continue;
    PyErr_Format(PyExc_TypeError, "%s returned %R among its values, expected %s numbers", name_.c_str(), item,
                 returns_.complex ? "complex" : "real");
    return false;
  }
  return true;
}

/// float() of each item, or complex().
bool PythonFunction::read_objects(PyArrayObject* array, double* out) const {
  PyObject* flat = PyArray_Ravel(array, NPY_CORDER);
  PyObject* items = flat == nullptr ? nullptr : PyArray_ToList(reinterpret_cast<PyArrayObject*>(flat));
  Py_XDECREF(flat);
  if (items == nullptr) return false;
  const bool numbers = holds_numbers(items);
  for (Py_ssize_t i = 0; numbers && i < PyList_GET_SIZE(items) && PyErr_Occurred() == nullptr; ++i) {
    if (returns_.complex) {
      const Py_complex z = PyComplex_AsCComplex(PyList_GET_ITEM(items, i));
      *out++ = z.real;
      *out++ = z.imag;
    } else {
      *out++ = PyFloat_AsDouble(PyList_GET_ITEM(items, i));
    }
    if (PyLong_Check(PyList_GET_ITEM(items, i)) && PyErr_ExceptionMatches(PyExc_OverflowError) != 0) {
      PyErr_Clear();
      PyErr_Format(PyExc_ValueError, "%s returned an integer too large for a double", name_.c_str());
    }
  }
  Py_DECREF(items);
  return PyErr_Occurred() == nullptr;
}

/// ValueError: the name of the function, the shape returned, the shape expected; with the exception that is set as its
/// cause.
void PythonFunction::complain(PyObject* returned) const {
  PyObject *type = nullptr, *cause = nullptr, *traceback = nullptr;
  PyErr_Fetch(&type, &cause, &traceback);
  if (type != nullptr) PyErr_NormalizeException(&type, &cause, &traceback);

  char expected[96];
  const auto rows = static_cast<long long>(returns_.rows), columns = static_cast<long long>(returns_.columns);
  if (returns_.matrix)
    std::snprintf(expected, sizeof expected, rows == 1 ? "shape (%lld, %lld) or (%lld,)" : "shape (%lld, %lld)", rows,
                  columns, columns);
  else
    std::snprintf(expected, sizeof expected, returns_.size() == 1 ? "a number or shape (1,)" : "shape (%lld,)", rows);
  if (PyArray_Check(returned)) {
    PyObject* shape = PyObject_GetAttrString(returned, "shape");
    PyErr_Format(PyExc_ValueError, "%s returned shape %S, expected %s", name_.c_str(), shape, expected);
    Py_XDECREF(shape);
  } else if (returned == Py_None) {
    PyErr_Format(PyExc_ValueError, "%s returned None (is a `return` missing?), expected %s", name_.c_str(), expected);
  } else {
    PyErr_Format(PyExc_ValueError, "%s returned a %s that is not an array of numbers, expected %s", name_.c_str(),
                 Py_TYPE(returned)->tp_name, expected);
  }
  if (cause != nullptr) {
    PyObject *t = nullptr, *error = nullptr, *tb = nullptr;
    PyErr_Fetch(&t, &error, &tb);
    PyErr_NormalizeException(&t, &error, &tb);
    PyException_SetCause(error, Py_NewRef(cause));
    PyErr_Restore(t, error, tb);
  }
  Py_XDECREF(type);
  Py_XDECREF(cause);
  Py_XDECREF(traceback);
}

void prepare_python_functions() {
  if (_import_array() < 0) throw nb::python_error();
}

}  // namespace invariode::binding
