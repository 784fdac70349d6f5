#pragma once
// lower ≤ y ≤ upper, component by component (docs/algorithms.md, 'Bounds'; after Shampine, Thompson, Kierzenka and
// Byrne, Appl. Math. Comput. 170 (2005) 556–569).

#include <cstddef>
#include <vector>

#include "callback.hpp"
#include "weights.hpp"

namespace invariode {

/// The bounds of those components that have any.
class Bounds {
 public:
  struct Interval {
    std::size_t component;
    double lower, upper;  // infinite where there is none
  };

  /// lower and upper have one entry per component, infinite where there is no bound. Throws std::invalid_argument where
  /// they differ in length, are NaN, or leave no value.
  Bounds(const std::vector<double>& lower, const std::vector<double>& upper);

  [[nodiscard]] std::size_t n() const { return n_; }
  [[nodiscard]] const std::vector<Interval>& intervals() const { return intervals_; }
  /// As they were given.
  [[nodiscard]] std::vector<double> lower() const;
  [[nodiscard]] std::vector<double> upper() const;
  [[nodiscard]] bool contain(const double* y) const;
  /// How far y is outside, in units of thr = atol / rtol, to be compared with rtol; and which component is the farthest
  /// (-1: none is outside).
  struct Excess {
    double size = 0;
    int component = -1;
  };
  [[nodiscard]] Excess excess(const double* y, const Weights& weights) const;
  /// Moves what is outside onto its bound. Returns the sum of what it added to the components.
  double clip(double* y) const;
  /// Of a slope at y, takes away what leads out of the bounds where y is at one or beyond. `forward`: +1 or −1, the
  /// direction of integration.
  void remove_outward(const double* y, double forward, double* slope) const;

 private:
  std::size_t n_;
  std::vector<Interval> intervals_;
};

/// f without what leads out of the bounds: what a method integrates that keeps them. It refers to the bounds.
class BoundedSlope {
 public:
  BoundedSlope(const Callback& f, const Bounds& bounds, double forward) : f_(f), bounds_(bounds), forward_(forward) {}
  BoundedSlope(const BoundedSlope&) = delete;
  BoundedSlope& operator=(const BoundedSlope&) = delete;

  /// Refers to this object.
  Callback callback() { return {&entry, this}; }

 private:
  static Status entry(void* self, double t, const double* y, double* out);

  Callback f_;
  const Bounds& bounds_;
  double forward_;
};

}  // namespace invariode
