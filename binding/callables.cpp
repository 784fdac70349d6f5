#define NPY_NO_DEPRECATED_API NPY_1_22_API_VERSION
#include "callables.hpp"

#include <Python.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>
#include <numpy/arrayobject.h>

#include <algorithm>
#include <cassert>
#include <cstdio>
#include <new>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "arrays.hpp"
#include "interpreter.hpp"
#include "linear/solve.hpp"
#include "manifolds.hpp"
#include "mechanics.hpp"

namespace invariode::binding {

/// A Python callable as a core callback. y, or its two parts, is handed over in an array that the callee may keep: it
/// is used again only if nobody else holds it or a view of it. Results are copied at once. The first exception stays
/// set, and the callback says `stop`.
class PythonFunction final : public Callable {
 public:
  PythonFunction(nb::handle callable, const nb::tuple& args, std::string name, Takes takes, Returns returns)
      : args_(args), name_(std::move(name)), takes_(takes), returns_(returns) {
    take(nb::borrow(callable));
  }
  ~PythonFunction() override {
    for (PyArrayObject* spare : spare_) Py_XDECREF(reinterpret_cast<PyObject*>(spare));
  }

  [[nodiscard]] Callback callback() { return {&PythonFunction::entry, this}; }
  /// Another one that takes and returns the same.
  void exchange(nb::object callable, nb::tuple args) {
    const nb::object before = take(std::move(callable));  // is given up at the end, which may run Python code
    std::swap(args_, args);
  }
  int visit(visitproc visit, void* arg) const override {
    Py_VISIT(callable_.ptr());
    Py_VISIT(args_.ptr());
    return 0;
  }

 private:
  static Status entry(void* self, double t, const double* y, double* out) noexcept {
    return in_python([&] { return static_cast<PythonFunction*>(self)->call(t, y, out); }) ? Status::ok : Status::stop;
  }

  /// The callable from now on. Returns what it was.
  nb::object take(nb::object callable) {
    state_first_ = nb::isinstance<StateFirst>(callable);
    if (state_first_) callable = nb::cast<const StateFirst&>(callable).fun;
    looks_for_signals_ = PyFunction_Check(callable.ptr()) != 0;
    return std::exchange(callable_, std::move(callable));
  }

  // None of these throws, but each may end its thread (`in_python`).
  bool call(double t, const double* y, double* out);
  PyObject* call_with(PyObject* time, PyArrayObject* const* parts);
  PyObject* call_with_tuple(PyObject* time, PyArrayObject* const* parts) const;
  [[nodiscard]] PyObject* time_for(double t, const double*& y) const;
  PyArrayObject* array_for(std::size_t part, const double* y);
  [[nodiscard]] bool reusable(PyArrayObject* a, std::span<const npy_intp> shape) const;
  bool read(PyObject* result, double* out);
  bool read_truth(PyObject* result, double* out) const;
  [[nodiscard]] bool read_sequence(PyObject* result, double* out) const;
  bool read_array(PyArrayObject* array, double* out);
  bool holds_numbers(PyObject* items) const;
  bool read_objects(PyArrayObject* array, double* out) const;
  bool has_values(PyObject* array) const;
  [[nodiscard]] bool fits(PyArrayObject* array) const;
  void complain(PyObject* returned) const;

