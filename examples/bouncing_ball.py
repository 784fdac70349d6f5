"""A ball that bounces: its energy is kept in flight, and held at its new value after each impact.

Usage: python bouncing_ball.py [output.png]
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv


def ball(t, state):
    height, _ = state
    return [state[1], -1 / (1 + height) ** 2]  # gravity falls off with the height


def energy(t, state):
    height, speed = state
    return speed**2 / 2 - 1 / (1 + height)


def floor(t, state):
    return state[0]


def bounce(t, state):
    return [0, -0.9 * state[1]]


impact = iv.Event(floor, direction=-1, terminal=31, action=bounce)
figure, axes = plt.subplots(layout="constrained")
for label, invariants in (("plain", None), ("projected", energy)):
    sol = iv.ode45(ball, (0, 100), [1, 0], events=impact, invariants=invariants, refine=10, dense_output=True)
    between = np.searchsorted(sol.t_events[0], sol.t, side="left")  # which flight each point belongs to
    after = np.flatnonzero(np.diff(sol.t) == 0) + 1
    between[after] += 1
    flights = [energy(0, sol.y[:, between == k]) for k in range(31)]
    drift = max(np.ptp(flight) for flight in flights)
    print(f"{label:>9}: energy within a flight off by {drift:.1e}, {len(sol.t_events[0])} impacts")
    axes.plot(sol.t, sol.y[0], lw=1, label=label)
axes.set(xlabel="t", ylabel="height", title="Thirty impacts, ode45")
axes.legend()
figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "bouncing_ball.png", dpi=150)
