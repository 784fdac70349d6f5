#pragma once
// User functions as callbacks of the core: Python callables, machine code, functions that fill matrices.

#include <nanobind/nanobind.h>

#include <Eigen/SparseCore>
#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <tuple>
#include <vector>

#include "arrays.hpp"
#include "callback.hpp"
#include "functions/piecewise_polynomial.hpp"
#include "linear/matrix.hpp"
#include "linear/preconditioner.hpp"
#include "series.hpp"

namespace nb = nanobind;

namespace invariode {
class Motion;
}

namespace invariode::binding {

/// Describes the state: `size` doubles, which are that many reals or half as many complex numbers.
struct Space {
  std::size_t size;
  bool complex;

  [[nodiscard]] std::size_t components() const { return complex ? size / 2 : size; }
};

/// A Python object whose fields are read by their names, such as those of `_problem/core_problem.py`.
class Record {
 public:
  explicit Record(nb::handle object) : object_(object) {}

  nb::object operator[](const char* name) const { return object_.attr(name); }
  template <class Value>
  [[nodiscard]] Value get(const char* name) const {
    return nb::cast<Value>((*this)[name]);
  }

 private:
  nb::handle object_;
};

// Garbage collection. None of the objects that Python sees changes what it holds: a cycle through one is broken
// elsewhere.

inline int visit_one(visitproc visit, void* arg, const nb::object& one) {
  Py_VISIT(one.ptr());
  return 0;
}
template <class Holder>
int visit_one(visitproc visit, void* arg, const Holder& one)
  requires requires { one.visit(visit, arg); }
{
  return one.visit(visit, arg);
}
template <class... Held>
int visit_all(visitproc visit, void* arg, const Held&... held) {
  int stop = 0;
  (void)((stop = visit_one(visit, arg, held)) || ...);
  return stop;
}
template <class Holder>
int traverse(PyObject* self, visitproc visit, void* arg) {
  Py_VISIT(Py_TYPE(self));
  return nb::inst_ready(self) ? nb::inst_ptr<Holder>(self)->visit(visit, arg) : 0;
}
/// Slots of the Python type of objects that show the objects they hold.
template <class Holder>
PyType_Slot slots[] = {{Py_tp_traverse, reinterpret_cast<void*>(&traverse<Holder>)}, {0, nullptr}};

/// A user's machine code: its address, what keeps it alive, and inputs, whose values at t come first in its parameters.
struct Native {
  std::uintptr_t address;
  bool event;
  nb::object owner;
  std::vector<PiecewisePolynomial> inputs;

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, owner); }
};

/// A Python function of (y, t, …), as SciPy's `odeint` has it. The core calls it in that order.
struct StateFirst {
  nb::object fun;

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, fun); }
};

/// A Python function of (t, y, out, …) that writes its values to out.
struct Filling {
  nb::object fun;

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, fun); }
};

/// A callback that ends a run where a step is one too many between two times of its output, without Python.
class StepLimit {
 public:
  StepLimit(std::vector<double> times, std::int64_t most) : times_(std::move(times)), most_(most) {}

  /// It refers to this.
  [[nodiscard]] Callback callback() { return {&entry, this}; }
  /// Counts an accepted step to t. Returns whether it was one too many.
  bool exceeded(double t);

 private:
  static Status entry(void* self, double t, const double*, double* stop) {
    *stop = static_cast<StepLimit*>(self)->exceeded(t) ? 1 : 0;
    return Status::ok;
  }

  std::vector<double> times_;  // strictly in order
  std::int64_t most_;
  std::size_t place_ = 0;  // of the first time that the last step has not passed
  std::int64_t steps_ = 0;
};

/// The right-hand side of y'' = f(t, y), a Python function or a `Native`, of states y = (q, v).
struct SecondOrderSpec {
  nb::object fun;  ///< of (t, q)

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, fun); }
};

/// Machine code for Taylor coefficients, what keeps it alive, and the order up to which it goes.
struct SeriesSpec {
  std::uintptr_t address;
  int order;
  nb::object owner;

  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, owner); }
};

/// An owner that keeps a user function for as long as the core may call it.
class Callable {
 public:
  Callable() = default;
  Callable(const Callable&) = delete;
  Callable& operator=(const Callable&) = delete;
  virtual ~Callable() = default;

  /// Shows what it owns to the garbage collector.
  virtual int visit(visitproc visit, void* arg) const = 0;
};

/// The values that a Python function is to return: rows × columns numbers; vectors have one column.
struct Returns {
  /// `conditions`: values, of which those that are true or false count as 1 or −1.
  enum class Kind { values, truth, conditions } kind = Kind::values;
  std::ptrdiff_t rows = 1;
  std::ptrdiff_t columns = 1;
  bool matrix = false;
  bool complex = false;

  [[nodiscard]] std::ptrdiff_t size() const { return rows * columns; }
};

/// The arguments that a Python function takes after t: a vector of n numbers, or a matrix with rows of n, or that and a
/// second one, a vector or a matrix with rows of n, one behind the other.
struct Takes {
  std::ptrdiff_t n;
  std::ptrdiff_t rows = 0;         ///< 0: a vector
  std::ptrdiff_t second = 0;       ///< numbers of the second one; 0: there is none
  std::ptrdiff_t second_rows = 0;  ///< 0: a vector
  bool complex = false;
  bool complex_time = false;  ///< t is the first of the complex numbers
};

class OwnedMotion;
class PythonFunction;

/// Owns the functions of a problem and makes callbacks of them. Names are for messages.
class Functions {
 public:
  /// `args`: what Python functions get after (t, y); `parameters`: what native ones get as p.
  Functions(Space space, nb::tuple args, std::vector<double> parameters);

