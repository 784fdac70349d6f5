#pragma once
// How explicit pairs choose |h|. The numbers are doubles, or packs of them, one trajectory in each lane.

#include <limits>

#include "number.hpp"

namespace invariode::runge_kutta {

inline constexpr double safety = 0.8;        // of the predicted optimal step; 1/1.25 on success
inline constexpr double largest_growth = 5;  // of h after a success
/// Errors that are a smaller part of the tolerance count as this one, with which h grows by the maximum factor.
inline constexpr double smallest_ratio = 0x1p-28;

/// Memory of the last accepted step. Its rate is 1/|h| of the step whose error would have been the
/// tolerance.
template <class Real>
struct Trend {
  Real rate{std::numeric_limits<double>::infinity()};  ///< infinite: there was no step
  Real growth{1};                                      ///< of the rate, from the step before
};

/// |h| after a success without failures before it, `root` = (error / rtol)^{1/q}.
template <class Real>
Real grown(const Real& h, const Real& root) {
  const Real tau = root / Real(safety);
  return choose(Real(1 / largest_growth) < tau, h / tau, largest_growth * h);
}

/// |h| after a success of the pair T, `root` as above, which becomes the last step of `trend`. `retried`: where an
/// attempt of the step had failed.
///
/// Pairs that predict expect a rate that grew in the last two steps to grow again, as much as in the last one
/// (Gustafsson's predictive controller, ACM Trans. Math. Softw. 20 (1994) 496-517; Hairer & Wanner, Solving ODEs II,
/// section IV.8). Where stability limits the steps, errors rise and fall from step to step, and none is predicted.
template <const auto& T, class Real, class Mask>
Real next_h(const Real& h, const Real& root, const Mask& retried, Trend<Real>& trend) {
  if constexpr (!T.predicts) return choose(retried, h, grown(h, root));
  const Trend<Real> last = trend;
  trend.rate = root / h;
  trend.growth = trend.rate / last.rate;
  const Real expected = choose(Real(1) < last.growth, larger(Real(1), trend.growth), Real(1));
  const Real next = larger(T.floor * h, grown(h, root * expected));
  return choose(retried, smaller(h, next), next);
}

/// Returns the factor of |h| after the first failure of a step, `root` = (rtol / error)^{1/q}.
template <class Real>
Real cut(const Real& root, double floor) {
  return larger(Real(floor), safety * root);
}
/// The factor of |h| after further failures of a step.
inline constexpr double halved = 0.5;

}  // namespace invariode::runge_kutta
