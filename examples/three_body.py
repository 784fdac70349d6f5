"""Restricted three-body problem
=============================

An orbit around Earth and Moon that closes after one period; at the default tolerances it does so only if its Jacobi
integral is held.

Source: L. F. Shampine, Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72,
section 6.
"""

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


def main():
    figure, axes = plt.subplots(layout="constrained")
    for label, invariants in (("plain", None), ("projected", jacobi)):
        sol = iv.ode45(orbiter, (0, period), start, invariants=invariants, refine=20)
        drift = np.abs(jacobi(sol.t, sol.y) - jacobi(0, start)).max()
        print(f"{label:>9}: drift {drift:.1e}, gap at the end {np.hypot(*(sol.y[:2, -1] - start[:2])):.1e}")
        axes.plot(*sol.y[:2], lw=1, label=label)
    axes.plot([-mu, 1 - mu], [0, 0], "k+")
    axes.set(xlabel="x", ylabel="y", title="One period, ode45", aspect="equal")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
