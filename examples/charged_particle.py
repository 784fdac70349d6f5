"""A charged particle in a magnetic bottle
=======================================

It gyrates around the field lines and is reflected where the field is strong. A magnetic field does no work, so the
energy is conserved; so is the canonical angular momentum, since the field is symmetric about the axis.

Source: T. G. Northrop, The Adiabatic Motion of Charged Particles, Interscience, 1963, for the motion; the field is a
simple example, with the vector potential (1 + z²) (-y, x, 0) / 2.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

start = [0.5, 0, 0, 0, 0.3, 0.4]


def lorentz(t, state):
    x, y, z, vx, vy, vz = state
    bx, by, bz = -x * z, -y * z, 1 + z * z
    return [vx, vy, vz, vy * bz - vz * by, vz * bx - vx * bz, vx * by - vy * bx]


def laws(t, state):
    x, y, z, vx, vy, vz = state
    return [(vx**2 + vy**2 + vz**2) / 2, x * vy - y * vx + (x * x + y * y) * (1 + z * z) / 2]


def main():
    figure = plt.figure(figsize=(9.6, 4.4), layout="constrained")
    for k, (label, given) in enumerate((("plain", None), ("projected", laws))):
        sol = iv.ode45(lorentz, (0, 200), start, invariants=given)
        drift = np.abs(np.transpose(laws(0, sol.y)) - laws(0, start)).max()
        print(f"{label:>9}: drift {drift:.1e} in {sol.stats.steps} steps")
        axes = figure.add_subplot(1, 2, k + 1, projection="3d", title=f"{label}, ode45")
        axes.plot(*sol.y[:3], lw=0.5)
        axes.set(xlabel="x", ylabel="y", zlabel="z", zlim=(-1.5, 1.5))
    return figure


if __name__ == "__main__":
    main()
    plt.show()
