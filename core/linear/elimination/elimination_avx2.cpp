// Elimination compiled for the instruction set avx2.

#define INVARIODE_LANES avx2
#include "linear/elimination/kernel.hpp"

namespace invariode::elimination {

constinit const Kernel of_avx2 = {.factor = &avx2::factor, .solve = &avx2::solve};

}  // namespace invariode::elimination
