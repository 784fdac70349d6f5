#pragma once
// lower ≤ y ≤ upper, component by component (docs/algorithms.md, 'Bounds'; after Shampine, Thompson, Kierzenka and
// Byrne, Appl. Math. Comput. 170 (2005) 556–569).

#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <span>
#include <vector>

#include "callback.hpp"
#include "linear/mass.hpp"
#include "weights.hpp"

namespace invariode {

inline constexpr double roundoff_at_bound = 1e-13;  // in units of thr: a few hundred ε of the sizes that count

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
  /// The bounds as they were given.
  [[nodiscard]] std::vector<double> lower() const;
  [[nodiscard]] std::vector<double> upper() const;
  [[nodiscard]] bool contain(const double* y) const;
  /// The distance of y outside, in units of thr = atol / rtol, to be compared with rtol; and which component is the
  /// farthest
  /// (-1: none is outside).
  struct Excess {
    double size = 0;
    int component = -1;
  };
  [[nodiscard]] Excess excess(const double* y, const Weights& weights) const;
  /// Moves what is outside onto its bound. Returns the sum of what it added to the components.
  double clip(double* y) const;
  /// Moves components that have come to a bound, but for roundoff, or for what the slope moves them in `shortest`, the
  /// smallest step, onto it, if the slope leads them there. Returns whether there were any.
  bool settle(const Weights& weights, double forward, const double* slope, double shortest, double* y) const;
  /// Returns whether a slope leads out of an interval at whose lower or upper end, or beyond, y is. `forward`: +1 or
  /// −1, the direction of integration.
  [[nodiscard]] static bool leads_out(const Interval& one, const double* y, double forward, const double* slope);

 private:
  std::size_t n_;
  std::vector<Interval> intervals_;
};

/// f without what leads out of the bounds: what a method integrates that keeps them. It refers to the bounds.
///
/// For explicit methods that depends on where y is: at or beyond a bound. It jumps there, and Newton's iteration would
/// find no solution across the jump. So for implicit methods it depends on where the step starts: components that rest
/// at a bound there, since f leads out, or is 0 where they have just come, are not led out anywhere in the step; the
/// others follow f. With explicit methods too a component that is not at a bound where the step starts follows f: no
/// step goes over the jump, whose error estimate may be small by chance.
class BoundedSlope {
 public:
  /// `mass`: the diagonal of a mass matrix, by which f is y' times a factor; where that is 0 the equation is algebraic,
  /// and stays. Empty: f is y'.
  BoundedSlope(const Callback& f, const Bounds& bounds, double forward, bool of_implicit_method,
               std::vector<double> mass = {});
  /// With another M, the component that must not lead out is one of y', and f without it is f − M e_i y_i'. Where M
  /// alone does not tell y', f stays as it is.
  BoundedSlope(const Callback& f, const Bounds& bounds, double forward, DifferentialRate rate);
  BoundedSlope(const BoundedSlope&) = delete;
  BoundedSlope& operator=(const BoundedSlope&) = delete;

