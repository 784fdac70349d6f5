#pragma once
// Explicit Runge-Kutta-Nystrom pairs for y'' = f(t, y) with local extrapolation and compensated sums, driven by
// tableaux (docs/algorithms.md, 'Nyström pairs').

#include <array>
#include <cstddef>
#include <memory>

#include "methods/rkn1210.hpp"
#include "methods/rkn64.hpp"
#include "methods/rkn86.hpp"
#include "methods/runge_kutta.hpp"
#include "step.hpp"

namespace invariode::nystrom {

using runge_kutta::Fsal;

/// The pairs: a new one needs a file with its tableau and a place here.
using Pairs = runge_kutta::Tableaux<dormand_prince_64, dormand_86, dormand_1210>;

/// Y consists of states of `state` doubles each, positions before velocities.
using MakeStep = std::unique_ptr<Step> (*)(Callback& f, const Weights& weights, Fsal fsal, std::size_t state);

extern const std::array<MakeStep, Pairs::count> steps;

}  // namespace invariode::nystrom
