"""A free rigid body
=================

Euler's equations for the angular momentum of a freely rotating body. Its length and the energy are conserved, so the
solution is a closed curve on a sphere.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., Springer, 2006, section IV.1.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

moments = np.array([2, 1, 2 / 3])  # of inertia


def euler(t, y):
    return np.cross(y, y / moments)


def laws(t, y):
    return [np.dot(y, y), np.dot(y, y / moments) / 2]  # length², energy


def main():
    figure = plt.figure(figsize=(9.6, 4.8), layout="constrained")
    for k, (label, given) in enumerate((("plain", None), ("projected", laws))):
        axes = figure.add_subplot(1, 2, k + 1, projection="3d", title=f"{label}, ode45", box_aspect=(1, 1, 1))
        drift = 0.0
        for angle in (0.4, 0.8, 1.1, 1.4):
            start = [np.cos(angle), 0, np.sin(angle)]
            sol = iv.ode45(euler, (0, 300), start, invariants=given, rtol=1e-2, atol=1e-4)
            values = np.array([laws(0, y) for y in sol.y.T])
            drift = max(drift, np.abs(values - values[0]).max())
            axes.plot(*sol.y, lw=0.8)
        print(f"{label:>9}: drift {drift:.1e}")
        axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xticks=[-1, 0, 1], yticks=[-1, 0, 1], zticks=[-1, 0, 1])
    return figure


if __name__ == "__main__":
    main()
    plt.show()
