// The steps of Runge-Kutta pairs for small systems; compiled without automatic vectorization.

#include "methods/runge_kutta_step.hpp"

namespace invariode::runge_kutta {

constinit const std::array<MakeStep, Pairs::count> steps_of_small_systems = factories<true>(Pairs());

}  // namespace invariode::runge_kutta
