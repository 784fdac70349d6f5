// Products of dense matrices with vectors for `benchmarks/products.py`, which compiles this with the flags of the core:
// `invariode::Matrix::multiply`, and one sum after the other.

#include "linear/elimination/elimination.cpp"
#include "linear/elimination/elimination_baseline.cpp"
#include "linear/matrix.cpp"

extern "C" {

/// A matrix of n² values by rows.
invariode::Matrix* matrix(const double* values, std::size_t n) {
  auto made = new invariode::Matrix(invariode::Structure{.n = n});
  made->values.assign(values, values + n * n);
  return made;
}

void multiply(const invariode::Matrix* A, const double* x, double* out) { A->multiply(x, out); }

void multiply_in_order(const invariode::Matrix* A, const double* x, double* out) {
  const std::size_t n = A->n();
  for (std::size_t i = 0; i < n; ++i) out[i] = 0;
  A->for_each([&](std::size_t i, std::size_t j, double a) { out[i] += a * x[j]; });
}
}
