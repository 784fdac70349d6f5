#pragma once
// Equations made of products of two components, such as |q|² = 1 and RᵀR = 1: the ready-made manifolds.

#include <cstddef>
#include <vector>

namespace invariode {

/// g_e(y) = Σ_k y[first_ek] y[second_ek], with `terms` products in each equation.
class Quadratic {
 public:
  /// `first`, `second`: (m, terms), row by row. Throws std::invalid_argument where these do not fit n components.
  Quadratic(std::size_t n, std::size_t terms, std::vector<std::size_t> first, std::vector<std::size_t> second);

  [[nodiscard]] std::size_t m() const { return first_.size() / terms_; }
  /// g(y), (m)
  void values(const double* y, double* g) const;
  /// ∂g/∂y, (m, n)
  void gradients(const double* y, double* J) const;

 private:
  std::size_t n_, terms_;
  std::vector<std::size_t> first_, second_;
};

}  // namespace invariode
