"""Predator and prey: the closed orbit, with and without its invariant. Usage: python lotka_volterra.py [output.png]"""

import sys

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


figure, axes = plt.subplots(layout="constrained")
for label, invariants in (("plain", None), ("projected", orbit)):
    sol = iv.ode23(predator_prey, (0, 50), [1, 3], invariants=invariants, refine=4)
    drift = np.abs(orbit(sol.t, sol.y) - orbit(0, [1, 3])).max()
    print(f"{label:>9}: drift {drift:.1e} in {sol.stats.steps} steps, {sol.nfev} evaluations of f")
    axes.plot(*sol.y, lw=1, label=label)
axes.set(xlabel="prey", ylabel="predator", title="Lotka-Volterra, ode23")
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "lotka_volterra.png", dpi=150)
