// Elimination compiled for the instruction set avx512.

#define INVARIODE_LANES avx512
#include "linear/elimination/kernel.hpp"

namespace invariode::elimination {

constinit const Kernel of_avx512 = {.factor = &avx512::factor, .solve = &avx512::solve};

}  // namespace invariode::elimination
