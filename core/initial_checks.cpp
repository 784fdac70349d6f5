#include "initial_checks.hpp"

namespace invariode {

State InitialChecks::inspect(double* y0) {
  if (!move_within_bounds(y0)) return State::start_out_of_bounds;
  Guard* guard = manifold_.guard();
  if (guard == nullptr) return State::created;
  if (const State found = judged(guard->start_value(settings_.t0, y0)); found != State::created) return found;
  if (manifold_.bounds() != nullptr && !manifold_.bounds()->contain(y0))
    if (const State found = project_within_bounds(y0); found != State::created) return found;
  return settings_.check ? judged(guard->start_jacobian(settings_.t0, y0)) : State::created;
}

bool InitialChecks::move_within_bounds(double* y) {
  const Bounds* bounds = manifold_.bounds();
  if (bounds == nullptr) return true;
  const Bounds::Excess outside = bounds->excess(y, weights_);
  if (outside.size > weights_.rtol()) {
    report_.component = outside.component;
    return false;
  }
  bounds->clip(y);
  return true;
}

/// The projection of the start, which has led out of the bounds, again within them.
State InitialChecks::project_within_bounds(double* y0) {
  switch (manifold_.project_start(settings_.t0, y0)) {
    case Outcome::stop: return State::interrupted;
    case Outcome::not_finite: return State::start_contradicts;
    case Outcome::ok: break;
  }
  if (const State found = judged(manifold_.guard()->start_value(settings_.t0, y0)); found != State::created)
    return found;
  return manifold_.bounds()->contain(y0) ? State::created : State::start_contradicts;
}

State InitialChecks::inspect_rates(const double* y0, const double* slope, double h) {
  Guard* guard = manifold_.guard();
  if (guard == nullptr || !settings_.check || settings_.t0 == settings_.tf) return State::created;
  return judged(guard->start_rate(settings_.t0, y0, slope, h));
}

State InitialChecks::judged(const Finding& finding) {
  if (finding.kind == Finding::Kind::none) return State::created;
  if (finding.kind == Finding::Kind::stop) return State::interrupted;
  report_.finding = finding;
  return State::invariant_refused;
}

}  // namespace invariode
