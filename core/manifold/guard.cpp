#include "manifold/guard.hpp"

#include <algorithm>
#include <cmath>

namespace invariode {
namespace {

// Thresholds from 460 designed and 1260 random runs (docs/algorithms.md, 'Guard').
constexpr double suspicious_angle = 1e-6;              // ρ, with a Jacobian that is exact
constexpr double suspicious_angle_differences = 1e-4;  // ρ, with one by differences
constexpr double suspicious_drift = 0.01;              // D, in units of rtol
constexpr double roundoff_in_t = 10 * eps;             // of t, as of all that g computes
constexpr double suspicious_correction = 10;           // in units of rtol

// The directional test of a user's Jacobian: central differences are good to ε^{2/3} of the terms, curvature adds as
// much.
constexpr double jacobian_tolerance = 1e-4;
// A difference quotient tells nothing below this multiple of what halving its increment changes.
constexpr double uncertainty = 10;
const double cbrt_eps = std::cbrt(eps);

/// Direction of the test: no component is 0 and no two are equal, so that errors do not cancel by symmetry.
double direction(std::size_t j) {
  constexpr double golden = 0.6180339887498949;
  const double fraction = std::fmod(golden * static_cast<double>(j + 1), 1.0);
  return (j % 2 == 0 ? 1 : -1) * (0.5 + fraction);
}

double weighted_norm(const double* v, const double* w, std::size_t n) {
  double sum = 0;
  for (std::size_t i = 0; i < n; ++i) sum += (v[i] / w[i]) * (v[i] / w[i]);
  return std::sqrt(sum);
}

double dot(const double* a, const double* b, std::size_t n) {
  double sum = 0;
  for (std::size_t i = 0; i < n; ++i) sum += a[i] * b[i];
  return sum;
}

Finding stopped() { return {.kind = Finding::Kind::stop}; }

}  // namespace

Guard::Guard(Invariants& invariants, const Weights& weights, Slope& slope)
    : invariants_(invariants),
      weights_(weights),
      slope_(slope),
      projector_(invariants, weights, 1),
      point_(invariants.n()),
      f_value_(invariants.n()),
      gt_(invariants.m()),
      plus_(invariants.m()),
      minus_(invariants.m()),
      differences_(invariants.m() * invariants.n()),
      halved_(invariants.m() * invariants.n()) {}

Finding Guard::start_value(double t, double* y) {
  const Linearization at = projector_.linearization();
  projected_start_ = false;
  const Outcome outcome = projector_.linearize_at(t, y);
  if (outcome == Outcome::stop) return stopped();
  if (outcome == Outcome::not_finite) return undefined(t);
  bool off = false;
  Finding worst;
  for (std::size_t i = 0; i < invariants_.m(); ++i) {
    const double r = at.residual[i];
    if (std::abs(r) <= invariants_.roundoff(i, y, at.jacobian.data())) continue;
    off = true;
    const double distance = std::abs(r) / at.row_norm[i] / weights_.rtol();
    if (!(distance <= 1) && !(distance <= worst.distance))
      worst = {
          .kind = Finding::Kind::off_value, .invariant = static_cast<int>(i), .t = t, .size = r, .distance = distance};
  }
  if (worst.kind != Finding::Kind::none || !off) return worst;
  const Imposed imposed = projector_.impose(t, y);
  if (imposed.outcome == Outcome::stop) return stopped();
  projected_start_ = imposed.converged;
  switch (projector_.linearize_at(t, y)) {
    case Outcome::stop: return stopped();
    case Outcome::not_finite: return undefined(t);
    case Outcome::ok: return {};
  }
  return {};
}

Finding Guard::undefined(double t) const {
  const Linearization at = projector_.linearization();
  const std::size_t n = invariants_.n();
  std::size_t i = 0;
  while (i + 1 < invariants_.m() && std::isfinite(at.residual[i]) && all_finite(at.gradient(i), n)) ++i;
  return {.kind = Finding::Kind::undefined, .invariant = static_cast<int>(i), .t = t};
}

Finding Guard::start_jacobian(double t, const double* y) {
  const Linearization at = projector_.linearization();
  const std::size_t n = invariants_.n(), m = invariants_.m();
  if (invariants_.all_by_differences()) return {};
  const double* J = at.jacobian.data();
  const double* size = invariants_.sizes(y);
  for (std::size_t j = 0; j < n; ++j) point_[j] = y[j] + cbrt_eps * size[j] * direction(j);
  if (invariants_.residual(t, point_.data(), plus_.data()) == Status::stop) return stopped();
  for (std::size_t j = 0; j < n; ++j) point_[j] = y[j] - cbrt_eps * size[j] * direction(j);
  if (invariants_.residual(t, point_.data(), minus_.data()) == Status::stop) return stopped();
  for (std::size_t i = 0; i < m; ++i) {
    if (invariants_.by_differences(i) || invariants_.certain(i)) continue;
    double expected = 0, terms = 0;
    for (std::size_t j = 0; j < n; ++j) {
      const double term = J[i * n + j] * size[j] * direction(j);
      expected += term;
      terms += std::abs(term);
    }
    const double quotient = (plus_[i] - minus_[i]) / (2 * cbrt_eps);
    const double noise = invariants_.roundoff(i, y, J) / cbrt_eps;
    if (std::abs(quotient - expected) > jacobian_tolerance * std::max(terms, std::abs(quotient)) + noise)
      return worst_entry(t, y);
  }
  return {};
}

/// The directional test failed somewhere: which entry is farthest off, in units of its row's terms?
Finding Guard::worst_entry(double t, const double* y) {
  const Linearization at = projector_.linearization();
  const std::size_t n = invariants_.n(), m = invariants_.m();
  if (invariants_.difference_jacobian(t, y, differences_.data(), true) == Status::stop) return stopped();
  if (invariants_.difference_jacobian(t, y, halved_.data(), true, 0.5) == Status::stop) return stopped();
  const double* J = at.jacobian.data();
  const double* size = invariants_.sizes(y);
  Finding worst;
  double largest = 0;
  for (std::size_t i = 0; i < m; ++i) {
    if (invariants_.certain(i)) continue;
    double terms = 0;
    for (std::size_t j = 0; j < n; ++j)
      terms = std::max({terms, std::abs(J[i * n + j] * size[j]), std::abs(differences_[i * n + j] * size[j])});
    const double noise = invariants_.roundoff(i, y, J) / cbrt_eps;
    for (std::size_t j = 0; j < n; ++j) {
      const double given = J[i * n + j], quotient = halved_[i * n + j];
      const double off = std::abs(given - quotient) * size[j];
      const double doubt = uncertainty * std::abs(quotient - differences_[i * n + j]) * size[j];
      if (!(off > jacobian_tolerance * terms + noise + doubt) || off / terms <= largest) continue;
      largest = off / terms;
      worst = {.kind = Finding::Kind::wrong_jacobian,
               .invariant = static_cast<int>(i),
               .component = static_cast<int>(j),
               .t = t,
               .size = given,
               .distance = quotient};
    }
  }
  return worst;
}

/// Whether g changes with t alone, seen at a point near y0 (at y0 itself where g is not defined nearby). It may begin
/// to do so later: `rate` goes on looking.
Outcome Guard::detect_time_dependence(double t, const double* y, double h) {
  const auto look = [&] {
    if (invariants_.residual(t, point_.data(), plus_.data()) == Status::stop) return Outcome::stop;
    if (invariants_.residual(t + h, point_.data(), minus_.data()) == Status::stop) return Outcome::stop;
    if (!all_finite(plus_.data(), plus_.size()) || !all_finite(minus_.data(), minus_.size()))
      return Outcome::not_finite;
    time_dependent_ = plus_ != minus_;
    return Outcome::ok;
  };
  const double* size = invariants_.sizes(y);
  for (std::size_t j = 0; j < point_.size(); ++j) point_[j] = y[j] + cbrt_eps * size[j] * direction(j);
  Outcome outcome = look();
  if (outcome == Outcome::not_finite) {
    std::copy(y, y + point_.size(), point_.begin());
    outcome = look();
  }
  return outcome;
}

Finding Guard::start_rate(double t, const double* y, const double* f, double h) {
  if (detect_time_dependence(t, y, h) == Outcome::stop) return stopped();
  return rate(projector_.linearization(), t, f, h, 0);
}

Finding Guard::rate(const Linearization& at, double t, const double* f, double h, std::int64_t steps) {
  if (steps < quiet_until_) return {};
  const std::size_t n = invariants_.n();
  std::fill(gt_.begin(), gt_.end(), 0);
  const double* y = at.y.data();
  const bool look = steps >= next_look_;
  if (look) next_look_ = steps + std::max<std::int64_t>(steps / 2, 1);
  const bool formed = time_dependent_ || look;
  if (formed && invariants_.time_derivative(t, h, y, at.jacobian.data(), gt_.data()) == Status::stop) return stopped();
  time_dependent_ = time_dependent_ || changes_with_time();
  if (suspect(at, t, f, h, formed).kind == Finding::Kind::none) return {};
  std::copy(y, y + n, point_.begin());
  const Finding confirmed = confirm(t, point_.data(), h);
  if (confirmed.kind == Finding::Kind::none) quiet_until_ = std::max<std::int64_t>(2 * steps, 1);
  return confirmed;
}

Finding Guard::corrected(double correction, double t, const double* y, double h, std::int64_t steps) {
  if (!(correction > suspicious_correction * weights_.rtol()) || steps < unworried_until_) return {};
  unworried_until_ = 2 * steps;
  return confirm(t, y, h);
}

bool Guard::changes_with_time() const {
  return std::any_of(gt_.begin(), gt_.end(), [](double g) { return g != 0; });
}

Finding Guard::confirm(double t, const double* y, double h) {
  const Linearization at = projector_.linearization();
  if (y != point_.data()) std::copy(y, y + point_.size(), point_.begin());
  const Imposed imposed = projector_.impose(t, point_.data());
  if (imposed.outcome == Outcome::stop) return stopped();
  if (!imposed.converged) return {};
  const Outcome outcome = projector_.linearize_at(t, point_.data());
  if (outcome == Outcome::stop) return stopped();
  if (outcome == Outcome::not_finite) return {};
  if (slope_.evaluate(t, point_.data(), h, f_value_.data()) == Status::stop) return stopped();
  if (!all_finite(f_value_.data(), f_value_.size())) return {};
  if (invariants_.time_derivative(t, h, point_.data(), at.jacobian.data(), gt_.data()) == Status::stop)
    return stopped();
  time_dependent_ = time_dependent_ || changes_with_time();
  const Finding finding = suspect(at, t, f_value_.data(), h, true);
  return finding.kind == Finding::Kind::none ? finding : unless_uncertain(finding, t, h);
}

Outcome Guard::examine(double t, const double* y, double h, std::vector<Examination>& result) {
  const Linearization at = projector_.linearization();
  const std::size_t n = invariants_.n(), m = invariants_.m();
  result.assign(m, {});
  if (const Outcome outcome = projector_.linearize_at(t, y); outcome != Outcome::ok) return outcome;
  for (std::size_t i = 0; i < m; ++i) {
    result[i].residual = at.residual[i];
    result[i].gradient = at.row_norm[i];
    result[i].distance = at.distance(i) / weights_.rtol();
  }
  std::copy(y, y + n, point_.begin());
  if (projector_.impose(t, point_.data()).outcome == Outcome::stop) return Outcome::stop;
  std::vector<double> again = point_;  // projecting once more shows what is dropped
  if (projector_.project(t, point_.data(), again.data()).outcome == Outcome::stop) return Outcome::stop;
  if (const Outcome outcome = projector_.linearize_at(t, point_.data()); outcome != Outcome::ok) return outcome;
  if (slope_.evaluate(t, point_.data(), h, f_value_.data()) == Status::stop) return Outcome::stop;
  if (!all_finite(f_value_.data(), n)) return Outcome::not_finite;
  if (invariants_.time_derivative(t, h, point_.data(), at.jacobian.data(), gt_.data()) == Status::stop)
    return Outcome::stop;
  const double speed = weighted_norm(f_value_.data(), at.weights.data(), n);
  for (std::size_t i = 0; i < m; ++i) {
    const bool differences = gt_[i] != 0 || invariants_.by_differences(i);
    const double rate = gt_[i] + dot(at.gradient(i), f_value_.data(), n);
    const double terms = std::abs(gt_[i]) + at.row_norm[i] * speed;
    result[i].rate = rate;
    result[i].angle = terms > 0 ? std::abs(rate) / terms : 0;
    result[i].redundant = projector_.dropped()[i] != 0;
    result[i].conserved = result[i].angle <= (differences ? suspicious_angle_differences : suspicious_angle);
  }
  return Outcome::ok;
}

/// The finding of `confirm` where differences with other increments say the same. Where they are too coarse to tell,
/// none; where they contradict a Jacobian that is none of differences, that is wrong: a complex step of a function that
/// is not analytic here is given up, a user's is the finding.
Finding Guard::unless_uncertain(const Finding& finding, double t, double h) {
  const Linearization at = projector_.linearization();
  const std::size_t n = invariants_.n();
  const auto i = static_cast<std::size_t>(finding.invariant);
  const double* J = at.jacobian.data();
  if (invariants_.difference_jacobian(t, point_.data(), halved_.data(), true, 0.5) == Status::stop) return stopped();
  if (invariants_.time_derivative(t, h, point_.data(), J, gt_.data(), 0.5) == Status::stop) return stopped();
  const double rate = gt_[i] + dot(halved_.data() + i * n, f_value_.data(), n);
  if (std::abs(rate) > uncertainty * std::abs(rate - finding.size)) return finding;
  if (invariants_.by_differences(i) || invariants_.leave_complex_steps(i)) return {};
  return worst_entry(t, point_.data());
}

/// The invariant with the largest angle ρ_i = |g_t + J_i f| / (|g_t| + ‖J_i W‖ ‖W⁻¹ f‖) among those whose drift
/// D_i = |h| |g_t + J_i f| / ‖J_i W‖ counts too, and is not what roundoff makes of differences. `formed`: g_t is one.
Finding Guard::suspect(const Linearization& at, double t, const double* f, double h, bool formed) {
  const std::size_t n = invariants_.n();
  const double speed = weighted_norm(f, at.weights.data(), n);
  const double *y = at.y.data(), *J = at.jacobian.data();
  Finding worst;
  for (std::size_t i = 0; i < invariants_.m(); ++i) {
    if (invariants_.certain(i)) continue;
    const bool differences = gt_[i] != 0 || invariants_.by_differences(i);
    const double limit = differences ? suspicious_angle_differences : suspicious_angle;
    const double rate = gt_[i] + dot(J + i * n, f, n);
    const double angle = std::abs(rate) / (std::abs(gt_[i]) + at.row_norm[i] * speed);
    const bool drifts = std::abs(h * rate) > suspicious_drift * weights_.rtol() * at.row_norm[i];
    const bool suspicious = angle > limit && drifts && angle > worst.distance;
    if (!suspicious) continue;
    double noise = invariants_.roundoff_of_rate(i, y, J, f);
    if (formed)  // t has roundoff too
      noise +=
          (invariants_.roundoff(i, y, J) + roundoff_in_t * std::abs(t * gt_[i])) / Invariants::time_increment(t, h);
    if (std::abs(rate) > noise)
      worst = {.kind = Finding::Kind::not_conserved,
               .invariant = static_cast<int>(i),
               .t = t,
               .size = rate,
               .distance = angle};
  }
  return worst;
}

}  // namespace invariode
