#pragma once
// Polynomials between the ends of a step: of doubles, or of packs of them, one trajectory in each lane.

#include <cstddef>
#include <span>

namespace invariode {

/// Below so many components, one component after the other is faster than one coefficient after the other.
inline constexpr std::size_t few_components = 8;

/// y(θ) = c₀ + θ (c₁ + (1−θ) (c₂ + θ (c₃ + …))), the coefficients c_j (n,) one after the other.
template <class Real>
void nested_polynomial(const Real* coefficients, std::size_t size, std::size_t n, const Real& theta, Real* out) {
  if (n == 0) return;
  const Real* const last = coefficients + (size - n);
  const Real factor[] = {theta, Real(1) - theta};
  const std::size_t degree = size / n - 1;
  if (sizeof(Real) > sizeof(double) || n < few_components) {
    for (std::size_t i = 0; i < n; ++i) {
      const Real* c = last + i;
      Real sum = *c;
      for (std::size_t j = degree; j-- > 0;) {
        c -= n;
        sum = *c + factor[j % 2] * sum;
      }
      out[i] = sum;
    }
    return;
  }
  const Real* c = last;
  for (std::size_t i = 0; i < n; ++i) out[i] = c[i];
  for (std::size_t j = degree; j-- > 0;) {
    c -= n;
    for (std::size_t i = 0; i < n; ++i) out[i] = c[i] + factor[j % 2] * out[i];
  }
}

/// Σ c_k θ^k, the coefficients c_k (n,) one after the other.
template <class Real>
void power_series(const Real* data, std::size_t size, std::size_t n, const Real& theta, Real* out) {
  if (n == 0) return;
  const Real* c = data + (size - n);
  for (std::size_t i = 0; i < n; ++i) out[i] = c[i];
  while (c != data) {
    c -= n;
    for (std::size_t i = 0; i < n; ++i) out[i] = c[i] + theta * out[i];
  }
}

/// Evaluates the power series at several θ, as an `Interpolate`.
void power_series(const double* data, std::size_t size, std::size_t n, std::span<const double> theta, double* out);

/// The part that a correction of the end has at θ ∈ [0, 1]: flat at both.
template <class Real>
Real part_of_end(const Real& theta) {
  return theta * theta * (Real(3) - 2 * theta);
}

/// Into so many intervals a step is cut whose extension has that degree: at their ends the signs of events are
/// compared.
constexpr std::size_t intervals_of_step(std::size_t degree) {
  constexpr std::size_t fewest_points = 3;  // inside of the step: an event need not be linear in y
  return (degree < fewest_points ? fewest_points : degree) + 1;
}

/// The factor by which an event may be steeper than between any two of these ends, before it is resolved.
inline constexpr double room_between_points = 1.25;

}  // namespace invariode
