#pragma once
// What the projection and the guard compute of one invariant and its gradient J, in the weights w (docs/algorithms.md,
// 'Projection', 'Guard'): of doubles, or of packs of them, one trajectory in each lane.

#include <cstddef>

#include "linear/rows.hpp"
#include "manifold/thresholds.hpp"
#include "number.hpp"
#include "weights.hpp"

namespace invariode {

/// s_j = max(|y_j|, min(thr_j, max_i |y_i|)): sizes of the components for increments.
template <class Real>
void take_sizes(const Real* y, const double* threshold, std::size_t n, Real* size) {
  Real largest(0);
  for (std::size_t j = 0; j < n; ++j) largest = larger(largest, absolute(y[j]));
  largest = choose(largest < Real(smallest_scale), Real(1), largest);
  for (std::size_t j = 0; j < n; ++j) {
    const double thr = threshold[j];
    const Real a = absolute(y[j]);
    const Real least = thr < smallest_scale ? choose(a < Real(smallest_scale), largest, Real(0))  // pure relative
                                            : smaller(Real(thr), largest);
    size[j] = larger(a, least);
  }
}

/// |value| + Σ_j |J_j y_j|: the size of what g sums.
template <class Real>
Real size_of_terms(const Real& value, const RowOf<Real>& gradient, const Real* y) {
  Real size = absolute(value);
  gradient.for_each([&](std::size_t j, const Real& J) { size += absolute(J * y[j]); });
  return size;
}
/// Size below which a residual is roundoff.
template <class Real>
Real roundoff_of_terms(const Real& value, const RowOf<Real>& gradient, const Real* y) {
  return (roundoff_of_g * eps) * size_of_terms(value, gradient, y);
}

template <class Real>
Real sum_of_squares(const Real* v, std::size_t n) {
  Real sum(0);
  for (std::size_t j = 0; j < n; ++j) sum += v[j] * v[j];
  return sum;
}
/// ‖W⁻¹ v‖
template <class Real>
Real weighted_norm(const Real* v, const Real* w, std::size_t n) {
  Real sum(0);
  for (std::size_t j = 0; j < n; ++j) sum += (v[j] / w[j]) * (v[j] / w[j]);
  return square_root(sum);
}

// ------------------------------------------------------------------------------------------------------ the correction

/// δ = W u d, u (n,) the unit vector along J W, d = r / ‖J W‖.
template <class Real>
void correction(const Real* w, const Real* u, const Real& d, std::size_t n, Real* delta) {
  for (std::size_t j = 0; j < n; ++j) delta[j] = w[j] * (u[j] * d);
}

/// Relative change of the length of a gradient.
template <class Real>
Real bend(const Real& length, const Real& before) {
  return larger(length / before, before / length) - Real(1);
}

/// Returns whether gradients that have bent so much, in the step from `from` to y, may change in the correction by as
/// much as they are.
template <class Real>
auto bends_sharply(const Real& bent, const Real* from, const Real* y, const Real* delta, std::size_t n) {
  auto sharp = Real(sharp_bend) < bent;
  for (std::size_t j = 0; j < n; ++j)
    sharp = sharp | (bend_of_correction * absolute(y[j] - from[j]) < bent * absolute(delta[j]));
  return sharp;
}

// ----------------------------------------------------------------------------------------------------------- the guard

/// The test of a Jacobian along a direction, in units of the sizes: J · direction, and the size of its terms.
template <class Real>
struct Directional {
  Real expected{0}, terms{0};

  template <class Direction>
  Directional(const RowOf<Real>& gradient, const Real* size, Direction direction) {
    gradient.for_each([&](std::size_t j, const Real& J) {
      const Real term = direction(j) * (J * size[j]);
      expected += term;
      terms += absolute(term);
    });
  }
  /// Returns whether a difference quotient contradicts the rate. `increment`: of the differences; `roundoff`: of g.
  [[nodiscard]] auto contradicted(const Real& quotient, const Real& roundoff, double increment) const {
    const Real allowed = jacobian_tolerance * larger(terms, absolute(quotient)) + roundoff / Real(increment);
    return allowed < absolute(quotient - expected);
  }
};

/// Returns whether a rate of change counts, in a step or in the whole interval. `tolerated`: rtol ‖J W‖.
template <class Real>
auto drifts(const Real& rate, const Real& h, double interval, const Real& tolerated) {
  const auto in_step = suspicious_drift * tolerated < absolute(h * rate);
  const auto in_interval = harmful_drift * tolerated < absolute(interval * rate);
  return in_step | in_interval;
}

}  // namespace invariode
