#pragma once
// Where a function of (t, y) turns along a step whose continuous solution is a polynomial (docs/algorithms.md,
// 'Events'): between its turning points it is monotonic, and signs at these tell all its roots.

#include <cstddef>
#include <vector>

#include "callback.hpp"
#include "series.hpp"

namespace invariode {

/// The function's Taylor coefficients along the polynomial are those of a polynomial of its own, whose derivative is
/// taken apart in Bernstein form: by Descartes' rule there are at most as many roots as changes of sign among the
/// coefficients. A part of the step where the function has not converged is halved, and expanded anew.
class TurningPoints {
 public:
  /// Writes θ ∈ (0, 1) to `points`, in their order: between neighbours the function is monotonic, or far from zero.
  /// c: (order + 1, n), coefficients of θ^k on the step of signed length `length` from t0.
  Status find(Series& series, double t0, double length, const double* c, std::size_t n, std::vector<double>& points);

  /// Σ |coefficients| of the last search, the size of the function on the step.
  [[nodiscard]] double size() const { return size_; }
  /// Returns whether its slope vanishes at the end of the step.
  [[nodiscard]] bool turns_at_end() const { return turns_at_end_; }

 private:
  /// A part of the step, as deep in the halving as it is short.
  struct Part {
    std::size_t depth;
    double start, width;
  };

  Status examine(const Part& part);
  Status halve(const Part& part);
  void take_apart(const Part& part);
  void take_root(const Part& part, double low, double high);
  [[nodiscard]] double slope(double theta) const;

  Series* series_ = nullptr;
  double t0_ = 0, length_ = 0;
  std::size_t n_ = 0, order_ = 0;
  std::vector<std::vector<double>> c_;         // of y, on the part in work at each depth
  std::vector<double> g_, bernstein_, boxes_;  // of the function there; of its slope, and in the boxes that are left
  std::vector<double>* points_ = nullptr;
  double size_ = 0;
  bool turns_at_end_ = false;
};

}  // namespace invariode
