#include "stiffness.hpp"

namespace invariode {
namespace {

constexpr double near = 0.5;  // of the limit: estimates there were 0.6 to 1.9 of it, in the median 0.9 to 1.1
constexpr double slow = 0.1;  // what may change in a step at the limit, in the weights
constexpr int long_streak = 10, end_of_streak = 4;  // looks

}  // namespace

void StiffnessDetector::look(const Step& method, double t0, const double* y0) {
  const double limit = method.stability();
  if (limit == 0) return;
  if (limit > near && moved(method, y0) < slow)
    limited(t0);
  else
    free();
}

void StiffnessDetector::limited(double t0) {
  if (streak_ == 0 && !sustained_) {
    since_ = t0;
    looks_ = limited_ = 0;
  }
  ++looks_;
  ++limited_;
  ++streak_;
  free_ = 0;
  sustained_ = sustained_ || streak_ >= long_streak;
}

void StiffnessDetector::free() {
  ++looks_;
  if (++free_ >= end_of_streak) streak_ = 0;
}

/// ‖y₁ − y₀‖
double StiffnessDetector::moved(const Step& method, const double* y0) const {
  const double* y1 = method.y();
  return max_norm(weights_.size(), [&](std::size_t i) { return (y1[i] - y0[i]) / weights_.at(i, y0[i], y1[i]); });
}

}  // namespace invariode
