#include "callables.hpp"

#include <Python.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cassert>
#include <cstddef>
#include <new>
#include <stdexcept>
#include <tuple>
#include <utility>

#include "interpreter.hpp"
#include "linear/solve.hpp"
#include "manifolds.hpp"
#include "mechanics.hpp"
#include "outputs.hpp"
#include "python_function.hpp"

namespace invariode::binding {

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
  /// Makes the form for a state of so many doubles. `acceleration` belongs to the same owner.
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

/// Returns the status of act(), which calls Python: an exception stays set.
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

/// A Python function of (t, y), or of t alone, as a core function that fills a matrix. It returns what `read_matrix`
/// takes: Python's own layer has brought what the user's function returned into this form.
class PythonMatrix final : public Callable {
 public:
  PythonMatrix(nb::handle function, bool complex) : function_(nb::borrow(function)), complex_(complex) {}

  [[nodiscard]] MatrixFunction callback() { return {&PythonMatrix::entry, this}; }
  int visit(visitproc visit, void* arg) const override { return visit_all(visit, arg, function_); }

 private:
  static Status entry(void* self, double t, const double* y, Matrix& out) noexcept {
    auto* me = static_cast<PythonMatrix*>(self);
    return reported([&] {
      read_matrix(y == nullptr ? me->function_(t) : me->function_(t, state_array(y, out.n(), me->complex_)), out);
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
  int visit(visitproc visit, void* arg) const override { return visit_all(visit, arg, function_); }

 private:
  /// The object that the user's function made; a thread that does not hold the interpreter may give it back.
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
      const nb::object state = state_array(y, me.space_.size, me.space_.complex);
      made = std::make_shared<Made>(me.function_(t, state, c));
    });
  }
  static Status solve(void* self, void* made, double* b) noexcept {
    auto& me = *static_cast<PythonPreconditioner*>(self);
    return reported([&] {
      const nb::object right = state_array(b, me.space_.size, me.space_.complex);
      const auto x = nb::cast<ConstVector>(static_cast<Made*>(made)->solve(right));
      require(x.size() == me.space_.size, "what a preconditioner returned is not of the size of the state");
      std::copy_n(x.data(), x.size(), b);
    });
  }

  nb::object function_;
  Space space_;
};

}  // namespace

Columns read_columns(nb::handle given, std::size_t rows, std::optional<std::size_t> columns) {
  Columns read = nb::cast<Columns>(given);
  const auto& [starts, indices, values] = read;
  const std::size_t n = columns.value_or(std::max<std::size_t>(starts.size(), 1) - 1);
  const auto count = static_cast<int>(indices.size());
  bool right =
      starts.size() == n + 1 && values.size() == indices.size() && starts.data()[0] == 0 && starts.data()[n] == count;
  for (std::size_t j = 0; right && j < n; ++j) {
    const int begin = starts.data()[j], end = starts.data()[j + 1];
    right = begin <= end && end <= count;
    for (int p = begin; right && p < end; ++p)
      right = indices.data()[p] >= 0 && indices.data()[p] < static_cast<int>(rows) &&
              (p == begin || indices.data()[p - 1] < indices.data()[p]);
  }
  require(right, "a sparse matrix does not consist of compressed columns");
  return read;
}

Eigen::SparseMatrix<double> read_sparse(nb::handle given, std::size_t rows, std::optional<std::size_t> columns) {
  const auto [starts, indices, values] = read_columns(given, rows, columns);
  return Eigen::Map<const Eigen::SparseMatrix<double>>(
      static_cast<Eigen::Index>(rows), static_cast<Eigen::Index>(starts.size()) - 1,
      static_cast<Eigen::Index>(values.size()), starts.data(), indices.data(), values.data());
}

