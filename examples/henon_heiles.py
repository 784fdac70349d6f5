"""A Poincaré section of Hénon and Heiles
======================================

The points where orbits of one energy cross the plane x = 0, located as events on the continuous solution, which stays
on the energy surface between the steps too. The islands are regular motion, the sea around them is chaotic.

Source: M. Hénon, C. Heiles, The applicability of the third integral of motion: some numerical experiments, Astron. J.
69 (1964) 73-79.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

level = 1 / 8


def star(t, state):
    x, y, vx, vy = state
    return [vx, vy, -x - 2 * x * y, -y - x * x + y * y]


def energy(t, state):
    x, y, vx, vy = state
    return (vx**2 + vy**2 + x**2 + y**2) / 2 + x * x * y - y**3 / 3


def plane(t, state):
    return state[0]


def main():
    figure, axes = plt.subplots(layout="constrained")
    section, drift = iv.Event(plane, direction=1), 0.0
    for y in (-0.15, -0.05, 0, 0.1, 0.2, 0.3, 0.45, 0.55):
        start = [0, y, np.sqrt(2 * level - y * y + 2 * y**3 / 3), 0]
        held = iv.Invariants(energy, value=level, iterations=3)
        sol = iv.dop853(star, (0, 1500), start, events=section, invariants=held, rtol=1e-6, atol=1e-9)
        drift = max(drift, np.abs(energy(0, sol.y_events[0].T) - level).max())
        axes.plot(*sol.y_events[0][:, [1, 3]].T, ".", ms=2)
    print(f"energy in the section off by {drift:.1e}")
    axes.set(xlabel="y", ylabel="vy", title="x = 0, E = 1/8, dop853")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
