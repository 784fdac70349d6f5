#pragma once
// The instruction sets that kernels were compiled for: each has an object file of its own, with flags of its own.

#include "run/lanes/lanes.hpp"

namespace invariode::lanes {

extern const Instructions of_baseline;
#if defined(INVARIODE_X86_LANES)
extern const Instructions of_avx2;
extern const Instructions of_avx512;
#endif

}  // namespace invariode::lanes
