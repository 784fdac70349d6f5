"""HIRES: a linear invariant
=========================

Eight species in a plant's high irradiance response, stiff. The amount of the enzyme, y7 + y8, is linear: every method
here keeps it to roundoff without projection.

Source: E. Schäfer, A new approach to explain the 'high irradiance responses' of photomorphogenesis on the basis of
phytochrome, J. Math. Biol. 2 (1975) 41-56; E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, section
IV.10.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

start = [1, 0, 0, 0, 0, 0, 0, 0.0057]


def hires(t, y):
    bound = 280 * y[5] * y[7]
    return [
        -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007,
        1.71 * y[0] - 8.75 * y[1],
        -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4],
        8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
        -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6],
        -bound + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
        bound - 1.81 * y[6],
        -bound + 1.81 * y[6],
    ]


def main():
    sol = iv.ode15s(hires, (0, 321.8122), start, rtol=1e-6, atol=1e-9)
    print(f"enzyme off by {np.abs(sol.y[6] + sol.y[7] - 0.0057).max():.1e} in {sol.stats.steps} steps")
    figure, axes = plt.subplots(layout="constrained")
    axes.loglog(sol.t[1:], sol.y[:, 1:].T, lw=1, label=[f"y{k}" for k in range(1, 9)])
    axes.loglog(sol.t[1:], sol.y[6:, 1:].sum(axis=0), "k--", lw=1, label="y7 + y8")
    axes.set(xlabel="t", ylabel="concentration", title="HIRES, ode15s", ylim=(1e-6, 2))
    axes.legend(ncols=2, fontsize="small")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
