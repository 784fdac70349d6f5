#pragma once
// The arithmetic of one step of an explicit Runge-Kutta pair, apart from what controls it: stages, candidate, error.
// The numbers are doubles, or packs of them that behave alike, one trajectory in each lane.

#include <array>
#include <cmath>
#include <cstddef>
#include <utility>

#include "methods/stability.hpp"
#include "methods/tableau.hpp"

namespace invariode::runge_kutta {

inline constexpr double safety = 0.8;        // of the predicted optimal step; 1/1.25 on success
inline constexpr double largest_growth = 5;  // of h after a success
// Slopes of the extension that are larger, in units of the largest of the step, come from beside a singularity of f.
// (On orbits, populations and oscillators with crude tolerances none was above 4 times that.)
inline constexpr double largest_slope = 100;

// Packs have functions of their own of these names.
inline double choose(bool condition, double yes, double no) { return condition ? yes : no; }
inline double square_root(double x) { return std::sqrt(x); }

/// `Build` tells translation units apart that are compiled with different flags: they must not share these functions.
template <const auto& T, class Real, int Build = 0>
struct Kernel {
  static constexpr std::size_t last = T.stages - 1;
  /// k_j of all stages, those of the extension behind those of the step; each (n,).
  using Stages = std::array<Real*, T.all_stages>;

  /// The argument of stage I: y + h Σ_{j<I} A_Ij k_j.
  template <std::size_t I>
  static void argument(const Real* y, Real h, const Stages& k, std::size_t n, Real* out) {
    for (std::size_t i = 0; i < n; ++i) out[i] = y[i] + h * dot<I>(k, [](auto j) { return T.A[I][j]; }, i);
  }

  /// The same for a stage of the extension, whose number is not known to the compiler.
  static void extension_argument(std::size_t stage, const Real* y, Real h, const Stages& k, std::size_t n, Real* out) {
    for (std::size_t i = 0; i < n; ++i) {
      Real sum(0);
      for (std::size_t j = 0; j < stage; ++j) sum += T.A[stage][j] * k[j][i];
      out[i] = y[i] + h * sum;
    }
  }

  /// y* = y + h Σ b_j k_j
  static void candidate(const Real* y, Real h, const Stages& k, std::size_t n, Real* out) {
    for (std::size_t i = 0; i < n; ++i) out[i] = y[i] + h * dot<last>(k, [](auto j) { return T.b()[j]; }, i);
  }

  /// ‖Σ E_j k_j‖ with the weights weight(i), to be multiplied by |h|. `Norm` collects a maximum by `add`.
  template <class Norm, class Weight>
  static Real error(const Stages& k, std::size_t n, Weight weight) {
    Norm norm, crude;
    for (std::size_t i = 0; i < n; ++i) {
      const Real w = weight(i);
      norm.add(dot<T.stages>(k, [](auto j) { return T.E[j]; }, i) / w);
      if constexpr (T.crude_order > 0) crude.add(dot<T.stages>(k, [](auto j) { return T.crude[j]; }, i) / w);
    }
    if constexpr (T.crude_order > 0)
      return combined_error(norm.value(), crude.value());
    else
      return norm.value();
  }

  /// Σ E_j k_j of each component, times h: the formula of higher order where there are two.
  static void errors(Real h, const Stages& k, std::size_t n, Real* out) {
    for (std::size_t i = 0; i < n; ++i) out[i] = h * dot<T.stages>(k, [](auto j) { return T.E[j]; }, i);
  }

  /// Σ v_j k_j and Σ u_j k_j of `probe`, for component i.
  static std::array<Real, 2> probed(const Stages& k, std::size_t i) {
    static constexpr auto p = probe<T>();
    return {dot<T.stages>(
                k, [](auto j) { return p.slopes[j]; }, i),
            dot<T.stages>(k, [](auto j) { return p.arguments[j]; }, i)};
  }

  /// Coefficients of the continuous extension, (degree, n): h Σ_j B_jd k_j.
  static void coefficients(Real h, const Stages& k, std::size_t n, Real* out) {
    [&]<std::size_t... D>(std::index_sequence<D...>) {
      (coefficient<D>(h, k, n, out + D * n), ...);
    }(std::make_index_sequence<T.degree>{});
  }

 private:
  /// With two lower formulas: e₁² / √(e₁² + (e₂/10)²) (Hairer, Nørsett, Wanner, Solving ODEs I, ch. II.10), in a form
  /// whose squares neither overflow nor underflow before the result does.
  static Real combined_error(Real error, Real crude) {
    constexpr double weight_of_crude = 0.1;
    const Real ratio = weight_of_crude * crude / error;
    return choose(Real(0) < error, error / square_root(Real(1) + ratio * ratio), error);
  }

  template <std::size_t D>
  static void coefficient(Real h, const Stages& k, std::size_t n, Real* out) {
    for (std::size_t i = 0; i < n; ++i) out[i] = h * dot<T.all_stages>(k, [](auto j) { return T.B[j][D]; }, i);
  }

  /// Σ_j w(j) k_j[i] over the stages j < Count whose weight, known at compile time, is not zero.
  template <std::size_t Count, class W>
  static Real dot(const Stages& k, W w, std::size_t i) {
    return [&]<std::size_t... J>(std::index_sequence<J...>) {
      Real sum(0);
      const auto add = [&]<std::size_t j>(std::integral_constant<std::size_t, j> index) {
        if constexpr (w(index) != 0) sum += w(index) * k[j][i];
      };
      (add(std::integral_constant<std::size_t, J>{}), ...);
      return sum;
    }(std::make_index_sequence<Count>{});
  }
};

}  // namespace invariode::runge_kutta
