#pragma once
// The arithmetic of one step of an explicit Runge-Kutta pair: stages, candidate, error, extension. The numbers are
// doubles, or packs of them, one trajectory in each lane.

#include <array>
#include <cstddef>
#include <type_traits>
#include <utility>

#include "instruction_sets.hpp"
#include "methods/stability.hpp"
#include "methods/tableau.hpp"
#include "number.hpp"
#include "weights.hpp"

namespace invariode::runge_kutta {

// Slopes of the extension that are larger, in units of the largest of the step, come from beside a singularity of f.
// (On orbits, populations and oscillators with crude tolerances none was above 4 times that.)
inline constexpr double largest_slope = 100;

// Where f jumps inside a step, a divided difference of its slopes is about as large as the jump; where f is smooth, it
// is much smaller than the range of the slopes, or the error estimate tells of it (docs/algorithms.md, 'Jumps of f').
inline constexpr double bend_of_jump = 0.2;  // of the range of the slopes: any jump leaves more than 0.5
inline constexpr double harmless_bend = 20;  // |h| times the difference, in units of rtol
inline constexpr double told_bend = 100;     // the same, in units of the error estimate

/// `Norm` collects a maximum by `add`. `Build` tells translation units apart that are compiled with different flags:
/// they must not share these functions.
template <const auto& T, class Real, class Norm, int Build = 0>
struct Kernel {
  static constexpr std::size_t last = T.stages - 1;
  /// k_j of all stages, those of the extension behind those of the step; each (n,).
  using Stages = std::array<Real*, T.all_stages>;

  /// The argument of stage I: y + h Σ_{j<I} A_Ij k_j.
  template <std::size_t I>
  static void argument(const Real* y, const Real& h, const Stages& k, std::size_t n, Real* out) {
    in_vectors(out, [y, h, &k, n](Real* __restrict to) {
      for (std::size_t i = 0; i < n; ++i) to[i] = y[i] + h * dot<I>(k, [](auto j) { return T.A[I][j]; }, i);
    });
  }

  /// Stages 1 … last − 1 from (t, y), of the step of size h = t₁ − t as all else (docs/algorithms.md, 'Every method'):
  /// evaluate(t, y, I) puts f(t, y) into k_I; false ends them.
  template <class Evaluate>
  static void inner_stages(const Real& t, const Real* y, const Real& h, const Stages& k, std::size_t n, Real* work,
                           Evaluate evaluate) {
    [&]<std::size_t... I>(std::index_sequence<I...>) {
      const auto stage = [&]<std::size_t i>(std::integral_constant<std::size_t, i>) {
        argument<i>(y, h, k, n, work);
        return evaluate(t + T.c[i] * h, work, i);
      };
      (stage(std::integral_constant<std::size_t, I + 1>{}) && ...);
    }(std::make_index_sequence<last - 1>{});
  }

  /// Evaluates the stages of the extension, of the step of size h from y to t1, alike.
  template <class Evaluate>
  static void further_stages(const Real& t1, const Real* y, const Real& h, const Stages& k, std::size_t n, Real* work,
                             Evaluate evaluate) {
    for (std::size_t s = T.stages; s < T.all_stages; ++s) {
      for (std::size_t i = 0; i < n; ++i) {
        Real sum(0);
        for (std::size_t j = 0; j < s; ++j) sum += T.A[s][j] * k[j][i];
        work[i] = y[i] + h * sum;
      }
      if (!evaluate(t1 - (1 - T.c[s]) * h, work, s)) return;
    }
  }

  /// ‖k_s‖ with the weights weight(i).
  template <class Weight>
  static Real size_of_stage(std::size_t s, const Stages& k, std::size_t n, Weight weight) {
    return norm_of(n, [&](std::size_t i) { return k[s][i]; }, weight);
  }
  /// Slopes of the extension that are larger are not sound: `largest_slope` times those of the step.
  template <class Weight>
  static Real largest_of_extension(const Stages& k, std::size_t n, Weight weight) {
    Real most(0);
    for (std::size_t s = 0; s < T.stages; ++s) most = larger(most, size_of_stage(s, k, n, weight));
    return largest_slope * most;
  }

