#pragma once
// Where an attempt leads: the only owner of h, t1, hmin, hmax and of the target.

#include <algorithm>
#include <cassert>
#include <cmath>
#include <limits>

#include "archive.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

inline constexpr double hmin_ulps = 16;  // hmin = 16 ulp(t) (docs/algorithms.md, 'Every method')
inline constexpr double stretch = 1.1;   // a step that comes this close to the target lands on it

/// Turns the |h| that a method proposes into the next attempt, the first one of a step and every retry:
///
///   hmin ≤ |h| ≤ hmax, except that an attempt that lands may be shorter, or longer by a tenth;
///   t1 = fl(t + h) lies before the target, or is the target itself, assigned exactly.
class Aim {
 public:
  /// `forward`: 1, or −1 for a run backwards.
  Aim(double forward, double hmax) : forward_(forward), hmax_(hmax) {}

  /// Steps lead to this t from now on: the next breakpoint, or the end of the interval.
  void at(double target) { target_ = target; }

  /// The first attempt of a step from t. One that comes close to the target is stretched or cut to land on it.
  void begin(double t, double proposed) {
    hmin_ = smallest(t);
    take(t, proposed, stretch);
  }
  /// The attempt of that step after one that failed. None is stretched: what was too long would become so again.
  void retry(double t, double proposed) { take(t, proposed, 1); }

  [[nodiscard]] double h() const { return h_; }  ///< signed
  [[nodiscard]] double t1() const { return t1_; }
  [[nodiscard]] double hmin() const { return hmin_; }
  [[nodiscard]] bool lands() const { return lands_; }  ///< t1 is the target
  [[nodiscard]] double target() const { return target_; }
  /// Whether there is an attempt, and it leads forward.
  [[nodiscard]] bool defined() const {
    return std::isfinite(t1_) && h_ * forward_ > 0 && std::isfinite(h_) && hmin_ >= 0;
  }
  /// What bounds the first step of a method that starts at t.
  [[nodiscard]] Step::Span span(double t) const { return {target_, hmax_, smallest(t)}; }

  /// Of the attempt; the target belongs to the run that reads this.
  void state(Archive& archive) { archive(h_, t1_, hmin_, lands_); }

 private:
  static double smallest(double t) { return hmin_ulps * ulp(t); }

  /// `reach`: so many times the step proposed may lead to the target. (The longest one may be stretched by a tenth in
  /// any attempt, or a retry with the same h would not land again.)
  void take(double t, double proposed, double reach) {
    constexpr double huge = std::numeric_limits<double>::max() / 16;  // on an infinite interval nothing else bounds h
    assert(forward_ * (target_ - t) > 0);
    const double distance = std::abs(target_ - t);
    const double size = std::max(hmin_, std::min({hmax_, huge, proposed}));
    lands_ = stretch * size >= distance && reach * std::max(size, proposed) >= distance;
    h_ = lands_ ? target_ - t : forward_ * size;
    t1_ = lands_ ? target_ : t + h_;
    lands_ = lands_ || t1_ == target_;  // rounding may lead there too
  }

  double forward_, hmax_;
  double target_ = 0;
  double h_ = 0, t1_ = 0;
  double hmin_ = 0;
  bool lands_ = false;
};

}  // namespace invariode
