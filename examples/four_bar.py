"""A four-bar linkage by SymPy's Lagrange's method
===============================================

Three moving bars and the ground form a closed loop. SymPy forms the equations with multipliers in the three angles; the
loop constraints are imposed automatically.

Source: for this kind of mechanism, J. J. Uicker, G. R. Pennock, J. E. Shigley, Theory of Machines and Mechanisms,
Oxford University Press, 2016, chapter 1.
"""

import matplotlib.pyplot as plt
import numpy as np
import sympy
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

from invariode import symbolic

BARS, GROUND = (1.0, 3.0, 2.5), 3.2


def linkage():
    """Uniform bars of density 1; the first one can turn full circle."""
    angles, g = dynamicsymbols("a b c"), sympy.Symbol("g")
    joints, energies = [sympy.Matrix([0, 0])], []
    for angle, length in zip(angles, BARS, strict=True):
        along = length * sympy.Matrix([sympy.cos(angle), sympy.sin(angle)])
        centre = joints[-1] + along / 2
        speed = centre.diff(dynamicsymbols._t)
        kinetic = length * speed.dot(speed) / 2 + length**3 * angle.diff() ** 2 / 24
        energies.append((kinetic, g * length * centre[1]))
        joints.append(joints[-1] + along)
    kinetic, potential = (sum(part) for part in zip(*energies, strict=True))
    method = LagrangesMethod(kinetic - potential, angles, hol_coneqs=[joints[3][0] - GROUND, joints[3][1]])
    method.form_lagranges_equations()
    return symbolic.from_mechanics(
        method,
        parameters={g: 9.81},
        points=[[sympy.S(0), sympy.S(0)], list(joints[1]), list(joints[2]), [GROUND, sympy.S(0)]],
    )


def start():
    """Angles that close the loop with the first bar upright, and speeds that go with them."""
    corner, ground = np.array([0, BARS[0]]), np.array([GROUND, 0])
    reach = ground - corner
    distance = np.hypot(*reach)
    lean = np.arccos((BARS[1] ** 2 + distance**2 - BARS[2] ** 2) / (2 * BARS[1] * distance))
    b = np.arctan2(reach[1], reach[0]) + lean
    knee = corner + BARS[1] * np.array([np.cos(b), np.sin(b)])
    c = np.arctan2(*(ground - knee)[::-1])
    rows = [[-BARS[1] * np.sin(b), -BARS[2] * np.sin(c)], [BARS[1] * np.cos(b), BARS[2] * np.cos(c)]]
    turn = 6.0
    others = np.linalg.solve(rows, [turn * BARS[0], 0])
    return [np.pi / 2, b, c, turn, *others]


def main():
    system = linkage()
    figure, (picture, drift) = plt.subplots(1, 2, figsize=(9.6, 4), layout="constrained")
    for label, correction in (("plain", "none"), ("projected", "levels")):
        problem = system.problem((0, 20), start(), correction=correction, compiled=False)
        sol = problem.solve("ode45", rtol=1e-4, atol=1e-6, dense_output=True)
        angles = sol.y[:3]
        x, y = (sum(r * turn(a) for r, a in zip(BARS, angles, strict=True)) for turn in (np.cos, np.sin))
        off = np.hypot(x - GROUND, y)
        print(f"{label:>9}: loop off by {off.max():.1e}")
        drift.semilogy(sol.t[1:], off[1:] + 1e-17, lw=0.9, label=label)
    for t in np.linspace(0, 0.7, 8):
        bars = [[r * np.cos(a), r * np.sin(a)] for r, a in zip(BARS, sol.sol(t)[:3], strict=True)]
        corners = np.cumsum([[0, 0], *bars], axis=0)
        picture.plot(*corners.T, "o-", lw=1.2, ms=4, color=plt.cm.viridis(t / 0.8))
    picture.set(xlabel="x", ylabel="y", title="Every 0.1", aspect="equal")
    drift.set(xlabel="t", title="Ends of the loop apart by")
    drift.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
