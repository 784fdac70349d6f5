// The kernels for AVX-512.

#define INVARIODE_LANES avx512
#include "run/lanes/block.hpp"
#include "run/lanes/instructions.hpp"

namespace invariode::lanes {
namespace {

constexpr int width = 16;
constexpr auto pairs = avx512::kernels<width, false>(runge_kutta::Pairs());

}  // namespace

constinit const Instructions of_avx512{"avx512", width, 512, pairs};

}  // namespace invariode::lanes
