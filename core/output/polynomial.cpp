#include "output/polynomial.hpp"

#include <array>

namespace invariode {
namespace {

constexpr std::size_t at_once = 16;  // θ, whose sums are independent of each other, and wait less for their terms
constexpr std::size_t wide = 8;      // components: from so many on those of one θ fill the vectors

/// One component at `at_once` θ.
void component_at_points(const double* last, std::size_t terms, std::size_t n, const double* theta, double* out) {
  std::array<double, at_once> sum;
  sum.fill(*last);
  for (std::size_t k = 1; k < terms; ++k) {
    last -= n;
    for (std::size_t p = 0; p < at_once; ++p) sum[p] = *last + theta[p] * sum[p];
  }
  for (std::size_t p = 0; p < at_once; ++p) out[p * n] = sum[p];
}

}  // namespace

void power_series(const double* data, std::size_t size, std::size_t n, std::span<const double> theta, double* out) {
  if (n == 0) return;
  while (n < wide && theta.size() >= at_once) {
    for (std::size_t i = 0; i < n; ++i) component_at_points(data + (size - n) + i, size / n, n, theta.data(), out + i);
    theta = theta.subspan(at_once);
    out += at_once * n;
  }
  for (const double one : theta) {
    power_series(data, size, n, one, out);
    out += n;
  }
}

}  // namespace invariode
