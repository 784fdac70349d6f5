"""The forces in the pins of a four-bar linkage
============================================

A crank that is driven by a constant torque turns a coupler and a rocker. Each bar has three coordinates, so that each
pin is two constraints of its own, the difference of the two points that it holds together: its multipliers are the
force on the first of them.

Source: for this kind of mechanism, J. J. Uicker, G. R. Pennock, J. E. Shigley, Theory of Machines and Mechanisms,
Oxford University Press, 2016, chapters 1 and 15.
"""

import matplotlib.pyplot as plt
import numpy as np

import invariode as iv

LENGTHS, DENSITY, GRAVITY, TORQUE = np.array([1.0, 3.0, 2.5]), 2.0, 9.81, 20.0
GROUND = np.array([3.2, 0.0])
MASSES = DENSITY * LENGTHS
INERTIA = np.ravel(np.column_stack([MASSES, MASSES, MASSES * LENGTHS**2 / 12]))


def ends(q):
    """The two ends of each bar from its centre and its angle: q = (x1, y1, a1, x2, ...)."""
    found = []
    for (x, y, angle), length in zip(np.reshape(q, (3, 3)), LENGTHS, strict=True):
        along = [length / 2 * np.cos(angle), length / 2 * np.sin(angle)]
        found.append(((x - along[0], y - along[1]), (x + along[0], y + along[1])))
    return found


def pins(t, q):
    """Two rows for each pin: the point of the bar that comes next, minus that of the one before, or of the ground."""
    crank, coupler, rocker = ends(q)
    pairs = ((crank[0], (0.0, 0.0)), (coupler[0], crank[1]), (rocker[0], coupler[1]), (rocker[1], GROUND))
    return [a - b for first, second in pairs for a, b in zip(first, second, strict=True)]


def loads(t, q, v):
    """Gravity, and the torque on the crank."""
    return [0, -GRAVITY * MASSES[0], TORQUE, 0, -GRAVITY * MASSES[1], 0, 0, -GRAVITY * MASSES[2], 0]


def start():
    """Centres and angles with the crank upright, at rest."""
    corner = np.array([0, LENGTHS[0]])
    reach = GROUND - corner
    distance = np.hypot(*reach)
    lean = np.arccos((LENGTHS[1] ** 2 + distance**2 - LENGTHS[2] ** 2) / (2 * LENGTHS[1] * distance))
    b = np.arctan2(reach[1], reach[0]) + lean
    knee = corner + LENGTHS[1] * np.array([np.cos(b), np.sin(b)])
    c = np.arctan2(*(GROUND - knee)[::-1])
    return np.ravel([[*corner / 2, np.pi / 2], [*(corner + knee) / 2, b], [*(knee + GROUND) / 2, c]])


def linkage():
    return iv.MechanicalSystem(INERTIA, loads, pins)


def main():
    system = linkage()
    sol = system.problem((0, 1.5), start(), np.zeros(9)).solve(
        "dop853", rtol=1e-8, atol=1e-10, t_eval=np.linspace(0, 1.5, 600)
    )
    force = system.multipliers(sol)  # on the first of the two points of each pin, in newtons if q is in metres
    size = np.hypot(force[0::2], force[1::2])
    print(f"{'pins':>20} off by {max(abs(gap) for q in sol.y[:9].T for gap in pins(0, q)):.1e}")
    figure, axes = plt.subplots(1, 2, figsize=(9.6, 4), layout="constrained")
    names = ("ground and crank", "crank and coupler", "coupler and rocker", "rocker and ground")
    for name, one in zip(names, size, strict=True):
        axes[0].plot(sol.t, one, lw=1.1, label=name)
        print(f"{name:>20}: at most {one.max():7.1f} N")
    axes[0].set(xlabel="t", ylabel="force in the pin (N)")
    axes[0].legend(fontsize=8)
    for i, k in enumerate(range(0, 400, 80)):
        corners = [point for pair in ends(sol.y[:9, k]) for point in pair]
        axes[1].plot(*np.array(corners).T, "o-", lw=1.2, ms=4, color=plt.cm.viridis(i / 5))
        pin = np.array(corners[2])
        axes[1].annotate("", pin + force[2:4, k] / 250, pin, arrowprops={"arrowstyle": "->", "color": "crimson"})
    axes[1].set(xlabel="x", ylabel="y", title="Force on the coupler in its first pin", aspect="equal")
    return figure


if __name__ == "__main__":
    main()
    plt.show()
