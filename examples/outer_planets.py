"""The outer solar system
======================

The sun and five planets over 100000 days. Energy and angular momentum are imposed; the total momentum is linear and
kept anyway.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., Springer, 2006, section I.2.4, with
the data of its table 2.2 (units: AU, days, masses of the sun and the inner planets).
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

G = 2.95912208286e-4
names = ["Sun", "Jupiter", "Saturn", "Uranus", "Neptune", "Pluto"]
m = np.array([1.00000597682, 9.54786104043e-4, 2.85583733151e-4, 4.37273164546e-5, 5.17759138449e-5, 1 / 1.3e8])
place = [[0, 0, 0], [-3.5023653, -3.8169847, -1.5507963], [9.0755314, -3.0458353, -1.6483708]]
place += [[8.3101420, -16.2901086, -7.2521278], [11.4707666, -25.7294829, -10.8169456]]
place += [[-15.5387357, -25.2225594, -3.1902382]]
speed = [[0, 0, 0], [0.00565429, -0.00412490, -0.00190589], [0.00168318, 0.00483525, 0.00192462]]
speed += [[0.00354178, 0.00137102, 0.00055029], [0.00288930, 0.00114527, 0.00039677]]
speed += [[0.00276725, -0.00170702, -0.00136504]]
start = np.ravel([place, speed])
first, second = np.triu_indices(6, 1)  # all pairs of bodies


def planets(t, state):
    x, v = state.reshape(2, 6, 3)
    d = x[None] - x[:, None]
    r3 = (d**2).sum(axis=2) ** 1.5 + np.eye(6)
    return np.ravel([v, G * ((m / r3)[:, :, None] * d).sum(axis=1)])


def laws(t, state):
    x, v = state.reshape(2, 6, 3)
    r = ((x[first] - x[second]) ** 2).sum(axis=1) ** 0.5
    energy = (m * (v**2).sum(axis=1)).sum() / 2 - G * (m[first] * m[second] / r).sum()
    moment = 1e9 * (m * x.T) @ v
    return [1e9 * energy, *(moment - moment.T)[[1, 2, 0], [2, 0, 1]]]


def main():
    figure, axes = plt.subplots(subplot_kw={"projection": "3d"}, layout="constrained", figsize=(7, 5))
    for label, given in (("plain", None), ("projected", iv.Invariants(laws, iterations=2))):
        sol = iv.ode113(planets, (0, 1e5), start, invariants=given, rtol=1e-5, atol=1e-9)
        drift = max(np.abs(np.divide(laws(0, y), laws(0, start)) - 1).max() for y in sol.y.T[::5])
        print(f"{label:>9}: relative drift {drift:.1e} in {sol.stats.steps} steps")
    for k, name in enumerate(names):
        axes.plot(*sol.y[3 * k : 3 * k + 3], lw=0.8, label=name)
    axes.set(title="100000 days, ode113, projected", xlabel="AU")
    figure.legend(loc="outside right upper", fontsize="small")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