void read_matrix(nb::handle values, Matrix& out) {
  if (out.structure.kind == Structure::Kind::sparse) {
    const auto [starts, rows, entries] = read_columns(values, out.n(), out.n());
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
  if (nb::isinstance<Native>(f)) return own<NativeFunction>(nb::cast<const Native&>(f), parameters_).callback();
  if (nb::isinstance<SecondOrderSpec>(f)) {
    Takes positions = takes;
    Returns accelerations = returns;
    positions.n /= 2, accelerations.rows /= 2;
    const Callback acceleration = add(nb::cast<const SecondOrderSpec&>(f).fun, args, name, accelerations, positions);
    return own<FirstOrderForm>(acceleration, space_.size).callback();
  }
  if (nb::isinstance<QuadraticSpec>(f)) return own<QuadraticFunction>(nb::cast<const QuadraticSpec&>(f)).callback();
  native_ = false;
  auto& function = own<PythonFunction>(f, args, name, takes, returns);
  if (args.is(args_)) lendable_.push_back(&function);
  return function.callback();
}

Motion& Functions::motion(const nb::object& mechanics) {
  for (OwnedMotion* known : motions_)
    if (known->is_of(mechanics)) return known->motion();
  motions_.push_back(&own<OwnedMotion>(mechanics, *this));
  return motions_.back()->motion();
}

Callback Functions::state_valued(nb::handle f, const std::string& name) {
  return add(f, args_, name, {.rows = static_cast<std::ptrdiff_t>(space_.components()), .complex = space_.complex},
             space_.complex);
}

Callback Functions::slope(nb::handle f, const std::string& name, std::size_t delays) {
  const std::size_t first = owned_.size();
  const auto n = static_cast<std::ptrdiff_t>(space_.components()), rows = static_cast<std::ptrdiff_t>(delays);
  const Callback callback = add(f, args_, name, {.rows = n, .complex = space_.complex},
                                Takes{.n = n, .second = rows * n, .second_rows = rows, .complex = space_.complex});
  postpone_overflows_from(first);
  return callback;
}

void Functions::postpone_overflows_from(std::size_t first) {
  for (std::size_t i = first; i < owned_.size(); ++i)
    if (auto* function = dynamic_cast<PythonFunction*>(owned_[i].get())) {
      function->postpone_overflow();
      postponing_.push_back(function);
    }
}

bool Functions::raise_overflow(double t, double forward) const {
  for (PythonFunction* function : postponing_)
    if (forward * (function->overflowed_at() - t) >= 0) {
      function->raise_overflow();
      return true;
    }
  return false;
}

void Functions::forget_overflows() const {
  for (PythonFunction* function : postponing_) function->forget_overflow();
}

void Functions::lend(const nb::object& functions, const nb::tuple& args) {
  const bool given = !functions.is_none();
  require(!given || nb::len(functions) == lendable_.size(), "functions are lent one for each Python function");
  for (std::size_t i = 0; i < lendable_.size(); ++i) {
    nb::object function = given ? nb::object(functions[i]) : nb::object();
    lendable_[i]->exchange(std::move(function), args);
  }
}

void Functions::give_back() {
  for (PythonFunction* function : lendable_) function->exchange(nb::ellipsis(), nb::tuple());
}

Callback Functions::events(nb::handle f, const std::string& name, std::size_t count) {
  return add(f, args_, name, {.kind = Returns::Kind::conditions, .rows = static_cast<std::ptrdiff_t>(count)},
             space_.complex);
}

Callback Functions::action_of_vector(nb::handle f, const std::string& name, std::size_t count) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components());
  return add(f, args_, name, {.rows = n, .complex = space_.complex},
             Takes{.n = n + static_cast<std::ptrdiff_t>(count), .complex = space_.complex});
}

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
  if (nb::isinstance<StepLimit>(f)) return own<OwnedStepLimit>(nb::cast<const StepLimit&>(f)).callback();
  return add(f, nb::tuple(), name, {.kind = Returns::Kind::truth}, space_.complex);
}

Callback Functions::vector(nb::handle f, const std::string& name, std::size_t m) {
  return add(f, args_, name, {.rows = static_cast<std::ptrdiff_t>(m)}, space_.complex);
}

Callback Functions::complex_vector(nb::handle f, const std::string& name, std::size_t m) {
  return add(f, args_, name, {.rows = static_cast<std::ptrdiff_t>(m), .complex = true}, true);
}

Callback Functions::square(nb::handle f, const std::string& name, std::size_t k) {
  const auto size = static_cast<std::ptrdiff_t>(k);
  return add(f, args_, name, {.rows = size, .columns = size, .matrix = true}, space_.complex);
}

Callback Functions::rows(nb::handle f, const std::string& name, std::size_t m) {
  return add(f, args_, name,
             {.rows = static_cast<std::ptrdiff_t>(m),
              .columns = static_cast<std::ptrdiff_t>(space_.components()),
              .matrix = true,
              .complex = space_.complex},
             space_.complex);
}

MatrixFunction Functions::matrix(nb::handle f) {
  if (nb::isinstance<Native>(f)) return own<NativeFunction>(nb::cast<const Native&>(f), parameters_).matrix();
  native_ = false;
  return own<PythonMatrix>(f, space_.complex).callback();
}

