// The one boundary between Python and the core: Python callables become core callbacks, core results become arrays.

#define NPY_NO_DEPRECATED_API NPY_1_22_API_VERSION
#include <Python.h>
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/variant.h>
#include <nanobind/stl/vector.h>
#include <numpy/arrayobject.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <complex>
#include <cstring>
#include <iterator>
#include <limits>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <variant>
#include <vector>

#include "integrate.hpp"
#include "methods/registry.hpp"
#include "run/ensemble.hpp"

namespace nb = nanobind;
using namespace invariode;

namespace {

using Vector = nb::ndarray<double, nb::numpy, nb::ndim<1>, nb::c_contig>;
using Table = nb::ndarray<double, nb::numpy, nb::ndim<2>, nb::c_contig>;
using Offsets = nb::ndarray<std::int64_t, nb::numpy, nb::ndim<1>, nb::c_contig>;
using ConstOffsets = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using ConstVector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using ConstMatrix = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// ---------------------------------------------------------------------------------------------------------------------
// Python callables as callbacks

/// What a Python function is to return.
struct Returns {
  enum class Kind { values, truth } kind = Kind::values;
  npy_intp rows = 1;  // (rows, columns) numbers; vectors have one column
  npy_intp columns = 1;
  bool matrix = false;
  bool complex = false;

  [[nodiscard]] npy_intp size() const { return rows * columns; }
};

/// A Python callable as a core callback. y is handed over in an array that the callee may keep: it is used again only
/// if nobody else holds it or a view of it. Results are copied at once. The first exception stays set, and the callback
/// says `stop`.
class PythonFunction {
 public:
  PythonFunction(nb::handle callable, const nb::tuple& args, std::string name, npy_intp n, bool complex,
                 Returns returns)
      : callable_(nb::borrow(callable)),
        args_(args),
        name_(std::move(name)),
        looks_for_signals_(PyFunction_Check(callable.ptr())),
        n_(n),
        complex_(complex),
        returns_(returns) {}
  PythonFunction(const PythonFunction&) = delete;
  PythonFunction& operator=(const PythonFunction&) = delete;
  ~PythonFunction() { Py_XDECREF(reinterpret_cast<PyObject*>(spare_)); }

  [[nodiscard]] Callback callback() { return {&PythonFunction::entry, this}; }
  int visit(visitproc visit, void* arg) const {
    Py_VISIT(callable_.ptr());
    Py_VISIT(args_.ptr());
    return 0;
  }

 private:
  static Status entry(void* self, double t, const double* y, double* out) noexcept {
    return static_cast<PythonFunction*>(self)->call(t, y, out) ? Status::ok : Status::stop;
  }

  bool call(double t, const double* y, double* out) noexcept;
  PyArrayObject* array_for(const double* y) noexcept;
  [[nodiscard]] bool reusable(PyArrayObject* a) const noexcept;
  bool read(PyObject* result, double* out) noexcept;
  [[nodiscard]] bool read_sequence(PyObject* result, double* out) const noexcept;
  bool read_array(PyArrayObject* array, double* out) noexcept;
  bool read_objects(PyArrayObject* array, double* out) const noexcept;
  [[nodiscard]] bool fits(PyArrayObject* array) const noexcept;
  void complain(PyObject* returned) const noexcept;