  /// The method sees f at the ends of its steps alone: any of them may have visited a bound.
  void see_ends_alone() { ends_alone_ = true; }
  /// The next step starts at (t, y). For an implicit method with a component at a bound this evaluates f. `changed`: it
  /// is another slope now, which the method's memory does not know.
  Status begin_step(double t, const double* y, bool& changed);
  /// Evaluations of f from now on belong to a step that starts at y.
  void start_at(const double* y);
  /// The components that the step from Y0 to (t, Y1) has brought to rest at their bounds: f does not lead them back
  /// inside. Evaluates f if there may be any. `changed`: their slopes or sensitivities jump there.
  Status find_arrived(double t, std::span<const double> Y0, const double* Y1, std::vector<std::size_t>& arrived,
                      bool& changed);
  /// Returns whether a component may be outside before the end of an attempt of signed size h from (t0, y0), with
  /// `slope` there, to y1, by the slopes that f has had since `start_at`: by more than the tolerance.
  [[nodiscard]] bool may_visit(double t0, double h, const Weights& weights, const double* y0, const double* slope,
                               const double* y1);
  /// The continuous extension of an attempt: Y at several θ, (count, size).
  struct Extension {
    double t0, h;
    std::size_t size;   ///< of Y
    std::size_t parts;  ///< into which the step is cut to be looked at
    std::function<void(std::span<const double> theta, double* Y)> values;
  };
  /// Looks where a component leaves its bounds by more than the tolerance in an attempt from y0. If f leads it out on
  /// the way to a point before the end, which is evaluated there, it has visited the bound (`visited`). `landing`: the
  /// θ at which it is outside by half of the tolerance, or 1.
  Status find_visit(const Extension& extension, const Weights& weights, const double* y0, double& landing);
  /// Returns how far a component visited the outside in the attempt.
  [[nodiscard]] const Bounds::Excess& visited() const { return visited_; }
  /// Returns the number of evaluations of f by `begin_step`, `find_visit` and `find_arrived`.
  [[nodiscard]] std::int64_t evaluations() const { return evaluations_; }
  /// Archives the components held too, which slopes of sensitivities at other points take from the last evaluation of
  /// f.
  void state(Archive& archive);

  /// The components whose slope the last evaluation set to 0.
  [[nodiscard]] const std::vector<std::size_t>& held() const { return held_; }
  /// Returns what the last evaluation has taken from y_i' of a component that is held.
  [[nodiscard]] double removed(std::size_t i) const { return removed_[i]; }
  /// Moves the held components of a candidate back to their bounds, from which iterations have moved them by less than
  /// the tolerance. Explicit methods leave none. Returns the largest move, in units of thr.
  double settle_held(const Weights& weights, double* y) const;
  /// Components at (t, y), behind a jump, that are not at a bound do not rest.
  void release(const double* y);
  /// Another right-hand side of M x' = f at the same time, such as that of a sensitivity, without what moves these
  /// components.
  void rest(double* f);

  /// Refers to this object.
  Callback callback() { return {&entry, this}; }

 private:
  Status look(double t, const double* y);
  Status evaluate_signs(double t, const double* y);
  void find_held(const double* slope);
  void find_outward(const double* y, const double* slope);
  void note(double t, const double* y, const double* slope);
  [[nodiscard]] bool rests(std::size_t k) const { return by_step_ && rests_[k] != 0; }
  Status evaluate(double t, const double* y, double* slope);
  [[nodiscard]] double mass(std::size_t i) const { return mass_.empty() ? 1 : mass_[i]; }
  static Status entry(void* self, double t, const double* y, double* out);

  Callback f_;
  const Bounds& bounds_;
  double forward_;
  bool by_step_, ends_alone_ = false;
  std::vector<double> mass_;
  std::optional<DifferentialRate> rates_;  // of an M that is not diagonal
  std::vector<double> rate_;               // y', of such an M
  // Of the bounded components, for implicit methods: whether they rest, now and in the step before; whether they are at
  // a bound, and have come there in the step before.
  std::vector<char> rests_, rested_, at_bound_, arrived_;
  std::vector<char> inside_;  // of the bounded components, for explicit methods: whether the step starts inside
  /// The slopes that f has had since `start_at`, in the direction of integration, and the shortest time in which one of
  /// them leads to the lower or the upper bound.
  struct Range {
    double lowest = 0, highest = 0;
    double to_lower = std::numeric_limits<double>::infinity(), to_upper = to_lower;

    void add(const Bounds::Interval& one, double y, double slope);
  };
  std::vector<Range> range_;   // of the bounded components
  std::vector<double> times_;  // at which f was evaluated
  std::vector<double> theta_, values_, point_, excess_;
  Bounds::Excess visited_;  // in the attempt
  std::vector<double> slope_;
  std::int64_t evaluations_ = 0;
  std::vector<std::size_t> held_;
  std::vector<double> removed_;  // of the components held
};

}  // namespace invariode
