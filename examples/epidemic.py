"""An epidemic
===========

Susceptible, infected and removed people. Their sum is linear and kept by every method; the other invariant, which
decides how many are never infected, needs projection. If one is imposed, the other must be too: the nearest point that
satisfies one need not satisfy the other.

Source: W. O. Kermack, A. G. McKendrick, A contribution to the mathematical theory of epidemics, Proc. R. Soc. Lond. A
115 (1927) 700-721.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

infection, recovery = 0.5, 0.2  # per day
start = [0.999, 0.001, 0]


def spread(t, y):
    s, i, _ = y
    return [-infection * s * i, infection * s * i - recovery * i, recovery * i]


def laws(t, y):
    s, i, r = y
    return [s + i + r, s + i - recovery / infection * np.log(s)]


def main():
    figure, axes = plt.subplots(layout="constrained")
    for label, invariants, style in (("plain", None, ":"), ("projected", laws, "-")):
        sol = iv.ode23(spread, (0, 150), start, invariants=invariants, rtol=1e-2, atol=1e-3, refine=8)
        total, drift = np.abs(np.transpose(laws(0, sol.y)) - laws(0, start)).max(axis=0)
        print(f"{label:>9}: drift {drift:.1e}, sum off by {total:.0e}, never infected {sol.y[0, -1]:.2%}")
        axes.set_prop_cycle(None)
        axes.plot(sol.t, sol.y.T, style, label=[f"{name}, {label}" for name in ("susceptible", "infected", "removed")])
    axes.set(xlabel="days", ylabel="part of the population", title="Kermack and McKendrick, ode23")
    axes.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
