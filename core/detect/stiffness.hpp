#pragma once
// Is it stability, not accuracy, that limits the steps? (docs/algorithms.md, 'Stability limit of an explicit step')

#include <cstdint>

#include "detect/step_look.hpp"
#include "report.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// Looks at the step from y0 that the method has just accepted.
StepLook look_at(const Step& method, const Weights& weights, const double* y0);

/// Watches explicit steps. Where |h λ| stays at the limit of the formula while the solution hardly changes in a step, λ
/// is not in the solution: the problem is stiff.
class StiffnessDetector {
 public:
  static constexpr std::int64_t every = StepLook::every;

  explicit StiffnessDetector(const Weights& weights) : weights_(weights) {}

  /// Step number `step`, from (t0, y0), has been accepted. True: it looked at it, as at one step in 64.
  bool note(const Step& method, std::int64_t step, double t0, const double* y0) {
    if (step % every != 0) return false;
    look(method, t0, y0);
    return true;
  }

  /// Returns whether stability limited the step that was tested last.
  [[nodiscard]] bool limited() const { return free_ == 0 && streak_ > 0; }

  /// Returns whether the problem is stiff, and since when. It is not unless most steps since then were limited.
  [[nodiscard]] Stiffness found() const {
    const bool most = 2 * limited_ > looks_;
    return sustained_ && most ? Stiffness{.found = true, .since = since_} : Stiffness{};
  }

  void state(Archive& archive) { archive(looks_, limited_, streak_, free_, sustained_, since_); }

 private:
  void look(const Step& method, double t0, const double* y0);
  void limited(double t0);
  void free();

  const Weights& weights_;
  std::int64_t looks_ = 0, limited_ = 0;  // since `since_`
  int streak_ = 0, free_ = 0;
  bool sustained_ = false;
  double since_ = 0;
};

}  // namespace invariode
