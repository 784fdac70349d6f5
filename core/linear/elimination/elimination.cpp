#include "linear/elimination/elimination.hpp"

#include <vector>

#include "instruction_sets.hpp"

namespace invariode::elimination {
namespace {

std::vector<const Kernel*> of_this_processor() {
  std::vector<const Kernel*> found;
#if defined(INVARIODE_X86_LANES)
  if (processor_has_avx512()) found.push_back(&of_avx512);
  if (processor_has_avx2()) found.push_back(&of_avx2);
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
