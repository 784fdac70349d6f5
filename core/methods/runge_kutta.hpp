#pragma once
// Explicit Runge-Kutta pairs with local extrapolation and FSAL, driven by tableaux (docs/algorithms.md, 'Runge-Kutta').

#include <memory>

#include "step.hpp"
#include "methods/tableaux.hpp"

namespace invariode {

/// What the first stage of the step after a projection is: `reuse` takes f(t₁, y*), already computed, which changes the
/// result by O(h^{q+1}) and saves an evaluation per step (paper, section 4); `evaluate` computes f(t₁, y₁).
enum class Fsal { reuse, evaluate };

/// y(θ) = c₀ + θ (c₁ + (1−θ) (c₂ + θ (c₃ + …))), the coefficients c_j (n,) one after the other.
void nested(const double* data, std::size_t size, std::size_t n, double theta, double* out);

std::unique_ptr<Step> ode23_step(Callback& f, const Weights& weights, Fsal fsal);
std::unique_ptr<Step> ode45_step(Callback& f, const Weights& weights, Fsal fsal);
/// f(t₁, y₁) has no part in the error estimates of these: it is evaluated once y₁ is known, so that `Fsal` makes no
/// difference.
std::unique_ptr<Step> dop853_step(Callback& f, const Weights& weights);
std::unique_ptr<Step> ode78_step(Callback& f, const Weights& weights);

}  // namespace invariode
