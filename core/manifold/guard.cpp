#include "manifold/guard.hpp"

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>
#include <utility>

#include "linear/scattered.hpp"
#include "manifold/gradient.hpp"

namespace invariode {
namespace {

// Thresholds from the campaigns of tests/fuzz (docs/algorithms.md, 'Guard'), beside those of thresholds.hpp.
constexpr double persistent_angle = 1e-12;    // ρ of g along the flow, which has to persist at points nearby
constexpr double errors_of_derivatives = 50;  // ρ with others, in units of their relative error
constexpr double roundoff_in_t = 10 * eps;    // of t, as of all that g computes
constexpr double factors_of_increments[] = {1, 1.0 / 16, 1.0 / 256};  // with which an entry must be wrong
// A difference quotient tells nothing below this multiple of what halving its increment changes.
constexpr double uncertainty = 10;
// A rate is no roundoff if at so many points this far away, in units of the components' sizes, it is of the same sign
// and no two differ by more than a factor of 2: of 8 random numbers that is true once in 1e6 times.
constexpr int nearby_points = 7;
constexpr double nearby = 1e-7;
constexpr double same_rate = 2;
constexpr double same_rate_of_slopes = 10;  // where y' itself is not good to roundoff
// What is left of a residual where its point is near enough to the manifold to compare rates before and after.
constexpr double sufficient_gain = 1e-2;
// Extrapolation of the derivative along the flow (Ridders, Adv. Eng. Software 4 (1982) 75): 32 h, 16 h, …, h/32. Steps
// of tight tolerances are much shorter than what g needs.
constexpr double longest_flow = 32;
constexpr int fewest_extrapolations = 6, extrapolations = 11;
constexpr int shorter_flows = 8;             // where g is not defined so far away h is a tenth, so many times
constexpr std::int64_t longest_trust = 256;  // steps from one look along the flow to the next, at most

Finding stopped() { return {.kind = Finding::Kind::stop}; }

}  // namespace

double Guard::direction(std::size_t j) { return (j % 2 == 0 ? 1 : -1) * (0.5 + spread(j)); }

Guard::Guard(const Projector& steps, const Weights& weights, Slope& slope, double interval)
    : interval_(interval),
      invariants_(steps.invariants()),
      weights_(weights),
      slope_(slope),
      projector_(invariants_, weights, 1, 0, &steps),
      point_(invariants_.n()),
      moved_(invariants_.n()),
      f_value_(invariants_.n()),
      gt_(invariants_.m()),
      plus_(invariants_.m()),
      minus_(invariants_.m()) {}

Finding Guard::start_value(double t, double* y) {
  const Linearization& at = projector_.linearization();
  projected_start_ = false;
  const Outcome outcome = projector_.linearize_at(t, y);
  if (outcome == Outcome::stop) return stopped();
  if (outcome == Outcome::not_finite) return undefined(t);
  bool off = false;
  Finding worst;
  for (std::size_t i = 0; i < invariants_.m(); ++i) {
    const double r = at.r[i];
    const double excess = invariants_.excess(i, r);
    if (excess <= invariants_.roundoff(i, y, at.J.data())) continue;
    off = true;
    const double distance = excess / at.norm[i] / weights_.rtol();
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
  const Linearization& at = projector_.linearization();
  std::size_t i = 0;
  while (i + 1 < invariants_.m() && std::isfinite(at.r[i]) && all_finite(at.gradient(i).values, at.gradient(i).size))
    ++i;
  return {.kind = Finding::Kind::undefined, .invariant = static_cast<int>(i), .t = t};
}

Finding Guard::start_jacobian(double t, const double* y) {
  const Linearization& at = projector_.linearization();
  const std::size_t n = invariants_.n(), m = invariants_.m();
  if (invariants_.all_by_differences()) return {};
  const double* J = at.J.data();
  const double* size = invariants_.sizes(y);
  for (std::size_t j = 0; j < n; ++j) point_[j] = y[j] + cbrt_eps * size[j] * direction(j);
  if (invariants_.residual(t, point_.data(), plus_.data()) == Status::stop) return stopped();
  for (std::size_t j = 0; j < n; ++j) point_[j] = y[j] - cbrt_eps * size[j] * direction(j);
  if (invariants_.residual(t, point_.data(), minus_.data()) == Status::stop) return stopped();
  for (std::size_t i = 0; i < m; ++i) {
    if (invariants_.by_differences(i) || invariants_.untested(i)) continue;
    const Directional<double> along(at.gradient(i), size, direction);
    const double quotient = (plus_[i] - minus_[i]) / (2 * cbrt_eps);
    if (along.contradicted(quotient, invariants_.roundoff(i, y, J), cbrt_eps)) return worst_entry(t, y);
  }
  return {};
}

/// The directional test failed somewhere: which entry is farthest off, in units of its row's terms? With smaller
/// increments too: the first ones may reach over a pole.
Finding Guard::worst_entry(double t, const double* y) {
  Finding worst;
  for (const double factor : factors_of_increments) {
    worst = worst_entry(t, y, factor);
    if (worst.kind != Finding::Kind::wrong_jacobian) break;
  }
  return worst;
}

Finding Guard::worst_entry(double t, const double* y, double factor) {
  const Linearization& at = projector_.linearization();
  const std::size_t n = invariants_.n(), m = invariants_.m();
  differences_.resize(m * n);
  halved_.resize(m * n);
  if (invariants_.difference_jacobian(t, y, differences_.data(), factor) == Status::stop) return stopped();
  if (invariants_.difference_jacobian(t, y, halved_.data(), factor / 2) == Status::stop) return stopped();
  const double* J = at.J.data();
  const double* size = invariants_.sizes(y);
  Finding worst;
  double largest = 0;
  for (std::size_t i = 0; i < m; ++i) {
    if (invariants_.untested(i)) continue;
    double terms = 0;
    for (std::size_t j = 0; j < n; ++j)
      terms =
          std::max({terms, std::abs(at.gradient(i).entry(j) * size[j]), std::abs(differences_[i * n + j] * size[j])});
    const double noise = invariants_.roundoff(i, y, J) / (factor * cbrt_eps);
    for (std::size_t j = 0; j < n; ++j) {
      const double given = at.gradient(i).entry(j), quotient = halved_[i * n + j];
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

/// Finds out whether g changes with t alone, at a point near y0 (at y0 itself where g is not defined nearby). It may
/// begin to do so later: `rate` continues to test this.
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

bool Guard::Pause::asks(std::int64_t steps, double size) const {
  return steps >= until || size > much_larger * acquitted;
}

void Guard::Pause::begin(std::int64_t steps, double size) {
  until = steps + std::clamp<std::int64_t>(steps, 1, longest_pause);
  acquitted = size;
}

Finding Guard::start_rate(double t, const double* y, const double* f, double h) {
  if (detect_time_dependence(t, y, h) == Outcome::stop) return stopped();
  return rate(projector_.linearization(), t, f, h, 0);
}

Finding Guard::rate(const Linearization& at, double t, const double* f, double h, std::int64_t steps) {
  assert(std::isfinite(h) && h != 0 && at.m() == invariants_.m());
  if (const Finding seen = look_along_flow(at, t, f, h, steps); seen.kind != Finding::Kind::none) return seen;
  const std::size_t n = invariants_.n();
  std::fill(gt_.begin(), gt_.end(), 0);
  const double* y = at.y.data();
  const bool look = steps >= next_look_;
  if (look) next_look_ = steps + std::clamp<std::int64_t>(steps / 2, 1, longest_pause);
  if ((time_dependent_ || look) && invariants_.time_derivative(t, h, y, at.J.data(), gt_.data()) == Status::stop)
    return stopped();
  time_dependent_ = time_dependent_ || changes_with_time();
  const Finding suspicion = suspect(at, t, f, h);
  if (suspicion.kind == Finding::Kind::none || !of_rates_.asks(steps, suspicion.drift)) return {};
  bool acquitted = false;
  Finding confirmed = acquitted_here(at, t, h, acquitted);
  if (!acquitted && confirmed.kind == Finding::Kind::none) {
    std::copy(y, y + n, point_.begin());
    confirmed = confirm(t, point_.data(), h);
  }
  if (confirmed.kind == Finding::Kind::none) of_rates_.begin(steps, suspicion.drift);
  return confirmed;
}

/// A method's slope belongs to another point than the linearization, or is not quite f. With f where the linearization
/// is, an invariant that holds beside the manifold too has no rate.
Finding Guard::acquitted_here(const Linearization& at, double t, double h, bool& acquitted) {
  if (slope_.evaluate(t, at.y.data(), h, f_value_.data()) == Status::stop) return stopped();
  acquitted =
      all_finite(f_value_.data(), f_value_.size()) && suspect(at, t, f_value_.data(), h).kind == Finding::Kind::none;
  return {};
}

Finding Guard::corrected(double correction, double t, const double* y, double h, std::int64_t steps) {
  if (!(correction > suspicious_correction * weights_.rtol()) || !of_corrections_.asks(steps, correction)) return {};
  of_corrections_.begin(steps, correction);
  return confirm(t, y, h);
}

Finding Guard::violated(double t, const double* y, double h, std::int64_t steps) {
  if (!of_violations_.asks(steps, 0)) return {};
  of_violations_.begin(steps, 0);
  return confirm(t, y, h);
}

bool Guard::changes_with_time() const {
  return std::any_of(gt_.begin(), gt_.end(), [](double g) { return g != 0; });
}

Finding Guard::confirm(double t, const double* y, double h) {
  if (y != point_.data()) std::copy(y, y + point_.size(), point_.begin());
  original_ = point_;
  const Imposed imposed = projector_.approach(t, point_.data());
  if (imposed.outcome == Outcome::stop) return stopped();
  if (imposed.converged) return confirm_at_point(t, h);
  if (!(imposed.gain <= sufficient_gain)) return {};
  // Nearer to the manifold, though not to roundoff: rates that are due to the distance fall with it.
  const Finding near = confirm_at_point(t, h);
  if (near.kind != Finding::Kind::not_conserved) return near;
  std::swap(point_, original_);
  const Outcome outcome = evaluate_rates(t, h);
  if (outcome == Outcome::stop) return stopped();
  const auto i = static_cast<std::size_t>(near.invariant);
  return outcome == Outcome::ok && std::abs(rate_here(i)) > same_rate * std::abs(near.size) ? Finding{} : near;
}

/// The test of `confirm` at the point as it is.
Finding Guard::confirm_at_point(double t, double h) {
  const Outcome outcome = evaluate_rates(t, h);
  if (outcome == Outcome::stop) return stopped();
  if (outcome == Outcome::not_finite) return {};
  time_dependent_ = time_dependent_ || changes_with_time();
  const Finding finding = suspect(projector_.linearization(), t, f_value_.data(), h);
  return finding.kind == Finding::Kind::none ? finding : unless_uncertain(finding, t, h);
}

/// J, f and g_t at the point.
Outcome Guard::evaluate_rates(double t, double h) {
  if (const Outcome outcome = projector_.linearize_at(t, point_.data()); outcome != Outcome::ok) return outcome;
  if (slope_.evaluate(t, point_.data(), h, f_value_.data()) == Status::stop) return Outcome::stop;
  if (!all_finite(f_value_.data(), f_value_.size())) return Outcome::not_finite;
  const double* J = projector_.linearization().J.data();
  if (invariants_.time_derivative(t, h, point_.data(), J, gt_.data()) == Status::stop) return Outcome::stop;
  return Outcome::ok;
}

double Guard::rate_here(std::size_t i) const {
  return gt_[i] + projector_.linearization().gradient(i).dot(f_value_.data());
}

/// A time in which the solution through (t, y) changes as its components' sizes tell, where no step does.
double Guard::scale_of_time(double t, const double* y, const double* f) {
  constexpr double part = 0.1;  // of that time, as a step would be
  const double* size = invariants_.sizes(y);
  double fastest = 0;
  for (std::size_t j = 0; j < invariants_.n(); ++j)
    if (f[j] != 0) fastest = std::max(fastest, std::abs(f[j]) / size[j]);
  if (fastest > 0) return part / fastest;
  return t != 0 ? part * std::abs(t) : part;
}

Outcome Guard::examine(double t, const double* y, std::vector<Examination>& result) {
  const Linearization& at = projector_.linearization();
  const std::size_t n = invariants_.n(), m = invariants_.m();
  result.assign(m, {});
  if (const Outcome outcome = projector_.linearize_at(t, y); outcome != Outcome::ok) return outcome;
  for (std::size_t i = 0; i < m; ++i) {
    result[i].residual = at.r[i];
    result[i].gradient = at.norm[i];
    result[i].distance = at.distance(i) / weights_.rtol();
  }
  if (slope_.evaluate(t, y, ulp(t), f_value_.data()) == Status::stop) return Outcome::stop;
  if (!all_finite(f_value_.data(), n)) return Outcome::not_finite;
  const double h = scale_of_time(t, y, f_value_.data());
  std::copy(y, y + n, point_.begin());
  if (projector_.impose(t, point_.data()).outcome == Outcome::stop) return Outcome::stop;
  moved_ = point_;  // projecting once more shows what is left out
  if (projector_.project(t, point_.data(), moved_.data()).outcome == Outcome::stop) return Outcome::stop;
  if (const Outcome outcome = evaluate_rates(t, h); outcome != Outcome::ok) return outcome;
  const double speed = weighted_norm(f_value_.data(), at.w.data(), n);
  for (std::size_t i = 0; i < m; ++i) {
    const double terms = std::abs(gt_[i]) + at.norm[i] * speed;
    result[i].rate = rate_here(i);
    result[i].angle = terms > 0 ? std::abs(result[i].rate) / terms : 0;
    result[i].detectable = limit(i);
    result[i].redundant = projector_.left_out(i);
    result[i].conserved = result[i].angle <= limit(i) || !invariants_.contradicts(i, result[i].rate);
  }
  for (std::size_t i = 0; i < m; ++i) {
    if (result[i].conserved) continue;
    bool persistent = false;
    if (persists(i, t, h, result[i].rate, persistent) == Outcome::stop) return Outcome::stop;
    result[i].conserved = !persistent;
  }
  return Outcome::ok;
}

/// The derivative along the flow from t − `back` to t + `ahead`: of length s on both sides or on one,
/// (g_i(t + ahead, y + ahead f) − g_i(t − back, y − back f)) / (ahead + back).
Outcome Guard::flow_difference(std::size_t i, double t, const double* y, const double* f, const Invariants::Reach& s,
                               double& quotient) {
  const std::size_t n = invariants_.n();
  const double later = t + s.ahead, earlier = t - s.back;  // y moves by what is left of s in these
  for (std::size_t j = 0; j < n; ++j) moved_[j] = y[j] + (later - t) * f[j];
  if (invariants_.residual(later, moved_.data(), plus_.data()) == Status::stop) return Outcome::stop;
  for (std::size_t j = 0; j < n; ++j) moved_[j] = y[j] - (t - earlier) * f[j];
  if (invariants_.residual(earlier, moved_.data(), minus_.data()) == Status::stop) return Outcome::stop;
  quotient = (plus_[i] - minus_[i]) / (later - earlier);
  return std::isfinite(quotient) ? Outcome::ok : Outcome::not_finite;
}

/// Richardson's extrapolation of differences, central ones, or one-sided ones at an edge of the piece, whose errors
/// have odd powers of s too. They begin long, for less roundoff: with the time in which a
/// component changes by a tenth of its size, between h / 32 and 32 h, so that no population becomes negative. An entry
/// of the table is never better than the roundoff of its shortest difference.
Guard::FlowRate Guard::flow_rate(std::size_t i, double t, const double* y, const double* J, const double* f, double h) {
  double row[extrapolations] = {};
  FlowRate best{.outcome = Outcome::ok, .error = std::numeric_limits<double>::infinity()};
  const double roundoff = invariants_.roundoff(i, y, J);
  double s = std::clamp(scale_of_time(t, y, f), std::abs(h) / longest_flow, longest_flow * std::abs(h));
  Invariants::Reach reach = invariants_.reach(t, s);
  const double base = reach.one_sided() ? 2 : 4;
  s = std::max(reach.back, reach.ahead);
  if (s == 0) return {.outcome = Outcome::not_finite};  // the piece is one point
  int k = 0, shorter = 0;
  while (k < extrapolations && (k < fewest_extrapolations || s > std::abs(h) / longest_flow)) {
    double next = 0;
    const Outcome outcome = flow_difference(i, t, y, f, reach, next);
    if (outcome == Outcome::stop) return {.outcome = outcome};
    if (outcome == Outcome::not_finite) {
      if (k > 0 || ++shorter > shorter_flows) return {.outcome = outcome};
      s /= 10;
      reach = {reach.back / 10, reach.ahead / 10};
      continue;
    }
    double factor = 1;
    for (int l = 0; l <= k; ++l) {
      const double previous = std::exchange(row[l], next);
      if (l == k) break;
      factor *= base;
      next = (factor * row[l] - previous) / (factor - 1);
      const double error = std::max({std::abs(next - row[l]), std::abs(next - previous), roundoff / s});
      if (error < best.error) best.rate = next, best.error = error;
    }
    ++k;
    s /= 2;
    reach = {reach.back / 2, reach.ahead / 2};
  }
  return best;
}

/// Tests whether invariant i changes at about this rate at the point and at others nearby on the manifold, each time by
/// g along the flow. Roundoff, of f, g or the projection, would change from one to the other.
Outcome Guard::persists(std::size_t i, double t, double h, double rate, bool& persistent) {
  persistent = false;
  const std::size_t n = invariants_.n();
  double least = std::abs(rate), largest = std::abs(rate);
  std::vector<double> f(f_value_);
  const double* J = projector_.linearization().J.data();
  for (int k = 0; k <= nearby_points; ++k) {
    nearby_ = point_;
    const double at = t + k * nearby * h;
    if (k > 0) {
      const double* size = invariants_.sizes(point_.data());
      for (std::size_t j = 0; j < n; ++j)
        nearby_[j] += nearby * size[j] * direction(static_cast<std::size_t>(k) * n + j);
      if (projector_.approach(at, nearby_.data()).outcome == Outcome::stop) return Outcome::stop;
      if (slope_.evaluate(at, nearby_.data(), h, f.data()) == Status::stop) return Outcome::stop;
      if (!all_finite(f.data(), n)) return Outcome::not_finite;
    }
    const FlowRate flow = flow_rate(i, at, nearby_.data(), J, f.data(), h);
    if (flow.outcome != Outcome::ok) return flow.outcome;
    if (!(std::abs(flow.rate) > uncertainty * flow.error) || std::signbit(flow.rate) != std::signbit(rate))
      return Outcome::ok;
    least = std::min(least, std::abs(flow.rate));
    largest = std::max(largest, std::abs(flow.rate));
  }
  persistent = largest <= (slope_.relative_error() > 0 ? same_rate_of_slopes : same_rate) * least;
  return Outcome::ok;
}

/// The finding of `confirm` where g along the flow, without any Jacobian, says the same. Where it is too coarse to
/// tell, none; where it contradicts a Jacobian that does not come from differences, the Jacobian is wrong: a complex
/// step of a function that is not analytic here is given up, a user's is the finding.
Finding Guard::unless_uncertain(const Finding& finding, double t, double h) {
  const auto i = static_cast<std::size_t>(finding.invariant);
  const FlowRate flow = flow_rate(i, t, point_.data(), projector_.linearization().J.data(), f_value_.data(), h);
  if (flow.outcome == Outcome::stop) return stopped();
  if (flow.outcome == Outcome::not_finite) return {};
  const double off = std::abs(flow.rate - finding.size);
  if (std::abs(finding.size) > uncertainty * off) {
    bool persistent = false;
    if (persists(i, t, h, finding.size, persistent) == Outcome::stop) return stopped();
    return persistent ? finding : Finding{};
  }
  const double noise = noise_in_time(projector_.linearization(), i, t, h);
  if (off <= uncertainty * flow.error + noise || invariants_.by_differences(i)) return {};
  if (invariants_.abandon_complex_steps(i)) return {};
  return worst_entry(t, point_.data());
}

/// ρ above which invariant i is suspected: what roundoff and the errors of derivatives leave of a rate that is 0.
double Guard::limit(std::size_t i) const {
  double error = slope_.relative_error();
  if (invariants_.by_differences(i)) error = std::max(error, invariants_.relative_error_of_derivatives());
  if (gt_[i] != 0) error = std::max(error, cbrt_eps * cbrt_eps);
  return std::max(suspicious_angle, errors_of_derivatives * error);
}

/// Returns the error in g_t by roundoff of g and of t, where g changes with t.
double Guard::noise_in_time(const Linearization& at, std::size_t i, double t, double h) const {
  if (!time_dependent_) return 0;
  const double roundoff = invariants_.roundoff(i, at.y.data(), at.J.data());
  return (roundoff + roundoff_in_t * std::abs(t * gt_[i])) / invariants_.resolution_in_time(t, h);
}

/// Returns whether a rate of invariant i counts, in a step or in the whole interval.
bool Guard::drifts(const Linearization& at, std::size_t i, double rate, double h) const {
  return invariode::drifts(rate, h, std::isfinite(interval_) ? interval_ : 0, weights_.rtol() * at.norm[i]);
}

/// Returns whether the derivatives of invariant i hide rates that count, though g itself does not.
bool Guard::blind(const Linearization& at, std::size_t i, double t, const double* f, double h) {
  if (invariants_.untested(i) || slope_.relative_error() > 0 || limit(i) <= suspicious_angle) return false;
  const double hidden = limit(i) * at.norm[i] * weighted_norm(f, at.w.data(), at.n()) +
                        invariants_.roundoff_of_rate(i, at.y.data(), at.J.data(), f) + noise_in_time(at, i, t, h);
  return drifts(at, i, hidden, h);
}

/// The test of `suspect` at the point, for those whose derivatives are blind, by g along the flow.
Finding Guard::suspect_along_flow(const Linearization& at, double t, double h) {
  const double* f = f_value_.data();
  const double speed = weighted_norm(f, at.w.data(), at.n());
  Finding worst;
  for (std::size_t i = 0; i < invariants_.m(); ++i) {
    if (!blind(at, i, t, f, h)) continue;
    const FlowRate flow = flow_rate(i, t, point_.data(), at.J.data(), f, h);
    if (flow.outcome == Outcome::stop) return stopped();
    if (flow.outcome != Outcome::ok || !(std::abs(flow.rate) > uncertainty * flow.error)) continue;
    if (!invariants_.contradicts(i, std::copysign(1.0, h) * flow.rate)) continue;
    const double angle = std::abs(flow.rate) / (std::abs(gt_[i]) + at.norm[i] * speed);
    if (angle > std::max(persistent_angle, worst.distance) && drifts(at, i, flow.rate, h))
      worst = {.kind = Finding::Kind::not_conserved,
               .invariant = static_cast<int>(i),
               .t = t,
               .size = flow.rate,
               .distance = angle};
  }
  return worst;
}

/// Tests, in steps 1, 4, 16, 64, 256, 512, 768, …, where derivatives are blind: g along the flow where the
/// linearization is, and what is then suspected, on the manifold.
Finding Guard::look_along_flow(const Linearization& at, double t, const double* f, double h, std::int64_t steps) {
  if (steps < next_flow_) return {};
  next_flow_ = steps + std::min(3 * steps, longest_trust);
  bool any = false;
  for (std::size_t i = 0; i < invariants_.m(); ++i) any = any || blind(at, i, t, f, h);
  if (!any) return {};
  std::copy(at.y.begin(), at.y.end(), point_.begin());
  if (slope_.evaluate(t, point_.data(), h, f_value_.data()) == Status::stop) return stopped();
  if (!all_finite(f_value_.data(), f_value_.size())) return {};
  if (const Finding first = suspect_along_flow(at, t, h); first.kind != Finding::Kind::not_conserved) return first;
  const Imposed imposed = projector_.approach(t, point_.data());
  const Outcome outcome = imposed.outcome == Outcome::ok ? evaluate_rates(t, h) : imposed.outcome;
  if (outcome == Outcome::stop) return stopped();
  if (outcome == Outcome::not_finite || !imposed.converged) return {};
  const Finding found = suspect_along_flow(projector_.linearization(), t, h);
  if (found.kind != Finding::Kind::not_conserved) return found;
  bool persistent = false;
  if (persists(static_cast<std::size_t>(found.invariant), t, h, found.size, persistent) == Outcome::stop)
    return stopped();
  return persistent ? found : Finding{};
}

/// The invariant with the largest angle ρ_i = |g_t + J_i f| / (|g_t| + ‖J_i W‖ ‖W⁻¹ f‖) among those whose drift
/// D_i = |h| |g_t + J_i f| / ‖J_i W‖ counts too, in a step or in the whole interval, and is not what roundoff makes of
/// differences.
Finding Guard::suspect(const Linearization& at, double t, const double* f, double h) {
  const std::size_t n = invariants_.n();
  const double speed = weighted_norm(f, at.w.data(), n);
  const double *y = at.y.data(), *J = at.J.data();
  Finding worst;
  double largest_drift = 0;
  for (std::size_t i = 0; i < invariants_.m(); ++i) {
    if (invariants_.untested(i)) continue;
    const double rate = gt_[i] + at.gradient(i).dot(f);
    if (!invariants_.contradicts(i, std::copysign(1.0, h) * rate)) continue;
    const double angle = std::abs(rate) / (std::abs(gt_[i]) + at.norm[i] * speed);
    const bool drifts = this->drifts(at, i, rate, h);
    const bool suspicious = angle > limit(i) && drifts;
    if (!suspicious) continue;
    if (!(std::abs(rate) > invariants_.roundoff_of_rate(i, y, J, f) + noise_in_time(at, i, t, h))) continue;
    largest_drift = std::max(largest_drift, std::abs(h * rate) / (weights_.rtol() * at.norm[i]));
    if (angle > worst.distance)
      worst = {.kind = Finding::Kind::not_conserved,
               .invariant = static_cast<int>(i),
               .t = t,
               .size = rate,
               .distance = angle};
  }
  worst.drift = largest_drift;
  return worst;
}

}  // namespace invariode
