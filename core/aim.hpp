#pragma once
// Where an attempt leads: the only owner of h, t1, hmin, hmax and of the target.

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>

#include "archive.hpp"
#include "number.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

inline constexpr double hmin_ulps = 16;      // hmin = 16 ulp(t) (docs/algorithms.md, 'Every method')
inline constexpr double growth_of_hmin = 2;  // from step to step after a start at 1 ulp(t)
inline constexpr double stretch = 1.1;       // a step that comes this close to the target lands on it
inline constexpr double huge =
    std::numeric_limits<double>::max() / 16;  // on an infinite interval nothing else bounds h

/// An attempt of the signed size h that ends at t1. `lands`: that is the target.
template <class Real, class Mask>
struct Aimed {
  Real h, t1;
  Mask lands;
};

/// The attempt from t for the |h| that a method proposes:
///
///   hmin ≤ |h| ≤ hmax, except that an attempt that lands may be shorter, or longer by a tenth;
///   t1 = fl(t + h) lies before the target, or is the target itself, assigned exactly.
///
/// `reach`: so many times the step proposed may lead to the target. (The longest one may be stretched by a tenth in any
/// attempt, or a retry with the same h would not land again.)
template <class Mask, class Real>
INVARIODE_EACH Aimed<Real, Mask> aimed(const Real& t, const Real& proposed, const Real& reach, const Real& hmin,
                                       double hmax, double forward, double target) {
  const Real goal(target), rest = goal - t, distance = absolute(rest);
  const Real size = larger(hmin, smaller(Real(hmax), proposed));
  const Real full = forward * size, ahead = t + full;
  const Mask close = distance <= stretch * size;
  if (!any(close)) return {full, ahead, close};  // a tenth of hmin is left at least, which no rounding bridges
  const Mask near = distance <= smaller(stretch * size, reach * larger(size, proposed));  // and close
  const Real h = choose(near, rest, full), t1 = choose(near, goal, ahead);
  // Rounding may lead there too. Of doubles these are bools:
  return {h, t1, Mask(near | ((t1 <= goal) & (goal <= t1)))};  // NOLINT(bugprone-signed-bitwise)
}

/// The attempts of a run, the first one of each step and every retry.
class Aim {
 public:
  /// `forward`: 1, or −1 for a run backwards.
  Aim(double forward, double hmax) : forward_(forward), hmax_(hmax) {}

  /// A method starts: its first step may be as short as one spacing of t, the next ones twice as long each, until they
  /// reach hmin.
  void start() { ulps_ = 1; }

  /// Steps lead to this t from now on: the next breakpoint, or the end of the interval.
  void at(double target) { target_ = target; }

  /// The first attempt of a step from t. One that comes close to the target is stretched or cut to land on it.
  void begin(double t, double proposed) {
    hmin_ = ulps_ * ulp(t);
    ulps_ = std::min(hmin_ulps, growth_of_hmin * ulps_);
    take(t, proposed, stretch);
  }
  /// The attempt of that step after one that failed. None is stretched: what was too long would become so again.
  void retry(double t, double proposed) { take(t, proposed, 1); }

  [[nodiscard]] double h() const { return h_; }  ///< signed
  [[nodiscard]] double t1() const { return t1_; }
  [[nodiscard]] double hmin() const { return hmin_; }
  [[nodiscard]] bool lands() const { return lands_; }  ///< t1 is the target
  [[nodiscard]] double target() const { return target_; }
  /// Returns whether there is an attempt, and it leads forward.
  [[nodiscard]] bool defined() const {
    return std::isfinite(t1_) && h_ * forward_ > 0 && std::isfinite(h_) && hmin_ >= 0;
  }
  /// Returns the limits of the first step of a method that starts at t.
  [[nodiscard]] Step::Span span(double t) const { return {target_, hmax_, smallest(t)}; }

  /// Archives the attempt; the target belongs to the run that reads this.
  void state(Archive& archive) {
    archive(h_, t1_, hmin_, lands_, ulps_);
    archive.require(ulps_ >= 1 && ulps_ <= hmin_ulps);
  }

 private:
  static double smallest(double t) { return hmin_ulps * ulp(t); }

  void take(double t, double proposed, double reach) {
    assert(forward_ * (target_ - t) > 0);
    const auto [h, t1, lands] = aimed<bool>(t, proposed, reach, hmin_, std::min(hmax_, huge), forward_, target_);
    // Of so few spacings of t, h is what they are; of more it is t₁ − t but for what a method does not notice.
    h_ = std::abs(h) < hmin_ulps * ulp(t) ? t1 - t : h, t1_ = t1, lands_ = lands;
  }

  double forward_, hmax_;
  double target_ = 0;
  double h_ = 0, t1_ = 0;
  double hmin_ = 0;
  double ulps_ = 1;  // hmin of the next step, in spacings of t
  bool lands_ = false;
};

}  // namespace invariode
