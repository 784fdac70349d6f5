// The kernels for the instructions that every processor of the target has; one trajectory alone is integrated by these,
// too.

#define INVARIODE_LANES baseline
#include "run/lanes/block.hpp"
#include "run/lanes/instructions.hpp"

namespace invariode::lanes {
namespace {

constexpr int width = 8;
constexpr auto pairs = baseline::kernels<width, true>(runge_kutta::Pairs());
constexpr std::string_view name = baseline::native == 1 ? "scalar" : "baseline";

}  // namespace

constinit const Instructions of_baseline{name, width, std::size_t{baseline::native} * 64, pairs};

}  // namespace invariode::lanes
