#include "runs.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <limits>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "arguments.hpp"
#include "arrays.hpp"
#include "bound_solver.hpp"
#include "callables.hpp"
#include "dense.hpp"
#include "ensembles.hpp"
#include "finished_run.hpp"
#include "interpreter.hpp"
#include "mechanics.hpp"
#include "methods/registry.hpp"
#include "outputs.hpp"
#include "problem.hpp"
#include "run/lanes/worker.hpp"
#include "run/names.hpp"
#include "run/problem.hpp"
#include "run/run.hpp"
#include "run/watch.hpp"

namespace invariode::binding {
namespace {

/// The interval between two reports of progress.
constexpr auto telling = std::chrono::milliseconds(100);

template <class State>
void require_state(const State& y0, std::size_t n) {
  if (y0.size() != n)
    throw std::invalid_argument("y0 has " + std::to_string(y0.size()) + " reals, the problem has " + std::to_string(n));
}

/// Matrices of more entries, 16 MB, are not kept with a solution: its extension starts the method anew.
constexpr std::size_t most_kept = std::size_t{1} << 21;

FinishedRun present(RunResult result, const Solver& solver, RunMemory memory = {}) {
  FinishedRun finished{std::move(result), {}, std::move(memory), solver.problem().complex};
  if (std::optional<DenseOutput> dense = std::exchange(finished.result.dense, {}))
    finished.dense.emplace(Dense{std::move(*dense), solver.weights(), solver.problem().complex});
  return finished;
}

bool can_go_on(State state) {
  return state == State::running || state == State::reached_end || state == State::terminal_event ||
         state == State::stopped_by_callback || state == State::stopped_by_request || state == State::limit_reached;
}

FinishedRun finish(Run& run, const Solver& solver, bool remember) {
  RunMemory memory;
  run.integration().end_attempts();
  if (remember && can_go_on(run.integration().state())) memory = run.memory(most_kept);
  return present(run.take_result(), solver, std::move(memory));
}

/// Calls a Python function (t, h) now and then with the progress of a run. Empty, it costs nothing.
class Progress {
 public:
  explicit Progress(const nb::object& function) : function_(function) {}

  explicit operator bool() const { return !function_.is_none(); }
  [[nodiscard]] bool due() const { return *this && Clock::now() >= next_; }
  /// Reports the progress, with the interpreter held. Returns false if the function raised.
  bool tell(const Integration& integration) {
    if (!*this) return true;
    next_ = Clock::now() + telling;
    return without_error([&] { function_(integration.t(), integration.step().h()); });
  }

 private:
  using Clock = std::chrono::steady_clock;

  const nb::object& function_;
  Clock::time_point next_ = Clock::now() + telling;
};

/// Hands a Python function what a run has put out since the last time, and what it remembers, now and then. Empty, it
/// costs nothing.
class Keeper {
 public:
  Keeper(const nb::object& kept, double every) : kept_(kept), every_(every) {}

  explicit operator bool() const { return !kept_.is_none(); }
  [[nodiscard]] bool due() const { return *this && (!last_ || Clock::now() - *last_ >= every_); }
  /// Keeps the run, with the interpreter held. False: the function raised.
  bool keep(Run& run, const Solver& solver) {
    if (!*this) return true;
    RunMemory memory;
    if (can_go_on(run.integration().state())) memory = run.memory(everything);
    FinishedRun part = present(run.result_since(marks_), solver, std::move(memory));
    const bool kept = without_error([&] { kept_(nb::cast(std::move(part))); });
    last_ = Clock::now();
    return kept;
  }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr std::size_t everything = std::numeric_limits<std::size_t>::max();

  const nb::object& kept_;
  std::chrono::duration<double> every_;  // perhaps longer than the clock can count
  Run::Marks marks_;
  std::optional<Clock::time_point> last_;  // none: the start is kept
};

/// Calls a Python function (stiff_since, discontinuities, sticks_since) with what a run has established, once it has
/// taken a second, and when it is interrupted: a long run's warnings would come too late at its end. Empty, it
/// costs nothing.
class Remarks {
 public:
  explicit Remarks(const nb::object& function) : function_(function) {}

