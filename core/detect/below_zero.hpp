#pragma once
// Does a component fall below 0 where f does not lead it there? (docs/algorithms.md, 'Components below zero')

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <vector>

#include "archive.hpp"
#include "callback.hpp"
#include "linear/mass.hpp"
#include "report.hpp"
#include "weights.hpp"

namespace invariode {

/// Watches the components that start at or above 0. If y_i' ≥ 0 wherever y_i = 0, the exact y_i stays there, so a y_i
/// far below 0 is an error, which may grow: an extinct species that comes back with the other sign. f is evaluated only
/// at the ends of steps in which a component falls below −100 atol.
class BelowZero {
 public:
  /// A step, of whose points (n,) the components are `stride` apart, after so many attempts.
  struct Step {
    double t0, t1;
    const double *y0, *y1;
    std::size_t stride;
    std::int64_t attempts;
  };

  /// `rate`: makes y' of f, with a mass matrix. `watches`: false: components may be negative, or are complex.
  BelowZero(Callback f, const Weights& weights, double forward, std::optional<DifferentialRate> rate, bool watches)
      : f_(f), weights_(weights), forward_(forward), rate_(std::move(rate)), watches_(watches) {}

  // A number for each component says how it is watched: |it| is the depth below 0 that is notable, infinite where none
  // is; it is negative once the component has fallen so deep where f did not lead it.

  /// Returns that number for a component that starts at or above 0.
  static double depth(double atol) { return notable * atol; }
  static bool falls(double watch, double y0, double y1) {
    const double limit = -std::abs(watch);
    return y1 < limit && !(y0 < limit);
  }
  /// Judges the components that fall in a step, and notes it in `watch`, whose entries have the stride of the step.
  Status judge(const Step& step, double* watch, std::int64_t& evaluations);
  /// Returns the component that is the farthest below 0, in units of what is notable, of those that f did not lead
  /// there.
  static Component deepest(std::size_t n, const double* y, const double* watch, std::size_t stride);

  // The same for a run of its own.

  /// The run starts at y. A component with a lower bound is not watched.
  void start(const double* y, const std::vector<double>& lower);
  Status accepted(const Step& step) {
    bool any = false;
    for (std::size_t i = 0; i < watch_.size(); ++i) any |= falls(watch_[i], step.y0[i], step.y1[i]);
    return any ? judge(step, watch_.data(), evaluations_) : Status::ok;
  }
  /// The solution jumps to y: what is below 0 there was meant to be.
  void jump(const double* y);
  [[nodiscard]] Component deepest(const double* y) const { return deepest(watch_.size(), y, watch_.data(), 1); }
  [[nodiscard]] std::int64_t evaluations() const { return evaluations_; }
  void state(Archive& archive);

 private:
  static constexpr double notable = 100;  // tolerances: less is the noise of components that decay to 0

  Status lead_down(double t, const double* y, std::size_t stride, std::size_t i, double least, bool& leads);

  Callback f_;
  const Weights& weights_;
  double forward_;
  std::optional<DifferentialRate> rate_;
  bool watches_;
  std::vector<double> watch_;
  std::vector<double> work_;  // a point, and f there
  std::int64_t evaluations_ = 0;
};

}  // namespace invariode
