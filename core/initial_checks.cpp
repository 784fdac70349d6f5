#include "initial_checks.hpp"

namespace invariode {

InitialChecks::Result InitialChecks::inspect(double* y0) {
  if (const int component = move_within_bounds(y0); component >= 0)
    return {.state = State::start_out_of_bounds, .component = component};
  Guard* guard = manifold_.guard();
  if (guard == nullptr) return {};
  if (const Result found = judged(guard->start_value(settings_.t0, y0)); found.state != State::created) return found;
  if (manifold_.bounds() != nullptr && !manifold_.bounds()->contain(y0))
    if (const Result found = project_within_bounds(y0); found.state != State::created) return found;
  return settings_.check ? judged(guard->start_jacobian(settings_.t0, y0)) : Result{};
}

int InitialChecks::move_within_bounds(double* y) {
  const Bounds* bounds = manifold_.bounds();
  if (bounds == nullptr) return -1;
  const Bounds::Excess outside = bounds->excess(y, weights_);
  if (outside.size > weights_.rtol()) return outside.component;
  bounds->clip(y);
  return -1;
}

/// The projection of the start, which has led out of the bounds, again within them.
InitialChecks::Result InitialChecks::project_within_bounds(double* y0) {
  switch (manifold_.project_start(settings_.t0, y0)) {
    case Outcome::stop: return {.state = State::interrupted};
    case Outcome::not_finite: return {.state = State::start_contradicts};
    case Outcome::ok: break;
  }
  if (const Result found = judged(manifold_.guard()->start_value(settings_.t0, y0)); found.state != State::created)
    return found;
  return {.state = manifold_.bounds()->contain(y0) ? State::created : State::start_contradicts};
}

InitialChecks::Result InitialChecks::inspect_rates(const double* y0, const double* slope, double h) {
  Guard* guard = manifold_.guard();
  if (guard == nullptr || !settings_.check || settings_.t0 == settings_.tf) return {};
  return judged(guard->start_rate(settings_.t0, y0, slope, h));
}

InitialChecks::Result InitialChecks::judged(const Finding& finding) {
  if (finding.kind == Finding::Kind::none) return {};
  if (finding.kind == Finding::Kind::stop) return {.state = State::interrupted};
  return {.state = State::invariant_refused, .finding = finding};
}

}  // namespace invariode