  explicit operator bool() const { return !function_.is_none(); }
  [[nodiscard]] bool due() const { return *this && Clock::now() >= next_; }
  /// Reports what is new, with the interpreter held. Returns false if the function raised, as a warning does that a
  /// filter makes an error.
  bool tell(const Integration& integration) {
    if (!*this) return true;
    next_ = Clock::now() + patience;
    const Stiffness stiffness = integration.stiffness();
    const DiscontinuityDetector& jumps = integration.discontinuities();
    const bool stiff = stiffness.found && !told_.stiffness;
    const bool jumped = (!jumps.found().empty() && !told_.discontinuities) || (jumps.sticks_since() && !told_.sticking);
    if (!stiff && !jumped) return true;
    told_.stiffness = told_.stiffness || stiff;
    told_.discontinuities = told_.discontinuities || jumped;
    told_.sticking = told_.sticking || jumps.sticks_since();
    return without_error([&] {
      function_(stiff ? std::optional(stiffness.since) : std::nullopt, jumped ? jumps.found() : std::vector<double>(),
                jumped ? jumps.sticks_since() : std::nullopt);
    });
  }
  [[nodiscard]] const FinishedRun::Told& told() const { return told_; }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr auto patience = std::chrono::seconds(1);

  const nb::object& function_;
  Clock::time_point next_ = Clock::now() + patience;
  FinishedRun::Told told_;
};

/// The beginning of a run: at a state, or where another one was.
struct Beginning {
  const double* y0 = nullptr;
  std::span<const std::byte> memory = {};
  bool anew = false;

  State operator()(Run& run) const { return y0 ? run.integration().start(y0) : run.resume(memory, anew); }
};

/// A run, with what reports on it and keeps it on the way.
class DrivenRun {
 public:
  DrivenRun(Run& run, const Solver& solver, Progress progress, Keeper keeper, Remarks remarks)
      : run_(run), solver_(solver), progress_(progress), keeper_(std::move(keeper)), remarks_(remarks) {}

  /// A run whose functions are all native does not hold the interpreter, but now and then, to look for signals and to
  /// tell how far it is. False: a signal's handler has raised, or what it called.
  bool without_interpreter(const Beginning& begin) {
    const Unlocked released;
    return run_watched(
        run_, [&] { return begin(run_); },
        [&] { return holding_interpreter([&] { return PyErr_CheckSignals() == 0 && tell_if_due(); }); });
  }

  /// Runs with the interpreter held; the functions look for signals.
  bool with_interpreter(const Beginning& begin) {
    if (keeper_ && begin(run_) == State::running) {  // its start is kept before the first step
      do
        if (!tell_if_due()) return false;
      while (run_.advance() == State::running);
      return true;
    }
    if (keeper_) return true;
    return run_watched(run_, [&] { return begin(run_); }, [&] { return tell_if_due(); });
  }

  /// Reports the end of the run.
  bool tell_the_end() { return progress_.tell(run_.integration()) && keeper_.keep(run_, solver_); }

  /// Reports the findings of a run that was interrupted; the exception stays the one that is on its way.
  void tell_the_interruption() {
    const nb::error_scope pending;
    if (!remarks_.tell(run_.integration())) PyErr_Clear();
  }
  [[nodiscard]] const FinishedRun::Told& told() const { return remarks_.told(); }

 private:
  bool tell_if_due() {
    return (!progress_.due() || progress_.tell(run_.integration())) &&
           (!keeper_.due() || keeper_.keep(run_, solver_)) && (!remarks_.due() || remarks_.tell(run_.integration()));
  }

