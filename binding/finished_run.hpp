#pragma once
// What comes out of a run.

#include <nanobind/nanobind.h>

#include <optional>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "dense.hpp"
#include "run/run.hpp"

namespace nb = nanobind;

namespace invariode::binding {

/// The result of a run, its continuous solution with the objects that evaluating it needs, and its memory.
struct FinishedRun {
  /// The warnings that were given while the run went on.
  struct Told {
    bool stiffness = false, discontinuities = false, sticking = false;
  };

  RunResult result;
  std::optional<Dense> dense;
  RunMemory memory;
  bool complex = false;
  std::vector<double> value = {};  ///< at which the invariants were held, of a run by `integrate_anew`
  bool points_taken = false;
  Told told = {};
};

inline std::pair<Vector, Table> to_arrays(Trajectory&& points, std::size_t n) {
  const std::size_t size = points.t.size();
  return {to_array<Vector>(std::move(points.t), size), to_array<Table>(std::move(points.y), size, n)};
}

/// (index, y, slope), or None.
inline std::optional<std::tuple<int, double, double>> component(const Component& one) {
  if (one.index < 0) return std::nullopt;
  return std::tuple(one.index, one.y, one.slope);
}

/// The name of a state, an object that is made once.
nb::str name_object(State state);

void define_finished_run(nb::module_& module);

}  // namespace invariode::binding
