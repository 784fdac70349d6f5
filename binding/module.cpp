// The one boundary between Python and the core: it converts, and decides nothing.

#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

#include "arguments.hpp"
#include "arrays.hpp"
#include "callables.hpp"
#include "dense.hpp"
#include "interpreter.hpp"
#include "manifolds.hpp"
#include "mechanics.hpp"
#include "methods/registry.hpp"
#include "outputs.hpp"
#include "problem.hpp"
#include "python_function.hpp"
#include "run/names.hpp"
#include "run/points.hpp"
#include "runs.hpp"

namespace invariode::binding {
namespace {

/// Returns the value of `work` with the interpreter held only where the problem's functions need it.
template <class Work>
auto unlocked(const BoundProblem& bound, Work work) {
  auto result = [&] {
    const Unlocked released(bound.native());
    return work();
  }();
  if (!result) throw nb::python_error();
  return std::move(*result);
}

Points to_points(const ConstVector& t, const ConstMatrix& y, const Problem& problem) {
  if (y.shape(0) != t.size() || y.shape(1) != problem.n)
    throw std::invalid_argument("y must have a row of " + std::to_string(problem.n) + " reals for each of the " +
                                std::to_string(t.size()) + " times");
  return {t.data(), y.data(), t.size()};
}

Table residual(const ConstVector& t, const ConstMatrix& y, nb::handle problem) {
  const BoundProblem bound{Record(problem)};
  const Points points = to_points(t, y, bound.problem());
  std::vector<double> r = unlocked(bound, [&] { return residuals(bound.problem(), points); });
  return to_array<Table>(std::move(r), points.count, bound.problem().value.size());
}

Table distance(const ConstVector& t, const ConstMatrix& y, nb::handle problem, nb::handle tolerances) {
  const BoundProblem bound{Record(problem)};
  const Weights weights = read_weights(Record(tolerances), bound.problem().n);
  const Points points = to_points(t, y, bound.problem());
  std::vector<double> d = unlocked(bound, [&] { return distances(bound.problem(), weights, points); });
  return to_array<Table>(std::move(d), points.count, bound.problem().value.size());
}

std::tuple<Table, Integers, Table, Integers> impose_points(const ConstVector& t, const ConstMatrix& y,
                                                           nb::handle problem, nb::handle tolerances) {
  const BoundProblem bound{Record(problem)};
  const Weights weights = read_weights(Record(tolerances), bound.problem().n);
  const Points points = to_points(t, y, bound.problem());
  ImposedPoints imposed = unlocked(bound, [&] { return impose(bound.problem(), weights, points); });
  return {to_array<Table>(std::move(imposed.y), points.count, bound.problem().n),
          to_array<Integers>(std::move(imposed.converged), points.count),
          to_array<Table>(std::move(imposed.residual), points.count, bound.problem().value.size()),
          to_array<Integers>(std::move(imposed.iterations), points.count)};
}

void require_point(const ConstVector& y, const Problem& problem) {
  if (y.size() != problem.n)
    throw std::invalid_argument("a point of this problem has " + std::to_string(problem.n) + " reals, not " +
                                std::to_string(y.size()));
}

/// The columns of a report on invariants by name, and (invariant, component, entry, difference quotient) of a Jacobian
/// that is wrong; or None.
std::optional<nb::dict> examine_point(double t, const ConstVector& y, nb::handle problem, nb::handle tolerances) {
  const BoundProblem bound{Record(problem)};
  const Weights weights = read_weights(Record(tolerances), bound.problem().n);
  require_point(y, bound.problem());
  const PointExamination found = unlocked(bound, [&] { return examine(bound.problem(), weights, t, y.data()); });
  if (!found.finite) return {};
  nb::dict fields;
  const auto column = [&](const char* name, auto member) {
    std::vector<double> values;
    for (const Guard::Examination& one : found.invariants) values.push_back(static_cast<double>(one.*member));
    const std::size_t m = values.size();
    fields[name] = to_array<Vector>(std::move(values), m);
  };
  using One = Guard::Examination;
  column("residual", &One::residual);
  column("distance", &One::distance);
  column("gradient", &One::gradient);
  column("rate", &One::rate);
  column("angle", &One::angle);
  column("redundant", &One::redundant);
  column("detectable", &One::detectable);
  column("conserved", &One::conserved);
  const Finding& wrong = found.jacobian;
  fields["wrong_jacobian"] =
      wrong.kind == Finding::Kind::wrong_jacobian
          ? nb::object(nb::make_tuple(wrong.invariant, wrong.component, wrong.size, wrong.distance))
          : nb::object(nb::none());
  return fields;
}

std::pair<Vector, const char*> find_consistent_start(double t0, const ConstVector& y0, nb::handle problem,
                                                     nb::handle tolerances) {
  const BoundProblem bound{Record(problem)};
  const Weights weights = read_weights(Record(tolerances), bound.problem().n);
  require_point(y0, bound.problem());
  ConsistentStart start = unlocked(bound, [&] { return consistent_start(bound.problem(), weights, t0, y0.data()); });
  return {to_array<Vector>(std::move(start.y0), bound.problem().n), name_of(start.verdict)};
}

std::tuple<Indices, Indices, Vector> jacobian(double t, const ConstVector& y, nb::handle problem,
                                              nb::handle tolerances) {
  const BoundProblem bound{Record(problem)};
  const Weights weights = read_weights(Record(tolerances), bound.problem().n);
  require_point(y, bound.problem());
  const Matrix J = unlocked(bound, [&] { return jacobian_at(bound.problem(), weights, t, y.data()); });
  std::vector<int> rows, columns;
  std::vector<double> values;
  rows.reserve(J.size());
  columns.reserve(J.size());
  values.reserve(J.size());
  J.for_each([&](std::size_t i, std::size_t j, double value) {
    rows.push_back(static_cast<int>(i));
    columns.push_back(static_cast<int>(j));
    values.push_back(value);
  });
  const std::size_t count = values.size();
  return {to_array<Indices>(std::move(rows), count), to_array<Indices>(std::move(columns), count),
          to_array<Vector>(std::move(values), count)};
}

std::tuple<std::optional<std::pair<Indices, Indices>>, std::int64_t, std::size_t> find_sparsity(
    double t, const ConstVector& y, nb::handle problem, std::int64_t most_calls, bool sparse_only) {
  const BoundProblem bound{Record(problem)};
  require_point(y, bound.problem());
  FoundPattern found = unlocked(bound, [&] {
    return sparsity(bound.problem(), t, y.data(), {.most_calls = most_calls, .sparse_only = sparse_only});
  });
  std::optional<std::pair<Indices, Indices>> pattern;
  if (found.pattern) {
    const std::size_t starts = found.pattern->starts.size(), rows = found.pattern->rows.size();
    pattern.emplace(to_array<Indices>(std::move(found.pattern->starts), starts),
                    to_array<Indices>(std::move(found.pattern->rows), rows));
  }
  return {std::move(pattern), found.calls, found.groups};
}

void define_points(nb::module_& module) {
  module.def("residual", &residual, nb::arg("t"), nb::arg("y"), nb::arg("problem"),
             "g(t, y) - value of each row of y: (len(t), m).");
  module.def("distance", &distance, nb::arg("t"), nb::arg("y"), nb::arg("problem"), nb::arg("tolerances"),
             "Distances of each row of y from the level sets, in units of rtol: (len(t), m).");
  module.def("impose", &impose_points, nb::arg("t"), nb::arg("y"), nb::arg("problem"), nb::arg("tolerances"),
             "Projects each row of y to roundoff: (y, converged, residual, iterations).");
  module.def("examine", &examine_point, nb::arg("t"), nb::arg("y"), nb::arg("problem"), nb::arg("tolerances"),
             "Examine each invariant at one point; None where g, its Jacobian or f is not finite there.");
  module.def("consistent_start", &find_consistent_start, nb::arg("t0"), nb::arg("y0"), nb::arg("problem"),
             nb::arg("tolerances"),
             "y0 with the algebraic equations of a singular mass matrix satisfied, and the verdict.");
  module.def("jacobian", &jacobian, nb::arg("t"), nb::arg("y"), nb::arg("problem"), nb::arg("tolerances"),
             "The Jacobian of f at a point, as an implicit method begins with it: (rows, columns, values).");
  module.def(
      "sparsity", &find_sparsity, nb::arg("t"), nb::arg("y"), nb::arg("problem"), nb::arg("most_calls"),
      nb::arg("sparse_only"),
      "(starts, rows) of the pattern of the Jacobian of f near a point, or None if it is not sparse or f may not "
      "be evaluated more often; the evaluations of f; those that differences take with it.");
}

std::optional<int> unless_zero(int count) { return count > 0 ? std::optional(count) : std::nullopt; }

/// A row of the registry, by the names of the fields of `Method` in Python.
nb::dict as_dict(const Method& m) {
  nb::dict row;
  row["name"] = m.name;
  row["summary"] = m.summary;
  row["family"] = m.family;
  row["min_order"] = m.min_order;
  row["order"] = m.order;
  row["extension_order"] = m.extension_order;
  row["stages"] = unless_zero(m.stages);
  row["extra"] = m.extra;
  row["iterations"] = m.iterations;
  row["refine"] = m.refine;
  row["source"] = m.source;
  row["scipy_name"] = m.scipy_name ? std::optional(m.scipy_name) : std::nullopt;
  row["scipy_bdf"] = m.scipy_bdf;
  row["mass"] = name_of(m.mass);
  row["equations"] = name_of(m.equations);
  row["delays"] = m.delays;
  std::vector<const char*> options;
  for (const char* one : m.options)
    if (one != nullptr) options.push_back(one);
  row["options"] = nb::tuple(nb::cast(options));
  return row;
}

void define_methods(nb::module_& module) {
  module.def(
      "methods",
      [] {
        std::vector<nb::dict> rows;
        for (const Method& row : methods()) rows.push_back(as_dict(row));
        return rows;
      },
      "The registry of methods: the fields of each, by name.");
}

}  // namespace
}  // namespace invariode::binding

NB_MODULE(_core, module) {
  using namespace invariode::binding;
  // Worker threads ask for the main interpreter, and would wait for it for ever while another one runs.
  if (PyInterpreterState_Get() != PyInterpreterState_Main())
    throw nb::import_error(
        "invariode works in Python's main interpreter only: use threads or processes, not "
        "sub-interpreters");
  nb::set_leak_warnings(false);  // what a user still holds when the interpreter ends is no fault to be told of
  module.attr("__doc__") = "The native core. Private: `invariode` is the interface.";
  prepare_outputs();
  prepare_python_functions();
  define_arguments(module);
  define_callables(module);
  define_dense(module);
  define_run(module);
  define_points(module);
  define_mechanics(module);
  define_manifolds(module);
  define_methods(module);
}
