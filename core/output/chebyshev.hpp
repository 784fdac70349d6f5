#pragma once
// All roots of a smooth function on an interval, from its Chebyshev interpolant (docs/algorithms.md, 'Events').

#include <cstddef>
#include <functional>
#include <utility>
#include <vector>

namespace invariode {

/// Separates the roots of a function. It is sampled at Chebyshev points until its coefficients have decayed, on halves
/// of the interval where they do not; the roots of the interpolant are separated by halving too, until its coefficients
/// on a part rule roots out or show that it is monotonic.
class RootSeparator {
 public:
  RootSeparator();

  /// The value at t; false: the search is to end.
  using Sample = std::function<bool(double t, double& value)>;

  /// An interval, and the values at its ends.
  struct Ends {
    double a, ea, b, eb;
  };
  /// Appends points between a and b to `points`, in their order, so that no two roots that the function's interpolant
  /// has lie between neighbours. False: a sample was. `noise` returns the size of roundoff in the function, and is
  /// called if the function is not soon resolved. `zero_at_start`: a is a root.
  bool separate(const Sample& sample, const std::function<bool(double& value)>& noise, const Ends& ends,
                bool zero_at_start, std::vector<double>& points);

 private:
  struct Interval {
    double a, ea, b, eb;
    int depth;
    [[nodiscard]] double time(double x) const { return 0.5 * (a + b) + 0.5 * (b - a) * x; }
  };

  bool interpolate(const Sample& sample, const Interval& on, bool& resolved);
  bool refine(const Sample& sample, const Interval& on);
  bool confirmed(const Sample& sample, const Interval& on, bool& agrees);
  [[nodiscard]] bool decayed() const;
  bool locate_roots();
  [[nodiscard]] double evaluate(double x) const;
  void split_between_roots(const Interval& on, std::vector<double>& points) const;

  std::size_t samples_ = 0;
  const std::function<bool(double& value)>* ask_noise_ = nullptr;  // null: it is known
  double noise_ = 0;
  std::vector<double> values_;        // at cos(kπ / N), k = 0 … N
  std::vector<double> coefficients_;  // of the Chebyshev polynomials
  std::vector<double> finer_;         // these, being refined
  std::vector<double> part_values_, part_coefficients_;
  std::vector<double> roots_;
  std::vector<Interval> left_;                    // of the step, not yet searched
  std::vector<std::pair<double, double>> parts_;  // of an interval, not yet searched for roots of the interpolant
};

}  // namespace invariode
