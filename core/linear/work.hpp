#pragma once
// What the linear algebra of an implicit method did, and what went wrong with it.

#include <cstdint>
#include <limits>
#include <optional>

#include "linear/misfit.hpp"

namespace invariode {

/// Why GMRES did not solve a linear system: it stagnates; a product of a user's function, or a difference of f in its
/// place, is not finite; what the preconditioner returns is not finite, or 0 of something else.
enum class Unsolved { none, slow, product, difference, preconditioner, preconditioner_zero };
/// Users' functions are why.
constexpr bool undefined_function(Unsolved why) { return why != Unsolved::none && why != Unsolved::slow; }

/// Jacobians, factorisations (or set-ups of a preconditioner) and solves so far, products with the Jacobian and
/// iterations of GMRES; whether the last attempt met a linear system that GMRES did not solve (with a J or a
/// preconditioner of that t), a singular iteration matrix, or a Jacobian or a mass matrix that is not finite.
struct LinearWork {
  std::int64_t jacobians = 0, factorizations = 0, solves = 0, products = 0, iterations = 0;
  Unsolved unsolved = Unsolved::none;
  double unsolved_t = 0;
  std::int64_t complex_calls = 0;                                             ///< of f at complex y, for Jacobians
  double abandoned_complex_steps = std::numeric_limits<double>::quiet_NaN();  ///< t at which differences replaced them
  std::int64_t enlargements = 0;                                              ///< of a sparsity pattern that was found,
  std::int64_t entries = 0, groups = 0;  ///< its entries, and the evaluations of f that differences take with it
  std::int64_t checks = 0;               ///< evaluations of f that tested Jacobians
  std::optional<Misfit> misfit;
  bool singular = false;
  bool undefined_jacobian = false;
  bool undefined_mass = false;
};

}  // namespace invariode
