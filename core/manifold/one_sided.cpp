#include "manifold/one_sided.hpp"

#include <algorithm>
#include <cmath>

namespace invariode {
namespace {

constexpr int newton_rounds = 10;  // Newton's iteration is at roundoff after three or four
// What ten iterations leave at a double root, as where G is at its minimum: less than 4⁻¹⁰. More has not converged.
constexpr double converged = 1e-3;

}  // namespace

OneSided::OneSided(Projector& projector, ActiveSet* within, double rtol)
    : projector_(projector),
      within_(within),
      rtol_(rtol),
      candidate_(projector.invariants().n()),
      residual_(projector.invariants().m()),
      distance_(projector.invariants().m()),
      first_excess_(projector.invariants().m()),
      g_(projector.invariants().m()),
      candidate_g_(projector.invariants().m()),
      debt_(projector.invariants().m()),
      by_slope_(projector.invariants().m()) {}

Status OneSided::start(double t, const double* y) { return projector_.invariants().hold_one_sided(t, y); }

Status OneSided::go_on(double t, const double* y) {
  if (projector_.invariants().evaluate(t, y, g_.data()) == Status::stop) return Status::stop;
  projector_.invariants().tighten(g_.data());
  return Status::ok;
}

Projected OneSided::project(const StepEnds& ends, const double* slope, double* y) {
  Invariants& invariants = projector_.invariants();
  limit_ = invariants.value();
  const Projected did = project_in_rounds(ends, slope, y);
  for (std::size_t i = 0; i < g_.size(); ++i) g_[i] += invariants.value()[i] - limit_[i];
  invariants.set_value(limit_);
  return did;
}

Projected OneSided::project_in_rounds(const StepEnds& ends, const double* slope, double* y) {
  const double t = ends.t1, *from = ends.y0;
  std::copy(y, y + candidate_.size(), candidate_.begin());
  projector_.rest_one_sided();
  engaged_ = false;
  Projected did = project_once(t, from, y);
  if (did.outcome != Outcome::ok) return did;
  note(did);
  bool remains = true;
  for (int round = 0; round <= newton_rounds && remains; ++round) {
    bool joined = false;
    if (did.skipped)
      std::copy(did.residual.begin(), did.residual.end(), g_.begin());
    else if (projector_.invariants().residual(t, y, g_.data()) == Status::stop)
      did.outcome = Outcome::stop;
    else if (!all_finite(g_.data(), g_.size()))
      did.outcome = Outcome::not_finite;
    if (did.outcome != Outcome::ok) return did;
    if (round == 0) candidate_g_ = g_;
    bool repays = round == 1 && repay_less(did.distance);
    if (round == 0 && repay(ends, slope, repays) == Status::stop) {
      did.outcome = Outcome::stop;
      return did;
    }
    remains = find_violations(y, joined) || repays;
    joined = joined || repays;
    if (!remains || round == newton_rounds) break;
    if (joined) std::copy(candidate_.begin(), candidate_.end(), y);
    did = project_once(t, from, y);
    if (did.outcome != Outcome::ok) return did;
    if (joined) note(did);
  }
  did.residual = residual_;
  did.distance = distance_;
  if (projector_.any_engaged()) measure_correction(y, did);
  for (std::size_t i = 0; i < g_.size() && remains; ++i)
    if (!projector_.idle(i) && projector_.invariants().excess(i, g_[i]) > converged * first_excess_[i] &&
        projector_.invariants().sense(i) != 0)
      did.outcome = Outcome::not_finite;
  return did;
}

Projected OneSided::project_once(double t, const double* from, double* y) {
  return within_ != nullptr ? within_->project(t, from, y) : projector_.project(t, from, y);
}

/// Where an invariant owes a change, what the candidate changes it by beyond what f does at the start of the step goes
/// into that: its new value is the one aimed at. `any`: there is one.
Status OneSided::repay(const StepEnds& ends, const double* slope, bool& any) {
  Invariants& invariants = projector_.invariants();
  const auto owes = [&](std::size_t i) { return std::min(debt_[i], invariants.sense(i) * g_[i]); };
  const auto pays = [&](std::size_t i, double amount) { return amount > invariants.roundoff_of_value(i); };
  bool asked = false;
  for (std::size_t i = 0; i < g_.size() && !asked; ++i) asked = pays(i, owes(i));
  if (!asked) return Status::ok;
  if (change_by_slope(ends, slope) == Status::stop) return Status::stop;
  std::vector<double> aim = limit_;
  for (std::size_t i = 0; i < g_.size(); ++i) {
    const double change = invariants.sense(i) * g_[i];
    const double paid = std::min(owes(i), change - std::max(0.0, invariants.sense(i) * by_slope_[i]));
    if (!pays(i, paid)) continue;
    aim[i] += invariants.sense(i) * (change - paid);
    first_excess_[i] = paid;
    projector_.engage(i);
    any = true;
  }
  invariants.set_value(aim);
  return Status::ok;
}

/// h d/ds g(t₀ + s, y₀ + s y₀') at s = 0, by a central difference.
Status OneSided::change_by_slope(const StepEnds& ends, const double* slope) {
  const double s = cbrt_eps * (ends.t1 - ends.t0);
  std::vector<double> point(candidate_.size()), behind(g_.size());
  for (const double side : {-s, s}) {
    for (std::size_t j = 0; j < point.size(); ++j) point[j] = ends.y0[j] + side * slope[j];
    std::vector<double>& g = side == s ? by_slope_ : behind;
    if (projector_.invariants().evaluate(ends.t0 + side, point.data(), g.data()) == Status::stop) return Status::stop;
  }
  for (std::size_t i = 0; i < behind.size(); ++i) by_slope_[i] = (by_slope_[i] - behind[i]) / (2 * cbrt_eps);
  return Status::ok;
}

/// A step pays no more than its tolerance. `distance`: of the candidate from the values aimed at. Returns whether any
/// of these has been moved towards it.
bool OneSided::repay_less(std::span<const double> distance) {
  Invariants& invariants = projector_.invariants();
  std::vector<double> aim = invariants.value();
  bool any = false;
  for (std::size_t i = 0; i < g_.size(); ++i) {
    const double kept = candidate_g_[i] - (aim[i] - limit_[i]);
    if (invariants.sense(i) * kept <= 0 || projector_.idle(i) || !(distance[i] > rtol_)) continue;
    aim[i] += kept * (1 - rtol_ / distance[i]);
    any = true;
  }
  invariants.set_value(aim);
  return any;
}

/// Residuals and distances of the candidate: zero where a one-sided invariant is not violated.
void OneSided::note(const Projected& did) {
  const Invariants& invariants = projector_.invariants();
  for (std::size_t i = 0; i < residual_.size(); ++i) {
    residual_[i] = invariants.sense(i) == 0 ? did.residual[i] : invariants.excess(i, did.residual[i]);
    distance_[i] = residual_[i] == 0 ? 0 : did.distance[i];
  }
}

/// Engages what g_, at y, violates. Whether it is to be projected again; `joined`: from the candidate, since more are
/// engaged than before. The roundoff of one that rests is that of its value: its gradient is not known at y.
bool OneSided::find_violations(const double* y, bool& joined) {
  const Invariants& invariants = projector_.invariants();
  const double* J = projector_.linearization().J.data();
  bool again = false;
  for (std::size_t i = 0; i < g_.size(); ++i) {
    if (invariants.sense(i) == 0) continue;
    const double excess = invariants.excess(i, g_[i]);
    const bool rests = projector_.idle(i);
    if (!(excess > (rests ? invariants.roundoff_of_value(i) : invariants.roundoff(i, y, J)))) continue;
    again = true;
    if (!rests) continue;
    projector_.engage(i);
    first_excess_[i] = excess;
    joined = engaged_ = true;
  }
  return again;
}

void OneSided::measure_correction(const double* y, Projected& did) const {
  const std::span<const double> w = projector_.linearization().w;
  did.correction = max_norm(candidate_.size(), [&](std::size_t i) { return (candidate_[i] - y[i]) / w[i]; });
}

void OneSided::commit() {
  Invariants& invariants = projector_.invariants();
  for (std::size_t i = 0; i < g_.size(); ++i) {
    debt_[i] = std::max(0.0, debt_[i] + invariants.sense(i) * (g_[i] - candidate_g_[i]));
    g_[i] += invariants.value()[i];
  }
  invariants.tighten(g_.data());
}

Outcome onto_between(Projector& projector, const Bounds* bounds, double t, const double* w, const double* g0,
                     const double* g1, std::span<double> target, double* y, int most) {
  Invariants& invariants = projector.invariants();
  const auto project = [&] {
    if (projector.all_idle()) return Outcome::ok;
    return bounds != nullptr ? onto_within(projector, *bounds, t, w, target.data(), y, most)
                             : projector.onto(t, w, target.data(), y, most);
  };
  projector.rest_one_sided();
  Outcome outcome = project();
  std::vector<double> r(target.size());
  // Each round engages one more at least, or is the last.
  for (std::size_t round = 0; round < target.size() && outcome == Outcome::ok; ++round) {
    if (invariants.residual(t, y, r.data()) == Status::stop) return Outcome::stop;
    bool joined = false;
    for (std::size_t i = 0; i < target.size(); ++i) {
      if (!projector.idle(i)) continue;
      const auto [low, high] = std::minmax({g0[i] - invariants.value()[i], g1[i] - invariants.value()[i]});
      target[i] = std::clamp(r[i], low, high);
      if (r[i] == target[i]) continue;
      projector.engage(i);
      joined = true;
    }
    if (!joined) break;
    outcome = project();
  }
  projector.rest_one_sided();
  return outcome;
}

}  // namespace invariode
