#include "runs.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "dense.hpp"
#include "interpreter.hpp"
#include "mechanics.hpp"
#include "methods/registry.hpp"
#include "problem.hpp"
#include "run/ensemble.hpp"
#include "run/lanes/worker.hpp"
#include "run/names.hpp"
#include "run/problem.hpp"
#include "run/run.hpp"
#include "run/watch.hpp"

namespace invariode::binding {
namespace {

/// How often progress is told.
constexpr auto telling = std::chrono::milliseconds(100);

const Method& method_of(const std::string& name) {
  if (const Method* method = find_method(name)) return *method;
  throw std::invalid_argument("unknown method '" + name + "'");
}

void require_state(const ConstVector& y0, std::size_t n) {
  if (y0.size() != n)
    throw std::invalid_argument("y0 has " + std::to_string(y0.size()) + " reals, the problem has " + std::to_string(n));
}

/// A solver with the functions that it calls. Made with the interpreter held; where all functions are native, its runs
/// do not need it.
struct BoundSolver {
  BoundSolver(const std::string& method, const ProblemSpec& problem, const Tolerances& tolerances,
              const RunSettings& settings)
      : bound(problem),
        solver(method_of(method), bound.problem(), tolerances.for_size(problem.n), settings, settings) {}

  BoundProblem bound;
  Solver solver;
};

/// What a run was, its continuous solution with what evaluating it takes.
struct FinishedRun {
  RunResult result;
  std::optional<Dense> dense;
};

FinishedRun finish(Run& run, const Solver& solver) {
  FinishedRun finished{run.take_result(), {}};
  if (std::optional<DenseOutput>& dense = finished.result.dense)
    finished.dense.emplace(Dense{std::move(*dense), solver.weights(), solver.problem().complex});
  return finished;
}

std::pair<Vector, Table> to_arrays(Trajectory&& points, std::size_t n) {
  const std::size_t size = points.t.size();
  return {to_array<Vector>(std::move(points.t), size), to_array<Table>(std::move(points.y), size, n)};
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
      in_python([&] { told_(integration.t(), integration.step().h()); });
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

/// A run whose functions are all native does not hold the interpreter, but now and then, to look for signals and to
/// tell how far it is. False: a signal's handler has raised, or who was told.
bool run_without_interpreter(Integration& integration, const double* y0, Progress& progress) {
  const Unlocked released;
  return run_watched(integration, y0, [&] {
    return holding_interpreter(
        [&] { return PyErr_CheckSignals() == 0 && (!progress.due() || progress.tell(integration)); });
  });
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

/// A wish to end a run, which another thread or a handler of signals makes while it goes on.
struct StopRequest {
  std::atomic<bool> made{false};
};

FinishedRun integrate(const BoundSolver& self, const ConstVector& y0, const nb::object& told, StopRequest* request) {
  require_state(y0, self.solver.problem().n);
  Run run(self.solver);
  if (request != nullptr) run.integration().heed(request->made);
  Progress progress(told);
  const bool finished = self.bound.native() ? run_without_interpreter(run.integration(), y0.data(), progress)
                                            : run_with_interpreter(run.integration(), y0.data(), progress);
  if (!finished || run.integration().state() == State::interrupted || !progress.tell(run.integration()))
    throw nb::python_error();
  return finish(run, self.solver);
}

/// A run that Python advances step by step. It keeps its solver alive.
class Stepper {
 public:
  Stepper(nb::object owner, const ConstVector& y0)
      : owner_(std::move(owner)), solver_(nb::cast<const BoundSolver&>(owner_).solver), run_(solver_) {
    require_state(y0, solver_.problem().n);
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
    return {std::move(*one), solver_.weights(), solver_.problem().complex};
  }

  [[nodiscard]] Vector y() {
    const double* y = integration().y();
    const std::size_t n = solver_.problem().n;
    return to_array<Vector>(std::vector<double>(y, y + n), n);
  }
  [[nodiscard]] Integration& integration() { return run_.integration(); }
  [[nodiscard]] FinishedRun result() { return finish(run_, solver_); }
  [[nodiscard]] std::int64_t evaluations() const { return run_.evaluations(); }
  [[nodiscard]] nb::handle owner() const { return owner_; }

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

  nb::object owner_;
  const Solver& solver_;
  Run run_;
  bool busy_ = false;
  bool accepted_ = false;
};

/// Code of f in the lanes of an instruction set, by its name.
LaneForm lane_form(const std::pair<std::string, std::uintptr_t>& code) {
  for (const lanes::Instructions* one : lanes::instructions())
    if (one->name == code.first) return {one, reinterpret_cast<lanes::Function*>(code.second), nullptr};
  throw std::invalid_argument("this processor has no instructions named " + code.first);
}

/// Integrates from each row of y0, with the row of `parameters` of the same number, on as many threads as there are
/// solvers, all of the same problem and native. `progress(done)` is called now and then.
std::unique_ptr<EnsembleResult> integrate_rows(const std::vector<BoundSolver*>& all, const ConstMatrix& y0,
                                               const ConstMatrix& parameters, const nb::object& progress,
                                               const std::optional<std::pair<std::string, std::uintptr_t>>& lanes) {
  std::vector<Solver*> solvers;
  for (BoundSolver* one : all) {
    if (!one->bound.native()) throw std::invalid_argument("functions of an ensemble on threads must be native");
    solvers.push_back(&one->solver);
  }
  if (parameters.shape(0) != y0.shape(0))
    throw std::invalid_argument("y0 and parameters must have as many rows as each other");
  bool raised = false;
  const auto look = [&](std::uint32_t done) {
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
  const auto watch = [&](std::uint32_t done) { return holding_interpreter([&] { return look(done); }); };
  std::optional<LaneForm> form;
  if (lanes) form = lane_form(*lanes);
  std::unique_ptr<EnsembleResult> result;
  {
    const Unlocked released;
    result = integrate_all(solvers, {y0.shape(0), y0.data(), parameters.data(), y0.shape(1), parameters.shape(1)},
                           watch, form);
  }
  if (!result) throw nb::python_error();
  return result;
}

/// Why each of the trajectories failed that did.
std::vector<std::pair<std::size_t, FinishedRun>> failures(const EnsembleResult& result) {
  std::vector<std::pair<std::size_t, FinishedRun>> all;
  for (const EnsembleResult::Failure& failure : result.failures) {
    FinishedRun& run = all.emplace_back(failure.trajectory, FinishedRun{}).second;
    run.result.state = failure.state;
    run.result.report = failure.report;
  }
  return all;
}

// ---------------------------------------------------------------------------------------------------------------------
// What Python sees

int traverse_solver(PyObject* self, visitproc visit, void* arg) {
  Py_VISIT(Py_TYPE(self));
  return nb::inst_ready(self) ? nb::inst_ptr<BoundSolver>(self)->bound.visit(visit, arg) : 0;
}
PyType_Slot solver_slots[] = {{Py_tp_traverse, reinterpret_cast<void*>(&traverse_solver)}, {0, nullptr}};

int traverse_stepper(PyObject* self, visitproc visit, void* arg) {
  Py_VISIT(Py_TYPE(self));
  if (nb::inst_ready(self)) Py_VISIT(nb::inst_ptr<Stepper>(self)->owner().ptr());
  return 0;
}
PyType_Slot stepper_slots[] = {{Py_tp_traverse, reinterpret_cast<void*>(&traverse_stepper)}, {0, nullptr}};

using RunClass = nb::class_<FinishedRun>;

void define_arrays_of_run(RunClass& run) {
  run.def(
         "take_points",
         [](FinishedRun& self) {
           RunResult& r = self.result;
           std::optional<Vector> end;
           if (r.y_end) end = to_array<Vector>(std::move(*r.y_end), r.n);
           auto [t, y] = to_arrays(std::move(r.points), r.n);
           return std::make_tuple(t, y, r.t_end, end);
         },
         "(t, y) of the points and of the end; the last is None where it is the last point.")
      .def("take_events",
           [](FinishedRun& self) {
             std::vector<std::pair<Vector, Table>> all;
             for (Trajectory& one : self.result.occurrences) all.push_back(to_arrays(std::move(one), self.result.n));
             return all;
           })
      .def("take_steps",
           [](FinishedRun& self) {
             constexpr std::size_t columns = sizeof(AcceptedStep) / sizeof(double);
             const std::size_t rows = self.result.record.size();
             return to_array<Table>(std::move(self.result.record), rows, columns);
           })
      .def("take_drift",
           [](FinishedRun& self) {
             Drift& drift = self.result.drift;
             const std::size_t m = drift.residual.size();
             return std::make_tuple(to_array<Vector>(std::move(drift.residual), m),
                                    to_array<Vector>(std::move(drift.distance), m), drift.correction);
           })
      .def("take_jumps",
           [](FinishedRun& self) {
             std::vector<std::tuple<std::size_t, double, Vector>> jumps;
             for (Jump& jump : self.result.jumps) {
               const std::size_t m = jump.value.size();
               jumps.emplace_back(jump.row, jump.t, to_array<Vector>(std::move(jump.value), m));
             }
             return jumps;
           })
      .def("take_dense", [](FinishedRun& self) { return std::exchange(self.dense, {}); });
}

/// Defines a property that is read from the result.
template <class Read>
void property(RunClass& run, const char* name, Read read) {
  run.def_prop_ro(name, [read](const FinishedRun& self) { return read(self.result); });
}

void define_report_of_run(RunClass& run) {
  property(run, "state", [](const RunResult& r) { return name_of(r.state); });
  property(run, "t", [](const RunResult& r) { return r.report.t; });
  property(run, "h", [](const RunResult& r) { return r.report.h; });
  property(run, "cause", [](const RunResult& r) { return name_of(r.report.cause); });
  property(run, "component", [](const RunResult& r) { return r.report.component; });
  property(run, "pure_relative", [](const RunResult& r) { return r.report.pure_relative; });
  property(run, "singular", [](const RunResult& r) { return r.report.linear.singular; });
  property(run, "undefined_mass", [](const RunResult& r) { return r.report.linear.undefined_mass; });
  property(run, "undefined_jacobian", [](const RunResult& r) { return r.report.linear.undefined_jacobian; });
  property(run, "event", [](const RunResult& r) { return r.report.event; });
  property(run, "limit", [](const RunResult& r) { return name_of(r.report.limit); });
  property(run, "steps_to_limit", [](const RunResult& r) { return r.report.steps; });
  property(run, "seconds_to_limit", [](const RunResult& r) { return r.report.seconds; });
  property(run, "finding", [](const RunResult& r) { return name_of(r.report.finding.kind); });
  property(run, "finding_invariant", [](const RunResult& r) { return r.report.finding.invariant; });
  property(run, "finding_component", [](const RunResult& r) { return r.report.finding.component; });
  property(run, "finding_t", [](const RunResult& r) { return r.report.finding.t; });
  property(run, "finding_size", [](const RunResult& r) { return r.report.finding.size; });
  property(run, "finding_distance", [](const RunResult& r) { return r.report.finding.distance; });
}

void define_summary_of_run(RunClass& run) {
  run.def_prop_ro(
      "counts", [](const FinishedRun& self) { return std::tuple_cat(self.result.counted()); },
      "Numbers, in the order of COUNTS.");
  property(run, "projected_start", [](const RunResult& r) { return r.projected_start; });
  property(run, "derivatives", [](const RunResult& r) {
    std::vector<const char*> names;
    for (const Derivative one : r.derivatives) names.push_back(name_of(one));
    return names;
  });
  property(run, "dropped", [](const RunResult& r) { return r.dropped; });
  property(run, "dropped_at", [](const RunResult& r) { return r.dropped_at; });
  property(run, "harmed", [](const RunResult& r) { return r.harm.component; });
  property(run, "harm", [](const RunResult& r) { return r.harm.ratio; });
  property(run, "stiff", [](const RunResult& r) { return r.stiffness.found; });
  property(run, "stiff_since", [](const RunResult& r) { return r.stiffness.since; });
  property(run, "clipped", [](const RunResult& r) { return r.clipped; });
  property(run, "breakpoints_passed", [](const RunResult& r) { return r.breakpoints_passed; });
  property(run, "next_h", [](const RunResult& r) { return r.next_h; });
}

void define_ensemble(nb::module_& module) {
  using Result = EnsembleResult;
  nb::class_<Result>(module, "EnsembleRun",
                     "Results of `integrate_all`. Arrays are handed over: each `take_…` works once.")
      .def("take_t", [](Result& r) { return to_array<Vector>(std::move(r.t), r.size); })
      .def("take_end", [](Result& r) { return to_array<Table>(std::move(r.y_end), r.size, r.n); })
      .def("take_y", [](Result& r) { return to_array<Block>(std::move(r.y), r.size, r.n / r.parts, r.n_t * r.parts); })
      .def("take_drift",
           [](Result& r) {
             return std::make_tuple(
                 to_array<Table>(std::move(r.value), r.size, r.m), to_array<Table>(std::move(r.before), r.size, r.m),
                 to_array<Table>(std::move(r.after), r.size, r.m), to_array<Vector>(std::move(r.correction), r.size));
           })
      .def("take_clipped", [](Result& r) { return to_array<Vector>(std::move(r.clipped), r.size); })
      .def("take_counts", [](Result& r) { return to_array<IntegerTable>(std::move(r.count), r.size, Result::counts); })
      .def("take_states", [](Result& r) { return to_array<Bytes>(std::move(r.state), r.size); })
      .def("take_events",
           [](Result& r) {
             std::vector<std::tuple<Integers, Vector, Table>> all;
             for (Result::Occurrences& one : r.occurrences) {
               const std::size_t count = one.trajectory.size();
               auto [t, y] = to_arrays(std::move(one.points), r.n);
               all.emplace_back(to_array<Integers>(std::move(one.trajectory), count), t, y);
             }
             return all;
           })
      .def("failures", &failures, "(trajectory, Run that tells why it ended) of those that failed.")
      .def_ro("alone", &Result::alone, "Trajectories that the lanes left to the code for one at a time.");
  module.def(
      "integrate_all", &integrate_rows, nb::arg("solvers"), nb::arg("y0"), nb::arg("parameters"),
      nb::arg("progress").none(), nb::arg("lanes") = nb::none(),
      "Integrates from each row of y0, on as many threads as there are solvers. lanes: the name of an instruction "
      "set and the address of f in its lanes.");
  std::vector<std::tuple<std::string, std::size_t, std::size_t>> sets;
  for (const lanes::Instructions* one : lanes::instructions())
    sets.emplace_back(std::string(one->name), one->lanes, one->bits);
  module.attr("LANES") = nb::cast(sets);
}

void define_solver(nb::module_& module) {
  nb::class_<StopRequest>(module, "StopRequest", "A wish to end a run.")
      .def(nb::init<>())
      .def("make", [](StopRequest& self) { self.made = true; }, "From any thread, or in a handler of signals.");
  nb::class_<BoundSolver>(module, "Solver", nb::type_slots(solver_slots),
                          "A problem with a method: all that is known before the initial value.")
      .def(nb::init<const std::string&, const ProblemSpec&, const Tolerances&, const RunSettings&>(), nb::arg("method"),
           nb::arg("problem"), nb::arg("tolerances"), nb::arg("settings"))
      .def_prop_ro(
          "native", [](const BoundSolver& self) { return self.bound.native(); },
          "Whether no function needs the interpreter.")
      .def_prop_ro(
          "obstacle_to_lanes",
          [](const BoundSolver& self) -> std::optional<std::string> {
            const char* obstacle = obstacle_to_lanes(self.solver);
            return obstacle ? std::optional<std::string>(obstacle) : std::nullopt;
          },
          "Why its trajectories cannot be integrated side by side, or None.")
      .def_prop_ro(
          "motion_work",
          [](const BoundSolver& self) -> nb::object {
            const auto motions = self.bound.motions();
            return motions.empty() ? nb::none() : nb::object(to_dict(motions[0]->motion().work()));
          },
          "What a mechanical system has cost so far: calls of its functions and factorisations.")
      .def(
          "resume",
          [](BoundSolver& self, const std::vector<std::int64_t>& seen, const std::vector<bool>& asleep) {
            self.solver.resume(seen, asleep);
          },
          nb::arg("seen"), nb::arg("asleep"),
          "Its runs go on from where another one ended, with so many occurrences of each event.")
      .def("integrate", &integrate, nb::arg("y0"), nb::arg("progress") = nb::none(), nb::arg("request") = nb::none(),
           "Integrates from (t0, y0). progress(t, h) is called at most ten times a second, and at the end. `request` "
           "ends "
           "the run after the step in which it is made.");
}

void define_stepper(nb::module_& module) {
  nb::class_<Stepper>(module, "Stepper", nb::type_slots(stepper_slots), "A run that is advanced step by step.")
      .def(
          "__init__",
          [](Stepper* self, nb::object solver, const ConstVector& y0) {
            if (!nb::isinstance<BoundSolver>(solver)) throw nb::type_error("a Stepper needs a Solver");
            new (self) Stepper(std::move(solver), y0);
          },
          nb::arg("solver"), nb::arg("y0"), "Starts at (t0, y0).")
      .def("step", &Stepper::step, "Goes on by one accepted step, if it can: see `state`.")
      .def("interpolant", &Stepper::interpolant, "The continuous solution over the last step.")
      .def("result", &Stepper::result, "Why the run ended, and its counts.")
      .def_prop_ro("state", [](Stepper& s) { return name_of(s.integration().state()); })
      .def_prop_ro("t", [](Stepper& s) { return s.integration().t(); })
      // The array has its own memory; a copy would be made by Python code, in which the thread may end
      // (interpreter.hpp).
      .def_prop_ro("y", &Stepper::y, nb::rv_policy::reference)
      .def_prop_ro(
          "h", [](Stepper& s) { return s.integration().step().h(); }, "|h| that the next step will try.")
      .def_prop_ro("order", [](Stepper& s) { return s.integration().step().order(); })
      .def_prop_ro("harmed", [](Stepper& s) { return s.integration().harm().component; })
      .def_prop_ro("harm", [](Stepper& s) { return s.integration().harm().ratio; })
      .def_prop_ro("nfev", &Stepper::evaluations)
      .def_prop_ro("njev", [](Stepper& s) { return s.integration().step().linear_work().jacobians; })
      .def_prop_ro("nlu", [](Stepper& s) { return s.integration().step().linear_work().factorizations; });
}

}  // namespace

void define_run(nb::module_& module) {
  RunClass run(module, "Run", "Results of `integrate`. Arrays are handed over: each `take_…` works once.");
  define_arrays_of_run(run);
  define_report_of_run(run);
  define_summary_of_run(run);
  define_ensemble(module);
  define_solver(module);
  define_stepper(module);
  std::vector<const char*> states;
  for (const auto& [name, state] : state_names) states.push_back(name);
  module.attr("STATES") = nb::cast(states);
  module.attr("COUNTS") = nb::tuple(
      nb::cast(std::vector<const char*>(std::begin(RunResult::count_names), std::end(RunResult::count_names))));
}

}  // namespace invariode::binding
