// The Runge-Kutta pairs for few equations; compiled without automatic vectorization.

#include "methods/runge_kutta_step.hpp"

namespace invariode::runge_kutta {

template <const auto& T>
std::unique_ptr<Step> step_for_few(Callback& f, const Weights& weights, Fsal fsal) {
  return std::make_unique<Pair<T, true>>(f, weights, fsal);
}

template std::unique_ptr<Step> step_for_few<bogacki_shampine>(Callback&, const Weights&, Fsal);
template std::unique_ptr<Step> step_for_few<dormand_prince>(Callback&, const Weights&, Fsal);
template std::unique_ptr<Step> step_for_few<dop853>(Callback&, const Weights&, Fsal);
template std::unique_ptr<Step> step_for_few<verner>(Callback&, const Weights&, Fsal);

}  // namespace invariode::runge_kutta
