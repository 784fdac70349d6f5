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

/// A new object of a class in Python. Written out, since calling the class takes twice as long.
nb::object new_object(nb::handle kind) {
  auto* const type = reinterpret_cast<PyTypeObject*>(kind.ptr());
  nb::object made = nb::steal(type->tp_new(type, nb::tuple().ptr(), nullptr));
  if (!made.is_valid()) throw nb::python_error();
  return made;
}

void set_attribute(nb::handle object, PyObject* name, nb::handle value) {
  if (PyObject_GenericSetAttr(object.ptr(), name, value.ptr()) < 0) throw nb::python_error();
}

/// An object whose attributes `later` makes: see `Deferred`.
nb::object deferred(nb::handle kind, nb::handle later) {
  static PyObject* const name = PyUnicode_InternFromString("_make");
  nb::object made = new_object(kind);
  set_attribute(made, name, later);
  return made;
}

nb::object steps_object(nb::handle kind, nb::handle run, nb::handle members) {
  static PyObject* const given = PyUnicode_InternFromString("_given");
  static PyObject* const methods = PyUnicode_InternFromString("_methods");
  nb::object made = new_object(kind);
  set_attribute(made, given, run);
  set_attribute(made, methods, members);
  return made;
}

/// Times and states of the occurrences of events, each a list by event; states of none have the shape (0,), as in
/// SciPy.
std::pair<nb::object, nb::object> occurrences_of(FinishedRun& self, nb::handle kind, const nb::list& names) {
  static PyObject* const own = PyUnicode_InternFromString("_names");
  std::pair<nb::object, nb::object> both(new_object(kind), new_object(kind));
  const auto append = [](nb::handle list, const nb::object& one) {
    if (PyList_Append(list.ptr(), one.ptr()) < 0) throw nb::python_error();
  };
  for (std::size_t e = 0; e < names.size(); ++e) {
    auto& [t, y] = self.result.occurrences.at(e);
    const std::size_t times = t.size(), n = self.result.n;
    append(both.first, times_array(std::move(t)));
    append(both.second,
           times == 0 ? state_array(nullptr, 0, self.complex) : rows_array(std::move(y), times, n, self.complex));
  }
  set_attribute(both.first, own, names);
  set_attribute(both.second, own, names);
  return both;
}

/// Makes the solution, with the names of the items made once.
nb::object make_solution(nb::handle_t<FinishedRun> run, const nb::tuple& kinds, const nb::dict& items,
                         nb::handle private_ones, nb::handle stats, nb::handle members, nb::handle events) {
  enum Name { t, y, nfev, njev, nlu, t_end, stats_item, steps, t_events, y_events, size };
  static const std::array<PyObject*, size> names = [] {
    std::array<PyObject*, size> made{};
    constexpr std::array<const char*, size> texts = {"t",     "y",     "nfev",  "njev",     "nlu",
                                                     "t_end", "stats", "steps", "t_events", "y_events"};
    for (std::size_t i = 0; i < size; ++i) made[i] = PyUnicode_InternFromString(texts[i]);
    return made;
  }();
  FinishedRun& self = *nb::inst_ptr<FinishedRun>(run);
  const RunResult& r = self.result;
  nb::object solution = deferred(kinds[0], private_ones);
  const auto set = [&](Name name, const nb::object& value) {
    if (PyDict_SetItem(solution.ptr(), names[name], value.ptr()) < 0) throw nb::python_error();
  };
  if (PyDict_Update(solution.ptr(), items.ptr()) < 0) throw nb::python_error();
  const auto [times, states] = points_of(self);
  set(t, times);
  set(y, states);
  set(nfev, nb::int_(r.nfev));
  set(njev, nb::int_(r.linear.jacobians));
  set(nlu, nb::int_(r.linear.factorizations));
  set(t_end, nb::float_(r.t_end));
  set(stats_item, deferred(kinds[1], stats));
  if (!members.is_none()) set(steps, steps_object(kinds[2], run, members));
  if (events.is_none()) return solution;
  const auto [found_t, found_y] = occurrences_of(self, kinds[3], nb::borrow<nb::list>(events));
  set(t_events, found_t);
  set(y_events, found_y);
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
  run.def("solution", &make_solution, nb::arg("kinds"), nb::arg("items"), nb::arg("private"), nb::arg("stats"),
          nb::arg("members").none(), nb::arg("events").none(),
          nb::sig("def solution(self, kinds: tuple[type, ...], items: dict[str, object], private: tuple[object, ...], "
                  "stats: tuple[object, ...], members: tuple[str, ...] | None, events: list[str] | None) -> object"),
          "The solution, with `items` and the run's own: points, handed over as by `take_points`, counts, steps, and "
          "occurrences of events. kinds: the classes of the solution, its counts, its steps and its lists by event. "
          "private, stats: functions, each with its arguments, that make the attributes of the first two when they are "
          "needed. members: the methods that made the steps; None: the solution has no steps. events: the names of the "
          "user's events; None: the solution has no events.")
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

/// Roundoff of an invariant, in tolerances, from which on it is reported.
constexpr double most_roundoff = 10;

/// The invariants with more roundoff, and how much they have.
std::vector<std::pair<std::size_t, double>> unresolved(const RunResult& r) {
  std::vector<std::pair<std::size_t, double>> found;
  for (std::size_t i = 0; i < r.unresolved.size(); ++i)
    if (r.unresolved[i] > most_roundoff) found.emplace_back(i, r.unresolved[i]);
  return found;
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

nb::object outcome(const FinishedRun& self) {
  const RunResult& r = self.result;
  const bool usual =
      r.state == State::reached_end || r.state == State::terminal_event || r.state == State::stopped_by_callback;
  const bool all = usual && !remarkable(r) && r.below_zero.index < 0 && std::isnan(r.linear.abandoned_complex_steps) &&
                   !r.linear.misfit && r.harm.component < 0 && r.dropped.empty() && unresolved(r).empty();
  return all ? nb::object(name_object(r.state)) : nb::none();
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
  run.def_prop_ro(
      "unresolved", [](const FinishedRun& self) { return unresolved(self.result); },
      "Invariants that are imposed no more accurately than their roundoff, which is a change of y by many tolerances: "
      "the number of each, and how many.");
  property(run, "dropped_at", [](const RunResult& r) { return r.dropped_at; });
  property(run, "harmed", [](const RunResult& r) { return r.harm.component; });
  property(run, "harm", [](const RunResult& r) { return r.harm.ratio; });
  property(run, "stiff", [](const RunResult& r) { return r.stiffness.found; });
  property(run, "stiff_since", [](const RunResult& r) { return r.stiffness.since; });
  property(run, "remarkable", [](const RunResult& r) { return remarkable(r); });
  property(run, "below_zero", [](const RunResult& r) { return component(r.below_zero); });
  run.def_prop_ro(
      "outcome", &outcome, nb::sig("def outcome(self) -> str | None"),
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
