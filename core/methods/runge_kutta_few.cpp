// The Runge-Kutta pairs for few equations; compiled without automatic vectorization.

#include "methods/runge_kutta_step.hpp"

namespace invariode::runge_kutta {

constinit const std::array<MakePair, Pairs::count> pairs_for_few = factories<true>(Pairs());

}  // namespace invariode::runge_kutta
