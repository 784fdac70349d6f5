"""Predator and prey
=================

The orbits of Lotka and Volterra's equations are closed: they are level sets of an invariant that is not a polynomial.

Source: L. F. Shampine, Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72,
section 6.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

a, c = 2, 1


def predator_prey(t, state):
    x, y = state
    return [a * x * (1 - y), -c * y * (1 - x)]


def orbit(t, state):
    x, y = state
    return c * (x - np.log(x)) + a * (y - np.log(y))


def main():
    figure, axes = plt.subplots(layout="constrained")
    for label, invariants in (("plain", None), ("projected", orbit)):
        sol = iv.ode23(predator_prey, (0, 50), [1, 3], invariants=invariants, refine=4)
        drift = np.abs(orbit(sol.t, sol.y) - orbit(0, [1, 3])).max()
        print(f"{label:>9}: drift {drift:.1e} in {sol.stats.steps} steps, {sol.nfev} evaluations of f")
        axes.plot(*sol.y, lw=1, label=label)
    axes.set(xlabel="prey", ylabel="predator", title="Lotka-Volterra, ode23")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
