#include "runge_kutta.hpp"

#include "runge_kutta_step.hpp"

namespace invariode {
namespace {

constexpr std::size_t few = 8;

template <const auto& T>
std::unique_ptr<Step> make(Callback& f, const Weights& weights, Fsal fsal) {
  if (weights.size() <= few) return runge_kutta::step_for_few<T>(f, weights, fsal);
  return std::make_unique<runge_kutta::Pair<T, false>>(f, weights, fsal);
}

}  // namespace

std::unique_ptr<Step> ode23_step(Callback& f, const Weights& weights, Fsal fsal) {
  return make<bogacki_shampine>(f, weights, fsal);
}

std::unique_ptr<Step> ode45_step(Callback& f, const Weights& weights, Fsal fsal) {
  return make<dormand_prince>(f, weights, fsal);
}

std::unique_ptr<Step> dop853_step(Callback& f, const Weights& weights) { return make<dop853>(f, weights, Fsal::reuse); }

std::unique_ptr<Step> ode78_step(Callback& f, const Weights& weights) { return make<verner>(f, weights, Fsal::reuse); }

}  // namespace invariode
