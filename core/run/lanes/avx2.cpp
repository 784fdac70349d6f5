// The kernels for AVX2.

#define INVARIODE_LANES avx2
#include "run/lanes/lane_integrator.hpp"

namespace invariode::lanes {

constinit const Instructions of_avx2 = avx2::instructions<16, false>("avx2");

}  // namespace invariode::lanes