  Run& run_;
  const Solver& solver_;
  Progress progress_;
  Keeper keeper_;
  Remarks remarks_;
};

FinishedRun drive(Run& run, const BoundSolver& self, const Beginning& begin, const nb::object& progress,
                  const nb::object& kept, double every, const nb::object& remarks, bool remember = true) {
  DrivenRun driven(run, self.solver, Progress(progress), Keeper(kept, every), Remarks(remarks));
  run.integration().watch_by([] { return holding_interpreter([] { return PyErr_CheckSignals() == 0; }); });
  self.bound.forget_overflows();
  const bool finished = self.bound.native() ? driven.without_interpreter(begin) : driven.with_interpreter(begin);
  if (!finished || run.integration().state() == State::interrupted || self.bound.raise_overflow(run.integration()) ||
      !driven.tell_the_end()) {
    driven.tell_the_interruption();
    throw nb::python_error();
  }
  self.bound.forget_overflows();
  FinishedRun finished_run = finish(run, self.solver, remember);
  finished_run.told = driven.told();
  return finished_run;
}

FinishedRun drive(const BoundSolver& self, const Beginning& begin, const nb::object& progress, StopRequest* request,
                  const nb::object& kept, double every, const nb::object& remarks) {
  Run run(self.solver);
  if (request != nullptr) run.integration().stop_on(request->made);
  return drive(run, self, begin, progress, kept, every, remarks);
}

FinishedRun integrate(const BoundSolver& self, const ConstVector& y0, const nb::object& progress, StopRequest* request,
                      const nb::object& kept, double every, const nb::object& remarks) {
  require_state(y0, self.solver.problem().size());
  return drive(self, {.y0 = y0.data()}, progress, request, kept, every, remarks);
}

FinishedRun resume(const BoundSolver& self, const nb::bytes& memory, bool anew, const nb::object& progress,
                   StopRequest* request, const nb::object& kept, double every, const nb::object& remarks) {
  const auto* bytes = static_cast<const std::byte*>(memory.data());
  return drive(self, {.memory = {bytes, memory.size()}, .anew = anew}, progress, request, kept, every, remarks);
}

/// Writes floats, in a tuple, in a record that is alone in one, or in an array, to the parameters. False: some are not
/// floats, or their number is wrong.
bool read_parameters(nb::handle args, std::span<double> out) {
  if (!PyTuple_Check(args.ptr())) {
    const auto array = nb::cast<ConstVector>(args);
    if (array.size() != out.size()) return false;
    std::copy_n(array.data(), array.size(), out.begin());
    return true;
  }
  PyObject* listed = args.ptr();
  if (PyTuple_GET_SIZE(listed) == 1 && PyTuple_Check(PyTuple_GET_ITEM(listed, 0))) listed = PyTuple_GET_ITEM(listed, 0);
  if (static_cast<std::size_t>(PyTuple_GET_SIZE(listed)) != out.size()) return false;
  for (std::size_t i = 0; i < out.size(); ++i) {
    PyObject* one = PyTuple_GET_ITEM(listed, static_cast<Py_ssize_t>(i));
    if (!PyFloat_Check(one)) return false;
    out[i] = PyFloat_AS_DOUBLE(one);
  }
  return true;
}

/// Lends Python functions, breakpoints without actions and a limit of steps to a solver: afterwards it holds nothing of
/// the user's.
class Lent {
 public:
  Lent(BoundSolver& solver, const nb::object& functions, const nb::object& args, nb::handle breakpoints,
       StepLimit* limit)
      : solver_(functions.is_none() ? nullptr : &solver) {
    if (solver_ == nullptr) {
      solver.bound.lend(nb::none(), nb::cast<nb::tuple>(args));
      return;
    }
    std::vector<Breakpoint> breaks;
    if (!breakpoints.is_none())
      for (const double t : numbers_of(breakpoints)) breaks.push_back({.t = t, .action = {}, .jump = {}});
    solver.solver.interrupt(std::move(breaks), limit == nullptr ? Callback() : limit->callback());
    solver.bound.lend(functions, nb::cast<nb::tuple>(args));
  }
  Lent(const Lent&) = delete;
  Lent& operator=(const Lent&) = delete;
  ~Lent() {
    if (solver_ == nullptr) return;
    solver_->bound.give_back();
    solver_->solver.interrupt({}, {});
    if (!solver_->solver.settings().output_at_times) return;
    Settings settings = solver_->solver.settings();
    settings.times = {};
    solver_->solver.cover(std::move(settings));
    solver_->course.reset();
  }