  nb::object callable_;
  nb::tuple args_;
  std::string name_;
  bool looks_for_signals_ = false;  // a function written in Python does so itself when it is entered
  bool state_first_ = false;        // it takes (y, t), not (t, y)
  Takes takes_;
  Returns returns_;
  PyArrayObject* spare_[2] = {nullptr, nullptr};  // the arrays of the last call, if no call is under way
};

bool PythonFunction::reusable(PyArrayObject* a, std::span<const npy_intp> shape) const {
  constexpr int flags = NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_OWNDATA | NPY_ARRAY_ALIGNED | NPY_ARRAY_WRITEABLE;
  return a != nullptr && is_unique(reinterpret_cast<PyObject*>(a)) &&
         PyArray_NDIM(a) == static_cast<int>(shape.size()) && std::equal(shape.begin(), shape.end(), PyArray_DIMS(a)) &&
         (PyArray_FLAGS(a) & ~NPY_ARRAY_F_CONTIGUOUS) == flags &&
         PyArray_TYPE(a) == (takes_.complex ? NPY_CDOUBLE : NPY_DOUBLE) && PyArray_ISNOTSWAPPED(a);
}

PyArrayObject* PythonFunction::array_for(std::size_t part, const double* y) {
  assert(part < 2);
  const bool matrix = part == 0 && takes_.rows > 0;
  const npy_intp whole[] = {matrix ? takes_.rows : part == 0 ? takes_.n : takes_.second, takes_.n};
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
  const bool two = takes_.second > 0;
  const std::ptrdiff_t first = takes_.n * std::max<std::ptrdiff_t>(takes_.rows, 1);
  if (two) parts[1] = array_for(1, y + first * (takes_.complex ? 2 : 1));
  PyObject* result = nullptr;
  if (time != nullptr && parts[0] != nullptr && (!two || parts[1] != nullptr)) result = call_with(time, parts);
  const bool done = result != nullptr && read(result, out);
  Py_XDECREF(result);
  Py_XDECREF(time);
  for (std::size_t k = 0; k < (two ? 2 : 1); ++k) {
    if (spare_[k] == nullptr)  // else a nested call of this function has left its own
      spare_[k] = parts[k];
    else
      Py_XDECREF(reinterpret_cast<PyObject*>(parts[k]));
  }
  return done;
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

/// What is true for Python; an array of several values is neither true nor false.
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
  PyObject* converted = PyArray_FromAny(reinterpret_cast<PyObject*>(array), PyArray_DescrFromType(type), 0, 0,
                                        NPY_ARRAY_CARRAY_RO | NPY_ARRAY_FORCECAST, nullptr);
  if (converted == nullptr) return false;
  copy(reinterpret_cast<PyArrayObject*>(converted));
  Py_DECREF(converted);
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

namespace {

/// Machine code as a core callback, with the arguments it gets. It needs no interpreter.
class NativeFunction final : public Callable {
 public:
  NativeFunction(const Native& native, std::span<const double> parameters)
      : native_(native), parameters_(parameters), p_(parameters.empty() ? nullptr : parameters.data()) {
    std::size_t size = 0;
    for (const PiecewisePolynomial& input : native_.inputs) size += input.size();
    if (size == 0) return;
    with_inputs_.resize(size + parameters.size());
    p_ = with_inputs_.data();
  }

  [[nodiscard]] Callback callback() { return with_inputs_.empty() ? of_kind<false>() : of_kind<true>(); }
  [[nodiscard]] MatrixFunction matrix() {
    return {with_inputs_.empty() ? &matrix_entry<false> : &matrix_entry<true>, this};
  }
  int visit(visitproc visit, void* arg) const override {
    Py_VISIT(native_.owner.ptr());
    return 0;
  }

 private:
  using VectorCode = void(double t, const double* y, double* out, const double* p);
  using EventCode = double(double t, const double* y, const double* p);

  // Entries of their own for functions with inputs: the others cost no more than the call.
  template <bool Inputs>
  [[nodiscard]] Callback of_kind() {
    return {native_.event ? &event_entry<Inputs> : &vector_entry<Inputs>, this};
  }
  template <bool Inputs>
  static Status vector_entry(void* self, double t, const double* y, double* out) noexcept {
    auto& me = *static_cast<NativeFunction*>(self);
    if constexpr (Inputs) me.evaluate_inputs(t);
    in_python([&] { reinterpret_cast<VectorCode*>(me.native_.address)(t, y, out, me.p_); });  // by ctypes
    return Status::ok;
  }
  template <bool Inputs>
  static Status event_entry(void* self, double t, const double* y, double* out) noexcept {
    auto& me = *static_cast<NativeFunction*>(self);
    if constexpr (Inputs) me.evaluate_inputs(t);
    out[0] = in_python([&] { return reinterpret_cast<EventCode*>(me.native_.address)(t, y, me.p_); });
    return Status::ok;
  }
  template <bool Inputs>
  static Status matrix_entry(void* self, double t, const double* y, Matrix& out) noexcept {
    return vector_entry<Inputs>(self, t, y, out.values.data());
  }

  /// Inputs at t, and behind them the parameters, which may have been written since the last call.
  void evaluate_inputs(double t) {
    double* p = with_inputs_.data();
    for (const PiecewisePolynomial& input : native_.inputs) {
      input.evaluate(t, p);
      p += input.size();
    }
    assert(p + parameters_.size() == with_inputs_.data() + with_inputs_.size());
    std::copy(parameters_.begin(), parameters_.end(), p);
  }

  Native native_;
  std::span<const double> parameters_;
  std::vector<double> with_inputs_;
  const double* p_;  // what the code gets: the parameters, or those behind the inputs; null: there are none
};

/// (v, f(t, q)) of f of y'' = f(t, y).
class FirstOrderForm final : public Callable {
 public:
  /// Of a state of so many doubles. `acceleration` belongs to the same owner.
  FirstOrderForm(const Callback& acceleration, std::size_t size) : acceleration_(acceleration), half_(size / 2) {}

  [[nodiscard]] Callback callback() { return {&entry, this}; }
  int visit(visitproc, void*) const override { return 0; }

 private:
  static Status entry(void* self, double t, const double* y, double* out) {
    auto& me = *static_cast<FirstOrderForm*>(self);
    std::copy_n(y + me.half_, me.half_, out);
    return me.acceleration_(t, y, out + me.half_);
  }

  Callback acceleration_;
  std::size_t half_;
};

/// Machine code for Taylor coefficients, with the parameters that it gets.
class NativeSeries final : public Callable {
 public:
  NativeSeries(const SeriesSpec& spec, std::span<const double> parameters)
      : spec_(spec), p_(parameters.empty() ? nullptr : parameters.data()) {}

  [[nodiscard]] Series series() { return {&entry, this, spec_.order}; }
  int visit(visitproc visit, void* arg) const override { return spec_.visit(visit, arg); }

 private:
  using Code = void(double t, double unit, const double* in, double* out, const double* p);

  static Status entry(void* self, double t, double unit, const double* in, double* out) noexcept {
    auto& me = *static_cast<NativeSeries*>(self);
    in_python([&] { reinterpret_cast<Code*>(me.spec_.address)(t, unit, in, out, me.p_); });  // by ctypes
    return Status::ok;
  }

  SeriesSpec spec_;
  const double* p_;
};

/// Compressed columns of an n × n matrix, as whoever reads them takes for granted.
void require_columns(const ConstIndices& starts, const ConstIndices& rows, const ConstVector& values, std::size_t n) {
  require(starts.size() == n + 1 && rows.size() == values.size(), "the lengths of a sparse matrix do not match");
  const auto count = static_cast<int>(rows.size());
  require(starts.data()[0] == 0 && starts.data()[n] == count, "the columns of a sparse matrix do not match its values");
  for (std::size_t j = 0; j < n; ++j) {
    const int begin = starts.data()[j], end = starts.data()[j + 1];
    require(begin <= end && end <= count, "the columns of a sparse matrix overlap");
    for (int p = begin; p < end; ++p)
      require(rows.data()[p] >= 0 && rows.data()[p] < static_cast<int>(n) &&
                  (p == begin || rows.data()[p - 1] < rows.data()[p]),
              "the rows of a sparse matrix are not ascending or out of range");
  }
}

/// What act(), which calls Python, comes to: an exception stays set.
template <class Act>
Status reported(Act act) noexcept {
  try {
    in_python(act);
    return Status::ok;
  } catch (nb::python_error& error) {
    error.restore();
  } catch (const std::bad_alloc&) {
    PyErr_NoMemory();
  } catch (const std::invalid_argument& error) {
    PyErr_SetString(PyExc_ValueError, error.what());
  } catch (const std::exception& error) {
    PyErr_SetString(PyExc_RuntimeError, error.what());
  }
  return Status::stop;
}

/// A new array of these values, `size` reals or half as many complex numbers.
nb::object new_array(const double* values, std::size_t size, bool complex) {
  auto n = static_cast<npy_intp>(complex ? size / 2 : size);
  PyObject* array = PyArray_SimpleNew(1, &n, complex ? NPY_CDOUBLE : NPY_DOUBLE);
  if (array == nullptr) throw nb::python_error();
  std::copy_n(values, size, static_cast<double*>(PyArray_DATA(reinterpret_cast<PyArrayObject*>(array))));
  return nb::steal(array);
}

/// A Python function of (t, y), or of t alone, as a core function that fills a matrix. It returns what `read_matrix`
/// takes: Python's own layer has brought what the user's function returned into this form.
class PythonMatrix final : public Callable {
 public:
  PythonMatrix(nb::handle function, bool complex) : function_(nb::borrow(function)), complex_(complex) {}

  [[nodiscard]] MatrixFunction callback() { return {&PythonMatrix::entry, this}; }
  int visit(visitproc visit, void* arg) const override { return visit_all(visit, arg, {function_}); }

 private:
  static Status entry(void* self, double t, const double* y, Matrix& out) noexcept {
    auto* me = static_cast<PythonMatrix*>(self);
    return reported([&] {
      read_matrix(y == nullptr ? me->function_(t) : me->function_(t, new_array(y, out.n(), me->complex_)), out);
    });
  }

  nb::object function_;
  bool complex_;
};

/// A Python function of (t, y, c) that returns a function x = solve(b), as a preconditioner. Python's own layer sees to
/// it that x is a float64 array, complex numbers as pairs.
class PythonPreconditioner final : public Callable {
 public:
  PythonPreconditioner(nb::handle function, Space space) : function_(nb::borrow(function)), space_(space) {}

  [[nodiscard]] Preconditioner callback() { return {&set_up, &solve, this}; }
  int visit(visitproc visit, void* arg) const override { return visit_all(visit, arg, {function_}); }

 private:
  /// What was made may be given back by a thread that does not hold the interpreter.
  struct Made {
    explicit Made(nb::object&& made) : solve(std::move(made)) {}
    Made(const Made&) = delete;
    Made& operator=(const Made&) = delete;
    ~Made() {
      holding_interpreter([this] { solve.reset(); });
    }
    nb::object solve;
  };

  static Status set_up(void* self, double t, const double* y, double c, std::shared_ptr<void>& made) noexcept {
    auto& me = *static_cast<PythonPreconditioner*>(self);
    return reported([&] {
      const nb::object state = new_array(y, me.space_.size, me.space_.complex);
      made = std::make_shared<Made>(me.function_(t, state, c));
    });
  }
  static Status solve(void* self, void* made, double* b) noexcept {
    auto& me = *static_cast<PythonPreconditioner*>(self);
    return reported([&] {
      const nb::object right = new_array(b, me.space_.size, me.space_.complex);
      const auto x = nb::cast<ConstVector>(static_cast<Made*>(made)->solve(right));
      require(x.size() == me.space_.size, "what a preconditioner returned is not of the size of the state");
      std::copy_n(x.data(), x.size(), b);
    });
  }

  nb::object function_;
  Space space_;
};

}  // namespace

void read_matrix(nb::handle values, Matrix& out) {
  if (out.structure.kind == Structure::Kind::sparse) {
    const auto [starts, rows, entries] = nb::cast<std::tuple<ConstIndices, ConstIndices, ConstVector>>(values);
    require_columns(starts, rows, entries, out.n());
    out.starts.assign(starts.data(), starts.data() + starts.size());
    out.rows.assign(rows.data(), rows.data() + rows.size());
    out.values.assign(entries.data(), entries.data() + entries.size());
    return;
  }
  const auto entries = nb::cast<ConstMatrix>(values);
  const auto& [kind, n, lower, upper] = out.structure;
  require(entries.shape(0) == (kind == Structure::Kind::dense ? n : lower + upper + 1) && entries.shape(1) == n,
          "a matrix is not of the shape of its structure");
  out.values.assign(entries.data(), entries.data() + entries.size());
}

Functions::Functions(Space space, nb::tuple args, std::vector<double> parameters)
    : space_(space), args_(std::move(args)), parameters_(std::move(parameters)) {}

int Functions::visit(visitproc visit, void* arg) const {
  Py_VISIT(args_.ptr());
  for (const auto& one : owned_)
    if (const int stop = one->visit(visit, arg); stop != 0) return stop;
  return 0;
}

Callback Functions::add(nb::handle f, const nb::tuple& args, const std::string& name, const Returns& returns,
                        bool complex_state) {
  return add(f, args, name, returns,
             Takes{.n = static_cast<std::ptrdiff_t>(space_.components()), .complex = complex_state});
}

Callback Functions::of_motion(nb::handle f, const std::string& name, const Takes& takes, const Returns& returns) {
  return add(f, args_, name, returns, takes);
}

Callback Functions::add(nb::handle f, const nb::tuple& args, const std::string& name, const Returns& returns,
                        const Takes& takes) {
  if (nb::isinstance<MotionPart>(f)) {
    const auto& [mechanics, part] = nb::cast<const MotionPart&>(f);
    return motion(mechanics).callback(part);
  }
  if (nb::isinstance<Native>(f)) {
    auto owner = std::make_unique<NativeFunction>(nb::cast<const Native&>(f), parameters_);
    const Callback callback = owner->callback();
    owned_.push_back(std::move(owner));
    return callback;
  }
  if (nb::isinstance<SecondOrderSpec>(f)) {
    Takes positions = takes;
    Returns accelerations = returns;
    positions.n /= 2, accelerations.rows /= 2;
    const Callback acceleration = add(nb::cast<const SecondOrderSpec&>(f).fun, args, name, accelerations, positions);
    auto owner = std::make_unique<FirstOrderForm>(acceleration, space_.size);
    const Callback callback = owner->callback();
    owned_.push_back(std::move(owner));
    return callback;
  }
  if (nb::isinstance<QuadraticSpec>(f)) {
    auto owner = std::make_unique<QuadraticFunction>(nb::cast<const QuadraticSpec&>(f));
    const Callback callback = owner->callback();
    owned_.push_back(std::move(owner));
    return callback;
  }
  native_ = false;
  auto owner = std::make_unique<PythonFunction>(f, args, name, takes, returns);
  const Callback callback = owner->callback();
  owned_.push_back(std::move(owner));
  return callback;
}

Motion& Functions::motion(const nb::object& mechanics) {
  for (OwnedMotion* known : motions_)
    if (known->is_of(mechanics)) return known->motion();
  auto owner = std::make_unique<OwnedMotion>(mechanics, *this);
  motions_.push_back(owner.get());
  owned_.push_back(std::move(owner));
  return motions_.back()->motion();
}

Callback Functions::state_valued(nb::handle f, const std::string& name) {
  return add(f, args_, name, {.rows = static_cast<npy_intp>(space_.components()), .complex = space_.complex},
             space_.complex);
}

Callback Functions::exchangeable(nb::handle f, const std::string& name) {
  const Callback callback = state_valued(f, name);
  exchangeable_ = owned_.empty() ? nullptr : dynamic_cast<PythonFunction*>(owned_.back().get());
  return callback;
}

void Functions::lend(nb::object f, nb::tuple args) {
  if (exchangeable_ == nullptr) throw std::invalid_argument("f is no Python function, and cannot be exchanged");
  exchangeable_->exchange(std::move(f), std::move(args));
}

Callback Functions::scalar(nb::handle f, const std::string& name) { return add(f, args_, name, {}, space_.complex); }

class OwnedStepLimit final : public Callable {
 public:
  explicit OwnedStepLimit(StepLimit limit) : limit_(std::move(limit)) {}

  [[nodiscard]] Callback callback() { return limit_.callback(); }
  int visit(visitproc, void*) const override { return 0; }

 private:
  StepLimit limit_;
};

bool StepLimit::exceeded(double t) {
  const bool forward = times_.back() >= times_.front();
  const std::size_t before = place_;
  while (place_ < times_.size() && (forward ? times_[place_] < t : times_[place_] > t)) ++place_;
  steps_ = place_ == before ? steps_ + 1 : 1;
  return steps_ >= most_ && place_ < times_.size() && times_[place_] != t;
}

Callback Functions::truth(nb::handle f, const std::string& name) {
  if (nb::isinstance<StepLimit>(f)) {
    auto owner = std::make_unique<OwnedStepLimit>(nb::cast<const StepLimit&>(f));
    const Callback callback = owner->callback();
    owned_.push_back(std::move(owner));
    return callback;
  }
  return add(f, nb::tuple(), name, {.kind = Returns::Kind::truth}, space_.complex);
}

Callback Functions::vector(nb::handle f, const std::string& name, std::size_t m) {
  return add(f, args_, name, {.rows = static_cast<npy_intp>(m)}, space_.complex);
}

Callback Functions::complex_vector(nb::handle f, const std::string& name, std::size_t m) {
  return add(f, args_, name, {.rows = static_cast<npy_intp>(m), .complex = true}, true);
}

Callback Functions::square(nb::handle f, const std::string& name, std::size_t k) {
  const auto size = static_cast<npy_intp>(k);
  return add(f, args_, name, {.rows = size, .columns = size, .matrix = true}, space_.complex);
}

Callback Functions::rows(nb::handle f, const std::string& name, std::size_t m) {
  return add(f, args_, name,
             {.rows = static_cast<npy_intp>(m),
              .columns = static_cast<npy_intp>(space_.components()),
              .matrix = true,
              .complex = space_.complex},
             space_.complex);
}

MatrixFunction Functions::matrix(nb::handle f) {
  if (nb::isinstance<Native>(f)) {
    auto owner = std::make_unique<NativeFunction>(nb::cast<const Native&>(f), parameters_);
    const MatrixFunction function = owner->matrix();
    owned_.push_back(std::move(owner));
    return function;
  }
  native_ = false;
  auto owner = std::make_unique<PythonMatrix>(f, space_.complex);
  const MatrixFunction function = owner->callback();
  owned_.push_back(std::move(owner));
  return function;
}

Callback Functions::product(nb::handle f, const std::string& name) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components());
  return add(f, args_, name, {.rows = n, .complex = space_.complex},
             Takes{.n = n, .second = n, .complex = space_.complex});
}

