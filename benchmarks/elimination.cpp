// One kernel of elimination for `benchmarks/dense.py`, which compiles this with the flags of the core: KERNEL is the
// file of the kernel, SET its name.

#include KERNEL

extern "C" int factor(double* re, double* im, std::size_t n, std::size_t height, std::size_t* exchanged_with) {
  return invariode::elimination::SET.factor({n, height, re, im}, exchanged_with) ? 1 : 0;
}
