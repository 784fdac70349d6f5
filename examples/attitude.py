"""Attitude of a tumbling satellite
================================

The state is a unit quaternion for the attitude, and the angular velocity in the body frame. The invariants are the norm
of the quaternion, the energy and the three components of the angular momentum in space; the intermediate axis flips
over.

Source: F. L. Markley, J. L. Crassidis, Fundamentals of Spacecraft Attitude Determination and Control, Springer, 2014,
sections 2.7 and 3.3.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

moments = np.array([1.0, 2.0, 3.0])


def to_space(q, v):
    """A vector v of the body frame, in space: q v q*."""
    s, u = q[0], q[1:]
    return (s * s - np.dot(u, u)) * v + 2 * np.dot(u, v) * u + 2 * s * np.cross(u, v)


def tumble(t, state):
    q, w = state[:4], state[4:]
    turn = 0.5 * np.concatenate([[-np.dot(q[1:], w)], q[0] * w + np.cross(q[1:], w)])
    return np.concatenate([turn, np.cross(moments * w, w) / moments])


def laws(t, state):
    q, w = state[:4], state[4:]
    return [np.dot(w, moments * w) / 2, *to_space(q, moments * w)]


def main():
    start = np.array([1, 0, 0, 0, 0.2, 1, 0.1])
    kept = [iv.UnitQuaternion(range(4)), laws]
    figure, panels = plt.subplots(2, sharex=True, layout="constrained")
    for axes, (label, given) in zip(panels, (("plain", None), ("projected", kept)), strict=True):
        sol = iv.ode45(tumble, (0, 200), start, invariants=given, atol=1e-3)
        off = [(y[:4] @ y[:4] - 1, *np.subtract(laws(0, y), laws(0, start))) for y in sol.y.T]
        drift = np.abs(off).max()
        print(f"{label:>9}: drift {drift:.1e}")
        axis = np.array([to_space(y[:4], np.array([0.0, 1, 0])) for y in sol.y.T])
        axes.plot(sol.t, axis, lw=1, label=["x", "y", "z"])
        axes.set(ylabel="axis in space", title=f"{label}, ode45", ylim=(-2, 2))
    panels[0].legend(loc="upper left", ncols=3)
    panels[1].set_xlabel("t")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
