#pragma once
// The initial step size, from the scale that a method has found for it. (The loop replaces it by the option
// `first_step`.)

#include <limits>

#include "number.hpp"
#include "step.hpp"

namespace invariode {

/// On an infinite interval with f = 0 at the start nothing sets a scale: h is this part of max(1, |t|).
inline constexpr double step_without_scale = 1e-3;
/// The first step is at most this part of the interval, the default hmax of the suite: a longer one may see f where t₀
/// and t_f are alike, as at the ends of a period, and nowhere else.
inline constexpr double first_part = 0.1;

/// 1 / reciprocal, at most hmax and that part of the interval from t to tf, and at least hmin.
template <class Real>
Real initial_step(const Real& reciprocal, const Real& t, double tf, double hmax, const Real& hmin) {
  const Real longest = smaller(Real(hmax), first_part * absolute(Real(tf) - t));
  const Real h = choose(Real(1) < longest * reciprocal, Real(1) / reciprocal, longest);
  const Real instead = step_without_scale * larger(Real(1), absolute(t));
  return larger(choose(h < Real(std::numeric_limits<double>::infinity()), h, instead), hmin);
}
inline double initial_step(double reciprocal, double t, const Step::Span& span) {
  return initial_step(reciprocal, t, span.tf, span.hmax, span.hmin);
}

}  // namespace invariode
