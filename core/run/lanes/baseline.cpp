// The kernels for the instructions that every processor of the target has; one trajectory alone is integrated by these,
// too.

#define INVARIODE_LANES baseline
#include "run/lanes/lane_integrator.hpp"

namespace invariode::lanes {

constinit const Instructions of_baseline =
    baseline::instructions<8, true>(baseline::native == 1 ? "scalar" : "baseline");

}  // namespace invariode::lanes
