#include "linear/solve.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

namespace invariode {

void solve_in_place(std::int64_t k, std::int64_t m, double* numbers) noexcept {
  double* const A = numbers;
  double* const B = numbers + k * k;
  for (std::int64_t c = 0; c < k; ++c) {
    std::int64_t pivot = c;
    for (std::int64_t i = c + 1; i < k; ++i)
      if (std::abs(A[i * k + c]) > std::abs(A[pivot * k + c])) pivot = i;
    if (!(std::abs(A[pivot * k + c]) > 0)) {
      std::fill(B, B + k * m, std::numeric_limits<double>::quiet_NaN());
      return;
    }
    if (pivot != c) {
      std::swap_ranges(A + c * k, A + (c + 1) * k, A + pivot * k);
      std::swap_ranges(B + c * m, B + (c + 1) * m, B + pivot * m);
    }
    for (std::int64_t i = c + 1; i < k; ++i) {
      const double factor = A[i * k + c] / A[c * k + c];
      if (factor == 0) continue;
      for (std::int64_t j = c + 1; j < k; ++j) A[i * k + j] -= factor * A[c * k + j];
      for (std::int64_t j = 0; j < m; ++j) B[i * m + j] -= factor * B[c * m + j];
    }
  }
  for (std::int64_t i = k; i-- > 0;)
    for (std::int64_t j = 0; j < m; ++j) {
      double sum = B[i * m + j];
      for (std::int64_t c = i + 1; c < k; ++c) sum -= A[i * k + c] * B[c * m + j];
      B[i * m + j] = sum / A[i * k + i];
    }
}

}  // namespace invariode
