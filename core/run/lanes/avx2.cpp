// The kernels for AVX2.

#define INVARIODE_LANES avx2
#include "run/lanes/block.hpp"
#include "run/lanes/instructions.hpp"

namespace invariode::lanes {
namespace {

constexpr int width = 16;
constexpr auto pairs = avx2::kernels<width, false>(runge_kutta::Pairs());

}  // namespace

constinit const Instructions of_avx2{"avx2", width, 256, pairs};

}  // namespace invariode::lanes
