"""A bouncing ball
===============

An event with an action: at each impact the ball loses a tenth of its speed and the integration continues. The energy is
kept in flight, and held at its new value after each impact.

Source: L. F. Shampine, S. Thompson, Event location for ordinary differential equations, Comput. Math. Appl. 39 (2000)
43-54, for the kind of problem; here gravity falls off with the height.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv


def ball(t, state):
    height, speed = state
    return [speed, -1 / (1 + height) ** 2]


def energy(t, state):
    height, speed = state
    return speed**2 / 2 - 1 / (1 + height)


def floor(t, state):
    return state[0]


def bounce(t, state):
    return [0, -0.9 * state[1]]


def main():
    impact = iv.Event(floor, direction=-1, terminal=31, action=bounce)
    figure, (path, drifts) = plt.subplots(2, sharex=True, layout="constrained")
    for label, invariants in (("plain", None), ("projected", energy)):
        sol = iv.ode45(ball, (0, 100), [1, 0], events=impact, invariants=invariants, refine=10)
        flight = np.cumsum(np.diff(sol.t, prepend=-1) == 0)  # a jump has two points: number the flights
        values, firsts = energy(0, sol.y), np.searchsorted(flight, range(31))
        off = np.abs(values - values[firsts][flight])
        print(f"{label:>9}: energy within a flight off by {off.max():.1e}, {len(sol.t_events[0])} impacts")
        path.plot(sol.t, sol.y[0], lw=1)
        drifts.semilogy(sol.t, off + 1e-17, lw=1, label=label)
    path.set(ylabel="height", title="Thirty impacts, ode45")
    drifts.set(xlabel="t", ylabel="energy in flight, off by")
    drifts.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
