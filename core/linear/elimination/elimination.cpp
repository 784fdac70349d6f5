#include "linear/elimination/elimination.hpp"

#include <vector>

namespace invariode::elimination {
namespace {

std::vector<const Kernel*> of_this_processor() {
  std::vector<const Kernel*> found;
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

std::span<const Kernel* const> kernels() {
  static const std::vector<const Kernel*> found = of_this_processor();
  return found;
}

}  // namespace invariode::elimination
