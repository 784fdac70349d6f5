#pragma once
// The initial step size, from the scale that a method has found for it, and where f at the start gives none, from f
// beside it. (The loop replaces it by the option `first_step`.)

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <utility>
#include <vector>

#include "archive.hpp"
#include "callback.hpp"
#include "number.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// On an infinite interval with f = 0 at the start nothing sets a scale: h is this part of max(1, |t|).
inline constexpr double step_without_scale = 1e-3;
/// The first step is at most this part of the interval, the default hmax of the suite: a longer one may see f where t₀
/// and t_f are alike, as at the ends of a period, and nowhere else.
inline constexpr double first_part = 0.1;

/// 1 / reciprocal, at most hmax and that part of the interval from t to tf. It may be shorter than t can represent.
template <class Real>
Real initial_step(const Real& reciprocal, const Real& t, double tf, double hmax) {
  const Real longest = smaller(Real(hmax), first_part * absolute(Real(tf) - t));
  const Real h = choose(Real(1) < longest * reciprocal, Real(1) / reciprocal, longest);
  const Real instead = step_without_scale * larger(Real(1), absolute(t));
  return choose(h < Real(std::numeric_limits<double>::infinity()), h, instead);
}
inline double initial_step(double reciprocal, double t, const Step::Span& span) {
  return initial_step(reciprocal, t, span.tf, span.hmax);
}

// ------------------------------------------------------------------------------------------------------ starts at rest
//
// Where f₀ is 0, or so small that it would allow a first step over all of the interval, f may be about to change on any
// scale: y' = t exp(-t/τ) is at rest at t = 0, and over long before the end of a step. f is then looked at beside the
// start, at distances δ that grow up to the step, along the tangent, and
//
//   1/h = 1.25 √(½ ‖y'(t + δ, y + δ y') − y'‖ / (δ rtol)),
//
// the rule that ode15s has for y'', at the largest of these quotients: what moves y by its tolerance within the step is
// not passed over (tests/test_first_step.py). Implicit methods, which evaluate f beside the start in any case, look
// there before the first attempt; explicit ones when it has passed the error test: where it fails, f has been seen.

inline constexpr double rest_safety = 1.25;      // of the suite's 1/h
inline constexpr double nearest_look = 0x1p-26;  // √ε, of the step that nothing limits: the first δ
inline constexpr double nearest_spacings = 16;   // of t, at least
inline constexpr double growth_of_look = 100;    // of δ from one look to the next
inline constexpr double farthest_look = 0.5;     // of that step: beyond, attempts see f themselves

/// Returns whether the reciprocal from f₀ limits the first step to less than the interval (of an infinite one: is not
/// 0). Otherwise the start is at rest.
template <class Real>
auto gives_scale(const Real& reciprocal, const Real& t, double tf) {
  return Real(1) < absolute(Real(tf) - t) * reciprocal;
}

/// The reciprocal that follows from the quotient ‖y'(t + δ, y + δ y') − y'‖ / δ.
template <class Real>
Real reciprocal_of_quotient(const Real& quotient, double rtol) {
  return rest_safety * square_root(quotient / Real(2 * rtol));
}

/// Enlarges the reciprocal of the first |h| of a start at rest. `look(δ, quotient)`, of signed δ: the quotient above.
/// The looks end where the next one would lie beyond the step, or the quotient is not finite.
/// `h`: the signed step that nothing else limits.
template <class Look>
Status look_beside_start(double t, double h, double rtol, double& reciprocal, Look look) {
  const double longest = std::abs(h);
  double delta = std::max(nearest_look * longest, nearest_spacings * ulp(t));
  while (delta <= farthest_look * longest) {
    double quotient = 0;
    if (look((t + std::copysign(delta, h)) - t, quotient) == Status::stop) return Status::stop;
    if (!std::isfinite(quotient)) break;
    reciprocal = std::max(reciprocal, reciprocal_of_quotient(quotient, rtol));
    delta *= growth_of_look;
    if (1 <= delta * reciprocal) break;
  }
  return Status::ok;
}

/// (f(t + δ, y + δ y') − f₀) / δ into `quotient` (n,), NaN in its first component if that point is not finite. `point`
/// (n,) becomes that point. `evaluate(t, y, out)`: f, with its outcome or status.
template <class Evaluate>
auto quotient_along(double t, const double* y, const double* slope, const double* f0, double delta, std::size_t n,
                    double* point, double* quotient, Evaluate&& evaluate) {
  decltype(evaluate(t, point, quotient)) result{};  // ok
  for (std::size_t i = 0; i < n; ++i) point[i] = y[i] + delta * slope[i];
  if (!all_finite(point, n)) {
    std::fill(quotient, quotient + n, std::numeric_limits<double>::quiet_NaN());
    return result;
  }
  result = evaluate(t + delta, point, quotient);
  for (std::size_t i = 0; i < n; ++i) quotient[i] = (quotient[i] - f0[i]) / delta;
  return result;
}

/// The start at rest of an explicit method, which judges its first attempt.
class RestingStart {
  /// An attempt that passes the error test may be longer than the step above by this factor: its stages lie in it.
  static constexpr double most_excess = 5;

 public:
  /// `reciprocal`: from f₀.
  void begin(double reciprocal, double t, const Step::Span& span) {
    rests_ = !gives_scale(reciprocal, t, span.tf);
    limit_ = 0;
  }
  /// The attempt from (t, y) of the signed size h has passed the error test. `norm(v)`: of v (n,) in the weights of the
  /// start, where f was `f0`. Enlarges the error above rtol if f beside the start asks for a shorter step.
  template <class Norm>
  Outcome judge(Callback& f, double t, const double* y, const double* f0, double h, double rtol, std::size_t n,
                double& error, Norm norm) {
    if (!rests_ || !(error <= rtol)) return Outcome::ok;
    std::vector<double> point(n), quotient(n);
    double reciprocal = 0;
    const Status status = look_beside_start(t, h, rtol, reciprocal, [&](double delta, double& size) {
      const Status looked = quotient_along(t, y, f0, f0, delta, n, point.data(), quotient.data(), f);
      size = norm(quotient.data());
      return looked;
    });
    const double excess = std::abs(h) * reciprocal;
    if (excess > most_excess) {
      limit_ = 1 / reciprocal;
      error = 2 * excess * rtol;
    }
    return status == Status::stop ? Outcome::stop : Outcome::ok;
  }
  /// The attempt was rejected. The |h| of the next one, if f beside the start limits it; otherwise 0.
  double reject() {
    rests_ = false;
    return std::exchange(limit_, 0);
  }
  void accept() { rests_ = false; }
  void state(Archive& archive) { archive(rests_); }

 private:
  bool rests_ = false;
  double limit_ = 0;
};

}  // namespace invariode
