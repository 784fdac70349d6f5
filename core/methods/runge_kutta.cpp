#include "methods/runge_kutta.hpp"

#include <algorithm>

#include "methods/runge_kutta_step.hpp"

namespace invariode {
namespace {

constexpr std::size_t few = 8;

template <const auto& T>
std::unique_ptr<Step> make(Callback& f, const Weights& weights, Fsal fsal) {
  if (weights.size() <= few) return runge_kutta::step_for_few<T>(f, weights, fsal);
  return std::make_unique<runge_kutta::Pair<T, false>>(f, weights, fsal);
}

}  // namespace

void nested(const double* data, std::size_t size, std::size_t n, double theta, double* out) {
  const double* c = data + (size - n);
  std::copy(c, c + n, out);
  for (std::size_t j = size / n - 1; j-- > 0;) {
    const double factor = j % 2 == 1 ? 1 - theta : theta;
    c -= n;
    for (std::size_t i = 0; i < n; ++i) out[i] = c[i] + factor * out[i];
  }
}

std::unique_ptr<Step> ode23_step(Callback& f, const Weights& weights, Fsal fsal) {
  return make<bogacki_shampine>(f, weights, fsal);
}

std::unique_ptr<Step> ode45_step(Callback& f, const Weights& weights, Fsal fsal) {
  return make<dormand_prince>(f, weights, fsal);
}

std::unique_ptr<Step> dop853_step(Callback& f, const Weights& weights) { return make<dop853>(f, weights, Fsal::reuse); }

std::unique_ptr<Step> ode78_step(Callback& f, const Weights& weights) { return make<verner>(f, weights, Fsal::reuse); }

}  // namespace invariode
