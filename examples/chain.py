"""A hanging chain
===============

Twelve links in Cartesian coordinates, released from a horizontal line. The script states only masses, gravity and the
lengths of the links. Corrections in levels keep the lengths to roundoff; without them the links grow.

Source: the pendulum of E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section VII.1, twelve times.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

LINKS = 12


def gravity(t, q, v):
    return np.tile([0, -1], LINKS)


def lengths(t, q):
    joints = np.vstack([[0, 0], q.reshape(-1, 2)])
    return (np.diff(joints, axis=0) ** 2).sum(axis=1) * LINKS**2 - 1


def energy(t, q, v):
    return v @ v / 2 + q[1::2].sum()


def main():
    chain = iv.MechanicalSystem(np.ones(2 * LINKS), gravity, lengths, energy=energy, name="chain")
    q0 = np.array([(i + 1, 0) for i in range(LINKS)]).ravel() / LINKS
    figure, (shapes, drifts) = plt.subplots(1, 2, figsize=(9.6, 4.4), layout="constrained")
    for label, correction in (("plain", "none"), ("projected", "levels")):
        problem = chain.problem((0, 4), q0, np.zeros(2 * LINKS), correction=correction)
        sol = problem.solve("ode113", rtol=1e-4, atol=1e-6, t_eval=np.linspace(0, 4, 121))
        off = [np.abs(lengths(0, q)).max() for q in sol.y[: 2 * LINKS].T]
        print(f"{label:>9}: lengths off by {max(off):.1e} with {sol.nfev} evaluations")
        drifts.semilogy(sol.t[1:], np.array(off[1:]) + 1e-17, lw=0.9, label=f'{label}, correction="{correction}"')
    for q in sol.y[: 2 * LINKS, ::12].T:
        x, y = np.vstack([[0, 0], q.reshape(-1, 2)]).T
        shapes.plot(x, y, "o-", ms=2.5, lw=0.9)
    shapes.set(xlabel="x", ylabel="y", title="The chain every 0.4", aspect="equal")
    drifts.set(xlabel="t", title="Squares of lengths, off by")
    drifts.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
