// Elimination compiled for the instruction set baseline.

#define INVARIODE_LANES baseline
#include "linear/elimination/kernel.hpp"

namespace invariode::elimination {

constinit const Kernel of_baseline = {.factor = &baseline::factor, .solve = &baseline::solve};

}  // namespace invariode::elimination
