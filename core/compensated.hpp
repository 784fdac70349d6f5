#pragma once
// Sums that keep what rounding drops: the state as a pair y = ŷ + e, |e| ≤ ½ ulp(ŷ) (docs/algorithms.md, 'Compensated
// sums'), for methods whose truncation errors can be smaller than roundoff.

#include <algorithm>
#include <cstddef>
#include <utility>
#include <vector>

#include "archive.hpp"
#include "number.hpp"

namespace invariode {

/// fl(a + b), and what rounding dropped: value + lost = a + b exactly (Knuth's two-sum).
template <class Real>
struct Sum {
  Real value, lost;
};
template <class Real>
INVARIODE_EACH Sum<Real> two_sum(const Real& a, const Real& b) {
  const Real value = a + b, part = value - a;
  return {value, (a - (value - part)) + (b - part)};
}

/// e of the point reached and of the candidate. A correction δ of the candidate, y₁ = ŷ* + δ, is one of the pair: e*
/// stays. What rounds off is ½ ulp of y₁ in each step, in directions of its own, where δ is known to no more than that.
class Remainder {
 public:
  explicit Remainder(std::size_t n) : now_(n), proposed_(n) {}

  /// The state is ŷ alone: at a start, after a jump, and where ŷ was moved onto bounds.
  void clear() { std::fill(now_.begin(), now_.end(), 0); }
  /// ŷ* = fl(ŷ + (d + e)) of component i.
  double propose(std::size_t i, double y, double d) {
    const auto [value, lost] = two_sum(y, d + now_[i]);
    proposed_[i] = lost;
    return value;
  }
  /// The candidate was accepted, projected or not.
  void accept() { std::swap(now_, proposed_); }
  [[nodiscard]] double operator[](std::size_t i) const { return now_[i]; }

  void state(Archive& archive) { archive(now_); }

 private:
  std::vector<double> now_, proposed_;
};

}  // namespace invariode
