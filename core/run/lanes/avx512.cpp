// The kernels for AVX-512.

#define INVARIODE_LANES avx512
#include "run/lanes/lane_integrator.hpp"

namespace invariode::lanes {

constinit const Instructions of_avx512 = avx512::instructions<16, false>("avx512");

}  // namespace invariode::lanes
