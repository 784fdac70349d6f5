#pragma once
// The instruction sets for which kernels are compiled, as far as this processor has them.

// A function compiled for AVX2, with all that it calls; it is called where `processor_has_avx2`. Nothing is contracted:
// the bits are those of the code for any processor.
#if defined(INVARIODE_X86_LANES)
#define INVARIODE_FOR_AVX2 [[gnu::target("avx2"), gnu::flatten, gnu::noinline]]
#else
#define INVARIODE_FOR_AVX2
#endif

namespace invariode {

#if defined(INVARIODE_X86_LANES)
[[nodiscard]] inline bool processor_has_avx2() {
  static const bool has = [] {
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") != 0;
  }();
  return has;
}

[[nodiscard]] inline bool processor_has_avx512() {
  __builtin_cpu_init();
  return __builtin_cpu_supports("avx512f") != 0 && __builtin_cpu_supports("avx512dq") != 0 &&
         __builtin_cpu_supports("avx512vl") != 0;
}
#else
[[nodiscard]] constexpr bool processor_has_avx2() { return false; }
#endif

}  // namespace invariode
