"""A rolling disc by SymPy's Kane's method
=======================================

A disc rolls on a plane without slipping: the velocity of its lowest point is zero, a condition that positions alone
cannot express. Kane's method gets it as two dependent speeds. The condition and the energy are imposed.

Source: T. R. Kane, D. A. Levinson, Dynamics: Theory and Applications, McGraw-Hill, 1985, section 2.9; the disc is also
in the documentation of SymPy.
"""

import matplotlib.pyplot as plt
import numpy as np
import sympy
from sympy.physics.mechanics import (
    KanesMethod,
    Point,
    ReferenceFrame,
    RigidBody,
    dynamicsymbols,
    inertia,
)

from invariode import symbolic


def disc():
    """Coordinates: heading, lean, spin, and the point of contact. Radius, mass and gravity are 1."""
    heading, lean, spin, x, y = q = dynamicsymbols("heading lean spin x y")
    w1, w2, w3, vx, vy = dynamicsymbols("w1 w2 w3 v_x v_y")
    ground = ReferenceFrame("N")
    turned = ground.orientnew("Y", "Axis", [heading, ground.z])
    leant = turned.orientnew("L", "Axis", [lean, turned.x])
    turning = leant.orientnew("R", "Axis", [spin, leant.y])
    rates = turning.ang_vel_in(ground)
    kinematics = [
        rates.dot(leant.x) - w1,
        rates.dot(leant.y) - w2,
        rates.dot(leant.z) - w3,
        x.diff() - vx,
        y.diff() - vy,
    ]
    spinning = w1 * leant.x + w2 * leant.y + w3 * leant.z
    turning.set_ang_vel(ground, spinning)
    leant.set_ang_vel(ground, w1 * leant.x + w3 * leant.z + w3 * sympy.tan(lean) * leant.y)
    origin = Point("O")
    origin.set_vel(ground, 0)
    contact = origin.locatenew("C", x * ground.x + y * ground.y)
    contact.set_vel(ground, vx * ground.x + vy * ground.y)
    centre = contact.locatenew("D", leant.z)
    centre.v2pt_theory(contact, ground, leant)
    slip = centre.vel(ground) - spinning.cross(leant.z)
    method = KanesMethod(
        ground,
        q_ind=q,
        u_ind=[w1, w2, w3],
        u_dependent=[vx, vy],
        kd_eqs=kinematics,
        velocity_constraints=[slip.dot(ground.x), slip.dot(ground.y)],
    )
    round_ = inertia(leant, sympy.Rational(1, 4), sympy.Rational(1, 2), sympy.Rational(1, 4))
    body = RigidBody("disc", centre, turning, 1, (round_, centre))
    method.kanes_equations([body], [(centre, -ground.z)])
    return symbolic.from_mechanics(method)


def main():
    system = disc()
    start = [0, 0.2, 0, 0, 0, 0.1, 2.0, 0.3, 0, 0]
    figure, (path, drift) = plt.subplots(1, 2, figsize=(9.6, 4), layout="constrained")
    no_slip = system.problem((0, 30), start, compiled=False).invariants[:2]
    start[8:] = [-one.fun(0, start)[0] for one in no_slip]  # a velocity of the contact plus what it must cancel
    problem = system.problem((0, 30), start, compiled=False)
    kept = problem.solve("ode45", rtol=1e-4, atol=1e-6, dense_output=True)
    plain = problem.replace(invariants=None).solve("ode45", rtol=1e-4, atol=1e-6)
    for label, sol in (("plain", plain), ("projected", kept)):
        states = zip(sol.t, sol.y.T, strict=True)
        slip = [max(abs(one.fun(t, y)[0]) for one in no_slip) for t, y in states]
        print(f"{label:>9}: slip off by {max(slip):.1e}")
        drift.semilogy(sol.t[1:], np.array(slip[1:]) + 1e-17, lw=0.9, label=label)
    path.plot(*kept.sol(np.linspace(0, 30, 2000))[3:5], lw=1)
    path.set(xlabel="x", ylabel="y", title="Where the disc touches the plane", aspect="equal")
    drift.set(xlabel="t", title="Velocity of the lowest point")
    drift.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
