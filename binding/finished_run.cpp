#include "finished_run.hpp"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <optional>
#include <tuple>
#include <utility>
#include <vector>

#include "outputs.hpp"
#include "run/names.hpp"

namespace invariode::binding {
namespace {

using RunClass = nb::class_<FinishedRun>;

std::pair<nb::object, nb::object> points_of(FinishedRun& self) {
  RunResult& r = self.result;
  if (std::exchange(self.points_taken, true)) throw handed_over_already();
  const std::size_t count = r.points.t.size();
  if (!r.y_end) r.y_end.emplace(r.end(), r.end() + r.n);
  nb::object y = states_array(std::move(r.points.y), r.n, count, self.complex);
  return {times_array(std::move(r.points.t)), std::move(y)};
}

/// An object of a class derived from dict, with items, and `make` as the attribute `_make`. Written out, since calling
/// the class takes twice as long.
nb::object new_dict(const nb::type_object& kind, const nb::dict& items, nb::handle make) {
  static PyObject* const name = PyUnicode_InternFromString("_make");
  auto* const type = reinterpret_cast<PyTypeObject*>(kind.ptr());
  nb::object made = nb::steal(type->tp_new(type, nb::tuple().ptr(), nullptr));
  const bool complete = made.is_valid() && PyDict_Update(made.ptr(), items.ptr()) == 0 &&
                        PyObject_GenericSetAttr(made.ptr(), name, make.ptr()) == 0;
  if (!complete) throw nb::python_error();
  return made;
}

/// Makes the solution, with the names of the items made once.
nb::object make_solution(FinishedRun& self, const nb::type_object& kind, const nb::dict& items, nb::handle make) {
  constexpr std::size_t size = 6;
  static const std::array<PyObject*, size> names = {
      PyUnicode_InternFromString("t"),    PyUnicode_InternFromString("y"),   PyUnicode_InternFromString("nfev"),
      PyUnicode_InternFromString("njev"), PyUnicode_InternFromString("nlu"), PyUnicode_InternFromString("t_end")};
  const auto [t, y] = points_of(self);
  const RunResult& r = self.result;
  const std::array<nb::object, size> values = {
      t, y, nb::int_(r.nfev), nb::int_(r.linear.jacobians), nb::int_(r.linear.factorizations), nb::float_(r.t_end)};
  const nb::object solution = new_dict(kind, items, make);
  for (std::size_t i = 0; i < size; ++i)
    if (PyDict_SetItem(solution.ptr(), names[i], values[i].ptr()) < 0) throw nb::python_error();
  return solution;
}

/// (t, y) of the occurrences of the first `count` events, y with a row for each.
nb::list take_events(FinishedRun& self, std::size_t count) {
  nb::list all;
  for (std::size_t e = 0; e < count; ++e) {
    Trajectory& one = self.result.occurrences.at(e);
    const std::size_t times = one.t.size();
    all.append(nb::make_tuple(times_array(std::move(one.t)),
                              rows_array(std::move(one.y), times, self.result.n, self.complex)));
  }
  return all;
}

void define_arrays_of_run(RunClass& run) {
  run.def("take_points", &points_of, nb::sig("def take_points(self) -> tuple[numpy.ndarray, numpy.ndarray]"),
          "(t, y) of the points, y of shape (n, n_t).")
      .def_prop_ro(
          "end", [](const FinishedRun& self) { return state_array(self.result.end(), self.result.n, self.complex); },
          nb::sig("def end(self) -> numpy.ndarray"), "y at the end.")
      .def("take_events", &take_events, nb::arg("count"),
           nb::sig("def take_events(self, count: int) -> list[tuple[numpy.ndarray, numpy.ndarray]]"),
           "(t, y) of the occurrences of each of the first `count` events, y with a row for each.")
      .def(
          "record",
          [](nb::handle_t<FinishedRun> run) {
            constexpr std::size_t columns = sizeof(AcceptedStep) / sizeof(double);
            Buffer<AcceptedStep>& record = nb::cast<FinishedRun&>(run).result.record;
            return Table(record.data(), {record.size(), columns}, run);
          },
          "The accepted steps, in rows that belong to the run.")
      .def_prop_ro(
          "drift",
          [](const FinishedRun& self) {
            const Drift& drift = self.result.drift;
            const std::size_t m = drift.residual.size();
            return std::make_tuple(to_array<Vector>(std::vector(drift.residual), m),
                                   to_array<Vector>(std::vector(drift.distance), m), drift.correction);
          },
          nb::rv_policy::move)
      .def_prop_ro(
          "jumps",
          [](const FinishedRun& self) {
            std::vector<std::tuple<std::size_t, double, Vector>> jumps;
            for (const Jump& jump : self.result.jumps)
              jumps.emplace_back(jump.row, jump.t, to_array<Vector>(std::vector(jump.value), jump.value.size()));
            return jumps;
          },
          nb::rv_policy::move)
      .def_prop_ro(
          "value", [](const FinishedRun& self) { return to_array<Vector>(std::vector(self.value), self.value.size()); },
          nb::rv_policy::move);
}

void define_course_of_run(RunClass& run) {
  run.def("solution", &make_solution, nb::arg("kind"), nb::arg("items"), nb::arg("make"),
          nb::sig("def solution(self, kind: type, items: dict[str, object], make: object) -> object"),
          "An object of a class derived from dict, without a call of its constructor: it has `items`, with `t` and "
          "`y`, handed over as by `take_points`, the counts `nfev`, `njev` and `nlu`, and `t_end` in their places, and "
          "`make` as its attribute `_make`.")
      .def("take_dense", [](FinishedRun& self) { return std::exchange(self.dense, {}); })
      .def(
          "take_sections",
          [](FinishedRun& self) {
            std::vector<std::tuple<std::int64_t, double, nb::bytes>> all;
            for (const Section& one : std::exchange(self.result.sections, {}))
              all.emplace_back(one.steps, one.t, nb::bytes(one.memory.data(), one.memory.size()));
            return all;
          },
          "(accepted steps before, t, memory for `Solver.resume`) of each section.");
}

/// Defines a property that is read from the result.
template <class Read>
void property(RunClass& run, const char* name, Read read) {
  run.def_prop_ro(name, [read](const FinishedRun& self) { return read(self.result); });
}

/// Returns whether there is a remark on its steps.
bool remarkable(const RunResult& r) {
  return r.stiffness.found || !r.discontinuities.empty() || r.sticks_since || r.accumulation;
}

void define_report_of_run(RunClass& run) {
  property(run, "state", [](const RunResult& r) { return name_object(r.state); });
  property(run, "t", [](const RunResult& r) { return r.report.t; });
  property(run, "h", [](const RunResult& r) { return r.report.h; });
  property(run, "cause", [](const RunResult& r) { return name_of(r.report.cause); });
  property(run, "component", [](const RunResult& r) { return r.report.component; });
  property(run, "coefficient", [](const RunResult& r) { return r.report.coefficient; });
  property(run, "pure_relative", [](const RunResult& r) { return r.report.pure_relative; });
  property(run, "fastest", [](const RunResult& r) { return component(r.report.fastest); });
  property(run, "undefined_below_zero", [](const RunResult& r) { return component(r.report.undefined_below_zero); });
  property(run, "singular", [](const RunResult& r) { return r.report.linear.singular; });
  property(run, "unsolved", [](const RunResult& r) { return name_of(r.report.linear.unsolved); });
  property(run, "unsolved_t", [](const RunResult& r) { return r.report.linear.unsolved_t; });
  property(run, "undefined_mass", [](const RunResult& r) { return r.report.linear.undefined_mass; });
  property(run, "undefined_jacobian", [](const RunResult& r) { return r.report.linear.undefined_jacobian; });
  property(run, "event", [](const RunResult& r) { return r.report.event; });
  property(run, "circle", [](const RunResult& r) { return r.report.circle; });
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

/// kind, t, row, column, lower, upper, change, predicted.
using MisfitFields =
    std::tuple<const char*, double, std::size_t, std::size_t, std::size_t, std::size_t, double, double>;
std::optional<MisfitFields> fields_of(const std::optional<Misfit>& misfit) {
  constexpr std::array<const char*, 3> kinds = {"pattern", "bands", "matrix"};
  if (!misfit) return {};
  const auto& [kind, t, row, column, lower, upper, change, predicted] = *misfit;
  return MisfitFields(kinds[static_cast<std::size_t>(kind)], t, row, column, lower, upper, change, predicted);
}

using AccumulationTuple = std::tuple<std::size_t, double, double, std::int64_t>;
std::optional<AccumulationTuple> as_tuple(const std::optional<Accumulation>& all) {
  if (!all) return {};
  return AccumulationTuple{all->event, all->t, all->interval, all->count};
}

void define_summary_of_run(RunClass& run) {
  run.def_prop_ro(
      "counts", [](const FinishedRun& self) { return std::tuple_cat(self.result.counted()); },
      "Numbers, in the order of COUNTS.");
  property(run, "steps", [](const RunResult& r) { return r.counts.steps; });
  property(run, "t_end", [](const RunResult& r) { return r.t_end; });
  property(run, "correction", [](const RunResult& r) { return r.drift.correction; });
  property(run, "nfev", [](const RunResult& r) { return r.nfev; });
  property(run, "njev", [](const RunResult& r) { return r.linear.jacobians; });
  property(run, "nlu", [](const RunResult& r) { return r.linear.factorizations; });
  property(run, "projected_start", [](const RunResult& r) { return r.projected_start; });
  property(run, "derivatives", [](const RunResult& r) {
    std::vector<const char*> names;
    for (const Derivative one : r.derivatives) names.push_back(name_of(one));
    return names;
  });
  property(run, "left_complex_steps", [](const RunResult& r) { return r.linear.abandoned_complex_steps; });
  property(run, "enlargements", [](const RunResult& r) { return r.linear.enlargements; });
  property(run, "misfit", [](const RunResult& r) { return fields_of(r.linear.misfit); });
  property(run, "pattern", [](const RunResult& r) { return std::make_pair(r.linear.entries, r.linear.groups); });
  property(run, "dropped", [](const RunResult& r) { return r.dropped; });
  property(run, "unresolved", [](const RunResult& r) { return r.unresolved; });
  property(run, "dropped_at", [](const RunResult& r) { return r.dropped_at; });
  property(run, "harmed", [](const RunResult& r) { return r.harm.component; });
  property(run, "harm", [](const RunResult& r) { return r.harm.ratio; });
  property(run, "stiff", [](const RunResult& r) { return r.stiffness.found; });
  property(run, "stiff_since", [](const RunResult& r) { return r.stiffness.since; });
  property(run, "remarkable", [](const RunResult& r) { return remarkable(r); });
  property(run, "below_zero", [](const RunResult& r) { return component(r.below_zero); });
  run.def_prop_ro(
      "outcome",
      [](const FinishedRun& self) -> nb::object {
        const RunResult& r = self.result;
        const bool usual =
            r.state == State::reached_end || r.state == State::terminal_event || r.state == State::stopped_by_callback;
        const bool all = usual && !remarkable(r) && r.below_zero.index < 0 &&
                         std::isnan(r.linear.abandoned_complex_steps) && !r.linear.misfit;
        return all ? nb::object(name_object(r.state)) : nb::none();
      },
      nb::sig("def outcome(self) -> str | None"),
      "The state of the run, if that describes its end, and nothing else is to be reported; otherwise None.");
  run.def_prop_ro(
      "told",
      [](const FinishedRun& self) {
        return std::make_tuple(self.told.stiffness, self.told.discontinuities, self.told.sticking);
      },
      "True for each remark made during the run: it is stiff, f is discontinuous, the solution sticks.");
  property(run, "sticks_since", [](const RunResult& r) { return r.sticks_since; });
  run.def_prop_ro(
      "accumulation", [](const FinishedRun& self) { return as_tuple(self.result.accumulation); },
      "Event whose actions come closer and closer until it is passed: its number, the last t, the interval before it, "
      "and the number of actions.");
  property(run, "marks", [](const RunResult& r) { return r.marks; });
  property(run, "discontinuities", [](const RunResult& r) { return r.discontinuities; });
  property(run, "clipped", [](const RunResult& r) { return r.clipped; });
  property(run, "next_h", [](const RunResult& r) { return r.next_h; });
  run.def_prop_ro(
      "memory", [](const FinishedRun& self) { return nb::bytes(self.memory.data(), self.memory.size()); },
      "Internal state of the run, for `Solver.resume`; empty if it cannot be resumed.");
}

}  // namespace

nb::str name_object(State state) {
  constexpr std::size_t size = std::size(state_names);
  static const std::array<PyObject*, size> names = [] {
    std::array<PyObject*, size> made{};
    for (std::size_t i = 0; i < made.size(); ++i) made[i] = PyUnicode_InternFromString(state_names[i].name);
    return made;
  }();
  return nb::borrow<nb::str>(names[static_cast<std::size_t>(state)]);
}

void define_finished_run(nb::module_& module) {
  RunClass run(module, "Run", "Results of `integrate`. Arrays are handed over: each `take_…` works once.");
  define_arrays_of_run(run);
  define_course_of_run(run);
  define_report_of_run(run);
  define_summary_of_run(run);
}

}  // namespace invariode::binding
