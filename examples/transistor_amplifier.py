"""A transistor amplifier
======================

Kirchhoff's law at eight nodes: 0 = F(t, y, y'). Capacitors between nodes put the derivatives of two voltages into two
equations, whose sums have none. So three of the eight voltages follow from the others, and the initial values of only
five can be chosen. The equations are written down as they stand; the amplifier's output clips.

Source: F. Mazzia and C. Magherini, Test Set for Initial Value Problem Solvers, release 2.4, 2008.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

SUPPLY, THERMAL, RESISTOR = 6.0, 0.026, 9000.0


def signal(t):
    return 0.1 * np.sin(200 * np.pi * t)


def diode(u):
    return 1e-6 * (np.exp(u / THERMAL) - 1)


def currents(t, y, yp):
    first, second = diode(y[1] - y[2]), diode(y[4] - y[5])
    c1, c3, c5 = 1e-6 * (yp[1] - yp[0]), 3e-6 * (yp[4] - yp[3]), 5e-6 * (yp[7] - yp[6])
    return [
        c1 - (y[0] - signal(t)) / 1000,
        -c1 - (2 * y[1] - SUPPLY) / RESISTOR - 0.01 * first,
        -2e-6 * yp[2] - y[2] / RESISTOR + first,
        c3 - (y[3] - SUPPLY) / RESISTOR - 0.99 * first,
        -c3 - (2 * y[4] - SUPPLY) / RESISTOR - 0.01 * second,
        -4e-6 * yp[5] - y[5] / RESISTOR + second,
        c5 - (y[6] - SUPPLY) / RESISTOR - 0.99 * second,
        -c5 - y[7] / RESISTOR,
    ]


def main():
    guess = np.array([0, 3, 3, 6, 3, 3, 6, 0.0])
    dae = iv.Dae(currents, 0, guess, equations=[f"node {i}" for i in range(8)])
    print(dae)
    sol = dae.solve((0, 0.2), "radau", rtol=1e-6, atol=1e-8)
    off = np.abs([currents(t, y, yp) for t, y, yp in zip(sol.t, sol.y.T, sol.yp.T, strict=True)]).max()
    print(f"laws of Kirchhoff: off by {off:.1e} A at most, at {len(sol.t)} steps; {sol.nfev} evaluations")
    figure, axes = plt.subplots(figsize=(8, 3.6), layout="constrained")
    axes.plot(1e3 * sol.t, signal(sol.t), label="input")
    axes.plot(1e3 * sol.t, sol.y[7], label="output")
    axes.set(xlabel="t / ms", ylabel="voltage / V", title="Two stages amplify, and clip")
    axes.legend(loc="lower left")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
