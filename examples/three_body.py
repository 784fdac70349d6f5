"""An orbit around Earth and Moon, closed by holding its Jacobi integral. Usage: python three_body.py [output.png]"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

mu = 1 / 82.45  # mass of the Moon; the Earth has 1 - mu
period, start = 6.19216933131963970674, [1.2, 0, 0, -1.04935750983031990726]


def orbiter(t, state):
    x, y, vx, vy = state
    earth, moon = (1 - mu) / np.hypot(x + mu, y) ** 3, mu / np.hypot(x - 1 + mu, y) ** 3
    ax = 2 * vy + x - earth * (x + mu) - moon * (x - 1 + mu)
    return [vx, vy, ax, -2 * vx + y - (earth + moon) * y]


def jacobi(t, state):
    x, y, vx, vy = state
    return (vx**2 + vy**2 - x**2 - y**2) / 2 - (1 - mu) / np.hypot(x + mu, y) - mu / np.hypot(x - 1 + mu, y)


figure, axes = plt.subplots(layout="constrained")
for label, invariants in (("plain", None), ("projected", jacobi)):
    sol = iv.ode45(orbiter, (0, period), start, invariants=invariants, refine=20)
    drift = np.abs(jacobi(sol.t, sol.y) - jacobi(0, start)).max()
    print(f"{label:>9}: drift {drift:.1e}, gap at the end {np.hypot(*(sol.y[:2, -1] - start[:2])):.1e}")
    axes.plot(*sol.y[:2], lw=1, label=label)
axes.set(xlabel="x", ylabel="y", title="Restricted three-body problem, ode45", aspect="equal")
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "three_body.png", dpi=150)