Callback Functions::of_sensitivities(nb::handle f, const std::string& name, std::size_t k) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components()), rows = static_cast<std::ptrdiff_t>(k);
  return add(f, nb::tuple(), name, {.rows = rows, .columns = n, .matrix = true, .complex = space_.complex},
             Takes{.n = n, .rows = 1 + rows, .complex = space_.complex});
}

Callback Functions::tangent(nb::handle f, const std::string& name, std::size_t k, std::size_t m) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components()), rows = static_cast<std::ptrdiff_t>(k);
  return add(f, nb::tuple(), name, {.rows = rows, .columns = static_cast<std::ptrdiff_t>(m), .matrix = true},
             Takes{.n = n, .rows = 1 + rows, .complex = space_.complex});
}

Callback Functions::jump(nb::handle f, const std::string& name, std::size_t k) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components()), rows = static_cast<std::ptrdiff_t>(k);
  return add(f, nb::tuple(), name, {.rows = rows, .columns = n, .matrix = true, .complex = space_.complex},
             Takes{.n = n, .rows = 1 + rows, .second = n, .complex = space_.complex});
}

Series Functions::series(const SeriesSpec& spec) {
  auto owner = std::make_unique<NativeSeries>(spec, parameters_);
  const Series series = owner->series();
  owned_.push_back(std::move(owner));
  return series;
}

