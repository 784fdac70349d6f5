// Right-hand sides of any size for `benchmarks/large.py`, which compiles this with the flags of the core, and STREAM's
// triad. p = [n, what a cell takes from its neighbours per unit of time, …]; the cells form a ring.

#include <chrono>
#include <cstddef>
#include <vector>

extern "C" {

/// Heat: n cells.
void heat_f(double, const double* y, double* out, const double* p) {
  const auto n = static_cast<std::size_t>(p[0]);
  const double d = p[1];
  out[0] = d * (y[n - 1] - 2 * y[0] + y[1 % n]);
  for (std::size_t i = 1; i + 1 < n; ++i) out[i] = d * (y[i - 1] - 2 * y[i] + y[i + 1]);
  out[n - 1] = d * (y[n - 2] - 2 * y[n - 1] + y[0]);
}

/// A wave: n / 2 displacements, then as many velocities.
void wave_f(double t, const double* y, double* out, const double* p) {
  const auto cells = static_cast<std::size_t>(p[0]) / 2;
  const double half[] = {static_cast<double>(cells), p[1]};
  for (std::size_t i = 0; i < cells; ++i) out[i] = y[cells + i];
  heat_f(t, y, out + cells, half);
}

/// Total heat, a linear invariant, and its Jacobian.
void heat_g(double, const double* y, double* out, const double* p) {
  const auto n = static_cast<std::size_t>(p[0]);
  double sum = 0;
  for (std::size_t i = 0; i < n; ++i) sum += y[i];
  out[0] = sum;
}

void heat_gjac(double, const double*, double* out, const double* p) {
  const auto n = static_cast<std::size_t>(p[0]);
  for (std::size_t i = 0; i < n; ++i) out[i] = 1;
}

/// Seconds that a[i] = b[i] + s c[i] takes for `size` numbers, in each of `count` repetitions.
double triad(std::size_t size, std::size_t count, double* seconds) {
  std::vector<double> a(size), b(size, 1.0), c(size, 2.0);
  double check = 0;
  for (std::size_t k = 0; k < count; ++k) {
    const double s = 1.0 + static_cast<double>(k);
    const auto start = std::chrono::steady_clock::now();
    for (std::size_t i = 0; i < size; ++i) a[i] = b[i] + s * c[i];
    seconds[k] = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    check += a[k % size];
  }
  return check;
}
}
