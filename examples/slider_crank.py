"""A slider crank
==============

A crank drives a slider along a guide through a rod. The coordinates are those of the crank pin and the position of the
slider, tied together by two lengths. The forces in the joints are computed from the solution.

Source: E. J. Haug, Computer Aided Kinematics and Dynamics of Mechanical Systems, Allyn and Bacon, 1989, section 5.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

CRANK, ROD, MASSES = 1.0, 2.5, np.array([1.0, 1.0, 2.0])


def lengths(t, q):
    x, y, slider = q
    return [x**2 + y**2 - CRANK**2, (slider - x) ** 2 + y**2 - ROD**2]


def gravity(t, q, v):
    return [0, -MASSES[1], 0]


def energy(t, q, v):
    return MASSES @ v**2 / 2 + MASSES[1] * q[1]


def joints(t, q):
    x, y, slider = q
    return [[0, 0], [x, y], [slider, 0]]


def main():
    machine = iv.MechanicalSystem(MASSES, gravity, lengths, energy=energy, points=joints, name="slider crank")
    figure, (pictures, forces) = plt.subplots(1, 2, figsize=(9.6, 4), layout="constrained")
    for label, correction in (("plain", "none"), ("projected", "levels")):
        problem = machine.problem((0, 30), [1, 0, 1 + ROD], [0, 2, 0], correction=correction)
        sol = problem.solve("ode45", rtol=1e-4, atol=1e-6, dense_output=True)
        off = max(np.abs(lengths(0, q)).max() for q in sol.y[:3].T)
        print(f"{label:>9}: lengths off by {off:.1e} after {sol.nfev} evaluations")
    for t in np.linspace(0, 2.4, 9):
        x, y = np.transpose(joints(t, sol.sol(t)[:3]))
        pictures.plot(x, y, "o-", lw=1.2, ms=4, color=plt.cm.viridis(t / 2.8))
    pictures.axhline(0, color="0.6", lw=0.8, zorder=0)
    pictures.set(xlabel="x", ylabel="y", title="Every 0.3", aspect="equal")
    first = sol.t < 10
    pull = -2 * ROD * machine.multipliers(sol)[1]  # λ times the length of the gradient of the second constraint
    forces.plot(sol.t[first], pull[first])
    forces.set(xlabel="t", title="Force along the rod (tension is positive)")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
