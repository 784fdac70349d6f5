"""An arm that hits a wall
=======================

Two links swing from a pivot until the tip meets a wall. The impact reverses the velocity of the tip as if there were no
links, which would tear the joints apart. `consistent` puts the velocities back onto the constraints, by the impulses in
the joints.

Source: F. Pfeiffer, C. Glocker, Multibody Dynamics with Unilateral Contacts, Wiley, 1996, chapter 6, for impacts of
mechanisms.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

WALL, RESTITUTION = -0.7, 0.8


def gravity(t, q, v):
    return [0, -1, 0, -1]


def links(t, q):
    elbow, forearm = q[:2], q[2:] - q[:2]
    return [elbow @ elbow - 1, forearm @ forearm - 1]


def energy(t, q, v):
    return v @ v / 2 + q[1] + q[3]


def distance(t, y):
    """The distance of the tip from the wall."""
    return y[2] - WALL


def joints(t, q):
    return [[0, 0], q[:2], q[2:]]


arm = iv.MechanicalSystem(np.ones(4), gravity, links, energy=energy, points=joints)


def bounce(t, y):
    after = y.copy()
    after[6] = -RESTITUTION * y[6]
    return arm.consistent(t, after)


def main():
    impact = iv.Event(distance, direction=-1, action=bounce)
    problem = arm.problem((0, 12), [1, 0, 2, 0], np.zeros(4)).replace(events=impact)
    sol = problem.solve("ode45", rtol=1e-8, atol=1e-10, dense_output=True)
    off = max(np.abs(links(t, q)).max() for t, q in zip(sol.t, sol.y[:4].T, strict=True))
    print(f"lengths after {len(sol.t_events[0])} impacts: off by {off:.1e}")
    figure, (paths, energies) = plt.subplots(1, 2, figsize=(9.6, 4.4), layout="constrained")
    paths.plot(*sol.sol(np.linspace(0, 12, 2000))[2:4], lw=0.8, color="C1")
    for t in np.linspace(0, sol.t_events[0][0], 7):
        x, y = np.transpose(arm.points(t, sol.sol(t)[:4]))
        paths.plot(x, y, "o-", color="0.4", ms=3, lw=1)
    paths.axvline(WALL, color="k", lw=3)
    paths.set(xlabel="x", ylabel="y", title="The arm until the first impact; the path of its tip", aspect="equal")
    energies.plot(sol.t, [energy(t, y[:4], y[4:]) for t, y in zip(sol.t, sol.y.T, strict=True)])
    energies.set(xlabel="t", ylabel="energy", title="Impacts take energy, flights keep it")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
