#pragma once
// The pair of ode23.

#include "methods/tableau.hpp"

namespace invariode {

/// Bogacki & Shampine, Appl. Math. Lett. 2 (1989) 321: the pair of ode23. The extension is the cubic Hermite
/// interpolant.
inline constexpr Tableau<4, 3> bogacki_shampine{
    .name = "ode23",
    .summary = "the Bogacki-Shampine (2,3) pair, for crude tolerances",
    .source = "P. Bogacki, L. F. Shampine, A 3(2) pair of Runge-Kutta formulas, Appl. Math. Lett. 2 (1989) 321-325",
    .scipy_name = "RK23",
    .iterations = 1,
    .order = 3,
    .error_order = 2,
    .extension_order = 3,
    .real_limit = 2.515625,
    .floor = 0.5,
    .predicts = false,
    .c = {0, 1. / 2, 3. / 4, 1},
    .A = {{{}, {1. / 2}, {0, 3. / 4}, {2. / 9, 1. / 3, 4. / 9}}},
    .E = {-5. / 72, 1. / 12, 1. / 9, -1. / 8},
    .B = detail::to_nested<4, 3>({{{1, -4. / 3, 5. / 9}, {0, 1, -2. / 3}, {0, 4. / 3, -8. / 9}, {0, -1, 1}}}),
};
static_assert(consistent(bogacki_shampine));

}  // namespace invariode
