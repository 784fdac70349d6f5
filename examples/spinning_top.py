"""Kowalevski's top: invariants found from f alone
===============================================

A heavy top with moments of inertia in the proportion 2 : 2 : 1 and its centre of mass in the equatorial plane.
`find_invariants` gets only the right-hand side, and finds four polynomials: the length of the vertical, the vertical
angular momentum, the energy, and Kowalevski's, of degree 4. Then they are imposed.

Source: S. Kowalevski, Sur le problème de la rotation d'un corps solide autour d'un point fixe, Acta Math. 12 (1889)
177-232.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

moments = np.array([1, 1, 0.5])
start = [0.8, 0.3, 0.9, 0.2, -0.5, 0.8]


def top(t, state):
    momentum, vertical = state.reshape(2, 3)  # both in the frame of the body
    turn = momentum / moments
    return np.concatenate([np.cross(momentum, turn) + np.cross(vertical, [1, 0, 0]), np.cross(vertical, turn)])


def main():
    found = iv.find_invariants(top, (0, 10), start, degree=4, labels=["l1", "l2", "l3", "g1", "g2", "g3"])
    for one in found:
        print(one.formula)
    figure, axes = plt.subplots(layout="constrained")
    for label, invariants in (("plain", None), ("projected", found)):
        sol = iv.ode45(top, (0, 50), start, invariants=invariants)
        off = np.max([np.abs(g(sol.y) - g(start)) for g in found], axis=0)
        print(f"{label:>9}: drift {off.max():.1e} of {len(found)} invariants")
        axes.semilogy(sol.t[1:], off[1:] + 1e-17, lw=1, label=label)
    axes.set(xlabel="t", ylabel="largest residual", title="Kowalevski's top, ode45")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
