#include "run/lanes/lanes.hpp"

#include <algorithm>
#include <vector>

namespace invariode::lanes {
namespace {

std::vector<const Instructions*> of_this_processor() {
  std::vector<const Instructions*> found;
#if defined(INVARIODE_X86_LANES)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") != 0 && __builtin_cpu_supports("avx512dq") != 0 &&
      __builtin_cpu_supports("avx512vl") != 0)
    found.push_back(&of_avx512);
  if (__builtin_cpu_supports("avx2") != 0) found.push_back(&of_avx2);
#endif
  found.push_back(&of_baseline);
  return found;
}

}  // namespace

const Kernel* Instructions::kernel(std::string_view method) const {
  const auto found = std::ranges::find(kernels, method, &Kernel::method);
  return found == kernels.end() ? nullptr : &*found;
}

std::span<const Instructions* const> instructions() {
  static const std::vector<const Instructions*> found = of_this_processor();
  return found;
}

}  // namespace invariode::lanes
