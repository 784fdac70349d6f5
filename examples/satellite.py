"""A satellite that hangs in its orbit
===================================

Gravity turns the long axis of a satellite in a circular orbit towards the Earth. Positions are a unit quaternion,
velocities the three rates in the body frame; `kinematics` relates them. The invariants are the norm and Jacobi's
integral.

Source: P. C. Hughes, Spacecraft Attitude Dynamics, Wiley, 1986, chapter 9.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

MOMENTS = np.array([1.1, 1.2, 0.2])  # about the axes of the body; one orbit takes 2 π


def turn(t, q, v):
    """q' of the quaternion."""
    w, u = q[0], q[1:]
    return 0.5 * np.concatenate([[-u @ v], w * v + np.cross(u, v)])


def to_body(q, vector):
    """A vector v of space, in the body frame: q* v q."""
    w, u = q[0], -q[1:]
    return (w * w - u @ u) * vector + 2 * (u @ vector) * u + 2 * w * np.cross(u, vector)


def outward(t, q):
    return to_body(q, np.array([np.cos(t), np.sin(t), 0]))


def torque(t, q, v):
    out = outward(t, q)
    return 3 * np.cross(out, MOMENTS * out) - np.cross(v, MOMENTS * v)


def jacobi(t, q, v):
    out, normal = outward(t, q), to_body(q, np.array([0, 0, 1]))
    return v @ (MOMENTS * v) / 2 + 1.5 * out @ (MOMENTS * out) - (MOMENTS * v) @ normal


def main():
    length = iv.UnitQuaternion(range(4))
    satellite = iv.MechanicalSystem(MOMENTS, torque, kinematics=turn, energy=jacobi, invariants=length)
    start = np.array([np.cos(0.6), 0.1, np.sin(0.6), 0.2])
    start /= np.linalg.norm(start)
    figure, (angle, drift) = plt.subplots(2, sharex=True, layout="constrained")
    for label, correction in (("plain", "none"), ("projected", "levels")):
        problem = satellite.problem((0, 20 * np.pi), start, [0, 0, 1.0], correction=correction)
        sol = problem.solve("ode45", rtol=1e-4, atol=1e-6)
        orbits, states = sol.t / (2 * np.pi), list(zip(sol.t, sol.y.T, strict=True))
        laws = [(y[:4] @ y[:4], jacobi(t, y[:4], y[4:])) for t, y in states]
        off = np.abs(np.array(laws) - laws[0]).max(axis=1)
        print(f"{label:>9}: drift {off.max():.1e}")
        drift.semilogy(orbits[1:], off[1:] + 1e-17, lw=0.9, label=label)
    along = [abs(outward(t, y[:4])[2]) for t, y in states]
    angle.plot(orbits, np.degrees(np.arccos(np.minimum(along, 1))), lw=1)
    angle.set(ylabel="degrees", title="Long axis to the vertical")
    drift.set(xlabel="orbits", title="Norm and Jacobi's integral, off by")
    drift.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
