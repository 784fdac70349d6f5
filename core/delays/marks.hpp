#pragma once
// Times at which a derivative of the solution jumps because of delays (docs/algorithms.md, 'Delays').

#include <cstddef>
#include <vector>

#include "archive.hpp"

namespace invariode {

/// The derivative of order `level` of the solution jumps at t; 0: the solution itself does.
struct Mark {
  double t;
  int level;
  double spacing;  ///< of the doubles from which t was computed
  /// ∂t/∂p of what each delay brings there, (delays, k), where f jumps in a run with sensitivities; 0: nothing.
  std::vector<double> rates;
};

/// The marks that a run has yet to pass, in increasing order of t, and those that it is passing. They grow while it
/// goes on.
class Marks {
 public:
  /// Marks that rounding alone tells apart are one, with the smaller level and what all delays bring.
  void add(const Mark& mark);
  /// Forgets those that were passed long before t.
  void pass(double t);

  [[nodiscard]] bool empty() const { return all_.empty(); }
  [[nodiscard]] std::size_t size() const { return all_.size(); }
  /// Returns the time of the first mark beyond t, or infinity.
  [[nodiscard]] double beyond(double t) const;
  /// Returns the first mark within `tolerance` of t, or null.
  [[nodiscard]] const Mark* at(double t, double tolerance) const;

  void state(Archive& archive);

 private:
  std::vector<Mark> all_;
};

}  // namespace invariode
