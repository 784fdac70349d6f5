"""Three bodies on a figure of eight
=================================

Three equal masses follow each other on one closed curve. Energy and angular momentum (zero) are imposed over ten
periods.

Source: A. Chenciner, R. Montgomery, A remarkable periodic solution of the three-body problem in the case of equal
masses, Ann. of Math. 152 (2000) 881-901; initial values of C. Simó, printed there.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

period = 6.32591398
x1, v3 = np.array([0.97000436, -0.24308753]), np.array([-0.93240737, -0.86473146])
start = np.concatenate([x1, -x1, 0 * x1, -v3 / 2, -v3 / 2, v3])


def bodies(t, state):
    x, v = state.reshape(2, 3, 2)
    d = x[[1, 2, 0]] - x  # from each to the next
    pull = d / (d**2).sum(axis=1)[:, None] ** 1.5
    return np.ravel([v, pull - pull[[2, 0, 1]]])


def laws(t, state):
    x, v = state.reshape(2, 3, 2)
    r = ((x[[1, 2, 0]] - x) ** 2).sum(axis=1) ** 0.5
    return [(v**2).sum() / 2 - (1 / r).sum(), (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum()]


def main():
    figure, panels = plt.subplots(2, sharex=True, sharey=True, layout="constrained")
    for axes, (label, given) in zip(panels, (("plain", None), ("projected", laws)), strict=True):
        sol = iv.ode45(bodies, (0, 10 * period), start, invariants=given, refine=10)
        drift = max(np.abs(np.subtract(laws(0, y), laws(0, start))).max() for y in sol.y.T)
        print(f"{label:>9}: drift {drift:.1e} in {sol.stats.steps} steps")
        for k in range(3):
            axes.plot(*sol.y[2 * k : 2 * k + 2], lw=0.8)
        axes.set(title=f"ten periods, ode45, {label}", aspect="equal")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
