"""A crane whose load follows a path
=================================

The load of a crane is to move along a given curve. Which force on the trolley, and which length of the rope, does that
take? Newton's laws of load and trolley, and the length of the rope, are four equations for four unknowns: the position
of the trolley, the force on it, the tension and the length. They have no degree of freedom: the path must be
differentiated four times, which nobody has to do by hand, and the result is exact to roundoff.

Source: W. Blajer and K. Kołodziejczyk, A geometric approach to solving problems of control
constraints: theory and a DAE framework, Multibody Syst. Dyn. 11 (2004) 343-364, with another path.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

GRAVITY, LOAD, TROLLEY, END = 9.81, 200.0, 50.0, 6.0


def path(t):
    """Over an obstacle: from x = 0 to x = 4, at rest at both ends."""
    s = t / END
    x = 4 * s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
    return x, -5 + 2 * np.sin(np.pi * x / 4) ** 2


def crane(t, y, yp, ypp):
    x, z, trolley, force, pull, length = y
    over, up = path(t)
    return [
        x - over,
        z - up,
        LOAD * ypp[0] + pull * (x - trolley),
        LOAD * ypp[1] + pull * z + LOAD * GRAVITY,
        TROLLEY * ypp[2] - force - pull * (x - trolley),
        (x - trolley) ** 2 + z**2 - length**2,
    ]


def main():
    names = ["x", "z", "trolley", "force", "pull", "length"]
    guess = [0, -5, 0, 0, LOAD * GRAVITY / 5, 5]
    print(iv.Dae(crane, 0, guess, names=names, order=2))
    sol = iv.solve_dae(crane, (0, END), guess, order=2, names=names, t_eval=np.linspace(0, END, 301))
    off = max(np.abs(sol.y[:2, k] - path(t)).max() for k, t in enumerate(sol.t))
    print(f"load: off by {off:.1e} m")
    figure, (place, drive) = plt.subplots(1, 2, figsize=(9.6, 3.8), layout="constrained")
    for k in range(0, 301, 25):
        place.plot([sol.y[2, k], sol.y[0, k]], [0, sol.y[1, k]], color="0.7", lw=0.8)
    place.plot(sol.y[0], sol.y[1], label="load")
    place.plot(sol.y[2], 0 * sol.t, lw=3, label="trolley")
    place.set(xlabel="x / m", ylabel="z / m", aspect="equal", title="Every half second")
    place.legend(loc="lower right")
    drive.plot(sol.t, sol.y[3], label="force / N")
    drive.plot(sol.t, 100 * sol.y[5], label="rope / cm")
    drive.set(xlabel="t / s", title="What the path takes")
    drive.legend()
    return figure


if __name__ == "__main__":
    main()
    plt.show()
