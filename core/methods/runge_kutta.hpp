#pragma once
// Explicit Runge-Kutta pairs with local extrapolation and FSAL, driven by tableaux (docs/algorithms.md, 'Runge-Kutta').

#include <array>
#include <cstddef>
#include <memory>
#include <vector>

#include "methods/dop853.hpp"
#include "methods/ode23.hpp"
#include "methods/ode45.hpp"
#include "methods/ode78.hpp"
#include "methods/ode89.hpp"
#include "step.hpp"

namespace invariode::runge_kutta {

/// The first stage of the step after a projection: `reuse` takes f(t₁, y*), already computed, which changes the result
/// by O(h^{q+1}) and saves an evaluation per step (paper, section 4); `evaluate` computes f(t₁, y₁).
enum class Fsal { reuse, evaluate };

/// `nested_polynomial` of output/polynomial.hpp.
void nested_polynomial(const double* data, std::size_t size, std::size_t n, double theta, double* out);

/// `size` doubles in `v`, which not every run needs. (Inlined, it would cost each step registers.)
double* resized(std::vector<double>& v, std::size_t size);

template <const auto&... T>
struct Tableaux {
  static constexpr std::size_t count = sizeof...(T);
};

/// The pairs: a new one needs a file with its tableau and a place here.
using Pairs = Tableaux<bogacki_shampine, dormand_prince, dormand_prince_853, verner_87, verner_98>;

using MakeStep = std::unique_ptr<Step> (*)(Callback& f, const Weights& weights, Fsal fsal);

/// The steps of all pairs compiled for small systems, where vector instructions cost more than they gain: what f has
/// just written one number at a time cannot be read two at a time before it has reached the cache
/// (docs/benchmarks/native.md).
extern const std::array<MakeStep, Pairs::count> steps_of_small_systems;
/// The makers of steps for any number of equations.
extern const std::array<MakeStep, Pairs::count> steps_of_any_system;
/// The most equations of a small system.
inline constexpr std::size_t small_system = 8;

}  // namespace invariode::runge_kutta