 private:
  BoundSolver* solver_;
};

/// Sets the solver on a course, unless it is on this very one.
void follow(const nb::object& course, BoundSolver& self) {
  if (course.is(self.course)) return;
  Settings settings = self.solver.settings();
  read_course(course, settings);
  self.course.reset();
  self.solver.cover(std::move(settings));
  self.course = course;
}

/// A run from another initial value, with other functions, arguments and values of what the solver was made for, on
/// another course. Nothing: y0 is not finite or of another size, or `args` are no floats, as many as there are
/// parameters; a single solve knows what to say. The problem has no singular mass matrix.
std::optional<FinishedRun> integrate_anew(BoundSolver& self, nb::handle y0, const nb::object& functions,
                                          const nb::object& args, const nb::object& parameters,
                                          const nb::object& course, nb::handle breakpoints, StepLimit* limit,
                                          bool remember, const nb::object& remarks, const nb::object& value,
                                          const nb::object& tolerances) {
  const Problem& problem = self.solver.problem();
  const std::span<const double> start = numbers_of(y0);
  if (start.size() != problem.size() || !all_finite(start.data(), start.size())) return {};
  const nb::object& numbers = parameters.is_none() ? args : parameters;
  if (!problem.parameters.empty() && !read_parameters(numbers, problem.parameters)) return {};
  follow(course, self);
  if (!tolerances.is_none()) self.solver.set_tolerances(numbers_of(tolerances));
  if (!value.is_none()) self.solver.hold(numbers_of(value));
  const Lent lent(self, functions, args, breakpoints, limit);
  Run run(self.solver);
  const bool holds = run.invariants() != nullptr && value.is_none();
  if (holds) {
    std::vector<double> unmoved(start.begin(), start.end());
    if (run.prepare(self.solver.settings().t0, unmoved.data()) == Consistency::stop) throw nb::python_error();
  }
  std::vector<double> held = run.invariants() != nullptr ? run.invariants()->value() : std::vector<double>();
  const nb::object nobody = nb::none();
  FinishedRun finished = drive(run, self, {.y0 = start.data()}, nobody, nobody, 0, remarks, remember);
  if (holds) finished.result.ng -= run.evaluations_of_prepare();
  finished.value = std::move(held);
  return finished;
}

/// A run that Python advances step by step. It keeps its solver alive.
class Stepper {
 public:
  Stepper(nb::object owner, nb::handle y0)
      : owner_(std::move(owner)),
        bound_(nb::cast<BoundSolver&>(owner_).bound),
        solver_(nb::cast<BoundSolver&>(owner_).solver) {
    begin(y0);
  }
  int visit(visitproc visit, void* arg) const { return visit_all(visit, arg, owner_); }

  /// Starts again at another point, to another end, with a size of the first step that a former run has found; 0: the
  /// method's own choice.
  /// What the former run has found is gone. Returns the state of the run.
  nb::str restart(double t0, double tf, nb::handle y0, double first_step) {
    if (busy_) throw being_advanced();
    Settings settings = solver_.settings();
    settings.t0 = t0;
    settings.tf = tf;
    settings.first_step = first_step;
    nb::cast<BoundSolver&>(owner_).course.reset();
    solver_.cover(std::move(settings));
    begin(y0);
    if (first_step > 0) integration().trust_first_step();
    return state();
  }

  /// Goes on by one accepted step; what the state is then, tells why not.
  void step() {
    if (integration().state() != State::running) throw std::runtime_error("the run has ended");
    last_.reset();
    guarded([&] {
      const std::int64_t steps = integration().counts().steps;
      const double t = integration().t();
      integration().advance();
      accepted_ = integration().counts().steps > steps;
      if (accepted_) t_old_ = t;
    });
  }
  /// Goes on until t is reached or passed, or the run has ended, by `most` accepted steps at most. Returns their
  /// number, and `remarkable`.
  nb::tuple advance(double t, std::int64_t most) {
    const std::int64_t before = integration().counts().steps;
    const auto made = [&] { return integration().counts().steps - before; };
    while (integration().state() == State::running && is_ahead(t) && made() < most) {
      step();
      if (PyErr_CheckSignals() != 0) throw nb::python_error();
    }
    return nb::make_tuple(made(), remarkable());
  }

