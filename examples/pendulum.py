"""A pendulum in Cartesian coordinates
===================================

The rod keeps its length because of a constraint and a hidden one: the bob moves along the circle. Both are invariants
of the equations, with the demanded value 0.

Source: L. F. Shampine, Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72,
section 6.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv


def pendulum(t, state):
    x, y, vx, vy = state
    tension = (vx**2 + vy**2 - y) / (x**2 + y**2)
    return [vx, vy, -tension * x, -tension * y - 1]


def rod(t, state):
    x, y, vx, vy = state
    return [x**2 + y**2 - 1, x * vx + y * vy]  # the position on the circle, the velocity along it


def main():
    figure, axes = plt.subplots(layout="constrained")
    for label, invariants in (("plain", None), ("projected", iv.Invariants(rod, value=0))):
        sol = iv.ode45(pendulum, (0, 50), [1, 0, 0, 0], invariants=invariants, refine=10)
        drift = np.abs(np.hypot(*sol.y[:2]) - 1).max()
        print(f"{label:>9}: length off by {drift:.1e} in {sol.stats.steps} steps, {sol.nfev} evaluations of f")
        axes.plot(*sol.y[:2], lw=1, label=label)
    axes.set(xlabel="x", ylabel="y", title="Path of the bob, ode45", aspect="equal")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
