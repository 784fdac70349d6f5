#include "run/lanes/lanes.hpp"

#include <algorithm>
#include <vector>

#include "instruction_sets.hpp"

namespace invariode::lanes {
namespace {

std::vector<const Instructions*> of_this_processor() {
  std::vector<const Instructions*> found;
#if defined(INVARIODE_X86_LANES)
  if (processor_has_avx512()) found.push_back(&of_avx512);
  if (processor_has_avx2()) found.push_back(&of_avx2);
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
