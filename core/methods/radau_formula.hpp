#pragma once
// The Radau IIA formulas of 3, 5 and 7 stages as numbers (docs/algorithms.md, 'Radau'; Hairer & Wanner, Solving
// Ordinary Differential Equations II, 2nd ed., 1996, section IV.5, and Stiff differential equations solved by Radau
// methods, J. Comput. Appl. Math. 111 (1999) 93-111).

#include <array>
#include <complex>
#include <cstddef>
#include <span>

namespace invariode {

/// A formula of s stages, order 2 s − 1. Increments Z_1 … Z_s, those of the stages, lie one behind the other in a
/// vector of s n numbers; the matrices are s × s, row by row.
struct RadauFormula {
  using Complex = std::complex<double>;

  std::size_t stages;
  const double* nodes;             ///< c, of which the last one is 1
  const double* A_inverse;         ///< h Y' = A⁻¹ Z
  double mu;                       ///< the real eigenvalue of A⁻¹
  std::span<const Complex> pairs;  ///< α + i β of the others
  const double* T;                 ///< columns: eigenvector of mu, real and imaginary part of that of each pair
  const double* T_inverse;         ///< T⁻¹
  const double* initial_slope;     ///< row: h times the derivative of the collocation polynomial at the start
  double farthest;  ///< θ where θ ∏ (θ − c_i) is largest: P is farthest from a smooth function through its points
  const double* value_there;   ///< row: the collocation polynomial P at that θ, less its start
  const double* slope_there;   ///< row: h P' there
  const double* coefficients;  ///< of that polynomial in the form of `runge_kutta::nested_polynomial`
  void (*transform)(const double* matrix, std::size_t n, std::size_t first, std::size_t end, const double* in,
                    double* out);  ///< see below

  [[nodiscard]] int order() const { return 2 * static_cast<int>(stages) - 1; }
};

/// All of them, by rising order. `transform`: out_k = Σ_j matrix_kj in_j, vectors (n,), in the components from `first`
/// to `end`; `out` may be `in`.
inline constexpr std::size_t radau_formula_count = 3;
extern const std::array<RadauFormula, radau_formula_count> radau_formulas;

}  // namespace invariode
