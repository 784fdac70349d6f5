#include "detect/stiffness.hpp"

namespace invariode {
namespace {

constexpr int end_of_streak = 4;  // looks

/// ‖y₁ − y₀‖
double moved(const Step& method, const Weights& weights, const double* y0) {
  const double* y1 = method.y();
  return max_norm(weights.size(), [&](std::size_t i) { return (y1[i] - y0[i]) / weights.at(i, y0[i], y1[i]); });
}

}  // namespace

StepLook look_at(const Step& method, const Weights& weights, const double* y0) {
  const double limit = method.stability();
  if (limit == 0) return {};
  if (!(limit > StepLook::near)) return {.known = true};
  return {.known = true, .at_limit = true, .moved = moved(method, weights, y0)};
}

void StiffnessDetector::look(const Step& method, double t0, const double* y0) {
  const StepLook step = look_at(method, weights_, y0);
  if (!step.known) return;
  if (step.limited())
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
  sustained_ = sustained_ || streak_ >= StepLook::long_streak;
}

void StiffnessDetector::free() {
  ++looks_;
  if (++free_ >= end_of_streak) streak_ = 0;
}

}  // namespace invariode
