#pragma once
// Where f changes its branch along a Taylor polynomial.

#include <cstddef>
#include <optional>
#include <vector>

#include "callback.hpp"
#include "series.hpp"

namespace invariode {

/// The conditions of f along the polynomial of a step: functions that change their sign where f changes its branch.
class Conditions {
 public:
  /// `series` outlives this.
  explicit Conditions(SystemSeries& series);

  [[nodiscard]] bool any() const { return series_.count > 0; }

  /// Sets `root` to the first change of sign of any condition on s from 0 to `length` (signed), as a fraction of the
  /// length: 0 if a condition vanishes at the start but not beyond, empty if no condition changes its sign.
  /// c: coefficients of y(t + unit s).
  Status first(double t, double unit, const double* c, double length, std::optional<double>& root);

 private:
  [[nodiscard]] std::optional<double> first_root();
  [[nodiscard]] double value(double theta) const;

  SystemSeries& series_;
  std::vector<double> all_;  // coefficients of all conditions
  std::vector<double> one_;  // of one of them, in θ ∈ [0, 1]
  std::vector<double> bernstein_, boxes_;
};

}  // namespace invariode
