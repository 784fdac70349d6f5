"""Kepler's orbit
==============

An eccentric orbit over twenty periods. In a plain run the energy drifts and the ellipse shrinks and turns; with energy
and angular momentum imposed it keeps its size and shape.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., Springer, 2006, section I.2.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

e = 0.6  # eccentricity; the period is 2 pi
start = [1 - e, 0, 0, np.sqrt((1 + e) / (1 - e))]


def kepler(t, state):
    x, y, vx, vy = state
    r3 = (x**2 + y**2) ** 1.5
    return [vx, vy, -x / r3, -y / r3]


def laws(t, state):
    x, y, vx, vy = state
    return [(vx**2 + vy**2) / 2 - 1 / (x**2 + y**2) ** 0.5, x * vy - y * vx]  # energy, angular momentum


def main():
    figure, axes = plt.subplots(layout="constrained")
    for label, invariants in (("plain", None), ("projected", laws)):
        sol = iv.ode45(kepler, (0, 40 * np.pi), start, rtol=1e-4, invariants=invariants, refine=10)
        drift = np.abs(np.transpose(laws(sol.t, sol.y)) - laws(0, start)).max()
        print(f"{label:>9}: drift {drift:.1e} in {sol.stats.steps} steps")
        axes.plot(*sol.y[:2], lw=0.8, label=label)
    axes.plot(0, 0, "k+")
    axes.set(xlabel="x", ylabel="y", title="Twenty periods, ode45", aspect="equal")
    axes.legend(loc="upper right")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