  /// The continuous solution over the last step.
  Dense interpolant() {
    if (!accepted_ || integration().state() == State::interrupted)
      throw std::runtime_error("there is no accepted step to interpolate");
    std::optional<DenseOutput> one;
    guarded([&] { one = integration().last_step(); });
    return {std::move(one.value()), solver_.weights(), solver_.problem().complex};
  }
  /// y at a time within the last step of a run that goes on, projected as `Dense::evaluate` does; None: t is not
  /// within.
  nb::object at(double t, nb::handle problem) {
    const bool within = accepted_ && integration().state() == State::running &&
                        integration().forward() * (t - t_old_) >= 0 && !is_ahead(t);
    if (!within) return nb::none();
    if (t == integration().t()) return y();
    if (!last_) last_.emplace(interpolant());
    return state_array(last_->at({&t, 1}, problem).data(), size(), solver_.problem().complex);
  }

  [[nodiscard]] nb::str state() { return name_object(integration().state()); }
  [[nodiscard]] nb::object y() { return state_array(integration().y(), size(), solver_.problem().complex); }
  [[nodiscard]] double t_old() const { return t_old_; }
  [[nodiscard]] Integration& integration() { return run_->integration(); }
  [[nodiscard]] bool remarkable() {
    const Integration& loop = integration();
    return loop.manifold().harm().component >= 0 || loop.below_zero().index >= 0 || loop.stiffness().found ||
           !loop.discontinuities().found().empty() || loop.discontinuities().sticks_since();
  }
  /// Returns the result of the run so far: it may continue afterwards.
  [[nodiscard]] FinishedRun result() {
    Run::Marks none;
    return present(run_->result_since(none), solver_);
  }
  [[nodiscard]] std::int64_t evaluations() const { return run_->evaluations(); }
  [[nodiscard]] nb::handle owner() const { return owner_; }

 private:
  static std::runtime_error being_advanced() { return std::runtime_error("the run is being advanced already"); }
  [[nodiscard]] std::size_t size() const { return solver_.problem().size(); }
  [[nodiscard]] bool is_ahead(double t) { return integration().forward() * (t - integration().t()) > 0; }

  void begin(nb::handle y0) {
    const std::span<const double> start = numbers_of(y0);
    require_state(start, size());
    accepted_ = false;
    last_.reset();
    run_.emplace(solver_);
    t_old_ = solver_.settings().t0;
    integration().keep_last_step();
    guarded([&] { integration().start(start.data()); });
  }

  /// A user function may not step the run that calls it, nor may another thread meanwhile.
  template <class Work>
  void guarded(Work&& work) {
    if (busy_) throw being_advanced();
    busy_ = true;
    try {
      work();
    } catch (...) {
      busy_ = false;
      throw;
    }
    busy_ = false;
    if (integration().state() == State::interrupted || bound_.raise_overflow(integration())) throw nb::python_error();
  }