  nb::object callable_;
  nb::tuple args_;
  std::string name_;
  bool looks_for_signals_;  // a function written in Python does so itself when it is entered
  npy_intp n_;
  bool complex_;
  Returns returns_;
  PyArrayObject* spare_ = nullptr;  // the array of the last call, if no call is under way
};

bool PythonFunction::reusable(PyArrayObject* a) const noexcept {
  constexpr int flags =
      NPY_ARRAY_C_CONTIGUOUS | NPY_ARRAY_F_CONTIGUOUS | NPY_ARRAY_OWNDATA | NPY_ARRAY_ALIGNED | NPY_ARRAY_WRITEABLE;
  return a != nullptr && Py_REFCNT(a) == 1 && PyArray_NDIM(a) == 1 && PyArray_DIM(a, 0) == n_ &&
         PyArray_FLAGS(a) == flags && PyArray_TYPE(a) == (complex_ ? NPY_CDOUBLE : NPY_DOUBLE);
}

PyArrayObject* PythonFunction::array_for(const double* y) noexcept {
  PyArrayObject* a = std::exchange(spare_, nullptr);
  if (!reusable(a)) {
    Py_XDECREF(reinterpret_cast<PyObject*>(a));
    a = reinterpret_cast<PyArrayObject*>(PyArray_SimpleNew(1, &n_, complex_ ? NPY_CDOUBLE : NPY_DOUBLE));
    if (a == nullptr) return nullptr;
  }
  std::memcpy(PyArray_DATA(a), y, static_cast<std::size_t>(n_) * (complex_ ? 2 : 1) * sizeof(double));
  return a;
}

bool PythonFunction::call(double t, const double* y, double* out) noexcept {
  if (!looks_for_signals_ && PyErr_CheckSignals() != 0) return false;
  PyArrayObject* array = array_for(y);
  if (array == nullptr) return false;
  PyObject* time = PyFloat_FromDouble(t);
  PyObject* result = nullptr;
  if (time != nullptr) {
    constexpr std::size_t few = 8;
    const auto extra = static_cast<std::size_t>(PyTuple_GET_SIZE(args_.ptr()));
    PyObject* here[few + 3];
    std::vector<PyObject*> many;
    PyObject** arguments = here;
    if (extra > few) {
      many.resize(extra + 3);
      arguments = many.data();
    }
    arguments[1] = time;  // arguments[0] is the callee's to overwrite (PY_VECTORCALL_ARGUMENTS_OFFSET)
    arguments[2] = reinterpret_cast<PyObject*>(array);
    for (std::size_t i = 0; i < extra; ++i)
      arguments[i + 3] = PyTuple_GET_ITEM(args_.ptr(), static_cast<Py_ssize_t>(i));
    result = PyObject_Vectorcall(callable_.ptr(), arguments + 1, (2 + extra) | PY_VECTORCALL_ARGUMENTS_OFFSET, nullptr);
    Py_DECREF(time);
  }
  const bool done = result != nullptr && read(result, out);
  Py_XDECREF(result);
  if (spare_ == nullptr)  // else a nested call of this function has left its own
    spare_ = array;
  else
    Py_DECREF(reinterpret_cast<PyObject*>(array));
  return done;
}

/// Copies what was returned into out, the common kinds without NumPy's generic paths.
bool PythonFunction::read(PyObject* result, double* out) noexcept {
  if (returns_.kind == Returns::Kind::truth) {
    const int truth = PyObject_IsTrue(result);
    out[0] = truth;
    return truth >= 0;
  }
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

/// Lists and tuples of Python or NumPy floats and ints, and a bare float where one number is expected. False: try as an
/// array.
bool PythonFunction::read_sequence(PyObject* result, double* out) const noexcept {
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
  if ((list ? PyList_GET_SIZE(result) : PyTuple_GET_SIZE(result)) != size) return false;
  for (npy_intp i = 0; i < size; ++i)
    if (!number(list ? PyList_GET_ITEM(result, i) : PyTuple_GET_ITEM(result, i), out + i * stride)) return false;
  return true;
}

bool PythonFunction::fits(PyArrayObject* array) const noexcept {
  const int nd = PyArray_NDIM(array);
  const npy_intp* shape = PyArray_DIMS(array);
  if (PyArray_SIZE(array) != returns_.size()) return false;
  if (returns_.size() == 1) return true;
  if (returns_.matrix && nd == 2) return shape[0] == returns_.rows && shape[1] == returns_.columns;
  return nd == 1 && (!returns_.matrix || returns_.rows == 1);
}

bool PythonFunction::read_array(PyArrayObject* array, double* out) noexcept {
  const int type = returns_.complex ? NPY_CDOUBLE : NPY_DOUBLE;
  if (!fits(array)) {
    complain(reinterpret_cast<PyObject*>(array));
    return false;
  }
  const std::size_t bytes = static_cast<std::size_t>(returns_.size()) * (returns_.complex ? 2 : 1) * sizeof(double);
  if (PyArray_TYPE(array) == type && PyArray_ISCARRAY_RO(array)) {
    std::memcpy(out, PyArray_DATA(array), bytes);
    return true;
  }
  const bool numeric = PyArray_ISNUMBER(array) || PyArray_ISBOOL(array) || PyArray_ISOBJECT(array);
  if (!numeric || (PyArray_ISCOMPLEX(array) && !returns_.complex)) {
    PyErr_Format(PyExc_TypeError, "%s returned values of type %S, expected %s numbers%s", name_.c_str(),
                 reinterpret_cast<PyObject*>(PyArray_DESCR(array)), returns_.complex ? "complex" : "real",
                 PyArray_ISCOMPLEX(array) && !complex_ ? " (for a complex problem give a complex y0)" : "");
    return false;
  }
  if (PyArray_ISOBJECT(array)) return read_objects(array, out);
  PyObject* converted = PyArray_FromAny(reinterpret_cast<PyObject*>(array), PyArray_DescrFromType(type), 0, 0,
                                        NPY_ARRAY_CARRAY_RO | NPY_ARRAY_FORCECAST, nullptr);
  if (converted == nullptr) return false;
  std::memcpy(out, PyArray_DATA(reinterpret_cast<PyArrayObject*>(converted)), bytes);
  Py_DECREF(converted);
  return true;
}

/// float() of each item, or complex(): what has neither (None) is an error, which NumPy would read as NaN.
bool PythonFunction::read_objects(PyArrayObject* array, double* out) const noexcept {
  PyObject* flat = PyArray_Ravel(array, NPY_CORDER);
  PyObject* items = flat == nullptr ? nullptr : PyArray_ToList(reinterpret_cast<PyArrayObject*>(flat));
  Py_XDECREF(flat);
  if (items == nullptr) return false;
  for (Py_ssize_t i = 0; i < PyList_GET_SIZE(items) && PyErr_Occurred() == nullptr; ++i) {
    if (returns_.complex) {
      const Py_complex z = PyComplex_AsCComplex(PyList_GET_ITEM(items, i));
      *out++ = z.real;
      *out++ = z.imag;
    } else {
      *out++ = PyFloat_AsDouble(PyList_GET_ITEM(items, i));
    }
  }
  Py_DECREF(items);
  return PyErr_Occurred() == nullptr;
}

/// ValueError: the name of the function, the shape returned, the shape expected; with the exception that is set as its
/// cause.
void PythonFunction::complain(PyObject* returned) const noexcept {
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
    PyErr_Format(PyExc_ValueError, "%s returned a %s that is no array of numbers, expected %s", name_.c_str(),
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

/// A user's machine code: its address, and what keeps it alive.
struct Native {
  std::uintptr_t address;
  bool event;
  nb::object owner;
};

/// Machine code as a core callback, with the arguments it gets. It needs no interpreter.
class NativeFunction {
 public:
  NativeFunction(const Native& native, const double* parameters) : native_(native), parameters_(parameters) {}

  [[nodiscard]] Callback callback() { return {native_.event ? &event_entry : &vector_entry, this}; }
  [[nodiscard]] MatrixFunction matrix() { return {&matrix_entry, this}; }
  int visit(visitproc visit, void* arg) const {
    Py_VISIT(native_.owner.ptr());
    return 0;
  }

 private:
  using Vector = void(double t, const double* y, double* out, const double* p);
  using Event = double(double t, const double* y, const double* p);

  static Status vector_entry(void* self, double t, const double* y, double* out) noexcept {
    const auto& me = *static_cast<NativeFunction*>(self);
    reinterpret_cast<Vector*>(me.native_.address)(t, y, out, me.parameters_);
    return Status::ok;
  }
  static Status event_entry(void* self, double t, const double* y, double* out) noexcept {
    const auto& me = *static_cast<NativeFunction*>(self);
    out[0] = reinterpret_cast<Event*>(me.native_.address)(t, y, me.parameters_);
    return Status::ok;
  }
  static Status matrix_entry(void* self, double t, const double* y, Matrix& out) noexcept {
    return vector_entry(self, t, y, out.values.data());
  }

  Native native_;
  const double* parameters_;
};

/// A Python function of (t, y), or of t alone, as a core function that fills a matrix. It returns what `read` takes:
/// the values as a float64 array in the matrix's layout, for a sparse one (starts, rows, values). Python's own layer
/// has brought what the user's function returned into this form.
class PythonMatrix {
 public:
  PythonMatrix(nb::object function, bool complex) : function_(std::move(function)), complex_(complex) {}

  [[nodiscard]] MatrixFunction callback() { return {&PythonMatrix::entry, this}; }
  int visit(visitproc visit, void* arg) const {
    Py_VISIT(function_.ptr());
    return 0;
  }

  static void read(nb::handle values, Matrix& out) {
    if (out.structure.kind == Structure::Kind::sparse) {
      using Indices = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
      const auto [starts, rows, entries] = nb::cast<std::tuple<Indices, Indices, ConstVector>>(values);
      out.starts.assign(starts.data(), starts.data() + starts.size());
      out.rows.assign(rows.data(), rows.data() + rows.size());
      out.values.assign(entries.data(), entries.data() + entries.size());
    } else {
      const auto entries = nb::cast<ConstMatrix>(values);
      out.values.assign(entries.data(), entries.data() + entries.size());
    }
  }

 private:
  static Status entry(void* self, double t, const double* y, Matrix& out) noexcept {
    auto* me = static_cast<PythonMatrix*>(self);
    try {
      read(y == nullptr ? me->function_(t) : me->function_(t, me->state(y, out.n())), out);
      return Status::ok;
    } catch (nb::python_error& error) {
      error.restore();
    } catch (const std::exception& error) {
      PyErr_SetString(PyExc_RuntimeError, error.what());
    }
    return Status::stop;
  }

  [[nodiscard]] nb::object state(const double* y, std::size_t size) const {
    auto n = static_cast<npy_intp>(complex_ ? size / 2 : size);
    PyObject* array = PyArray_SimpleNew(1, &n, complex_ ? NPY_CDOUBLE : NPY_DOUBLE);
    if (array == nullptr) throw nb::python_error();
    std::memcpy(PyArray_DATA(reinterpret_cast<PyArrayObject*>(array)), y, size * sizeof(double));
    return nb::steal(array);
  }

  nb::object function_;
  bool complex_;
};

// ---------------------------------------------------------------------------------------------------------------------
// The problem as the core sees it

/// Describes the state: `size` doubles, which are that many reals or half as many complex numbers.
struct Space {
  std::size_t size;
  bool complex;

  [[nodiscard]] npy_intp components() const { return static_cast<npy_intp>(complex ? size / 2 : size); }
};

/// (fun, jac or how it is had, m, name, value is held)
using InvariantSpec = std::tuple<nb::object, nb::object, std::size_t, std::string, bool>;
/// (fun, terminal count, direction, name, action or None, rehold)
using EventSpec = std::tuple<nb::object, std::int64_t, int, std::string, nb::object, bool>;

template <class Names>
auto find_name(const Names& names, const std::string& name, const char* what) {
  for (const auto& [key, value] : names)
    if (key == name) return value;
  throw nb::value_error((std::string("unknown ") + what + " '" + name + "'").c_str());
}

/// By complex steps, until g does not take one.
constexpr const char* choose_derivative = "complex-step or 3-point";
constexpr std::pair<const char*, Derivative> derivatives[] = {{choose_derivative, Derivative::complex_step},
                                                              {"complex-step", Derivative::complex_step},
                                                              {"3-point", Derivative::central},
                                                              {"2-point", Derivative::forward}};

/// What `Linear` of Python's layer says of ∂f/∂y and M.
struct LinearSpec {
  Structure structure;
  std::string kind;       // of the Jacobian: "constant", "function", "differences"
  nb::object jacobian;    // its values, its function, or for sparse differences its pattern
  nb::object mass;        // None, the values of a constant one, or M(t)
  nb::object null_basis;  // (starts, rows, values, r) of Z
  nb::object lapack;      // None, or capsules by name
};

std::vector<double> to_vector(const ConstVector& a) { return {a.data(), a.data() + a.size()}; }

/// Owns the Python functions of a call and makes callbacks of them.
class Functions {
 public:
  /// `parameters`: what native functions get as p.
  Functions(Space space, nb::tuple args, std::vector<double> parameters)
      : space_(space), args_(std::move(args)), parameters_(std::move(parameters)) {}

  /// Other values of the same parameters.
  void set_parameters(const double* p) { std::copy(p, p + parameters_.size(), parameters_.begin()); }
  [[nodiscard]] std::size_t parameters() const { return parameters_.size(); }
  /// Whether no function needs the interpreter.
  [[nodiscard]] bool native() const { return owned_.empty() && matrices_.empty(); }
  /// Shows all that is owned to the garbage collector: a function may well own what owns this.
  int visit(visitproc visit, void* arg) const {
    Py_VISIT(args_.ptr());
    int stop = 0;
    const auto each = [&](const auto& functions) {
      for (const auto& one : functions)
        if (stop == 0) stop = one->visit(visit, arg);
    };
    each(natives_);
    each(owned_);
    each(matrices_);
    return stop;
  }

  Callback state_valued(nb::handle f, const std::string& name) {
    return add(f, args_, name, {.rows = space_.components(), .complex = space_.complex});
  }
  Callback scalar(nb::handle f, const std::string& name) { return add(f, args_, name, {}); }
  Callback truth(nb::handle f, const std::string& name) {
    return add(f, nb::tuple(), name, {.kind = Returns::Kind::truth});
  }
  MatrixFunction matrix(const nb::object& function) {
    if (nb::isinstance<Native>(function)) return native(function).matrix();
    matrices_.push_back(std::make_unique<PythonMatrix>(function, space_.complex));
    return matrices_.back()->callback();
  }
  std::vector<InvariantBlock> invariants(const std::vector<InvariantSpec>& specs) {
    std::vector<InvariantBlock> blocks;
    for (const auto& [g, jacobian, m, name, held] : specs) {
      const auto rows = static_cast<npy_intp>(m);
      InvariantBlock block;
      block.g = add(g, args_, "invariant " + name, {.rows = rows});
      block.m = m;
      block.held = held;
      if (nb::isinstance<nb::str>(jacobian)) {
        block.derivative = find_name(derivatives, nb::cast<std::string>(jacobian), "kind of derivative");
        if (block.derivative == Derivative::complex_step) {
          const bool may_fail = nb::cast<std::string>(jacobian) == choose_derivative;
          const nb::object at_complex =
              may_fail ? nb::module_::import_("invariode.invariants").attr("at_complex")(g, m) : g;
          block.complex_g = add(at_complex, args_, "invariant " + name, {.rows = rows, .complex = true}, true);
        }
      } else {
        block.jacobian = add(jacobian, args_, "the Jacobian of invariant " + name,
                             {.rows = rows, .columns = space_.components(), .matrix = true, .complex = space_.complex});
      }
      blocks.push_back(block);
    }
    return blocks;
  }

 private:
  Callback add(nb::handle f, const nb::tuple& args, std::string name, Returns returns, bool complexified = false) {
    if (nb::isinstance<Native>(f)) return native(f).callback();
    owned_.push_back(std::make_unique<PythonFunction>(f, args, std::move(name), space_.components(),
                                                      space_.complex || complexified, returns));
    return owned_.back()->callback();
  }

  NativeFunction& native(nb::handle f) {
    const double* p = parameters_.empty() ? nullptr : parameters_.data();
    natives_.push_back(std::make_unique<NativeFunction>(nb::cast<const Native&>(f), p));
    return *natives_.back();
  }

  Space space_;
  nb::tuple args_;
  std::vector<double> parameters_;
  std::vector<std::unique_ptr<NativeFunction>> natives_;
  std::vector<std::unique_ptr<PythonFunction>> owned_;
  std::vector<std::unique_ptr<PythonMatrix>> matrices_;
};

/// thr of all components, or of each.
using Threshold = std::variant<double, ConstVector>;

Weights to_weights(std::size_t n, double rtol, const Threshold& threshold, const std::optional<ConstVector>& scale) {
  const auto* each = std::get_if<ConstVector>(&threshold);
  if ((each && each->size() != n) || (scale && scale->size() != n)) throw nb::value_error("weights do not match");
  return {rtol, each ? to_vector(*each) : std::vector<double>(n, std::get<double>(threshold)),
          scale ? to_vector(*scale) : std::vector<double>{}};
}

/// Lets other threads run the interpreter until `end`, where nothing here needs it.
class Unlocked {
 public:
  explicit Unlocked(bool possible) {
    if (possible) released_.emplace();
  }
  void end() { released_.reset(); }

 private:
  std::optional<nb::gil_scoped_release> released_;
};

/// The invariants, of which there must be as many as values.
Invariants bound(std::size_t n, Functions& functions, const std::vector<InvariantSpec>& specs, const ConstVector& value,
                 const Weights& weights) {
  std::size_t m = 0;
  for (const auto& [g, jacobian, size, name, held] : specs) m += static_cast<std::size_t>(size);
  if (m != value.size()) throw nb::value_error("not as many values as invariants");
  return {n, functions.invariants(specs), to_vector(value), weights};
}

/// Hands a vector over to NumPy without copying it.
template <class Array, class T, class... Size>
Array to_array(std::vector<T>&& values, Size... shape) {
  auto* owner = new std::vector<T>(std::move(values));
  const nb::capsule free(owner, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return Array(owner->data(), {static_cast<std::size_t>(shape)...}, free);
}

template <class Array, class T, class... Size>
Array to_array(Buffer<T>&& values, Size... shape) {
  void* block = values.release();
  const nb::capsule free(block, [](void* p) noexcept { std::free(p); });
  return Array(block, {static_cast<std::size_t>(shape)...}, free);
}

const char* name_of(State state) {
  switch (state) {
    case State::created: return "created";
    case State::running: return "running";
    case State::reached_end: return "reached_end";
    case State::terminal_event: return "terminal_event";
    case State::stopped_by_callback: return "stopped_by_callback";
    case State::interrupted: return "interrupted";
    case State::event_undefined: return "event_undefined";
    case State::action_undefined: return "action_undefined";
    case State::start_undefined: return "start_undefined";
    case State::step_failed: return "step_failed";
    case State::invariant_refused: return "invariant_refused";
    case State::invariant_convicted: return "invariant_convicted";
  }
  return "";
}

const char* name_of(Derivative derivative) {
  switch (derivative) {
    case Derivative::given: return "given";
    case Derivative::complex_step: return "complex step";
    case Derivative::central: return "central differences";
    case Derivative::forward: return "forward differences";
  }
  return "";
}

const char* name_of(Cause cause) {
  switch (cause) {
    case Cause::error: return "error";
    case Cause::newton: return "newton";
    case Cause::projection: return "projection";
    case Cause::not_finite: return "not_finite";
  }
  return "";
}

const char* name_of(Finding::Kind kind) {
  switch (kind) {
    case Finding::Kind::none: return "none";
    case Finding::Kind::stop: return "stop";
    case Finding::Kind::undefined: return "undefined";
    case Finding::Kind::off_value: return "off_value";
    case Finding::Kind::wrong_jacobian: return "wrong_jacobian";
    case Finding::Kind::not_conserved: return "not_conserved";
  }
  return "";
}

const char* name_of(Consistency verdict) {
  switch (verdict) {
    case Consistency::consistent: return "consistent";
    case Consistency::corrected: return "corrected";
    case Consistency::not_found: return "not_found";
    case Consistency::index_too_high: return "index_too_high";
    case Consistency::undefined: return "undefined";
    case Consistency::stop: return "stop";
  }
  return "";
}

/// ∂f/∂y, M and the linear algebra of an implicit method, from their description.
class LinearProblem {
 public:
  LinearProblem(const LinearSpec& spec, Functions& functions, const Weights& weights)
      : jacobian_(make_jacobian(spec, functions, weights)) {
    if (!spec.lapack.is_none()) take_lapack(spec.lapack);
    if (spec.mass.is_none()) return;
    Matrix mass(spec.structure);
    MatrixFunction function;
    if (PyCallable_Check(spec.mass.ptr()) != 0)
      function = functions.matrix(spec.mass);
    else
      PythonMatrix::read(spec.mass, mass);
    mass_.emplace(std::move(mass), function, make_basis(spec.null_basis, spec.structure.n));
  }

  [[nodiscard]] LinearAlgebra algebra() {
    return {.jacobian = &jacobian_, .mass = mass_ ? &*mass_ : nullptr, .lapack = lapack_ ? &*lapack_ : nullptr};
  }

 private:
  static Jacobian make_jacobian(const LinearSpec& spec, Functions& functions, const Weights& weights) {
    Matrix matrix(spec.structure);
    if (spec.kind == "function" && nb::isinstance<nb::tuple>(spec.jacobian)) {  // native, and its pattern if sparse
      const auto [code, pattern] = nb::cast<std::pair<nb::object, nb::object>>(spec.jacobian);
      if (!pattern.is_none()) PythonMatrix::read(pattern, matrix);
      return {Jacobian::Kind::function, matrix, functions.matrix(code), weights};
    }
    if (spec.kind == "function") return {Jacobian::Kind::function, matrix, functions.matrix(spec.jacobian), weights};
    const bool differences = spec.kind == "differences";
    if (!spec.jacobian.is_none()) PythonMatrix::read(spec.jacobian, matrix);
    return {differences ? Jacobian::Kind::differences : Jacobian::Kind::constant, std::move(matrix), {}, weights};
  }

  static Mass::Basis make_basis(const nb::object& basis, std::size_t n) {
    using Indices = nb::ndarray<const int, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
    const auto [starts, rows, values] = nb::cast<std::tuple<Indices, Indices, ConstVector>>(basis);
    return Eigen::Map<const Mass::Basis>(static_cast<Eigen::Index>(n), static_cast<Eigen::Index>(starts.size()) - 1,
                                         static_cast<Eigen::Index>(values.size()), starts.data(), rows.data(),
                                         values.data());
  }

  template <class Routine>
  static void take(const nb::object& capsules, const char* name, Routine*& to) {
    PyObject* capsule = nb::object(capsules[name]).ptr();
    to = reinterpret_cast<Routine*>(PyCapsule_GetPointer(capsule, PyCapsule_GetName(capsule)));
    if (to == nullptr) throw nb::python_error();
  }
  void take_lapack(const nb::object& capsules) {
    lapack_.emplace();
    take(capsules, "dgetrf", lapack_->dgetrf);
    take(capsules, "dgetrs", lapack_->dgetrs);
    take(capsules, "dgbtrf", lapack_->dgbtrf);
    take(capsules, "dgbtrs", lapack_->dgbtrs);
  }

  Jacobian jacobian_;
  std::optional<Mass> mass_;
  std::optional<Lapack> lapack_;
};

constexpr std::pair<const char*, Structure::Kind> structures[] = {
    {"dense", Structure::Kind::dense}, {"banded", Structure::Kind::banded}, {"sparse", Structure::Kind::sparse}};
constexpr std::pair<const char*, Fsal> fsals[] = {{"reuse", Fsal::reuse}, {"evaluate", Fsal::evaluate}};
constexpr std::pair<const char*, Interpolation> interpolations[] = {
    {"projected", Interpolation::projected}, {"corrected", Interpolation::corrected}, {"raw", Interpolation::raw}};

template <class Value>
const char* name_in(const std::pair<const char*, Value> (&names)[3], Value value) {
  for (const auto& [name, one] : names)
    if (one == value) return name;
  return "";
}

// ---------------------------------------------------------------------------------------------------------------------
// What Python calls

/// The continuous solution, with the tolerances that its projections use.
struct Dense {
  DenseOutput output;
  Weights weights;
  bool complex;

  Table evaluate(const ConstVector& t, const std::vector<InvariantSpec>& invariants, const ConstVector& value,
                 const nb::tuple& args, const ConstVector& parameters) const {
    Functions functions({output.n(), complex}, args, to_vector(parameters));
    std::optional<Invariants> g;
    std::optional<Projector> projector;
    if (output.projects() && !invariants.empty()) {
      if (value.size() != output.parts().m) throw nb::value_error("not the number of invariants of the run");
      g.emplace(bound(output.n(), functions, invariants, value, weights));
      projector.emplace(*g, weights, 1);
    }
    std::vector<double> y(t.size() * output.n());
    Unlocked unlocked(functions.native());
    if (output.evaluate(t.data(), t.size(), y.data(), projector ? &*projector : nullptr) == Status::stop)
      throw nb::python_error();
    unlocked.end();
    return to_array<Table>(std::move(y), t.size(), output.n());
  }

  /// This and then `next`, which starts where this ends.
  [[nodiscard]] Dense joined(const Dense& next) const {
    const DenseOutput::Parts a = output.parts(), b = next.output.parts();
    if (output.n() != next.output.n() || complex != next.complex || a.m != b.m || a.mode != b.mode || a.raw != b.raw)
      throw nb::value_error("continuous solutions of different kinds");
    Dense both{DenseOutput(output.n(), a.m, a.mode, a.raw), weights, complex};
    both.output.append(output);
    both.output.append(next.output);
    return both;
  }

  /// Everything, as the arguments of `from_parts`.
  [[nodiscard]] nb::dict parts() const {
    const DenseOutput::Parts all = output.parts();
    const std::vector<std::int64_t> offset(all.offset.begin(), all.offset.end());
    nb::dict d;
    d["t"] = copied(all.knots.t.copy());
    d["y"] = to_array<Table>(all.knots.y.copy(), all.knots.t.size(), output.n());
    d["end"] = copied(all.end);
    d["offset"] = to_array<Offsets>(std::vector<std::int64_t>(offset), offset.size());
    d["data"] = copied(all.data.copy());
    d["m"] = all.m;
    d["interpolation"] = name_in(interpolations, all.mode);
    d["extension"] = find_extension(all.raw)->name;
    d["rtol"] = weights.rtol();
    d["threshold"] = copied(weights.threshold());
    d["scale"] = weights.scale().empty() ? nb::object(nb::none()) : nb::cast(copied(weights.scale()));
    d["complex"] = complex;
    return d;
  }

  /// From parts, which may be of a file that anyone wrote: each segment is checked to be one that can be evaluated.
  static Dense from_parts(const ConstVector& t, const ConstMatrix& y, const ConstVector& end,
                          const ConstOffsets& offset, const ConstVector& data, std::size_t m,
                          const std::string& interpolation, const std::string& extension, double rtol,
                          const Threshold& threshold, const std::optional<ConstVector>& scale, bool complex) {
    const std::size_t n = y.shape(1), segments = end.size();
    const Interpolation mode = find_name(interpolations, interpolation, "interpolation");
    const Extension* raw = find_extension(std::string_view(extension));
    const auto require = [](bool right, const char* what) {
      if (!right) throw nb::value_error(what);
    };
    require(raw != nullptr, "unknown extension");
    require(n > 0 || segments == 0, "there is nothing to interpolate");
    require(t.size() == segments + 1 && y.shape(0) == t.size() && offset.size() == segments, "lengths do not match");
    Dense dense{DenseOutput(n, m, mode, raw->evaluate), to_weights(n, rtol, threshold, scale), complex};
    const std::size_t overhead = Interpolant(n, m, mode, raw->evaluate, nullptr).overhead();
    dense.output.start(t.data()[0], y.data());
    for (std::size_t s = 0; s < segments; ++s) {
      const auto begin = static_cast<std::size_t>(offset.data()[s]);
      const std::size_t stop = s + 1 < segments ? static_cast<std::size_t>(offset.data()[s + 1]) : data.size();
      require((s > 0 || begin == 0) && begin <= stop && stop <= data.size(), "segments do not match");
      const double t0 = t.data()[s], t1 = end.data()[s];
      const double* next = y.data() + (s + 1) * n;
      if (t1 == t0) {  // a jump
        require(s > 0 && begin == stop && t.data()[s + 1] == t0, "jumps do not match");
        dense.output.start(t0, next);
        continue;
      }
      const std::size_t size = stop - begin;
      require(size >= overhead && raw->fits(size - overhead, n), "segments do not match");
      dense.output.add({t0, t1, data.data() + begin, size}, t.data()[s + 1], next);
    }
    return dense;
  }

 private:
  static Vector copied(const std::vector<double>& values) {
    return to_array<Vector>(std::vector<double>(values), values.size());
  }
};

/// How long native code runs before someone looks for signals.
constexpr auto patience = std::chrono::milliseconds(50);
/// How often progress is told.
constexpr auto telling = std::chrono::milliseconds(100);

/// What `integrate` returns: arrays with one row per point, counts, and why the run ended.
struct Run {
  std::size_t n;
  Trajectory points;
  std::vector<Trajectory> occurrences;
  Buffer<AcceptedStep> record;
  Drift drift;
  std::vector<Jump> jumps;
  std::optional<Dense> dense;
  State state;
  Report report;
  Counts counts;
  LinearWork linear;
  std::int64_t nfev, nfev_check, ng, ngjac, ngdiff;
  bool projected_start = false;
  std::vector<const char*> derivatives;
  std::vector<int> dropped;
  double dropped_at = 0;
  Harm harm = {};
  double t_end = 0;
  std::optional<std::vector<double>> y_end = {};  // nothing: it is the last of the points
  double next_h = 0;

  static constexpr const char* count_names[] = {"steps", "failed", "nfev",        "nfev_check", "njev",
                                                "nlu",   "nsolve", "projections", "skipped",    "ng",
                                                "ngjac", "ngdiff", "dropped"};
  static constexpr std::size_t count_size = std::size(count_names);
  [[nodiscard]] std::array<std::int64_t, count_size> counted() const {
    return {counts.steps,
            counts.failed,
            nfev,
            nfev_check,
            linear.jacobians,
            linear.factorizations,
            linear.solves,
            counts.projections,
            counts.skipped,
            ng,
            ngjac,
            ngdiff,
            static_cast<std::int64_t>(dropped.size())};
  }
  [[nodiscard]] const double* end() const { return y_end ? y_end->data() : points.y.data() + points.y.size() - n; }
  static std::pair<Vector, Table> arrays(Trajectory&& points, std::size_t n) {
    const std::size_t size = points.t.size();
    return {to_array<Vector>(std::move(points.t), size), to_array<Table>(std::move(points.y), size, n)};
  }
};

/// A problem with a method: everything that is known before the initial value. Made with the interpreter held; where
/// all functions are native, its runs do not need it.
class Solver {
 public:
  Solver(const std::string& method, std::size_t n, const nb::object& fun, const nb::tuple& args, double t0, double tf,
         bool complex, double rtol, const Threshold& threshold, const std::optional<ConstVector>& scale,
         double max_step, double first_step, const std::string& fsal, int max_order, bool bdf,
         const std::optional<LinearSpec>& linear, const std::string& interpolation, int refine,
         const std::optional<ConstVector>& times, bool dense, bool save_all, bool record, bool check,
         const std::vector<EventSpec>& events, const nb::object& callback, const std::vector<InvariantSpec>& invariants,
         const ConstVector& value, int iterations, double negligible, const ConstVector& parameters)
      : n(n),
        complex(complex),
        weights(to_weights(n, rtol, threshold, scale)),
        functions({n, complex}, args, to_vector(parameters)),
        method(find_method(method)),
        f(functions.state_valued(fun, "fun(t, y)")),
        notify(callback.is_none() ? Callback() : functions.truth(callback, "callback(t, y)")),
        blocks(functions.invariants(invariants)),
        value(to_vector(value)),
        settings{.t0 = t0,
                 .tf = tf,
                 .hmax = max_step,
                 .first_step = first_step,
                 .iterations = iterations,
                 .refine = refine,
                 .output_at_times = times.has_value(),
                 .times = times ? to_vector(*times) : std::vector<double>{},
                 .interpolation = find_name(interpolations, interpolation, "interpolation"),
                 .dense = dense,
                 .save_all = save_all,
                 .record = record,
                 .check = check,
                 .negligible = negligible},
        options{.fsal = find_name(fsals, fsal, "fsal"),
                .max_order = max_order,
                .bdf = bdf,
                .projected = !invariants.empty()} {
    if (linear) implicit.emplace(*linear, functions, weights);
    for (const auto& [function, terminal, direction, name, action, rehold] : events) {
      EventFunction event;
      event.function = functions.scalar(function, "event " + name);
      event.terminal = terminal;
      event.direction = direction;
      if (!action.is_none()) event.action = functions.state_valued(action, "the action of event " + name);
      event.rehold = rehold;
      event_functions.push_back(event);
    }
  }
  Solver(const Solver&) = delete;
  Solver& operator=(const Solver&) = delete;

  /// Its runs go on from where another one ended, with so many `seen` occurrences of each event; those `asleep`
  /// occurred right there.
  void resume(const std::vector<std::int64_t>& seen, const std::vector<bool>& asleep) {
    settings.resumed = true;
    for (std::size_t e = 0; e < event_functions.size(); ++e) {
      event_functions[e].seen = seen.at(e);
      event_functions[e].asleep = asleep.at(e);
    }
  }

  std::size_t n;
  bool complex;
  Weights weights;
  Functions functions;
  const Method* method;
  Callback f, notify;
  std::vector<EventFunction> event_functions;
  std::optional<LinearProblem> implicit;
  std::vector<InvariantBlock> blocks;
  std::vector<double> value;
  Settings settings;
  MethodOptions options;
};

/// One run of a solver: everything that changes while it integrates.
class Course {
 public:
  explicit Course(const Solver& solver)
      : f(solver.f),
        implicit_(solver.implicit),
        g_(make_invariants(solver)),
        integration(make_step(solver), solver.weights, manifold_, solver.event_functions, solver.notify,
                    solver.settings),
        complex_(solver.complex),
        output_at_times_(solver.settings.output_at_times),
        weights_(solver.weights) {}
  Course(const Course&) = delete;
  Course& operator=(const Course&) = delete;

  /// Holds the invariants whose values are not demanded at those of the initial value, which is moved before where the
  /// algebraic equations of a singular mass matrix ask for it.
  Consistency prepare(double t0, double* y0) {
    Consistency verdict = Consistency::consistent;
    const LinearAlgebra algebra = implicit_ ? implicit_->algebra() : LinearAlgebra{};
    Callback uncounted = f;  // nfev is what the method evaluates
    if (algebra.mass && algebra.mass->singular()) verdict = make_consistent(uncounted, algebra, weights_, t0, y0);
    if (g_ && g_->hold(t0, y0) == Status::stop) return Consistency::stop;
    if (between_ && between_->hold(t0, y0) == Status::stop) return Consistency::stop;
    return verdict;
  }
  /// What a single solve has in ng before its run, each invariant once, less what `prepare` has added: what is held,
  /// for the steps and for the output between them.
  [[nodiscard]] std::int64_t uncounted_starts(const std::vector<InvariantBlock>& blocks) const {
    const std::int64_t held = std::ranges::count_if(blocks, &InvariantBlock::held);
    return static_cast<std::int64_t>(blocks.size()) - (between_ ? 2 : 1) * held;
  }

  /// What the run did, when it has ended; arrays are moved out.
  Run result();

  [[nodiscard]] Invariants* invariants() { return between_ ? &*between_ : g_ ? &*g_ : nullptr; }

  Callback f;

 private:
  std::optional<LinearProblem> implicit_;
  // With a singular mass matrix the invariants are imposed together with the algebraic equations.
  std::optional<Invariants> between_;
  std::optional<AlgebraicConstraints> algebraic_;
  std::unique_ptr<Slope> slope_;
  Integration::Manifold manifold_;
  std::optional<Invariants> g_;

  std::optional<Invariants> make_invariants(const Solver& solver);
  std::unique_ptr<Step> make_step(const Solver& solver);

 public:
  Integration integration;

 private:
  bool complex_;
  bool output_at_times_;
  const Weights& weights_;
};

std::optional<Invariants> Course::make_invariants(const Solver& solver) {
  if (solver.blocks.empty()) return {};
  std::vector<InvariantBlock> blocks = solver.blocks;
  std::vector<double> values = solver.value;
  const LinearAlgebra algebra = implicit_ ? implicit_->algebra() : LinearAlgebra{};
  Mass* mass = algebra.mass;
  if (mass)
    slope_ = std::make_unique<MassSlope>(f, algebra, solver.weights);
  else
    slope_ = std::make_unique<ExplicitSlope>(f);
  manifold_.slope = slope_.get();
  if (mass && mass->singular()) {
    manifold_.between = &between_.emplace(solver.n, blocks, values, solver.weights);
    algebraic_.emplace(f, *algebra.jacobian, *mass);
    InvariantBlock block;
    block.g = algebraic_->residual();
    block.jacobian = algebraic_->jacobian();
    block.m = algebraic_->count();
    block.certain = true;
    blocks.push_back(block);
    values.resize(values.size() + algebraic_->count());
  }
  return std::optional<Invariants>(std::in_place, solver.n, std::move(blocks), std::move(values), solver.weights);
}

std::unique_ptr<Step> Course::make_step(const Solver& solver) {
  if (g_) {
    manifold_.steps = &*g_;
    if (!between_) manifold_.between = &*g_;
  }
  return solver.method->step(f, solver.weights, solver.options, implicit_ ? implicit_->algebra() : LinearAlgebra{});
}

Run Course::result() {
  Run run{.n = integration.step().n(),
          .points = std::move(integration.points),
          .occurrences = std::move(integration.occurrences),
          .record = std::move(integration.steps),
          .drift = std::move(integration.drift),
          .jumps = std::move(integration.jumps),
          .dense = {},
          .state = integration.state(),
          .report = integration.report(),
          .counts = integration.counts(),
          .linear = integration.step().linear_work(),
          .nfev = f.calls(),
          .nfev_check = slope_ ? slope_->evaluations() : 0,
          .ng = g_ ? g_->calls() : 0,
          .ngjac = g_ ? g_->jacobian_calls() : 0,
          .ngdiff = g_ ? g_->derivative_calls() : 0,
          .derivatives = {},
          .dropped = {}};
  if (between_) {  // the block of the algebraic equations is none of the user's functions
    run.ng += between_->calls() - g_->blocks().back().g.calls();
    run.ngjac += between_->jacobian_calls() - g_->blocks().back().jacobian.calls();
  }
  if (integration.dense) run.dense.emplace(Dense{std::move(*integration.dense), weights_, complex_});
  if (g_) {
    for (const InvariantBlock& block : g_->blocks())
      if (!block.certain) run.derivatives.push_back(name_of(block.derivative));
    run.projected_start = integration.guard()->projected_start();
    const Projector& projector = *integration.projector();
    const std::vector<char> dropped = projector.dropped();
    for (std::size_t i = 0; i < dropped.size(); ++i)
      if (dropped[i] != 0) run.dropped.push_back(static_cast<int>(i));
    run.dropped_at = projector.dropped_at();
    run.harm = integration.harm();
  }
  run.t_end = integration.t();
  if (output_at_times_ || run.points.t.empty()) run.y_end.emplace(integration.y(), integration.y() + run.n);
  run.next_h = integration.step().h();
  return run;
}

/// Tells a Python function (t, h) how far a run is, now and then. Empty, it costs nothing.
class Progress {
 public:
  explicit Progress(const nb::object& told) : told_(told) {}

  explicit operator bool() const { return !told_.is_none(); }
  [[nodiscard]] bool due() const { return Clock::now() >= next_; }
  /// With the interpreter held. False: it raised.
  bool tell(const Integration& integration) {
    if (!*this) return true;
    try {
      told_(integration.t(), integration.step().h());
    } catch (nb::python_error& error) {
      error.restore();
      return false;
    }
    next_ = Clock::now() + telling;
    return true;
  }

 private:
  using Clock = std::chrono::steady_clock;

  const nb::object& told_;
  Clock::time_point next_ = Clock::now() + telling;
};

/// Runs an integration whose functions are all native, without holding the interpreter; looks for signals now and then,
/// and tells how far it is. False: a signal's handler has raised, or who was told.
bool run_without_interpreter(Integration& integration, const double* y0, Progress& progress) {
  using Clock = std::chrono::steady_clock;
  constexpr int most = 16;
  int steps = 1;  // from one look at the clock to the next: more of those that are fast
  auto looked = Clock::now(), watched = looked;
  State state = integration.start(y0);
  for (int step = 0; state == State::running;) {
    state = integration.advance();
    if (++step < steps) continue;
    step = 0;
    const auto now = Clock::now(), before = std::exchange(watched, now);
    steps = now - before < patience / most ? std::min(2 * steps, most) : 1;
    if (now - looked < patience) continue;
    const nb::gil_scoped_acquire held;
    if (PyErr_CheckSignals() != 0) return false;
    if (progress.due() && !progress.tell(integration)) return false;
    looked = Clock::now();
  }
  return true;
}

/// The same with the interpreter held; the functions look for signals.
bool run_with_interpreter(Integration& integration, const double* y0, Progress& progress) {
  if (integration.start(y0) != State::running) return true;
  if (!progress) {
    integration.run();
    return true;
  }
  while (integration.advance() == State::running)
    if (progress.due() && !progress.tell(integration)) return false;
  return true;
}

Run integrate(const Solver& solver, const ConstVector& y0, const nb::object& told) {
  Course course(solver);
  Progress progress(told);
  bool finished;
  if (solver.functions.native()) {
    nb::gil_scoped_release released;
    finished = run_without_interpreter(course.integration, y0.data(), progress);
  } else {
    finished = run_with_interpreter(course.integration, y0.data(), progress);
  }
  if (!finished || course.integration.state() == State::interrupted || !progress.tell(course.integration))
    throw nb::python_error();
  return course.result();
}

/// A run that Python advances step by step. It keeps no output, and its solver alive.
class Stepper {
 public:
  Stepper(nb::object owner, const ConstVector& y0)
      : solver_(std::move(owner)),
        course_(nb::cast<const Solver&>(solver_)),
        complex_(nb::cast<const Solver&>(solver_).complex),
        weights_(nb::cast<const Solver&>(solver_).weights) {
    if (y0.size() != weights_.size()) throw nb::value_error("y0 is not of the size of the problem");
    guarded([&] { integration().start(y0.data()); });
  }

  /// Goes on by one accepted step; what the state is then, tells why not.
  void step() {
    if (integration().state() != State::running) throw std::runtime_error("the run has ended");
    guarded([&] {
      const std::int64_t steps = integration().counts().steps;
      integration().advance();
      accepted_ = integration().counts().steps > steps;
    });
  }

  /// The continuous solution over the last step.
  Dense interpolant() {
    if (!accepted_ || integration().state() == State::interrupted)
      throw std::runtime_error("there is no accepted step to interpolate");
    std::optional<DenseOutput> one;
    guarded([&] { one = integration().last_step(); });
    return {std::move(*one), weights_, complex_};
  }

  [[nodiscard]] Vector y() { return copied(integration().y()); }
  [[nodiscard]] Integration& integration() { return course_.integration; }
  [[nodiscard]] Run result() { return course_.result(); }
  [[nodiscard]] std::int64_t evaluations() const { return course_.f.calls(); }

  static int traverse(PyObject* self, visitproc visit, void* arg) {
    Py_VISIT(Py_TYPE(self));
    if (nb::inst_ready(self)) Py_VISIT(nb::inst_ptr<Stepper>(self)->solver_.ptr());
    return 0;
  }

 private:
  /// A user function may not step the run that calls it, nor may another thread meanwhile.
  template <class Work>
  void guarded(Work&& work) {
    if (busy_) throw std::runtime_error("the run is being advanced already");
    busy_ = true;
    try {
      work();
    } catch (...) {
      busy_ = false;
      throw;
    }
    busy_ = false;
    if (integration().state() == State::interrupted) throw nb::python_error();
  }
  [[nodiscard]] Vector copied(const double* values) const {
    return to_array<Vector>(std::vector<double>(values, values + weights_.size()), weights_.size());
  }

  nb::object solver_;
  Course course_;
  bool complex_;
  Weights weights_;
  bool busy_ = false;
  bool accepted_ = false;
};

int traverse_solver(PyObject* self, visitproc visit, void* arg) {
  Py_VISIT(Py_TYPE(self));
  return nb::inst_ready(self) ? nb::inst_ptr<Solver>(self)->functions.visit(visit, arg) : 0;
}
PyType_Slot solver_slots[] = {{Py_tp_traverse, reinterpret_cast<void*>(&traverse_solver)}, {0, nullptr}};
PyType_Slot stepper_slots[] = {{Py_tp_traverse, reinterpret_cast<void*>(&Stepper::traverse)}, {0, nullptr}};

/// What `integrate_all` returns: one row per trajectory.
struct EnsembleRun {
  /// Occurrences of one event: in which trajectory, when and where.
  struct Occurrences {
    std::vector<std::int64_t> trajectory;
    Trajectory points;
  };
  /// Why a trajectory ended early.
  struct Failure {
    std::size_t trajectory;
    State state;
    Report report;
  };
  /// States that only trajectories of an ensemble have: the initial value is not finite, or not consistent.
  static constexpr std::int8_t not_finite = -1, not_found = -2, index_too_high = -3;
  static constexpr std::size_t counts = Run::count_size;
  EnsembleRun(std::size_t size, std::size_t n, bool complex, std::size_t m, std::size_t n_t, std::size_t events)
      : size(size),
        n(n),
        parts(complex ? 2 : 1),
        m(m),
        n_t(n_t),
        t(size),
        y_end(size * n),
        y(size * n * n_t, std::numeric_limits<double>::quiet_NaN()),
        value(size * m, std::numeric_limits<double>::quiet_NaN()),
        before(size * m),
        after(size * m),
        correction(size),
        count(size * counts),
        state(size),
        occurrences(events) {}

  /// Trajectory i cannot start.
  void refuse(std::size_t i, std::int8_t why, double t0, const double* y0) {
    state[i] = why;
    t[i] = t0;
    std::copy(y0, y0 + n, &y_end[i * n]);
  }
  /// Keeps what trajectory i did; ng gets `uncounted` more. The times of y that it did not reach stay NaN.
  void keep(std::size_t i, Course& course, std::vector<double> held, std::int64_t uncounted);

  std::size_t size, n, parts, m, n_t;
  std::vector<double> t, y_end;
  std::vector<double> y;  // (size, n / parts, n_t, parts): numbers of one or two reals
  std::vector<double> value, before, after, correction;
  std::vector<std::int64_t> count;
  std::vector<std::int8_t> state;
  std::vector<Occurrences> occurrences;
  std::vector<Failure> failures;
  std::mutex shared;  // for the last two
};

void EnsembleRun::keep(std::size_t i, Course& course, std::vector<double> held, std::int64_t uncounted) {
  Run run = course.result();
  run.ng += uncounted;
  t[i] = run.t_end;
  std::copy(run.end(), run.end() + n, &y_end[i * n]);
  state[i] = static_cast<std::int8_t>(run.state);
  std::ranges::copy(run.counted(), &count[i * counts]);
  for (std::size_t j = 0; j < run.points.t.size() && n_t > 0; ++j)
    for (std::size_t c = 0; c < n; ++c)
      y[((i * n + c - c % parts) / parts * n_t + j) * parts + c % parts] = run.points.y[j * n + c];
  if (m > 0) {
    std::copy(held.begin(), held.end(), &value[i * m]);
    std::copy_n(run.drift.residual.begin(), m, &before[i * m]);
    correction[i] = run.drift.correction;
    std::vector<double> g(m);
    const auto measure = [&](double at, const double* point) {
      if (course.invariants()->evaluate(at, point, g.data()) == Status::stop) return;
      for (std::size_t k = 0; k < m; ++k) {
        double& largest = after[i * m + k];
        const double residual = std::abs(g[k] - held[k]);
        if (residual > largest || std::isnan(residual)) largest = residual;  // NaN, where g was NaN, stays
      }
    };
    auto jump = run.jumps.begin();
    const auto pass_jumps = [&](std::size_t row) {
      for (; jump != run.jumps.end() && jump->row <= row; ++jump)
        held.assign(jump->value.begin(), jump->value.begin() + static_cast<std::ptrdiff_t>(m));
    };
    for (std::size_t j = 0; j < run.points.t.size() && n_t > 0; ++j) {
      pass_jumps(j);
      measure(run.points.t[j], &run.points.y[j * n]);
    }
    pass_jumps(std::numeric_limits<std::size_t>::max());
    measure(t[i], &y_end[i * n]);
  }
  const bool failure =
      run.state != State::reached_end && run.state != State::terminal_event && run.state != State::stopped_by_callback;
  bool happened = failure;
  for (const Trajectory& found : run.occurrences) happened = happened || !found.t.empty();
  if (!happened) return;
  const std::lock_guard lock(shared);
  if (failure) failures.push_back({i, run.state, run.report});
  for (std::size_t e = 0; e < run.occurrences.size(); ++e) {
    const Trajectory& found = run.occurrences[e];
    occurrences[e].trajectory.insert(occurrences[e].trajectory.end(), found.t.size(), static_cast<std::int64_t>(i));
    occurrences[e].points.t.append(found.t.data(), found.t.size());
    occurrences[e].points.y.append(found.y.data(), found.y.size());
  }
}

/// Integrates from each row of y0, with the row of `parameters` of the same number, on as many threads as there are
/// solvers, all of the same problem and native. `progress(done)` is called now and then.
std::unique_ptr<EnsembleRun> integrate_all(const std::vector<Solver*>& solvers, const ConstMatrix& y0,
                                           const ConstMatrix& parameters, const nb::object& progress) {
  const Solver& first = *solvers.at(0);
  const std::size_t size = y0.shape(0), n = first.n, m = first.value.size();
  for (const Solver* solver : solvers)
    if (!solver->functions.native()) throw nb::value_error("functions of an ensemble on threads must be native");
  if (size >= std::numeric_limits<std::uint32_t>::max()) throw nb::value_error("too many trajectories");
  auto run = std::make_unique<EnsembleRun>(size, n, first.complex, m, first.settings.times.size(),
                                           first.event_functions.size());
  const auto work = [&](std::size_t worker, std::uint32_t i, const std::atomic<bool>& cancelled) {
    Solver& solver = *solvers[worker];
    solver.functions.set_parameters(parameters.data() + i * parameters.shape(1));
    const double t0 = solver.settings.t0;
    const double* given = y0.data() + i * n;
    std::vector<double> start(given, given + n);
    Course course(solver);
    std::vector<double> held;
    if (!all_finite(given, n)) return run->refuse(i, EnsembleRun::not_finite, t0, given);
    switch (course.prepare(t0, start.data())) {
      case Consistency::not_found: return run->refuse(i, EnsembleRun::not_found, t0, given);
      case Consistency::index_too_high: return run->refuse(i, EnsembleRun::index_too_high, t0, given);
      case Consistency::consistent:
      case Consistency::corrected:
      case Consistency::undefined:  // the run says so
      case Consistency::stop: break;
    }
    if (const Invariants* g = course.invariants()) held = g->value();
    State state = course.integration.start(start.data());
    while (state == State::running && !cancelled.load(std::memory_order_relaxed)) state = course.integration.advance();
    run->keep(i, course, std::move(held), course.uncounted_starts(solver.blocks));
  };
  bool raised = false;
  const auto watch = [&](std::uint32_t done) {
    const nb::gil_scoped_acquire held;
    if (raised || PyErr_CheckSignals() != 0) {
      raised = true;
      return false;
    }
    if (progress.is_none()) return true;
    try {
      progress(done);
    } catch (nb::python_error& error) {
      error.restore();
      raised = true;
    }
    return !raised;
  };
  bool finished;
  {
    const nb::gil_scoped_release released;
    finished = for_each_index(static_cast<std::uint32_t>(size), solvers.size(), patience, work, watch);
  }
  if (!finished) throw nb::python_error();
  return run;
}

/// y0 moved until the algebraic equations of a singular mass matrix hold, and how that ended.
std::pair<Vector, const char*> make_consistent_start(const nb::object& fun, const nb::tuple& args, double t0,
                                                     const ConstVector& y0, bool complex, double rtol,
                                                     const Threshold& threshold,
                                                     const std::optional<ConstVector>& scale, const LinearSpec& linear,
                                                     const ConstVector& parameters) {
  const std::size_t n = y0.size();
  const Weights weights = to_weights(n, rtol, threshold, scale);
  Functions functions({n, complex}, args, to_vector(parameters));
  Callback f = functions.state_valued(fun, "fun(t, y)");
  LinearProblem problem(linear, functions, weights);
  std::vector<double> y = to_vector(y0);
  const Consistency verdict = make_consistent(f, problem.algebra(), weights, t0, y.data());
  if (verdict == Consistency::stop) throw nb::python_error();
  return {to_array<Vector>(std::move(y), n), name_of(verdict)};
}

/// Projects each row of y, at the time in t, to roundoff: (y, converged, residual, iterations).
auto impose(const ConstVector& t, const ConstMatrix& y, bool complex, double rtol, const Threshold& threshold,
            const std::optional<ConstVector>& scale, const std::vector<InvariantSpec>& invariants,
            const ConstVector& value, const nb::tuple& args, const ConstVector& parameters) {
  const std::size_t count = y.shape(0), n = y.shape(1), m = value.size();
  const Weights weights = to_weights(n, rtol, threshold, scale);
  Functions functions({n, complex}, args, to_vector(parameters));
  Invariants g = bound(n, functions, invariants, value, weights);
  Projector projector(g, weights, 1);
  std::vector<double> points(y.data(), y.data() + y.size()), residual(count * m);
  std::vector<std::int64_t> iterations(count), converged(count);
  Unlocked unlocked(functions.native());
  for (std::size_t p = 0; p < count; ++p) {
    const Imposed imposed = projector.impose(t.data()[p], &points[p * n]);
    if (imposed.outcome == Outcome::stop || g.residual(t.data()[p], &points[p * n], &residual[p * m]) == Status::stop)
      throw nb::python_error();
    converged[p] = imposed.converged;
    iterations[p] = imposed.iterations;
  }
  unlocked.end();
  using Integers = nb::ndarray<std::int64_t, nb::numpy, nb::ndim<1>, nb::c_contig>;
  return std::make_tuple(to_array<Table>(std::move(points), count, n), to_array<Integers>(std::move(converged), count),
                         to_array<Table>(std::move(residual), count, m),
                         to_array<Integers>(std::move(iterations), count));
}

/// How each invariant stands at (t, y), as a dict of arrays of m; None where g, its Jacobian or f is not finite there.
nb::object examine(const nb::object& fun, const nb::tuple& args, double t, const ConstVector& y, bool complex,
                   double rtol, const Threshold& threshold, const std::optional<ConstVector>& scale,
                   const std::vector<InvariantSpec>& invariants, const ConstVector& value,
                   const ConstVector& parameters) {
  const std::size_t n = y.size(), m = value.size();
  const Weights weights = to_weights(n, rtol, threshold, scale);
  Functions functions({n, complex}, args, to_vector(parameters));
  const Callback f = functions.state_valued(fun, "fun(t, y)");
  Invariants g = bound(n, functions, invariants, value, weights);
  ExplicitSlope slope(f);
  Guard guard(g, weights, slope, 0);
  std::vector<Guard::Examination> found;
  switch (guard.examine(t, y.data(), found)) {
    case Outcome::stop: throw nb::python_error();
    case Outcome::not_finite: return nb::none();
    case Outcome::ok: break;
  }
  std::vector<double> point = to_vector(y);
  Finding jacobian = guard.start_value(t, point.data());
  if (jacobian.kind != Finding::Kind::stop) jacobian = guard.start_jacobian(t, point.data());
  if (jacobian.kind == Finding::Kind::stop) throw nb::python_error();
  const auto column = [&](auto member) {
    std::vector<double> values(m);
    for (std::size_t i = 0; i < m; ++i) values[i] = static_cast<double>(found[i].*member);
    return to_array<Vector>(std::move(values), m);
  };
  nb::dict result;
  result["residual"] = column(&Guard::Examination::residual);
  result["distance"] = column(&Guard::Examination::distance);
  result["gradient"] = column(&Guard::Examination::gradient);
  result["rate"] = column(&Guard::Examination::rate);
  result["angle"] = column(&Guard::Examination::angle);
  result["redundant"] = column(&Guard::Examination::redundant);
  result["detectable"] = column(&Guard::Examination::detectable);
  result["conserved"] = column(&Guard::Examination::conserved);
  result["wrong_jacobian"] = nb::none();
  if (jacobian.kind == Finding::Kind::wrong_jacobian)
    result["wrong_jacobian"] = nb::make_tuple(jacobian.invariant, jacobian.component, jacobian.size, jacobian.distance);
  return result;
}

/// g(t, y) − value of each row of y: (count, m).
Table residual(const ConstVector& t, const ConstMatrix& y, bool complex, const std::vector<InvariantSpec>& invariants,
               const ConstVector& value, const nb::tuple& args, const ConstVector& parameters) {
  const std::size_t count = y.shape(0), n = y.shape(1), m = value.size();
  const Weights weights(1, std::vector<double>(n), {});
  Functions functions({n, complex}, args, to_vector(parameters));
  Invariants g = bound(n, functions, invariants, value, weights);
  std::vector<double> r(count * m);
  Unlocked unlocked(functions.native());
  for (std::size_t p = 0; p < count; ++p)
    if (g.residual(t.data()[p], y.data() + p * n, &r[p * m]) == Status::stop) throw nb::python_error();
  unlocked.end();
  return to_array<Table>(std::move(r), count, m);
}

/// Distances of each row of y from the invariants' level sets, in units of rtol: (count, m).
Table distance(const ConstVector& t, const ConstMatrix& y, bool complex, double rtol, const Threshold& threshold,
               const std::optional<ConstVector>& scale, const std::vector<InvariantSpec>& invariants,
               const ConstVector& value, const nb::tuple& args, const ConstVector& parameters) {
  const std::size_t count = y.shape(0), n = y.shape(1), m = value.size();
  const Weights weights = to_weights(n, rtol, threshold, scale);
  Functions functions({n, complex}, args, to_vector(parameters));
  Invariants g = bound(n, functions, invariants, value, weights);
  Projector projector(g, weights, 1);
  std::vector<double> d(count * m);
  Unlocked unlocked(functions.native());
  for (std::size_t p = 0; p < count; ++p) {
    if (projector.linearize_at(t.data()[p], y.data() + p * n) == Outcome::stop) throw nb::python_error();
    for (std::size_t i = 0; i < m; ++i) d[p * m + i] = projector.linearization().distance(i) / rtol;
  }
  unlocked.end();
  return to_array<Table>(std::move(d), count, m);
}

}  // namespace

NB_MODULE(_core, module) {
  if (_import_array() < 0) throw nb::python_error();
  nb::set_leak_warnings(false);  // what a user still holds when the interpreter ends is no fault to be told of
  module.attr("__doc__") = "The native core. Private: `invariode` is the interface.";

  nb::class_<Dense>(module, "Dense")
      .def_static("from_parts", &Dense::from_parts, nb::kw_only(), nb::arg("t"), nb::arg("y"), nb::arg("end"),
                  nb::arg("offset"), nb::arg("data"), nb::arg("m"), nb::arg("interpolation"), nb::arg("extension"),
                  nb::arg("rtol"), nb::arg("threshold"), nb::arg("scale").none(), nb::arg("complex"),
                  "What `parts` gave, put together again.")
      .def("parts", &Dense::parts, "What it consists of: arrays, numbers and names.")
      .def("evaluate", &Dense::evaluate, nb::arg("t"), nb::kw_only(), nb::arg("invariants"), nb::arg("value"),
           nb::arg("args"), nb::arg("parameters"), "y at each t: (len(t), n).")
      .def("joined", &Dense::joined, nb::arg("next"), "This and then `next`, which starts where this ends.")
      .def("knots", [](const Dense& d) {
        const Buffer<double>& knots = d.output.knots();
        return to_array<Vector>(knots.copy(), knots.size());
      });

  nb::class_<Native>(module, "Native", "Machine code of the user, and what keeps it alive.")
      .def(
          "__init__",
          [](Native* self, std::uintptr_t address, bool event, nb::object owner) {
            new (self) Native{address, event, std::move(owner)};
          },
          nb::kw_only(), nb::arg("address"), nb::arg("event"), nb::arg("owner").none());
  module.def(
      "capsule_address",
      [](const nb::object& capsule) {
        void* pointer = PyCapsule_GetPointer(capsule.ptr(), PyCapsule_GetName(capsule.ptr()));
        if (pointer == nullptr) throw nb::python_error();
        return reinterpret_cast<std::uintptr_t>(pointer);
      },
      nb::arg("capsule"), "The pointer in a capsule.");

  nb::class_<LinearSpec>(module, "Linear", "What is known of the Jacobian of f and of the mass matrix.")
      .def(
          "__init__",
          [](LinearSpec* self, const std::string& structure, std::size_t n, std::size_t lower, std::size_t upper,
             std::string kind, nb::object jacobian, nb::object mass, nb::object null_basis, nb::object lapack) {
            new (self) LinearSpec{{find_name(structures, structure, "structure"), n, lower, upper},
                                  std::move(kind),
                                  std::move(jacobian),
                                  std::move(mass),
                                  std::move(null_basis),
                                  std::move(lapack)};
          },
          nb::kw_only(), nb::arg("structure"), nb::arg("n"), nb::arg("lower"), nb::arg("upper"), nb::arg("kind"),
          nb::arg("jacobian").none(), nb::arg("mass").none(), nb::arg("null_basis").none(), nb::arg("lapack").none())
      .def_prop_ro(
          "algebraic", [](const LinearSpec& l) { return nb::len(nb::object(l.null_basis[0])) - 1; },
          "Number of algebraic equations: the dimension of the left null space of M.");

  nb::class_<Run>(module, "Run", "Results of `integrate`. Arrays are handed over: each `take_…` works once.")
      .def(
          "take_points",
          [](Run& r) {
            std::optional<Vector> end;
            if (r.y_end) end = to_array<Vector>(std::move(*r.y_end), r.n);
            auto [t, y] = Run::arrays(std::move(r.points), r.n);
            return std::make_tuple(t, y, r.t_end, end);
          },
          "(t, y) of the points and of the end; the last is None where it is the last point.")
      .def("take_events",
           [](Run& r) {
             std::vector<std::pair<Vector, Table>> all;
             for (Trajectory& one : r.occurrences) all.push_back(Run::arrays(std::move(one), r.n));
             return all;
           })
      .def("take_steps",
           [](Run& r) {
             constexpr std::size_t columns = sizeof(AcceptedStep) / sizeof(double);
             const std::size_t rows = r.record.size();
             return to_array<Table>(std::move(r.record), rows, columns);
           })
      .def("take_drift",
           [](Run& r) {
             const std::size_t m = r.drift.residual.size();
             return std::make_tuple(to_array<Vector>(std::move(r.drift.residual), m),
                                    to_array<Vector>(std::move(r.drift.distance), m), r.drift.correction);
           })
      .def("take_jumps",
           [](Run& r) {
             std::vector<std::tuple<std::size_t, double, Vector>> jumps;
             for (Jump& jump : r.jumps) {
               const std::size_t m = jump.value.size();
               jumps.emplace_back(jump.row, jump.t, to_array<Vector>(std::move(jump.value), m));
             }
             return jumps;
           })
      .def_ro("next_h", &Run::next_h)
      .def("take_dense", [](Run& r) { return std::exchange(r.dense, {}); })
      .def_prop_ro("state", [](const Run& r) { return name_of(r.state); })
      .def_prop_ro("t", [](const Run& r) { return r.report.t; })
      .def_prop_ro("h", [](const Run& r) { return r.report.h; })
      .def_prop_ro("cause", [](const Run& r) { return name_of(r.report.cause); })
      .def_prop_ro("component", [](const Run& r) { return r.report.component; })
      .def_prop_ro("pure_relative", [](const Run& r) { return r.report.pure_relative; })
      .def_prop_ro("event", [](const Run& r) { return r.report.event; })
      .def_prop_ro("finding", [](const Run& r) { return name_of(r.report.finding.kind); })
      .def_prop_ro("finding_invariant", [](const Run& r) { return r.report.finding.invariant; })
      .def_prop_ro("finding_component", [](const Run& r) { return r.report.finding.component; })
      .def_prop_ro("finding_t", [](const Run& r) { return r.report.finding.t; })
      .def_prop_ro("finding_size", [](const Run& r) { return r.report.finding.size; })
      .def_prop_ro("finding_distance", [](const Run& r) { return r.report.finding.distance; })
      .def_prop_ro(
          "counts", [](const Run& r) { return std::tuple_cat(r.counted()); }, "Numbers, in the order of COUNTS.")
      .def_prop_ro("singular", [](const Run& r) { return r.report.linear.singular; })
      .def_prop_ro("undefined_jacobian", [](const Run& r) { return r.report.linear.undefined_jacobian; })
      .def_ro("projected_start", &Run::projected_start)
      .def_ro("derivatives", &Run::derivatives)
      .def_ro("dropped", &Run::dropped)
      .def_ro("dropped_at", &Run::dropped_at)
      .def_prop_ro("harmed", [](const Run& r) { return r.harm.component; })
      .def_prop_ro("harm", [](const Run& r) { return r.harm.ratio; });

  using Bytes = nb::ndarray<std::int8_t, nb::numpy, nb::ndim<1>, nb::c_contig>;
  using Indices = nb::ndarray<std::int64_t, nb::numpy, nb::ndim<1>, nb::c_contig>;
  using Counted = nb::ndarray<std::int64_t, nb::numpy, nb::ndim<2>, nb::c_contig>;
  using Block = nb::ndarray<double, nb::numpy, nb::ndim<3>, nb::c_contig>;
  nb::class_<EnsembleRun>(module, "EnsembleRun",
                          "Results of `integrate_all`. Arrays are handed over: each `take_…` works once.")
      .def("take_t", [](EnsembleRun& r) { return to_array<Vector>(std::move(r.t), r.size); })
      .def("take_end", [](EnsembleRun& r) { return to_array<Table>(std::move(r.y_end), r.size, r.n); })
      .def("take_y",
           [](EnsembleRun& r) { return to_array<Block>(std::move(r.y), r.size, r.n / r.parts, r.n_t * r.parts); })
      .def("take_drift",
           [](EnsembleRun& r) {
             return std::make_tuple(
                 to_array<Table>(std::move(r.value), r.size, r.m), to_array<Table>(std::move(r.before), r.size, r.m),
                 to_array<Table>(std::move(r.after), r.size, r.m), to_array<Vector>(std::move(r.correction), r.size));
           })
      .def("take_counts",
           [](EnsembleRun& r) { return to_array<Counted>(std::move(r.count), r.size, EnsembleRun::counts); })
      .def("take_states", [](EnsembleRun& r) { return to_array<Bytes>(std::move(r.state), r.size); })
      .def("take_events",
           [](EnsembleRun& r) {
             std::vector<std::tuple<Indices, Vector, Table>> all;
             for (EnsembleRun::Occurrences& one : r.occurrences) {
               const std::size_t count = one.trajectory.size();
               auto [t, y] = Run::arrays(std::move(one.points), r.n);
               all.emplace_back(to_array<Indices>(std::move(one.trajectory), count), t, y);
             }
             return all;
           })
      .def(
          "failures",
          [](const EnsembleRun& r) {
            std::vector<std::pair<std::size_t, Run>> all;
            for (const EnsembleRun::Failure& failure : r.failures) {
              all.emplace_back(failure.trajectory, Run{});
              all.back().second.state = failure.state;
              all.back().second.report = failure.report;
            }
            return all;
          },
          "(trajectory, Run that tells why it ended) of those that failed.");
  module.attr("COUNTS") =
      nb::tuple(nb::cast(std::vector<const char*>(std::begin(Run::count_names), std::end(Run::count_names))));
  std::vector<const char*> states;
  for (int i = 0; i <= static_cast<int>(State::invariant_convicted); ++i)
    states.push_back(name_of(static_cast<State>(i)));
  module.attr("STATES") = nb::cast(states);
  module.def("integrate_all", &integrate_all, nb::arg("solvers"), nb::arg("y0"), nb::arg("parameters"),
             nb::arg("progress").none(), "Integrates from each row of y0, on as many threads as there are solvers.");

  nb::class_<Solver>(module, "Solver", nb::type_slots(solver_slots),
                     "A problem with a method: all that is known before the initial value.")
      .def(nb::init<const std::string&, std::size_t, const nb::object&, const nb::tuple&, double, double, bool, double,
                    const Threshold&, const std::optional<ConstVector>&, double, double, const std::string&, int, bool,
                    const std::optional<LinearSpec>&, const std::string&, int, const std::optional<ConstVector>&, bool,
                    bool, bool, bool, const std::vector<EventSpec>&, const nb::object&,
                    const std::vector<InvariantSpec>&, const ConstVector&, int, double, const ConstVector&>(),
           nb::kw_only(), nb::arg("method"), nb::arg("n"), nb::arg("fun"), nb::arg("args"), nb::arg("t0"),
           nb::arg("tf"), nb::arg("complex"), nb::arg("rtol"), nb::arg("threshold"), nb::arg("scale").none(),
           nb::arg("max_step"), nb::arg("first_step"), nb::arg("fsal"), nb::arg("max_order"), nb::arg("bdf"),
           nb::arg("linear").none(), nb::arg("interpolation"), nb::arg("refine"), nb::arg("times").none(),
           nb::arg("dense"), nb::arg("save_all"), nb::arg("record"), nb::arg("check"), nb::arg("events"),
           nb::arg("callback").none(), nb::arg("invariants"), nb::arg("value"), nb::arg("iterations"),
           nb::arg("negligible"), nb::arg("parameters"))
      .def_prop_ro(
          "native", [](const Solver& solver) { return solver.functions.native(); },
          "Whether no function needs the interpreter.")
      .def("resume", &Solver::resume, nb::arg("seen"), nb::arg("asleep"),
           "Its runs go on from where another one ended, with so many occurrences of each event.")
      .def("integrate", &integrate, nb::arg("y0"), nb::arg("progress") = nb::none(),
           "Integrates from (t0, y0). progress(t, h) is called at most ten times a second, and at the end.");
  nb::class_<Stepper>(module, "Stepper", nb::type_slots(stepper_slots), "A run that is advanced step by step.")
      .def(
          "__init__",
          [](Stepper* self, nb::object solver, const ConstVector& y0) {
            if (!nb::isinstance<Solver>(solver)) throw nb::type_error("a Stepper needs a Solver");
            new (self) Stepper(std::move(solver), y0);
          },
          nb::arg("solver"), nb::arg("y0"), "Starts at (t0, y0).")
      .def("step", &Stepper::step, "Goes on by one accepted step, if it can: see `state`.")
      .def("interpolant", &Stepper::interpolant, "The continuous solution over the last step.")
      .def("result", &Stepper::result, "Why the run ended, and its counts.")
      .def_prop_ro("state", [](Stepper& s) { return name_of(s.integration().state()); })
      .def_prop_ro("t", [](Stepper& s) { return s.integration().t(); })
      .def_prop_ro("y", &Stepper::y, nb::rv_policy::move)
      .def_prop_ro(
          "h", [](Stepper& s) { return s.integration().step().h(); }, "|h| that the next step will try.")
      .def_prop_ro("order", [](Stepper& s) { return s.integration().step().order(); })
      .def_prop_ro("nfev", &Stepper::evaluations)
      .def_prop_ro("njev", [](Stepper& s) { return s.integration().step().linear_work().jacobians; })
      .def_prop_ro("nlu", [](Stepper& s) { return s.integration().step().linear_work().factorizations; });
  module.def("consistent_start", &make_consistent_start, nb::kw_only(), nb::arg("fun"), nb::arg("args"), nb::arg("t0"),
             nb::arg("y0"), nb::arg("complex"), nb::arg("rtol"), nb::arg("threshold"), nb::arg("scale").none(),
             nb::arg("linear"), nb::arg("parameters"),
             "y0 with the algebraic equations of a singular mass matrix satisfied, and the verdict.");
  module.def("impose", &impose, nb::arg("t"), nb::arg("y"), nb::kw_only(), nb::arg("complex"), nb::arg("rtol"),
             nb::arg("threshold"), nb::arg("scale").none(), nb::arg("invariants"), nb::arg("value"), nb::arg("args"),
             nb::arg("parameters"), "Projects each row of y to roundoff: (y, converged, residual, iterations).");
  module.def("distance", &distance, nb::arg("t"), nb::arg("y"), nb::kw_only(), nb::arg("complex"), nb::arg("rtol"),
             nb::arg("threshold"), nb::arg("scale").none(), nb::arg("invariants"), nb::arg("value"), nb::arg("args"),
             nb::arg("parameters"), "Distances of each row of y from the level sets, in units of rtol: (len(t), m).");
  module.def("examine", &examine, nb::kw_only(), nb::arg("fun"), nb::arg("args"), nb::arg("t"), nb::arg("y"),
             nb::arg("complex"), nb::arg("rtol"), nb::arg("threshold"), nb::arg("scale").none(), nb::arg("invariants"),
             nb::arg("value"), nb::arg("parameters"), "How each invariant stands at one point.");
  module.def("residual", &residual, nb::arg("t"), nb::arg("y"), nb::kw_only(), nb::arg("complex"),
             nb::arg("invariants"), nb::arg("value"), nb::arg("args"), nb::arg("parameters"),
             "g(t, y) - value of each row of y: (len(t), m).");
}
