#pragma once
// Numbers by which the projection and its guard decide, shared by single runs and by trajectories side by side. All are
// known at compile time: nothing here is initialised when the library is loaded, by code for one instruction set.

#include <cstdint>

namespace invariode {

// ------------------------------------------------------------------------------------------------------ the correction

inline constexpr double largest_correction =
    100;  // in units of rtol; right invariants stay below (docs/algorithms.md, 'Guard')
inline constexpr double large_residual = 0.1;  // of the terms of an invariant
// Relative changes of a gradient: of a step, and at most of its correction, where that may leave the domain of g. Less
// than the slight one is not looked at.
inline constexpr double sharp_bend = 1, bend_of_correction = 0.2, slight_bend = 0.05;
// Newton's iteration leaves (1 − 1/p)^p < 1/e of the residual at a root of multiplicity p, and half of it or more where
// it runs away from a pole.
inline constexpr double slowest_newton = 0.45;
inline constexpr double last_correction =
    1e-10;  // in units of the weights: it leaves a residual of its square, roundoff
inline constexpr int interpolation_iterations = 3;  // between steps, at most (docs/algorithms.md, 'Between steps')
inline constexpr double small_square = 1e-280, large_square = 1e280;  // outside, squares underflow or overflow
// Each correction of sensitivities leaves of the residual what the gradients have changed by in the state's last one,
// which is at most some 1e-3 of a component at the crudest tolerances.
inline constexpr int tangent_iterations = 10;
inline constexpr double roundoff_of_g = 10;  // of ε: what an evaluation of g may be off (docs/algorithms.md, 'impose')
inline constexpr double roundoffs_of_change = 2;  // what is no more between two evaluations of g is none

// ----------------------------------------------------------------------------------------------------------- the guard

// From the campaigns of tests/fuzz (docs/algorithms.md, 'Guard').
inline constexpr double suspicious_angle =
    1e-11;  // ρ: 40 times what right invariants had, with derivatives that are exact
inline constexpr double suspicious_drift = 0.01;  // D, in units of rtol
inline constexpr double harmful_drift = 0.1;      // over the whole interval at this rate: errors of orbits grow with t
inline constexpr double suspicious_correction = 10;  // in units of rtol
// Steps from an acquittal to the next look, at most: a look costs one f or two, an acquitted suspicion may come in
// every step. In between, only suspicions that are so many times larger are looked at. (Measured with pulses that break
// an energy for a while; docs/algorithms.md, 'Guard'.)
inline constexpr std::int64_t longest_pause = 64;
inline constexpr double much_larger = 3;
// The directional test of a user's Jacobian: central differences are good to ε^{2/3} of the terms, curvature adds as
// much.
inline constexpr double jacobian_tolerance = 1e-4;

// Steps from one look at harm to the next, so that it costs less than 1 % of them.
inline constexpr std::int64_t harm_period = 8;

}  // namespace invariode
