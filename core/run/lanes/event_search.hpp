#pragma once
// Locates the events of a step in which a lane has seen a sign change (`EventScan`): the step is made again by the code
// for single runs, and output/events searches it.

#include <memory>
#include <optional>
#include <vector>

#include "manifold/invariants.hpp"
#include "manifold/projection.hpp"
#include "output/events.hpp"
#include "output/interpolant.hpp"
#include "output/output.hpp"
#include "run/ensemble.hpp"
#include "run/lanes/lanes.hpp"
#include "run/problem.hpp"

namespace invariode {

class EventSearch {
 public:
  /// For a solver whose parameters are those of the trajectory whenever `search` is called.
  EventSearch(const Solver& solver, const Ensemble& ensemble);

  /// Adds what occurs to `found`, of each event.
  lanes::Found search(const lanes::Crossed& crossed, std::vector<Trajectory>& found);

 private:
  bool make_step(const lanes::Crossed& crossed);
  bool keep(double t1, std::vector<Trajectory>& found);

  const Solver& solver_;
  const Ensemble& ensemble_;
  Callback f_;
  std::unique_ptr<Step> step_;
  std::optional<Invariants> invariants_;
  std::optional<Projector> projector_, output_projector_;
  std::optional<StepInterpolant> interpolant_;
  Events events_;
  std::vector<double> y0_, k_, y1_, y_;
};

}  // namespace invariode
