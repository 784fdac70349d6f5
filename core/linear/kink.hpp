#pragma once
// Does the derivative of f jump between two points? (docs/algorithms.md, 'A Jacobian that is much too large')

#include <span>
#include <vector>

#include "callback.hpp"

namespace invariode {

/// Looks for a jump of the derivative of f along e on a line between two points (t, y), by halving it towards the half
/// in which the derivative changes more: of a smooth one each half keeps about half of the change, of a jump one half
/// keeps all. What changes within a sixteenth of the line is as good as a jump.
class KinkSearch {
 public:
  enum class [[nodiscard]] Verdict { smooth, kink, stop };

  /// `e`: the increment with which differences are formed; `w`: weights of the components of f; `roundoff`: of them,
  /// in a difference. Where f is not finite the verdict is `smooth`.
  Verdict search(Callback& f, double t0, const double* y0, double t1, const double* y1, const double* e,
                 std::span<const double> w, const double* roundoff);
  /// f(t, y + e) − f(t, y) at the end of the line of the latest search.
  [[nodiscard]] const double* at_end() const { return end_.data(); }

 private:
  /// A point of the line; `theta` is between 0 and 1.
  struct Point {
    double theta = 0;
    std::vector<double> difference;
  };
  struct Line {
    Callback* f;
    double t0, t1;
    const double *y0, *y1, *e;
  };
  bool evaluate(const Line& line, Point& point);

  bool stopped_ = false;
  std::vector<double> y_, f_, end_;
  Point a_, b_, middle_;  // kept, for the memory
};

}  // namespace invariode
