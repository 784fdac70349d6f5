#pragma once
// How far from its limit of stability an explicit pair is (docs/algorithms.md, 'Stability limit of an explicit step').

#include <array>
#include <cstddef>

#include "methods/tableau.hpp"

namespace invariode::runge_kutta {

/// Weights of two sums over stages: of the slopes, Σ v_i k_i, and of the arguments of those slopes, h Σ u_j k_j. A
/// smooth solution has no part in them to a high power of h; what is left is what f amplifies most.
template <std::size_t S>
struct Probe {
  std::array<double, S> slopes{}, arguments{};
};

/// Two stages at t₁ where the pair has them, as in Hairer and Wanner's DOPRI5 (Solving ODEs II, ch. IV.2). Else the
/// third divided difference of the last four.
template <const auto& T>
constexpr auto probe() {
  constexpr std::size_t S = T.stages, last = S - 1;
  Probe<S> p;
  if (T.c[last - 1] == 1) {
    p.slopes[last] = 1;
    p.slopes[last - 1] = -1;
  } else {
    for (std::size_t i = S - 4; i < S; ++i) {
      p.slopes[i] = 1;
      for (std::size_t j = S - 4; j < S; ++j)
        if (j != i) p.slopes[i] /= T.c[i] - T.c[j];
    }
  }
  for (std::size_t j = 0; j < S; ++j)
    for (std::size_t i = 0; i < S; ++i) p.arguments[j] += p.slopes[i] * T.A[i][j];
  return p;
}

/// The weights of the divided difference over the stages `T.bends`, in units of its largest value for slopes that are 0
/// up to some stage and 1 after it.
template <const auto& T>
constexpr auto bend_weights() {
  constexpr std::size_t count = T.bends.size();
  std::array<double, T.stages> v{};
  double part = 0, most = 0;
  for (std::size_t i = 0; i < count; ++i) {
    double& weight = v[T.bends[i]] = 1;
    for (std::size_t j = 0; j < count; ++j)
      if (j != i) weight /= T.c[T.bends[i]] - T.c[T.bends[j]];
    part += weight;
    if (i + 1 < count && detail::absolute(part) > most) most = detail::absolute(part);
  }
  for (double& weight : v) weight /= most;
  return v;
}

}  // namespace invariode::runge_kutta
