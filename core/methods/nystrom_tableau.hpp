#pragma once
// An explicit Runge-Kutta-Nystrom pair for y'' = f(t, y) as data that checks itself, as a `Tableau` does: order
// conditions of both formulas and of the continuous extension in positions and velocities. Each pair has a file of its
// own, named after the method.

#include <array>
#include <cstddef>

#include "methods/tableau.hpp"

namespace invariode {

/// With F_j = f(t + c_j h, q + c_j h v + h² Σ_k A_jk F_k) the higher formulas are q₁ = q + h v + h² Σ b̄_j F_j, v₁ = v +
/// h Σ b_j F_j, b̄ being row `stages` − 1 of A: the last stage is f(t₁, q*), the next step's first one (appended, with
/// weight 0, to a pair whose formulas do not have it). E_q and E_v give the differences from the lower formulas.
///
/// The extension is q(θ) = q + θ h v + h² Σ F_j P_j(θ), with its derivative for v(θ), as P = θ (B₀ + (1−θ) (B₁ + θ (B₂
/// + …))); it meets q, v and f at both ends, and may take `Extra` stages of its own.
template <std::size_t Stages, std::size_t Degree, std::size_t Extra = 0>
struct NystromTableau {
  static constexpr std::size_t stages = Stages;
  static constexpr std::size_t degree = Degree;
  static constexpr std::size_t all_stages = Stages + Extra;
  static constexpr bool predicts = true;  // the controller sees a trend of the errors

  const char* name;     ///< of the method
  const char* summary;  ///< what it is and what it is for, in a few words
  const char* source;   ///< where the coefficients come from
  int iterations;       ///< of the projection in a step
  int order;            ///< of the higher formulas
  int error_order;      ///< of the lower ones.
  int extension_order;  ///< of the continuous extension, in q and v together: its q is better by one order
  double floor;         ///< smallest factor by which a first failure cuts h
  std::array<double, all_stages> c;
  std::array<std::array<double, all_stages>, all_stages> A;
  std::array<double, all_stages> b;
  std::array<double, Stages> E_q, E_v;
  std::array<std::array<double, Degree>, all_stages> B_q, B_v;

