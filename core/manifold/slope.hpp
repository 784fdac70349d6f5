#pragma once
// y' as a function of its own, for the tests that ask whether invariants are conserved: its evaluations of f are
// counted apart from the method's.

#include <cstdint>

#include "callback.hpp"

namespace invariode {

class Slope : public Archived {
 public:
  Slope() = default;
  Slope(const Slope&) = delete;
  Slope& operator=(const Slope&) = delete;
  virtual ~Slope() = default;

  /// y'(t, y) into out; NaN where it is not defined. h: a step of the run, which gives the scale of t.
  virtual Status evaluate(double t, const double* y, double h, double* out) = 0;
  /// Its accuracy, relative to its size; 0: roundoff.
  [[nodiscard]] virtual double relative_error() const { return 0; }
  /// Evaluations of f so far.
  [[nodiscard]] virtual std::int64_t evaluations() const = 0;
};

/// y' = f(t, y)
class ExplicitSlope final : public Slope {
 public:
  explicit ExplicitSlope(const Callback& f, double relative_error = 0)
      : f_(f), relative_error_(relative_error), before_(f.calls()) {}
  Status evaluate(double t, const double* y, double, double* out) override { return f_(t, y, out); }
  [[nodiscard]] double relative_error() const override { return relative_error_; }
  [[nodiscard]] std::int64_t evaluations() const override { return f_.calls() - before_; }
  void state(Archive& archive) override {
    f_.state(archive);
    archive(before_);
  }

 private:
  Callback f_;
  double relative_error_;
  std::int64_t before_;  // calls that the callback had counted when it was copied
};

}  // namespace invariode