Callback Functions::product(nb::handle f, const std::string& name) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components());
  return add(f, args_, name, {.rows = n, .complex = space_.complex},
             Takes{.n = n, .second = n, .complex = space_.complex});
}

Callback Functions::of_sensitivities(nb::handle f, const std::string& name, std::size_t k, std::size_t delays) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components()), rows = static_cast<std::ptrdiff_t>(k);
  const std::ptrdiff_t width = n * static_cast<std::ptrdiff_t>(1 + delays);
  const std::size_t first = owned_.size();
  const Callback callback =
      add(f, nb::tuple(), name, {.rows = rows, .columns = n, .matrix = true, .complex = space_.complex},
          Takes{.n = width, .rows = 1 + rows, .complex = space_.complex});
  postpone_overflows_from(first);
  return callback;
}

Callback Functions::tangent(nb::handle f, const std::string& name, std::size_t k, std::size_t m) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components()), rows = static_cast<std::ptrdiff_t>(k);
  return add(f, nb::tuple(), name, {.rows = rows, .columns = static_cast<std::ptrdiff_t>(m), .matrix = true},
             Takes{.n = n, .rows = 1 + rows, .complex = space_.complex});
}

Callback Functions::jump(nb::handle f, const std::string& name, std::size_t k, std::size_t delays) {
  const auto n = static_cast<std::ptrdiff_t>(space_.components()), rows = static_cast<std::ptrdiff_t>(k);
  return add(
      f, nb::tuple(), name,
      {.rows = delays > 0 ? 2 * rows : rows, .columns = n, .matrix = true, .complex = space_.complex},
      Takes{
          .n = n, .rows = 1 + rows, .second = n * static_cast<std::ptrdiff_t>(1 + delays), .complex = space_.complex});
}

Series Functions::series(const SeriesSpec& spec) { return own<NativeSeries>(spec, parameters_).series(); }

Preconditioner Functions::preconditioner(nb::handle f) {
  native_ = false;
  return own<PythonPreconditioner>(f, space_).callback();
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
            require(self.size() == 1, "there are several functions");
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
      .def(nb::init<nb::object>(), nb::arg("fun"))
      .def(
          "__call__",
          [](const StateFirst& self, const nb::object& t, const nb::object& y, const nb::args& rest) {
            return self.fun(y, t, *rest);
          },
          nb::sig("def __call__(self, t: object, y: object, /, *args: object) -> object"))
      .def_prop_ro("__wrapped__", [](const StateFirst& self) { return self.fun; }, "The function as it was given.");
  nb::class_<Filling>(module, "Filling", nb::type_slots(slots<Filling>),
                      "A Python function of (t, y, out, ...) that writes its values to out.")
      .def(nb::init<nb::object>(), nb::arg("fun"))
      .def_prop_ro("__wrapped__", [](const Filling& self) { return self.fun; }, "The function as it was given.");
  nb::class_<SecondOrderSpec>(module, "SecondOrder", nb::type_slots(slots<SecondOrderSpec>),
                              "f of (t, q) with y'' = f(t, y), as y' of (q, v).")
      .def(nb::init<nb::object>(), nb::arg("fun"))
      .def_prop_ro("fun", [](const SecondOrderSpec& self) { return self.fun; });
  nb::class_<SeriesSpec>(module, "Series", nb::type_slots(slots<SeriesSpec>),
                         "Machine code for Taylor coefficients, and what keeps it alive.")
      .def(nb::init<std::uintptr_t, int, nb::object>(), nb::kw_only(), nb::arg("address"), nb::arg("order"),
           nb::arg("owner").none(),
           "void (double t, double unit, const double* in, double* out, const double* p) writes the coefficients in s "
           "at t + unit s of the powers 0 ... order: of a system from y (n,), (order + 1, n); of a function g of m "
           "values from those of y, (order + 1, m).")
      .def_ro("order", &SeriesSpec::order);
}

}  // namespace

void define_callables(nb::module_& module) {
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
      "solve_addresses",
      [] {
        return std::tuple(reinterpret_cast<std::uintptr_t>(&solve_in_place),
                          reinterpret_cast<std::uintptr_t>(&solve_sparse_in_place));
      },
      "Addresses of functions (k, m, numbers) and (k, m, entries, places, numbers) that solve a linear system in "
      "place, for generated code.");
}

}  // namespace invariode::binding