  [[nodiscard]] constexpr std::array<double, all_stages> b_bar() const { return A[Stages - 1]; }
  /// The controller's exponent.
  [[nodiscard]] constexpr double exponent() const { return 1.0 / (error_order + 1); }
  /// Returns whether f(t₁, q*) has a part in the error estimate. Where it has none, it is evaluated once y₁ is known.
  [[nodiscard]] constexpr bool last_in_error() const { return E_v[Stages - 1] != 0; }
};

/// The one of the two sums that the weights w belong to.
enum class Nystrom { position, velocity };

/// Largest defect in the order conditions of the weights w of a sum over the stages A, c: h² Σ w_j F_j of positions or
/// h Σ w_j F_j of velocities at t + θh. The trees are the rooted trees whose nodes at odd levels, derivatives of y,
/// have at most one branch each: f does not depend on them (Hairer, Nørsett, Wanner, Solving ODEs I, ch. II.14). The
/// first one above `enough` will do.
template <std::size_t S>
constexpr double nystrom_defect(const std::array<std::array<double, S>, S>& A, const std::array<double, S>& c,
                                const std::array<double, S>& w, Nystrom sum, int order, double theta = 1,
                                double enough = std::numeric_limits<double>::infinity()) {
  constexpr std::size_t most = 13;  // nodes: one above the highest order, where the conditions must fail
  const bool position = sum == Nystrom::position;
  double worst = 0, power = position ? theta : 1;
  for (std::size_t r = 1; r + (position ? 1 : 0) <= static_cast<std::size_t>(order); ++r) {
    power *= theta;
    detail::RootedTree<most> tree(r);
    do {
      std::array<std::size_t, most> branches{};
      bool special = true;
      for (std::size_t v = r; v-- > 1;)
        special &= tree.level[tree.parent(v)] % 2 == 0 || ++branches[tree.parent(v)] == 1;
      if (!special) continue;
      std::array<std::array<double, S>, most> phi{};
      for (auto& node : phi) node.fill(1);
      for (std::size_t v = r; v-- > 1;) {
        if (tree.level[v] % 2 == 0) continue;  // an f: its parent knows how it is taken in
        auto& up = phi[tree.parent(v)];
        for (std::size_t i = 0; i < S; ++i) {
          double inside = branches[v] == 0 ? c[i] : 0;
          for (std::size_t j = 0; j < S && branches[v] > 0; ++j) inside += A[i][j] * phi[v + 1][j];
          up[i] *= inside;
        }
      }
      double total = 0;
      for (std::size_t i = 0; i < S; ++i) total += w[i] * phi[0][i];
      const double exact = power / tree.density() / (position ? static_cast<double>(r + 1) : 1);
      const double defect = detail::absolute(total - exact);
      if (defect > worst) worst = defect;
      if (worst > enough) return worst;
    } while (tree.next());
  }
  return worst;
}

/// True where a tableau is what it says. Every condition that a misprint in one coefficient breaks is tested.
template <std::size_t S, std::size_t D, std::size_t X>
constexpr bool consistent(const NystromTableau<S, D, X>& T, double roundoff) {
  const auto close = [roundoff](double a, double b) { return detail::absolute(a - b) <= roundoff; };
  for (std::size_t i = 0; i < S + X; ++i) {
    double sum = 0;
    for (std::size_t j = 0; j < S + X; ++j) {
      if (j >= i && T.A[i][j] != 0) return false;  // explicit
      sum += T.A[i][j];
    }
    if (!close(sum, T.c[i] * T.c[i] / 2)) return false;
  }
  if (T.c[0] != 0 || T.c[S - 1] != 1) return false;          // the last stage is f(t₁, q*)
  if (T.E_v[S - 1] == 0 && T.E_v[S - 2] == 0) return false;  // the error estimate sees a NaN in the last stage it has

  const auto end_q = nested_weights(T.B_q, 1), end_v = nested_weights(T.B_v, 1);
  const auto slope0 = nested_weights(T.B_v, 0, true), slope1 = nested_weights(T.B_v, 1, true);
  for (std::size_t k = 0; k < S + X; ++k) {
    if (!close(end_q[k], T.b_bar()[k]) || !close(end_v[k], T.b[k])) return false;
    if (!close(slope0[k], k == 0 ? 1 : 0) || !close(slope1[k], k == S - 1 ? 1 : 0)) return false;
  }
  for (std::size_t theta = 1; theta < D; ++theta) {  // at as many places as tell polynomials apart
    const double at = static_cast<double>(theta) / D;
    const auto slope = nested_weights(T.B_q, at, true), v = nested_weights(T.B_v, at);
    for (std::size_t k = 0; k < S + X; ++k)
      if (!close(slope[k], v[k])) return false;
  }

  const auto reaches = [&T, roundoff](Nystrom sum, int order, const std::array<double, S + X>& w, double theta = 1) {
    return nystrom_defect(T.A, T.c, w, sum, order, theta, roundoff) <= roundoff;
  };
  auto lower_q = T.b_bar(), lower_v = T.b;
  for (std::size_t k = 0; k < S; ++k) lower_q[k] -= T.E_q[k], lower_v[k] -= T.E_v[k];
  if (!reaches(Nystrom::position, T.order, T.b_bar()) || !reaches(Nystrom::velocity, T.order, T.b)) return false;
  if (!reaches(Nystrom::position, T.error_order, lower_q) || !reaches(Nystrom::velocity, T.error_order, lower_v))
    return false;
  for (const double theta : {0.25, 0.5, 0.75, 1.0}) {
    const auto q = nested_weights(T.B_q, theta), v = nested_weights(T.B_v, theta);
    if (!reaches(Nystrom::position, T.extension_order + 1, q, theta)) return false;
    if (!reaches(Nystrom::velocity, T.extension_order, v, theta)) return false;
  }
  return true;
}

}  // namespace invariode
