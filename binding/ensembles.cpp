#include "ensembles.hpp"

#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <cstddef>
#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bound_solver.hpp"
#include "finished_run.hpp"
#include "interpreter.hpp"
#include "outputs.hpp"
#include "require.hpp"
#include "run/ensemble.hpp"
#include "run/lanes/worker.hpp"

namespace invariode::binding {
namespace {

/// The name of an instruction set, and where the code of the functions is in its lanes: of f, and its series if the
/// problem has them, the slope of sensitivities, of an invariant that is held g and its Jacobian, with its tangent, and
/// of events.
using LaneCodes = std::pair<std::string, std::vector<std::uintptr_t>>;

LaneForm lane_form(const LaneCodes& codes, const Problem& problem) {
  const auto& [name, addresses] = codes;
  std::size_t next = 0;
  const auto address = [&addresses = addresses, &next] {
    const std::size_t i = next++;
    return i < addresses.size() ? addresses[i] : 0;
  };
  const auto called = [&address] { return lanes::Called{reinterpret_cast<lanes::Function*>(address()), nullptr}; };
  LaneForm form;
  for (const lanes::Instructions* one : lanes::instructions())
    if (one->name == name) form.instructions = one;
  require(form.instructions != nullptr, "this processor has no instructions named " + name);
  form.f = called();
  if (problem.series) form.series = {reinterpret_cast<lanes::SeriesFunction*>(address()), nullptr};
  if (problem.variations) form.slope = called();
  if (!problem.invariants.empty()) {
    form.g = called();
    form.jacobian = called();
    if (problem.variations) form.tangent = called();
  }
  while (next < addresses.size()) form.events.push_back(called());
  return form;
}

/// The results of an ensemble by name. Its arrays are handed over.
nb::dict results_by_name(EnsembleResult& r) {
  nb::dict fields;
  const auto column = [&](const char* name, auto& values) {
    fields[name] = to_array<Vector>(std::move(values), r.size);
  };
  const auto table = [&](const char* name, auto& values, std::size_t columns) {
    fields[name] = to_array<Table>(std::move(values), r.size, columns);
  };
  column("t_end", r.t);
  table("y_end", r.y_end, r.n);
  fields["y"] = to_array<Cube>(std::move(r.y), r.size, r.n / r.parts, r.n_t * r.parts);
  table("value", r.value, r.m);
  table("residual_before", r.before, r.m);
  table("residual_after", r.after, r.m);
  column("correction", r.correction);
  column("clipped_amount", r.clipped);
  column("stiff_since", r.stiff_since);
  column("discontinuity", r.discontinuity);
  column("accumulation", r.accumulation);
  fields["counts"] = to_array<IntegerTable>(std::move(r.count), r.size, EnsembleResult::counts);
  fields["states"] = to_array<Bytes>(std::move(r.state), r.size);
  nb::list events, failures;
  for (EnsembleResult::Occurrences& one : r.occurrences) {
    const std::size_t count = one.trajectory.size();
    auto [t, y] = to_arrays(std::move(one.points), r.n);
    events.append(nb::make_tuple(to_array<Integers>(std::move(one.trajectory), count), t, y));
  }
  for (const EnsembleResult::Failure& failure : r.failures) {
    FinishedRun run;
    run.result.state = failure.state;
    run.result.report = failure.report;
    failures.append(nb::make_tuple(failure.trajectory, std::move(run)));
  }
  fields["events"] = events;
  fields["failures"] = failures;
  fields["alone"] = std::vector<std::size_t>(r.alone.begin(), r.alone.end());
  return fields;
}

/// Integrates from each row of y0, with the rows of `parameters`, and of `tolerances` of sensitivities, of the same
/// number, on as many threads as there are solvers, all of the same problem and native. `progress(done)` is called now
/// and then. A `request` cancels the rest.
nb::dict integrate_rows(const std::vector<BoundSolver*>& all, const ConstMatrix& y0, const ConstMatrix& parameters,
                        const nb::object& progress, const std::optional<LaneCodes>& lanes,
                        const std::optional<ConstMatrix>& tolerances, const StopRequest* request) {
  std::vector<Solver*> solvers;
  for (BoundSolver* one : all) {
    require(one->bound.native(), "functions of an ensemble on threads must be native");
    solvers.push_back(&one->solver);
  }
  if (parameters.shape(0) != y0.shape(0))
    throw std::invalid_argument("y0 and parameters must have as many rows as each other");
  if (tolerances && (tolerances->shape(0) != y0.shape(0) || solvers.empty() ||
                     tolerances->shape(1) != y0.shape(1) - solvers.front()->problem().n))
    throw std::invalid_argument("tolerances must have the shape of the sensitivities");
  bool raised = false;
  const auto look = [&](std::uint32_t done) {
    if (raised || PyErr_CheckSignals() != 0) {
      raised = true;
      return false;
    }
    if (request != nullptr && request->made) return false;
    raised = !progress.is_none() && !without_error([&] { progress(done); });
    return !raised;
  };
  const auto watch = [&](std::uint32_t done) { return holding_interpreter([&] { return look(done); }); };
  std::optional<LaneForm> form;
  if (lanes && !solvers.empty()) form = lane_form(*lanes, solvers.front()->problem());
  std::unique_ptr<EnsembleResult> result;
  {
    const Unlocked released;
    const Ensemble rows{.size = y0.shape(0),
                        .y0 = y0.data(),
                        .rows = parameters.data(),
                        .n = y0.shape(1),
                        .parameters = parameters.shape(1),
                        .tolerances = tolerances ? tolerances->data() : nullptr};
    result = integrate_all(solvers, rows, watch, form);
  }
  if (raised) throw nb::python_error();
  return results_by_name(*result);
}

}  // namespace

void define_ensemble(nb::module_& module) {
  module.def(
      "integrate_all", &integrate_rows, nb::arg("solvers"), nb::arg("y0"), nb::arg("parameters"),
      nb::arg("progress").none(), nb::arg("lanes") = nb::none(), nb::arg("tolerances") = nb::none(),
      nb::arg("request") = nb::none(),
      "Integrates from each row of y0, on as many threads as there are solvers. lanes: the name of an instruction "
      "set and where the code of the functions is in its lanes: of f, the slope of sensitivities, of an invariant g, "
      "its Jacobian and its tangent, of events. tolerances: absolute ones of the sensitivities, in rows. A "
      "`request` cancels the trajectories that are not solved yet, whose states are then the last one. Returns by "
      "name: "
      "arrays with a row for each trajectory; events, (trajectory, t, y) of each; failures, pairs of a trajectory "
      "and a Run that tells why it ended; alone, the numbers of trajectories that the lanes left to scalar code, by "
      "cause: a value that is not finite or a step too short, stability, the invariant, an event or output inside a "
      "step, max_steps, and too many left. stiff_since, discontinuity, and accumulation, after which actions of an "
      "event "
      "are missing because they came ever closer together: times, or NaN where this did not happen.");
  module.def(
      "instruction_sets",
      [] {
        std::vector<std::pair<std::string, std::size_t>> sets;
        for (const lanes::Instructions* one : lanes::instructions())
          sets.emplace_back(std::string(one->name), one->lanes);
        return sets;
      },
      "(name, lanes) of each that this processor has, the best first.");
}

}  // namespace invariode::binding
