"""A double pendulum
=================

Its motion is chaotic: no solver can follow one solution for long. But a solution can keep the right energy; at crude
tolerances a plain run gains or loses some.

Source: T. Shinbrot, C. Grebogi, J. Wisdom, J. A. Yorke, Chaos in a double pendulum, Am. J. Phys. 60 (1992) 491-499.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

start = [2.0, 2.5, 0, 0]


def double_pendulum(t, state):  # two unit masses on rods of length 1, g = 1; angles from the vertical
    a, b, wa, wb = state
    c, s = np.cos(a - b), np.sin(a - b)
    left = -s * wb**2 - 2 * np.sin(a), s * wa**2 - np.sin(b)
    return [wa, wb, (left[0] - c * left[1]) / (2 - c * c), (2 * left[1] - c * left[0]) / (2 - c * c)]


def energy(t, state):
    a, b, wa, wb = state
    return wa**2 + wb**2 / 2 + wa * wb * np.cos(a - b) - 2 * np.cos(a) - np.cos(b)


def main():
    figure, (path, drifts) = plt.subplots(1, 2, figsize=(9.6, 4.4), layout="constrained")
    for label, given in (("plain", None), ("projected", energy)):
        sol = iv.ode45(double_pendulum, (0, 200), start, invariants=given, refine=8)
        off = np.abs(energy(sol.t, sol.y) - energy(0, start))
        print(f"{label:>9}: drift {off.max():.1e} in {sol.stats.steps} steps")
        drifts.semilogy(sol.t[1:], off[1:] + 1e-16, lw=0.8, label=label)
        x, y = (f(sol.y[0]) + f(sol.y[1]) for f in (np.sin, np.cos))
        path.plot(x, -y, lw=0.4)
    path.set(xlabel="x", ylabel="y", title="Path of the lower mass, ode45", aspect="equal")
    drifts.set(xlabel="t", title="Energy, off by")
    drifts.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
