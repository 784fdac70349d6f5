#pragma once
// The pair of ode45.

#include "methods/tableau.hpp"

namespace invariode {

/// Dormand & Prince, J. Comput. Appl. Math. 6 (1980) 19: the pair of ode45, with the fourth-order extension of the
/// MATLAB ODE Suite (Shampine & Reichelt, SIAM J. Sci. Comput. 18 (1997) 1).
inline constexpr Tableau<7, 4> dormand_prince{
    .name = "ode45",
    .summary = "the Dormand-Prince (4,5) pair, the one to try first",
    .source =
        "J. R. Dormand, P. J. Prince, A family of embedded Runge-Kutta formulae, J. Comput. Appl. Math. 6 (1980) "
        "19-26; extension: L. F. Shampine, M. W. Reichelt, The MATLAB ODE Suite, SIAM J. Sci. Comput. 18 (1997) "
        "1-22",
    .scipy_name = "RK45",
    .iterations = 2,
    .refine = 4,
    .order = 5,
    .error_order = 4,
    .extension_order = 4,
    .real_limit = 3.3125,
    .floor = 0.1,
    .predicts = false,
    .c = {0, 1. / 5, 3. / 10, 4. / 5, 8. / 9, 1, 1},
    .A = {{{},
           {1. / 5},
           {3. / 40, 9. / 40},
           {44. / 45, -56. / 15, 32. / 9},
           {19372. / 6561, -25360. / 2187, 64448. / 6561, -212. / 729},
           {9017. / 3168, -355. / 33, 46732. / 5247, 49. / 176, -5103. / 18656},
           {35. / 384, 0, 500. / 1113, 125. / 192, -2187. / 6784, 11. / 84}}},
    .E = {71. / 57600, 0, -71. / 16695, 71. / 1920, -17253. / 339200, 22. / 525, -1. / 40},
    .B = detail::to_nested<7, 4>({{{1, -183. / 64, 37. / 12, -145. / 128},
                                   {0, 0, 0, 0},
                                   {0, 1500. / 371, -1000. / 159, 1000. / 371},
                                   {0, -125. / 32, 125. / 12, -375. / 64},
                                   {0, 9477. / 3392, -729. / 106, 25515. / 6784},
                                   {0, -11. / 7, 11. / 3, -55. / 28},
                                   {0, 3. / 2, -4, 5. / 2}}}),
};
static_assert(consistent(dormand_prince));

}  // namespace invariode
