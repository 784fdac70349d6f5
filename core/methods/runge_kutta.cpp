#include "methods/runge_kutta.hpp"

#include "methods/runge_kutta_step.hpp"
#include "output/polynomial.hpp"

namespace invariode::runge_kutta {

void nested_polynomial(const double* data, std::size_t size, std::size_t n, double theta, double* out) {
  invariode::nested_polynomial(data, size, n, theta, out);
}

double* resized(std::vector<double>& v, std::size_t size) {
  v.resize(size);
  return v.data();
}

constinit const std::array<MakeStep, Pairs::count> steps_of_any_system = factories<false>(Pairs());

}  // namespace invariode::runge_kutta
