"""Many pendulums at once
======================

A disc of 400 initial values of the pendulum, carried along by its flow, on all processors. The functions are compiled,
so that they run on threads without the interpreter. Each trajectory keeps its own energy.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., Springer, 2006, section VI.2.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv


@iv.compile
def pendulum(t, y):
    return y[1], -np.sin(y[0])


@iv.compile
def energy(t, y):
    return y[1] ** 2 / 2 - np.cos(y[0])


def main():
    angle, radius = 2.39996 * np.arange(400), 0.6 * np.sqrt(np.arange(400) / 400)  # a sunflower
    start = np.column_stack([radius * np.cos(angle), 1.3 + radius * np.sin(angle)])
    times = [0, 1.5, 3, 4.5]
    held = iv.Invariants(energy, names="energy", iterations=4)
    many = iv.solve_ensemble(pendulum, (0, 4.5), start, t_eval=times, invariants=held, rtol=1e-6, atol=1e-9)
    print(f"energy off by {np.ptp(energy(0, many.y.transpose(1, 0, 2)), axis=1).max():.1e} in all trajectories")

    figure, axes = plt.subplots(layout="constrained")
    for k, t in enumerate(times):
        axes.plot(*many.y[:, :, k].T, ".", ms=3, label=f"t = {t}")
    axes.set(xlabel="angle", ylabel="angular velocity", title="The flow of a pendulum, ode45")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
