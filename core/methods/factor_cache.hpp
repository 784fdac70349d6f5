#pragma once
// Which factors of M − c J are at hand (docs/algorithms.md, 'Newton').

#include <cmath>
#include <optional>

#include "archive.hpp"

namespace invariode {

/// For which c, and for M at which t, the factors at hand were made. The factors themselves belong to a solver.
class FactorCache {
 public:
  [[nodiscard]] bool holds() const { return c_.has_value(); }
  [[nodiscard]] double c() const { return *c_; }
  [[nodiscard]] double t() const { return t_; }
  /// |c| of the first factors with this J, if there are any.
  [[nodiscard]] const std::optional<double>& first_c() const { return first_c_; }

  /// Returns whether the factors at hand serve for c: they are those for a c that differs by no more than that part.
  /// If they do not, they are forgotten.
  [[nodiscard]] bool serves(double c, double tolerated) {
    if (c_ && std::abs(c - *c_) <= tolerated * std::abs(*c_)) return true;
    if (!first_c_) first_c_ = std::abs(c);
    c_.reset();
    return false;
  }
  void made(double c, double t) {
    c_ = c;
    t_ = t;
  }
  void forget() { c_.reset(); }
  /// There is another J.
  void forget_jacobian() {
    c_.reset();
    first_c_.reset();
  }
  void state(Archive& archive) { archive(c_, t_, first_c_); }

 private:
  std::optional<double> c_;
  double t_ = 0;
  std::optional<double> first_c_;
};

}  // namespace invariode
