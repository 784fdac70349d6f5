#pragma once
// Does projection do harm? (docs/algorithms.md, 'Guard'; beyond the paper)

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <span>
#include <vector>

#include "manifold/thresholds.hpp"
#include "report.hpp"
#include "step.hpp"
#include "weights.hpp"

namespace invariode {

/// Compares, component by component, what projections move with the estimated errors of the steps. A projection spreads
/// a correction over the components by their weights. Where weights do not say how accurate a component is, as with one
/// atol for positions and velocities, it corrects the errors of some at the cost of others that had none.
class HarmDetector {
 public:
  /// Makes a detector for a state of n doubles, in steps of `all`.
  HarmDetector(std::size_t n, std::size_t all) : error_(all), errors_(n), corrections_(n) {}

  /// Step number `step`, from the candidate to y1, is about to be accepted. Looks at one step in eight.
  void note(const Step& method, std::int64_t step, const double* candidate, const double* y1, const double* w) {
    if (step % harm_period != 0 || !method.errors(error_.data())) return;
    ++looks_;
    for (std::size_t i = 0; i < errors_.size(); ++i) {
      errors_[i] += std::abs(error_[i]) / w[i];
      corrections_[i] += std::abs(y1[i] - candidate[i]) / w[i];
    }
  }

  [[nodiscard]] Harm harm(double rtol) const { return harm(looks_, errors_, corrections_, rtol); }
  /// Judges sums to which so many looks have added.
  static Harm harm(std::int64_t looks, std::span<const double> errors, std::span<const double> corrections,
                   double rtol) {
    Harm worst;
    if (looks < fewest) return worst;
    const double smallest = std::numeric_limits<double>::min();
    const double usual = *std::ranges::max_element(corrections) / std::max(*std::ranges::max_element(errors), smallest);
    for (std::size_t i = 0; i < errors.size(); ++i) {
      const double ratio = corrections[i] / std::max(errors[i], smallest);
      const bool matters = static_cast<double>(harm_period) * corrections[i] > rtol;
      if (matters && ratio > harmful && ratio > uneven * usual && ratio > worst.ratio)
        worst = {.component = static_cast<int>(i), .ratio = ratio};
    }
    return worst;
  }

  void state(Archive& archive) { archive(looks_, errors_, corrections_); }

 private:
  static constexpr std::int64_t fewest = 5;  // looks before it says anything
  // Where projection helps, components were moved by up to 25 times their estimated errors, but then all alike, within
  // a factor of 5; on the car axis of the IVP Test Set, with one atol, one by 27 times or more, 700 times what is
  // usual.
  static constexpr double harmful = 10;
  static constexpr double uneven = 200;

  std::int64_t looks_ = 0;
  std::vector<double> error_, errors_, corrections_;
};

}  // namespace invariode
