#pragma once
// Times at which f changes its branch as a function of t alone (docs/algorithms.md, 'Switching times').

#include <cstddef>
#include <vector>

#include "callback.hpp"

namespace invariode {

/// Known before a run, for every t: single times, and progressions, whose times are formed when the run comes there.
class Landings {
 public:
  /// The times first + k period for all integers k.
  struct Progression {
    double first, period;
  };

  Landings() = default;
  /// `times`: in increasing order. Throws std::invalid_argument for others, or where a period is not positive.
  Landings(std::vector<double> times, std::vector<Progression> progressions);

  [[nodiscard]] bool empty() const { return times_.empty() && progressions_.empty(); }
  /// The nearest one beyond t, where forward = 1 leads to larger times and −1 to smaller ones; infinite if there is
  /// none.
  [[nodiscard]] double beyond(double t, double forward) const;

  Callback jump;  ///< (t, Y before, y) -> S from there on, (k, n); empty: sensitivities do not jump

 private:
  std::vector<double> times_;
  std::vector<Progression> progressions_;
};

}  // namespace invariode