  /// y* = y + h Σ b_j k_j
  static void candidate(const Real* y, const Real& h, const Stages& k, std::size_t n, Real* out) {
    in_vectors(out, [y, h, &k, n](Real* __restrict to) {
      for (std::size_t i = 0; i < n; ++i) to[i] = y[i] + h * dot<last>(k, [](auto j) { return T.b()[j]; }, i);
    });
  }

  /// ‖Σ E_j k_j‖ with the weights weight(i), to be multiplied by |h|.
  template <class Weight>
  static Real error(const Stages& k, std::size_t n, Weight weight) {
    const auto norm_by = [&k, n, weight](auto weights) {
      return norm_of(n, [&](std::size_t i) { return dot<T.stages>(k, weights, i); }, weight);
    };
    const Real fine = norm_by([](auto j) { return T.E[j]; });
    if constexpr (T.crude_order > 0)
      return combined_error(fine, norm_by([](auto j) { return T.crude[j]; }));
    else
      return fine;
  }

  /// ‖D k‖, of the divided difference over the stages `T.bends`, scaled so that it is at most 1 where the slopes jump
  /// from 0 to 1, and the norm of the range of their slopes.
  template <class Weight>
  static std::array<Real, 2> bend(const Stages& k, std::size_t n, Weight weight) {
    static constexpr auto d = bend_weights<T>();
    const auto bent = [&k](std::size_t i) { return dot<T.stages>(k, [](auto j) { return d[j]; }, i); };
    const auto range = [&k](std::size_t i) {
      Real least = k[T.bends[0]][i], most = least;
      [&]<std::size_t... J>(std::index_sequence<J...>) {
        ((least = smaller(least, k[T.bends[J + 1]][i]), most = larger(most, k[T.bends[J + 1]][i])), ...);
      }(std::make_index_sequence<T.bends.size() - 1>{});
      return most - least;
    };
    return {norm_of(n, bent, weight), norm_of(n, range, weight)};
  }

  /// Returns whether slopes with that `bend`, over a step of that |h| with that error estimate, look like those of an f
  /// that jumps. `nearly`: 1, or less to include all that do so with other roundoff.
  static auto looks_like_jump(const std::array<Real, 2>& bend, const Real& length, const Real& error, double rtol,
                              double nearly = 1) {
    const auto [difference, range] = bend;
    const Real size = length * difference;
    const auto harmful = Real(nearly * harmless_bend * rtol) < size;
    const auto sharp = Real(nearly * bend_of_jump) * range < difference;
    const auto hidden = Real(nearly * told_bend) * error < size;
    return harmful & sharp & hidden;  // NOLINT(bugprone-signed-bitwise): truth values, or masks of them
  }

  /// Σ E_j k_j of each component, times h: the formula of higher order where there are two.
  static void errors(const Real& h, const Stages& k, std::size_t n, Real* out) {
    for (std::size_t i = 0; i < n; ++i) out[i] = h * dot<T.stages>(k, [](auto j) { return T.E[j]; }, i);
  }

  /// ‖Σ v_j k_j‖ and ‖Σ u_j k_j‖ of `probe` over the step of size h to y1, with the weights weight(i).
  template <class Weight>
  static std::array<Real, 2> probed(const Stages& k, std::size_t n, const Real& h, const Real* y1,
                                    const Real* candidate, Weight weight) {
    static constexpr auto p = probe<T>();
    Norm slopes, arguments;
    for (std::size_t i = 0; i < n; ++i) {
      const Real w = weight(i), slope = dot<T.stages>(k, [](auto j) { return p.slopes[j]; }, i);
      Real argument = dot<T.stages>(k, [](auto j) { return p.arguments[j]; }, i);
      if constexpr (!T.last_in_error()) argument += (y1[i] - candidate[i]) / h;  // the last slope is that at y₁
      slopes.add(slope / w);
      arguments.add(argument / w);
    }
    return {slopes.value(), arguments.value()};
  }

