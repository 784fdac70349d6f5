// The Brusselator on a line, as in tests/stiff.py, for `benchmarks/banded.py`, which compiles this with the flags of
// the core. p = [points, what a point takes from a neighbour per unit of time]; u and v alternate, u = 1 and v = 3 at
// both ends.

#include <cstddef>

extern "C" void brusselator_f(double, const double* y, double* out, const double* p) {
  const auto points = static_cast<std::size_t>(p[0]);
  const double d = p[1], ends[] = {1, 3};
  for (std::size_t i = 0; i < points; ++i) {
    const double* here = y + 2 * i;
    const double *left = i > 0 ? here - 2 : ends, *right = i + 1 < points ? here + 2 : ends;
    const double u = here[0], v = here[1], uuv = u * u * v;
    out[2 * i] = d * (left[0] - 2 * u + right[0]) + 1 + uuv - 4 * u;
    out[2 * i + 1] = d * (left[1] - 2 * v + right[1]) + 3 * u - uuv;
  }
}
