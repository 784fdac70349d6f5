#pragma once
// Is it stability, not accuracy, that limits the steps? (docs/algorithms.md, 'Stability limit of an explicit step')

#include <cstdint>

#include "report.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// Watches explicit steps. Where |h λ| stays at the limit of the formula while the solution hardly changes in a step, λ
/// is not in the solution: the problem is stiff.
class StiffnessDetector {
 public:
  explicit StiffnessDetector(const Weights& weights) : weights_(weights) {}

  /// Step number `step`, from (t0, y0), has been accepted. Looks at one step in 64.
  void note(const Step& method, std::int64_t step, double t0, const double* y0) {
    if (step % every != 0) return;
    const double limit = method.stability();
    if (limit == 0) return;
    if (limit > near && moved(method, y0) < slow)
      limited(t0);
    else
      free();
  }

  /// Nothing, unless most steps since then were limited.
  [[nodiscard]] Stiffness found() const {
    const bool most = 2 * limited_ > looks_;
    return sustained_ && most ? Stiffness{.found = true, .since = since_} : Stiffness{};
  }

 private:
  void limited(double t0) {
    if (streak_ == 0 && !sustained_) {
      since_ = t0;
      looks_ = limited_ = 0;
    }
    ++looks_;
    ++limited_;
    ++streak_;
    free_ = 0;
    sustained_ = sustained_ || streak_ >= long_streak;
  }

  void free() {
    ++looks_;
    if (++free_ >= end_of_streak) streak_ = 0;
  }

  /// ‖y₁ − y₀‖
  [[nodiscard]] double moved(const Step& method, const double* y0) const {
    const double* y1 = method.y();
    return max_norm(weights_.size(), [&](std::size_t i) { return (y1[i] - y0[i]) / weights_.at(i, y0[i], y1[i]); });
  }

  static constexpr std::int64_t every = 64;  // so that it costs less than 1 % of a step
  static constexpr double near = 0.5;  // of the limit: estimates there were 0.6 to 1.9 of it, in the median 0.9 to 1.1
  static constexpr double slow = 0.1;  // what may change in a step at the limit, in the weights
  static constexpr int long_streak = 10, end_of_streak = 4;  // looks

  const Weights& weights_;
  std::int64_t looks_ = 0, limited_ = 0;  // since `since_`
  int streak_ = 0, free_ = 0;
  bool sustained_ = false;
  double since_ = 0;
};

}  // namespace invariode