  /// Coefficients of the continuous extension, (degree, n): h Σ_j B_jd k_j.
  static void coefficients(const Real& h, const Stages& k, std::size_t n, Real* out) {
    [&]<std::size_t... D>(std::index_sequence<D...>) {
      (coefficient<D>(h, k, n, out + D * n), ...);
    }(std::make_index_sequence<T.degree>{});
    if constexpr (T.all_stages > T.stages && T.watches_bends()) prefer_cubic(h, k, n, out);
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

 private:
  /// True if loops over components become vector instructions: not in small systems, and lanes are vectors already.
  static constexpr bool vectorised = std::is_same_v<Real, double> && Build == 0;
  static constexpr std::size_t beside = vectorised ? 4 : 1;  // maxima, as in `max_norm`

  template <class Loop>
  INVARIODE_FOR_AVX2 static auto for_avx2(Real* __restrict out, const Loop& loop) {
    return loop(out);
  }
  /// Runs a loop over components, by AVX2 where this processor has it, given where it writes.
  template <class Loop>
  INVARIODE_EACH static auto in_vectors(Real* __restrict out, const Loop& loop) {
    if constexpr (vectorised)
      if (processor_has_avx2()) return for_avx2(out, loop);
    return loop(out);
  }

  /// ‖value(i)‖ with the weights weight(i). In vectors by blocks, where weights have a loop of their own, whose cases
  /// are decided before it, and no maximum waits for the one before.
  template <class Value, class Weight>
  INVARIODE_EACH static Real norm_of(std::size_t n, const Value& value, const Weight& weight) {
    return in_vectors(nullptr, [n, &value, &weight](Real*) {
      Norm norm[beside];
      std::size_t i = 0;
      if constexpr (vectorised) {
        for (; i + block_of_norm <= n; i += block_of_norm) {
          double w[block_of_norm], values[block_of_norm];
          for (std::size_t j = 0; j < block_of_norm; ++j) w[j] = weight(i + j);
          for (std::size_t j = 0; j < block_of_norm; ++j) values[j] = value(i + j) / w[j];
          for (std::size_t j = 0; j < block_of_norm; ++j) norm[j % beside].add(values[j]);
        }
      }
      for (; i < n; ++i) norm[0].add(value(i) / weight(i));
      for (std::size_t j = 1; j < beside; ++j) norm[0].add(norm[j].value());
      return norm[0].value();
    });
  }

  /// With two lower formulas: e₁² / √(e₁² + (e₂/10)²) (Hairer, Nørsett, Wanner, Solving ODEs I, ch. II.10), in a form
  /// whose squares neither overflow nor underflow before the result does.
  static Real combined_error(const Real& error, const Real& crude) {
    constexpr double weight_of_crude = 0.1;
    const Real ratio = weight_of_crude * crude / error;
    return choose(Real(0) < error, error / square_root(Real(1) + ratio * ratio), error);
  }

  /// Keeps, of each component, only the first three terms of the extension, the cubic Hermite interpolant, if their
  /// slopes at inner stages of the step are closer to those of f: where stability limits the step, the other terms
  /// magnify what is left of a fast component in the slopes of the further stages (docs/algorithms.md, 'Runge-Kutta').
  static void prefer_cubic(const Real& h, const Stages& k, std::size_t n, Real* out) {
    constexpr std::size_t cubic = 3;
    static constexpr std::array inner{T.bends[1], T.bends[2], T.bends[3]};
    static constexpr std::array slopes{nested_slopes<T.degree>(T.c[inner[0]]), nested_slopes<T.degree>(T.c[inner[1]]),
                                       nested_slopes<T.degree>(T.c[inner[2]])};
    for (std::size_t i = 0; i < n; ++i) {
      Real off(0), cubic_off(0);
      for (std::size_t s = 0; s < inner.size(); ++s) {
        Real left = h * k[inner[s]][i];
        for (std::size_t d = 0; d < cubic; ++d) left = left - slopes[s][d] * out[d * n + i];
        cubic_off = larger(cubic_off, absolute(left));
        for (std::size_t d = cubic; d < T.degree; ++d) left = left - slopes[s][d] * out[d * n + i];
        off = larger(off, absolute(left));
      }
      const auto closer = cubic_off < off;
      for (std::size_t d = cubic; d < T.degree; ++d) out[d * n + i] = choose(closer, Real(0), out[d * n + i]);
    }
  }

  template <std::size_t D>
  static void coefficient(const Real& h, const Stages& k, std::size_t n, Real* out) {
    for (std::size_t i = 0; i < n; ++i) out[i] = h * dot<T.all_stages>(k, [](auto j) { return T.B[j][D]; }, i);
  }
};

}  // namespace invariode::runge_kutta
