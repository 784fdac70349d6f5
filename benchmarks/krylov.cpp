// The Brusselator in three dimensions and a preconditioner for it, for `benchmarks/krylov.py`, which compiles this with
// the flags of the core. p = [points in each direction, what a point takes from a neighbour per unit of time]; u and v
// alternate; no flux through the boundary: the points beyond it mirror those within.

#include <cstddef>

namespace {

constexpr double A = 1, B = 3.4;

std::size_t before(std::size_t i) { return i > 0 ? i - 1 : 1; }
std::size_t after(std::size_t i, std::size_t side) { return i + 1 < side ? i + 1 : side - 2; }

}  // namespace

extern "C" {

void brusselator_f(double, const double* y, double* out, const double* p) {
  const auto side = static_cast<std::size_t>(p[0]);
  const double d = p[1];
  const auto row = [side](std::size_t i, std::size_t j) { return 2 * side * (i * side + j); };
  for (std::size_t i = 0; i < side; ++i)
    for (std::size_t j = 0; j < side; ++j) {
      const double* here = y + row(i, j);
      const double* around[] = {y + row(before(i), j), y + row(after(i, side), j), y + row(i, before(j)),
                                y + row(i, after(j, side))};
      double* rate = out + row(i, j);
      const auto diffuse = [&](std::size_t k, std::size_t left, std::size_t right) {
        for (std::size_t m = 0; m < 2; ++m) {
          double sum = here[2 * left + m] + here[2 * right + m] - 6 * here[2 * k + m];
          for (const double* other : around) sum += other[2 * k + m];
          rate[2 * k + m] = d * sum;
        }
      };
      diffuse(0, 1, 1);
      for (std::size_t k = 1; k + 1 < side; ++k) diffuse(k, k - 1, k + 1);
      diffuse(side - 1, side - 2, side - 2);
      for (std::size_t k = 0; k < side; ++k) {
        const double u = here[2 * k], v = here[2 * k + 1], uuv = u * u * v;
        rate[2 * k] += A + uuv - (B + 1) * u;
        rate[2 * k + 1] += B * u - uuv;
      }
    }
}

/// b becomes x, where (I − c J) x = b at y without the exchange with neighbours: 2 × 2 blocks.
void brusselator_solve(double c, const double* y, double* b, const double* p) {
  const auto side = static_cast<std::size_t>(p[0]), points = side * side * side;
  for (std::size_t k = 0; k < points; ++k) {
    const double u = y[2 * k], v = y[2 * k + 1], own = 1 + 6 * c * p[1];
    const double a11 = own - c * (2 * u * v - B - 1), a12 = -c * u * u, a21 = -c * (B - 2 * u * v),
                 a22 = own + c * u * u;
    const double b1 = b[2 * k], b2 = b[2 * k + 1], determinant = a11 * a22 - a12 * a21;
    b[2 * k] = (a22 * b1 - a12 * b2) / determinant;
    b[2 * k + 1] = (a11 * b2 - a21 * b1) / determinant;
  }
}
}
