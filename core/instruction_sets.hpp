#pragma once
// The instruction sets for which kernels are compiled, as far as this processor has them.

namespace invariode {

#if defined(INVARIODE_X86_LANES)
[[nodiscard]] inline bool processor_has_avx2() {
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx2") != 0;
}

[[nodiscard]] inline bool processor_has_avx512() {
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx512f") != 0 && __builtin_cpu_supports("avx512dq") != 0 &&
         __builtin_cpu_supports("avx512vl") != 0;
}
#endif

}  // namespace invariode