  nb::object owner_;
  const BoundProblem& bound_;
  Solver& solver_;
  std::optional<Run> run_;
  std::optional<Dense> last_;  // the solution over the last step, once `at` has evaluated it
  double t_old_ = 0;           // where the last accepted step began
  bool busy_ = false;
  bool accepted_ = false;
};

void define_other_runs(nb::class_<BoundSolver>& solver) {
  solver.def(
      "integrate_anew", &integrate_anew, nb::arg("y0"), nb::arg("functions").none(), nb::arg("args"),
      nb::arg("parameters").none(), nb::arg("course"), nb::arg("breakpoints").none(), nb::arg("limit").none(),
      nb::arg("remember"), nb::arg("remarks").none(), nb::arg("value").none(), nb::arg("tolerances").none(),
      "Integrates from y0 on another course (t0, tf, max_step, times, max_points, max_bytes), with other arguments. "
      "functions: those in place of the Python functions that it was made with, in the order of their making, and "
      "with them breakpoints, without actions and in order, and another limit of steps; it keeps none of them. "
      "None: its own. parameters: of native functions, if `args` are not floats. remember: the run can be resumed. "
      "remarks: as in `integrate`. value: of the invariants; None: that at y0. tolerances: absolute ones of the "
      "sensitivities. Returns None if y0 is not finite, or something is not of the right size or type.");
}

void define_solver(nb::module_& module) {
  nb::class_<StopRequest>(module, "StopRequest", "A wish to end a run.")
      .def(nb::init<>())
      .def("make", [](StopRequest& self) { self.made = true; }, "From any thread, or in a handler of signals.");
  nb::class_<BoundSolver> solver(module, "Solver", nb::type_slots(slots<BoundSolver>),
                                 "A problem with a method: all that is known before the initial value.");
  define_other_runs(solver);
  solver
      .def(nb::init<const std::string&, nb::handle, nb::handle, nb::handle, nb::handle>(), nb::arg("method"),
           nb::arg("problem"), nb::arg("tolerances"), nb::arg("course"), nb::arg("settings"),
           "From a CoreProblem, Weights, a Course and Settings.")
      .def_prop_ro(
          "native", [](const BoundSolver& self) { return self.bound.native(); },
          "True if no function needs the interpreter.")
      .def_prop_ro(
          "members",
          [](const BoundSolver& self) {
            const Method& method = self.solver.method();
            if (!method.switches()) return nb::make_tuple(method.name);
            const auto [first, second] = members(self.solver.options());
            return nb::make_tuple(first.name, second.name);
          },
          "The names of the methods that make the steps: one, or the explicit and the implicit one that take turns.")
      .def_prop_ro(
          "obstacle_to_lanes",
          [](const BoundSolver& self) -> std::optional<std::string> {
            const char* obstacle = obstacle_to_lanes(self.solver);
            return obstacle ? std::optional<std::string>(obstacle) : std::nullopt;
          },
          "Reason why trajectories cannot be integrated in SIMD lanes, or None.")
      .def(
          "lanes",
          [](const BoundSolver& self, const std::string& instructions) -> std::size_t {
            for (const lanes::Instructions* one : lanes::instructions())
              if (const lanes::Kernel* kernel = one->kernel(self.solver.method().name);
                  kernel != nullptr && one->name == instructions)
                return kernel->lanes;
            return 1;
          },
          nb::arg("instructions"), "Return the number of trajectories that are integrated at once in SIMD lanes.")
      .def_prop_ro(
          "motion_work",
          [](const BoundSolver& self) -> nb::object {
            const auto motions = self.bound.motions();
            return motions.empty() ? nb::none() : nb::object(to_dict(motions[0]->motion().work()));
          },
          "Work of a mechanical system so far: calls of its functions and factorisations.")
      .def("integrate", &integrate, nb::arg("y0"), nb::arg("progress") = nb::none(), nb::arg("request") = nb::none(),
           nb::arg("keep") = nb::none(), nb::arg("every") = 0.0, nb::arg("remarks") = nb::none(),
           "Integrates from (t0, y0). progress(t, h) is called at most ten times a second, and at the end. `request` "
           "ends the run after the step in which it is made. keep(part) is called at the start, after `every` seconds, "
           "and at the end, with a Run of what has come since the last time. remarks(stiff_since, discontinuities, "
           "sticks_since) is called once a second if there is something new, and when the run is interrupted.")
      .def("resume", &resume, nb::arg("memory"), nb::arg("anew"), nb::arg("progress") = nb::none(),
           nb::arg("request") = nb::none(), nb::arg("keep") = nb::none(), nb::arg("every") = 0.0,
           nb::arg("remarks") = nb::none(),
           "Goes on from the `Run.memory` of a run of the same problem. `anew`: the method starts again.");
}

void define_steps_of_stepper(nb::class_<Stepper>& stepper) {
  stepper
      .def(
          "__init__",
          [](Stepper* self, nb::object solver, nb::handle y0) {
            if (!nb::isinstance<BoundSolver>(solver)) throw nb::type_error("a Stepper needs a Solver");
            new (self) Stepper(std::move(solver), y0);
          },
          nb::arg("solver"), nb::arg("y0"), "Starts at (t0, y0).")
      .def("restart", &Stepper::restart, nb::lock_self(), nb::arg("t0"), nb::arg("tf"), nb::arg("y0"),
           nb::arg("first_step"),
           "Starts again at (t0, y0), with the end tf, and returns the state; first_step: what a former run has found, "
           "or 0 if the method is to choose it. The run must not have times of output.")
      .def("step", &Stepper::step, nb::lock_self(), "Goes on by one accepted step, if it can: see `state`.")
      .def("advance", &Stepper::advance, nb::lock_self(), nb::arg("t"), nb::arg("most"),
           nb::sig("def advance(self, t: float, most: int) -> tuple[int, bool]"),
           "Goes on by accepted steps, at most so many, until t is reached or passed or the run has ended. Returns how "
           "many steps it has made, and `remarkable`.")
      .def("interpolant", &Stepper::interpolant, nb::lock_self(), "The continuous solution over the last step.")
      .def(
          "at", &Stepper::at, nb::lock_self(), nb::arg("t"), nb::arg("problem").none(),
          nb::sig("def at(self, t: float, problem: object | None) -> numpy.ndarray | None"),
          "y at a time within the last step, of a run that has not ended, projected as by `Dense.evaluate`; None: t is "
          "not within it.")
      .def("result", &Stepper::result, nb::lock_self(),
           "Return the result of the run so far, and why it ended, if it has.")
      .def_prop_ro("state", &Stepper::state, nb::lock_self())
      .def_prop_ro(
          "point", [](Stepper& s) { return nb::make_tuple(s.integration().t(), s.y(), s.state()); }, nb::lock_self(),
          nb::sig("def point(self) -> tuple[float, numpy.ndarray, str]"), "t, y and the state, at one time.")
      .def_prop_ro(
          "t", [](Stepper& s) { return s.integration().t(); }, nb::lock_self())
      .def_prop_ro("t_old", &Stepper::t_old, nb::lock_self(), "Time at which the last accepted step began.")
      .def_prop_ro("y", &Stepper::y, nb::lock_self(), nb::sig("def y(self) -> numpy.ndarray"), "A new array.")
      .def_prop_ro(
          "h", [](Stepper& s) { return s.integration().step().h(); }, nb::lock_self(),
          "|h| that the next step will try.")
      .def_prop_ro("order", [](Stepper& s) { return s.integration().step().order(); }, nb::lock_self());
}

void define_remarks_of_stepper(nb::class_<Stepper>& stepper) {
  stepper
      .def_prop_ro("remarkable", &Stepper::remarkable, nb::lock_self(),
                   "True if the steps have shown harm by projection, a fall below 0, stiffness or a discontinuity.")
      .def_prop_ro("nfev", &Stepper::evaluations, nb::lock_self())
      .def_prop_ro(
          "nfev_check",
          [](Stepper& s) {
            const Integration& loop = s.integration();
            return loop.evaluations_of_checks() + loop.step().linear_work().checks;
          },
          nb::lock_self())
      .def_prop_ro(
          "njev", [](Stepper& s) { return s.integration().step().linear_work().jacobians; }, nb::lock_self())
      .def_prop_ro(
          "nlu", [](Stepper& s) { return s.integration().step().linear_work().factorizations; }, nb::lock_self());
}

void define_stepper(nb::module_& module) {
  nb::class_<Stepper> stepper(module, "Stepper", nb::type_slots(slots<Stepper>),
                              "A run that is advanced step by step. Threads take turns.");
  define_steps_of_stepper(stepper);
  define_remarks_of_stepper(stepper);
}

}  // namespace

void define_run(nb::module_& module) {
  define_finished_run(module);
  define_ensemble(module);
  define_solver(module);
  define_stepper(module);
  module.attr("MEMORY_VERSION") = Archive::version;
  std::vector<const char*> states;
  for (const auto& [name, state] : state_names) states.push_back(name);
  module.attr("STATES") = nb::cast(states);
  module.attr("COUNTS") = nb::tuple(
      nb::cast(std::vector<const char*>(std::begin(RunResult::count_names), std::end(RunResult::count_names))));
}

}  // namespace invariode::binding
