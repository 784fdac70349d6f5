#include "methods/runge_kutta.hpp"

#include <algorithm>

#include "methods/runge_kutta_step.hpp"

namespace invariode::runge_kutta {

void nested_polynomial(const double* data, std::size_t size, std::size_t n, double theta, double* out) {
  const double* c = data + (size - n);
  std::copy(c, c + n, out);
  for (std::size_t j = size / n - 1; j-- > 0;) {
    const double factor = j % 2 == 1 ? 1 - theta : theta;
    c -= n;
    for (std::size_t i = 0; i < n; ++i) out[i] = c[i] + factor * out[i];
  }
}

double* memory(std::vector<double>& v, std::size_t size) {
  v.resize(size);
  return v.data();
}

constinit const std::array<MakePair, Pairs::count> pairs_for_many = factories<false>(Pairs());

}  // namespace invariode::runge_kutta
