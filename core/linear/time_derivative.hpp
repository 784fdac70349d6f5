#pragma once
// ∂f/∂t, the one rule for it.

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "callback.hpp"
#include "weights.hpp"

namespace invariode {

/// ∂f/∂t at (t, y), where f is `slope`, into ft (n,): a forward difference in the direction of the step h with the
/// increment min(√ε max(|t|, |t + h|), |h|), which follows the units of t. 0 where f is not finite there. One call of
/// f.
inline Status time_derivative(Callback& f, double t, const double* y, const double* slope, double h, std::size_t n,
                              double* ft) {
  const double size = std::min(std::sqrt(eps) * std::max(std::abs(t), std::abs(t + h)), std::abs(h));
  const double increment = (t + std::copysign(size, h)) - t;
  if (f(t + increment, y, ft) == Status::stop) return Status::stop;
  const bool known = increment != 0 && all_finite(ft, n);
  for (std::size_t i = 0; i < n; ++i) ft[i] = known ? (ft[i] - slope[i]) / increment : 0;
  return Status::ok;
}

}  // namespace invariode
