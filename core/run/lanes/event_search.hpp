#pragma once
// Locates the events of a step in which a lane has seen a sign change (`EventScan`): output/events searches
// the segment of the step.

#include <memory>
#include <optional>
#include <vector>

#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "output/events.hpp"
#include "output/interpolant.hpp"
#include "output/output.hpp"
#include "run/lanes/lanes.hpp"
#include "run/problem.hpp"

namespace invariode {

class EventSearch {
 public:
  /// For a solver whose parameters are those of the trajectory whenever `search` is called.
  explicit EventSearch(const Solver& solver);

  /// Adds what occurs to `found`, of each event.
  lanes::Found search(const lanes::Crossed& crossed, std::vector<Trajectory>& found);

 private:
  void take(const lanes::Crossed& crossed);
  bool keep(double t1, std::vector<Trajectory>& found);

  Callback f_;
  std::unique_ptr<Step> step_;  // never made: the interpolant knows its extension
  std::optional<Invariants> invariants_;
  std::optional<Projector> projector_;
  std::optional<StepInterpolant> interpolant_;
  Events events_;
  std::vector<double> y0_, y1_, y_;
};

}  // namespace invariode