Preconditioner Functions::preconditioner(nb::handle f) {
  native_ = false;
  auto owner = std::make_unique<PythonPreconditioner>(f, space_);
  const Preconditioner made = owner->callback();
  owned_.push_back(std::move(owner));
  return made;
}

namespace {

void define_inputs(nb::module_& module) {
  nb::class_<PiecewisePolynomial>(module, "PiecewisePolynomial", "Functions of t that are polynomials between times.")
      .def(
          "__init__",
          [](PiecewisePolynomial* self, const ConstVector& times, const ConstVector& coefficients, std::size_t degree,
             std::size_t size) {
            new (self) PiecewisePolynomial(to_vector(times), to_vector(coefficients), degree, size);
          },
          nb::arg("times"), nb::arg("coefficients"), nb::arg("degree"), nb::arg("size"))
      .def(
          "evaluate",
          [](const PiecewisePolynomial& self, const ConstVector& t) {
            std::vector<double> values(t.size() * self.size());
            for (std::size_t i = 0; i < t.size(); ++i) self.evaluate(t.data()[i], values.data() + i * self.size());
            return to_array<Table>(std::move(values), t.size(), self.size());
          },
          nb::arg("t"), "(len(t), size)")
      .def(
          "at",
          [](const PiecewisePolynomial& self, double t) {
            double value = 0;
            if (self.size() != 1) throw std::invalid_argument("there are several functions");
            self.evaluate(t, &value);
            return value;
          },
          nb::arg("t"), "The one value at t.");
}

void define_step_limit(nb::module_& module) {
  nb::class_<StepLimit>(module, "StepLimit",
                        "A callback that stops one run after so many steps between two times of its output.")
      .def(
          "__init__",
          [](StepLimit* self, const ConstVector& times, std::int64_t most) {
            new (self) StepLimit(to_vector(times), most);
          },
          nb::arg("times"), nb::arg("most"))
      .def(
          "__call__", [](StepLimit& self, double t, const nb::object&) { return self.exceeded(t); }, nb::arg("t"),
          nb::arg("y"));
}

void define_machine_code(nb::module_& module) {
  nb::class_<Native>(module, "Native", nb::type_slots(slots<Native>),
                     "Machine code of the user, and what keeps it alive.")
      .def(
          "__init__",
          [](Native* self, std::uintptr_t address, bool event, nb::object owner,
             std::vector<PiecewisePolynomial> inputs) {
            new (self) Native{address, event, std::move(owner), std::move(inputs)};
          },
          nb::kw_only(), nb::arg("address"), nb::arg("event"), nb::arg("owner").none(),
          nb::arg("inputs") = std::vector<PiecewisePolynomial>{})
      .def_prop_ro("address", [](const Native& self) { return self.address; });
  nb::class_<StateFirst>(module, "StateFirst", nb::type_slots(slots<StateFirst>),
                         "A Python function of (y, t, ...) as one of (t, y, ...).")
      .def(
          "__init__", [](StateFirst* self, nb::object fun) { new (self) StateFirst{std::move(fun)}; }, nb::arg("fun"))
      .def(
          "__call__",
          [](const StateFirst& self, const nb::object& t, const nb::object& y, const nb::args& rest) {
            return self.fun(y, t, *rest);
          },
          nb::sig("def __call__(self, t: object, y: object, /, *args: object) -> object"))
      .def_prop_ro("__wrapped__", [](const StateFirst& self) { return self.fun; }, "The function as it was given.");
  nb::class_<SecondOrderSpec>(module, "SecondOrder", nb::type_slots(slots<SecondOrderSpec>),
                              "f of (t, q) with y'' = f(t, y), as y' of (q, v).")
      .def(
          "__init__", [](SecondOrderSpec* self, nb::object fun) { new (self) SecondOrderSpec{std::move(fun)}; },
          nb::arg("fun"))
      .def_prop_ro("fun", [](const SecondOrderSpec& self) { return self.fun; });
  nb::class_<SeriesSpec>(module, "Series", nb::type_slots(slots<SeriesSpec>),
                         "Machine code for Taylor coefficients, and what keeps it alive.")
      .def(
          "__init__",
          [](SeriesSpec* self, std::uintptr_t address, int order, nb::object owner) {
            new (self) SeriesSpec{address, order, std::move(owner)};
          },
          nb::kw_only(), nb::arg("address"), nb::arg("order"), nb::arg("owner").none(),
          "void (double t, double unit, const double* in, double* out, const double* p) writes the coefficients in s "
          "at t + unit s of the powers 0 ... order: of a system from y (n,), (order + 1, n); of a function g of m "
          "values from those of y, (order + 1, m).")
      .def_ro("order", &SeriesSpec::order);
}

}  // namespace

void define_callables(nb::module_& module) {
  if (_import_array() < 0) throw nb::python_error();
  define_inputs(module);
  define_step_limit(module);
  define_machine_code(module);
  module.def(
      "capsule_address",
      [](const nb::object& capsule) {
        void* pointer = PyCapsule_GetPointer(capsule.ptr(), PyCapsule_GetName(capsule.ptr()));
        if (pointer == nullptr) throw nb::python_error();
        return reinterpret_cast<std::uintptr_t>(pointer);
      },
      nb::arg("capsule"), "The pointer in a capsule.");
  module.def(
      "solve_address", [] { return reinterpret_cast<std::uintptr_t>(&solve_in_place); },
      "Of a function (k, m, numbers) that solves a linear system in place, for generated code.");
}

}  // namespace invariode::binding