  /// f(t, y) -> state
  Callback state_valued(nb::handle f, const std::string& name);
  /// f, whose overflows are postponed. `delays`: of so many states z, it is f(t, y, z), with z (delays, n).
  Callback slope(nb::handle f, const std::string& name, std::size_t delays = 0);
  /// Puts functions in the places of the Python functions with arguments, in the order of their making, and other
  /// arguments. None: the functions stay.
  void lend(const nb::object& functions, const nb::tuple& args);
  /// Lets go of the functions that were lent, and of their arguments.
  void give_back();
  /// An event, f(t, y) -> number, or `count` events: truth values are conditions, 1 or −1.
  Callback event(nb::handle f, const std::string& name) { return events(f, name, 1); }
  Callback events(nb::handle f, const std::string& name, std::size_t count);
  /// (t, (y, d)) -> y, with `count` numbers d.
  Callback action_of_vector(nb::handle f, const std::string& name, std::size_t count);
  /// f(t, y), without args, -> true or false
  Callback truth(nb::handle f, const std::string& name);
  /// f(t, y) -> (m,); the same of a complex y, though the problem is real
  Callback vector(nb::handle f, const std::string& name, std::size_t m);
  Callback complex_vector(nb::handle f, const std::string& name, std::size_t m);
  /// f(t, y) -> (k, k) real numbers
  Callback square(nb::handle f, const std::string& name, std::size_t k);
  /// f(t, y) -> (m, n)
  Callback rows(nb::handle f, const std::string& name, std::size_t m);
  /// f(t, y), or f(t), without args, -> what `read_matrix` takes
  MatrixFunction matrix(nb::handle f);
  // Of a state with sensitivities to k parameters, Y of 1 + k states; without args.
  /// f(t, Y) -> (k, state)
  /// `delays`: each row of Y has so many delayed states behind its own.
  Callback of_sensitivities(nb::handle f, const std::string& name, std::size_t k, std::size_t delays = 0);
  /// f(t, Y) -> (k, m)
  Callback tangent(nb::handle f, const std::string& name, std::size_t k, std::size_t m);
  /// f(t, Y, state) -> (k, state)
  Callback jump(nb::handle f, const std::string& name, std::size_t k, std::size_t delays);
  /// f(t, y, v) -> state
  Callback product(nb::handle f, const std::string& name);
  /// Taylor coefficients, by machine code
  Series series(const SeriesSpec& spec);
  /// f(t, y, c), without args, -> a function that solves
  Preconditioner preconditioner(nb::handle f);

  /// Sets the exception with which f, or the slope of sensitivities, overflowed at t or beyond, seen in the direction
  /// `forward`. False: nothing overflowed.
  [[nodiscard]] bool raise_overflow(double t, double forward) const;
  void forget_overflows() const;

  [[nodiscard]] std::size_t state_size() const { return space_.size; }
  /// Any other function of t and one vector or two.
  Callback of_motion(nb::handle f, const std::string& name, const Takes& takes, const Returns& returns);

  /// The motion of a MechanicsTerms: one for all functions of a problem that are parts of it.
  Motion& motion(const nb::object& mechanics);
  /// The motions made by `motion`.
  [[nodiscard]] std::span<OwnedMotion* const> motions() const { return motions_; }
  /// Returns whether no function needs the interpreter.
  [[nodiscard]] bool native() const { return native_; }
  /// The parameters that native functions read: they may be written between their calls.
  [[nodiscard]] std::span<double> parameters() { return parameters_; }
  /// Shows all that is owned to the garbage collector: a function may well own what owns this.
  int visit(visitproc visit, void* arg) const;

 private:
  /// Makes a function that lives as long as this.
  template <class Owned, class... Arguments>
  Owned& own(Arguments&&... arguments) {
    auto owner = std::make_unique<Owned>(std::forward<Arguments>(arguments)...);
    Owned& owned = *owner;
    owned_.push_back(std::move(owner));
    return owned;
  }
  void postpone_overflows_from(std::size_t first);
  Callback add(nb::handle f, const nb::tuple& args, const std::string& name, const Returns& returns,
               bool complex_state);
  Callback add(nb::handle f, const nb::tuple& args, const std::string& name, const Returns& returns,
               const Takes& takes);

  Space space_;
  nb::tuple args_;
  std::vector<double> parameters_;
  std::vector<std::unique_ptr<Callable>> owned_;
  std::vector<OwnedMotion*> motions_;        // among them
  std::vector<PythonFunction*> postponing_;  // likewise
  std::vector<PythonFunction*> lendable_;    // likewise: those that get args_
  bool native_ = true;
};

/// A sparse matrix as compressed columns: where each of them starts, and its end; rows, ascending in each; values.
using Columns = std::tuple<ConstIndices, ConstIndices, ConstVector>;
/// Reads the compressed columns of a matrix of so many rows, and columns if their number is known. Throws
/// std::invalid_argument unless they are.
Columns read_columns(nb::handle given, std::size_t rows, std::optional<std::size_t> columns = std::nullopt);
Eigen::SparseMatrix<double> read_sparse(nb::handle given, std::size_t rows,
                                        std::optional<std::size_t> columns = std::nullopt);

/// Reads values in the matrix's layout: a float64 array, for a sparse one (starts, rows, values). Throws
/// std::invalid_argument where they do not fit it.
void read_matrix(nb::handle values, Matrix& out);

void define_callables(nb::module_& module);

}  // namespace invariode::binding
