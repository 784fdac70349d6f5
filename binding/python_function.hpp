#pragma once
// Calls of Python functions from the core.

#include <Python.h>
#include <nanobind/nanobind.h>
#include <numpy/ndarraytypes.h>

#include <cstddef>
#include <limits>
#include <span>
#include <string>
#include <utility>

#include "callables.hpp"
#include "interpreter.hpp"

namespace invariode::binding {

/// A Python callable as a core callback. y, or its two parts, is handed over in an array that the callee may keep: it
/// is used again only if nobody else holds it or a view of it. Results are copied at once. The first exception stays
/// set, and the callback says `stop`; but see `postpone_overflow`.
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
  /// Another one that takes and returns the same, with other arguments. Null: only the arguments are others.
  void exchange(nb::object callable, nb::tuple args) {
    const nb::object before = callable ? take(std::move(callable)) : nb::object();  // its end may run Python code
    std::swap(args_, args);
  }
  /// From now on an OverflowError, which Python's `math` raises where NumPy returns inf, does not end the run: values
  /// are NaN, and the exception is kept.
  void postpone_overflow() { postpones_ = true; }
  /// The time of the call that raised the exception kept last; NaN: none did.
  [[nodiscard]] double overflowed_at() const { return overflowed_at_; }
  /// Sets that exception.
  void raise_overflow();
  void forget_overflow();
  int visit(visitproc visit, void* arg) const override { return visit_all(visit, arg, callable_, args_, overflow_); }

 private:
  static Status entry(void* self, double t, const double* y, double* out) noexcept {
    return in_python([&] { return static_cast<PythonFunction*>(self)->call(t, y, out); }) ? Status::ok : Status::stop;
  }

  /// The callable from now on. Returns what it was.
  nb::object take(nb::object callable) {
    state_first_ = nb::isinstance<StateFirst>(callable);
    if (state_first_) callable = nb::cast<const StateFirst&>(callable).fun;
    fills_ = nb::isinstance<Filling>(callable);
    if (fills_) callable = nb::cast<const Filling&>(callable).fun;
    looks_for_signals_ = PyFunction_Check(callable.ptr()) != 0;
    return std::exchange(callable_, std::move(callable));
  }

  // None of these throws, but each may end its thread (`in_python`).
  bool call(double t, const double* y, double* out);
  bool keep_overflow(double t, double* out);
  PyObject* call_with(PyObject* time, PyArrayObject* const* parts);
  PyObject* call_with_tuple(PyObject* time, PyArrayObject* const* parts) const;
  [[nodiscard]] PyObject* time_for(double t, const double*& y) const;
  PyArrayObject* array_for(std::size_t part, const double* y);
  PyArrayObject* array_to_fill();
  [[nodiscard]] bool reusable(PyArrayObject* a, std::span<const npy_intp> shape) const;
  bool read(PyObject* result, double* out);
  bool read_filled(PyObject* result, PyArrayObject* filled, double* out) const;
  [[nodiscard]] std::size_t count_parts() const { return fills_ || takes_.second > 0 ? 2 : 1; }
  bool read_truth(PyObject* result, double* out) const;
  [[nodiscard]] bool read_sequence(PyObject* result, double* out) const;
  bool read_array(PyArrayObject* array, double* out);
  bool holds_numbers(PyObject* items) const;
  bool read_objects(PyArrayObject* array, double* out) const;
  bool has_no_unit(PyObject* value) const;
  bool has_values(PyObject* array) const;
  [[nodiscard]] bool fits(PyArrayObject* array) const;
  void complain(PyObject* returned) const;

  nb::object callable_;
  nb::tuple args_;
  std::string name_;
  bool looks_for_signals_ = false;  // a function written in Python does so itself when it is entered
  bool state_first_ = false;        // it takes (y, t), not (t, y)
  bool fills_ = false;              // it takes (t, y, out) and writes its values to out
  bool postpones_ = false;
  nb::object overflow_;
  double overflowed_at_ = std::numeric_limits<double>::quiet_NaN();
  Takes takes_;
  Returns returns_;
  PyArrayObject* spare_[2] = {nullptr, nullptr};  // the arrays of the last call, if no call is under way
};

/// Loads NumPy; to be called before the first function is made.
void prepare_python_functions();

}  // namespace invariode::binding
