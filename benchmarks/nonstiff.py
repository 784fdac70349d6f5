"""Problems that are not stiff, each written once for all packages: +, -, *, /, and s^(-3/2) as the package has it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

Function = Callable[[float, Any], tuple[Any, ...]]
Power = Callable[[Any], Any]


@dataclass(frozen=True)
class Problem:
    """y' = f(t, y) over `span` from y0, with its invariants.

    Attributes
    ----------
    name, title : str
        For the command line and file names; for tables.
    rhs : callable
        Given the function s -> s^(-3/2) of a package, f(t, y): a tuple, of floats, of arrays or of expressions.
    g, g_jac : callable
        The invariants and the rows of their Jacobian one after the other, tuples of floats; compiled by numba.
    names : sequence of str
        Names of the invariants.
    exact : sequence of float or None
        The final state, where it is known.
    """

    name: str
    title: str
    span: tuple[float, float]
    y0: Sequence[float]
    rhs: Callable[[Power], Function]
    g: Function
    g_jac: Function
    names: Sequence[str]
    exact: Sequence[float] | None = None


# ----------------------------------------------------------------------------------------------------------------------
# Lotka-Volterra


def lotka_volterra(power: Power) -> Function:
    def f(t, y):
        return 2.0 * y[0] * (1.0 - y[1]), -y[1] * (1.0 - y[0])

    return f


def lotka_volterra_g(t, y):
    return (y[0] - math.log(y[0]) + 2.0 * (y[1] - math.log(y[1])),)


def lotka_volterra_jac(t, y):
    return 1.0 - 1.0 / y[0], 2.0 - 2.0 / y[1]


# ----------------------------------------------------------------------------------------------------------------------
# Restricted three-body problem, as distributed with MATLAB (orbitode)

MU = 1 / 82.45
MU1 = 1 - MU


def three_body(power: Power) -> Function:
    def f(t, y):
        a, b = y[0] + MU, y[0] - MU1
        p = MU1 * power(a * a + y[1] * y[1])
        q = MU * power(b * b + y[1] * y[1])
        return y[2], y[3], 2.0 * y[3] + y[0] - p * a - q * b, -2.0 * y[2] + y[1] - (p + q) * y[1]

    return f


def jacobi_integral(t, y):
    a, b = y[0] + MU, y[0] - MU1
    r, s = math.sqrt(a * a + y[1] * y[1]), math.sqrt(b * b + y[1] * y[1])
    return ((y[2] * y[2] + y[3] * y[3] - y[0] * y[0] - y[1] * y[1]) / 2.0 - MU1 / r - MU / s,)


def jacobi_gradient(t, y):
    a, b = y[0] + MU, y[0] - MU1
    r2, s2 = a * a + y[1] * y[1], b * b + y[1] * y[1]
    p, q = MU1 / (r2 * math.sqrt(r2)), MU / (s2 * math.sqrt(s2))
    return p * a + q * b - y[0], (p + q) * y[1] - y[1], y[2], y[3]


# ----------------------------------------------------------------------------------------------------------------------
# Kepler


def kepler(power: Power) -> Function:
    def f(t, y):
        p = power(y[0] * y[0] + y[1] * y[1])
        return y[2], y[3], -p * y[0], -p * y[1]

    return f


def kepler_g(t, y):
    r = math.sqrt(y[0] * y[0] + y[1] * y[1])
    return (y[2] * y[2] + y[3] * y[3]) / 2.0 - 1.0 / r, y[0] * y[3] - y[1] * y[2]


def kepler_jac(t, y):
    r2 = y[0] * y[0] + y[1] * y[1]
    p = 1.0 / (r2 * math.sqrt(r2))
    return p * y[0], p * y[1], y[2], y[3], y[3], -y[2], -y[1], y[0]


def kepler_start(e: float) -> list[float]:
    """Perihelion of an orbit of eccentricity e and period 2 pi."""
    return [1 - e, 0.0, 0.0, math.sqrt((1 + e) / (1 - e))]


# ----------------------------------------------------------------------------------------------------------------------
# Hénon-Heiles


def henon_heiles(power: Power) -> Function:
    def f(t, y):
        return y[2], y[3], -y[0] - 2.0 * y[0] * y[1], -y[1] - y[0] * y[0] + y[1] * y[1]

    return f


def henon_heiles_g(t, y):
    potential = (y[0] * y[0] + y[1] * y[1]) / 2.0 + y[0] * y[0] * y[1] - y[1] * y[1] * y[1] / 3.0
    return ((y[2] * y[2] + y[3] * y[3]) / 2.0 + potential,)


def henon_heiles_jac(t, y):
    return y[0] + 2.0 * y[0] * y[1], y[1] + y[0] * y[0] - y[1] * y[1], y[2], y[3]


def henon_heiles_start(energy: float, y: float) -> list[float]:
    """On the section x = 0 with p_y = 0."""
    return [0.0, y, math.sqrt(2 * energy - y * y + 2 * y**3 / 3), 0.0]


# ----------------------------------------------------------------------------------------------------------------------
# Free rigid body, as distributed with MATLAB (rigidode)


def rigid_body(power: Power) -> Function:
    def f(t, y):
        return y[1] * y[2], -y[0] * y[2], -0.51 * y[0] * y[1]

    return f


def rigid_body_g(t, y):
    return y[0] * y[0] + y[1] * y[1], 0.51 * y[0] * y[0] + y[2] * y[2]


def rigid_body_jac(t, y):
    return 2.0 * y[0], 2.0 * y[1], 0.0, 1.02 * y[0], 0.0, 2.0 * y[2]


# ----------------------------------------------------------------------------------------------------------------------
# Outer solar system: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed., Springer 2006, I.2.4.
# Lengths are in astronomical units, masses in solar ones; the unit of time, of 1/sqrt(G) = 58.1 days, is ours: it makes
# velocities as large as they are for a unit orbit, so that one absolute tolerance suits them and the positions.

G = 2.95912208286e-4  # per day^2
DAY = math.sqrt(G)
MASSES = (1.00000597682, 0.000954786104043, 0.000285583733151, 0.0000437273164546, 0.0000517759138449, 1 / 1.3e8)
POSITIONS = (
    (0.0, 0.0, 0.0),
    (-3.5023653, -3.8169847, -1.5507963),
    (9.0755314, -3.0458353, -1.6483708),
    (8.3101420, -16.2901086, -7.2521278),
    (11.4707666, -25.7294829, -10.8169456),
    (-15.5387357, -25.2225594, -3.1902382),
)
VELOCITIES = (  # per day
    (0.0, 0.0, 0.0),
    (0.00565429, -0.00412490, -0.00190589),
    (0.00168318, 0.00483525, 0.00192462),
    (0.00354178, 0.00137102, 0.00055029),
    (0.00288930, 0.00114527, 0.00039677),
    (0.00276725, -0.00170702, -0.00136504),
)
BODIES = range(len(MASSES))
PAIRS = [(i, j) for i in BODIES for j in BODIES if i < j]


def q(body: int, axis: int) -> str:
    """A component of a position."""
    return f"y[{3 * body + axis}]"


def v(body: int, axis: int) -> str:
    """A component of a velocity."""
    return f"y[{3 * (len(MASSES) + body) + axis}]"


def unrolled(name: str, lines: Sequence[str], values: Sequence[str], **names: Any) -> Function:
    """The function name(t, y) that runs these lines and returns these values."""
    body = [*lines, f"return ({', '.join(values)},)"]
    namespace = dict(names)
    exec("\n    ".join([f"def {name}(t, y):", *body]), namespace)
    return namespace[name]


def distances() -> list[str]:
    """The vectors from body i to body j, and the squares of their lengths."""
    lines = []
    for i, j in PAIRS:
        lines += [f"d{i}{j}{a} = {q(j, a)} - {q(i, a)}" for a in range(3)]
        lines.append(f"s{i}{j} = {' + '.join(f'd{i}{j}{a} * d{i}{j}{a}' for a in range(3))}")
    return lines


def force(i: int, a: int, scale: bool) -> str:
    """Component a of the acceleration of body i, times its mass if `scale`."""
    terms = []
    for j in BODIES:
        if i != j:
            pair = f"{min(i, j)}{max(i, j)}"
            factor = MASSES[i] * MASSES[j] if scale else MASSES[j]
            terms.append(f"{'+' if i < j else '-'} {factor!r} * p{pair} * d{pair}{a}")
    return " ".join(terms).removeprefix("+ ")


def outer_solar_system(power: Power) -> Function:
    lines = distances() + [f"p{i}{j} = power(s{i}{j})" for i, j in PAIRS]
    accelerations = [force(i, a, scale=False) for i in BODIES for a in range(3)]
    return unrolled("f", lines, [v(i, a) for i in BODIES for a in range(3)] + accelerations, power=power)


def energy_and_momentum() -> tuple[Function, Function]:
    """g and its Jacobian: the energy and the three components of the total angular momentum."""
    kinetic = [f"{MASSES[i] / 2!r} * {v(i, a)} * {v(i, a)}" for i in BODIES for a in range(3)]
    potential = [f"{MASSES[i] * MASSES[j]!r} / sqrt(s{i}{j})" for i, j in PAIRS]
    values = [" + ".join(kinetic) + " - " + " - ".join(potential)]
    gradient = [f"-({force(i, a, scale=True)})" for i in BODIES for a in range(3)]
    gradient += [f"{MASSES[i]!r} * {v(i, a)}" for i in BODIES for a in range(3)]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        values.append(" + ".join(f"{MASSES[i]!r} * ({q(i, b)} * {v(i, c)} - {q(i, c)} * {v(i, b)})" for i in BODIES))
        for part, sign in ((v, ""), (q, "-")):
            rows = {a: ["0.0"] * 6, b: [], c: []}
            rows[b] = [f"{sign}{MASSES[i]!r} * {part(i, c)}" for i in BODIES]
            rows[c] = [f"{'-' if not sign else ''}{MASSES[i]!r} * {part(i, b)}" for i in BODIES]
            gradient += [rows[axis][i] for i in BODIES for axis in range(3)]
    powers = [f"p{i}{j} = 1.0 / (s{i}{j} * sqrt(s{i}{j}))" for i, j in PAIRS]
    g = unrolled("g", distances(), values, sqrt=math.sqrt)
    return g, unrolled("g_jac", distances() + powers, gradient, sqrt=math.sqrt)


def solar_start() -> list[float]:
    return [x for row in POSITIONS for x in row] + [x / DAY for row in VELOCITIES for x in row]


# ----------------------------------------------------------------------------------------------------------------------

_SOLAR_G, _SOLAR_JAC = energy_and_momentum()

PROBLEMS = {
    problem.name: problem
    for problem in (
        Problem(
            "lotka-volterra",
            "Lotka–Volterra, t ≤ 50",
            (0.0, 50.0),
            [1.0, 3.0],
            lotka_volterra,
            lotka_volterra_g,
            lotka_volterra_jac,
            ["u - ln u + 2 (v - ln v)"],
        ),
        Problem(
            "three-body",
            "Restricted three-body problem, one period",
            (0.0, 6.19216933131963970674),
            [1.2, 0.0, 0.0, -1.04935750983031990726],
            three_body,
            jacobi_integral,
            jacobi_gradient,
            ["Jacobi integral"],
        ),
        Problem(
            "kepler",
            "Kepler, e = 0.6, twenty periods",
            (0.0, 40 * math.pi),
            kepler_start(0.6),
            kepler,
            kepler_g,
            kepler_jac,
            ["energy", "angular momentum"],
            exact=kepler_start(0.6),
        ),
        Problem(
            "henon-heiles",
            "Hénon–Heiles, energy 1/12, t ≤ 100",
            (0.0, 100.0),
            henon_heiles_start(1 / 12, 0.1),
            henon_heiles,
            henon_heiles_g,
            henon_heiles_jac,
            ["energy"],
        ),
        Problem(
            "solar-system",
            "Outer solar system, 50 000 days, n = 36",
            (0.0, 5e4 * DAY),
            solar_start(),
            outer_solar_system,
            _SOLAR_G,
            _SOLAR_JAC,
            ["energy", "angular momentum, x", "angular momentum, y", "angular momentum, z"],
        ),
        Problem(
            "rigid-body",
            "Free rigid body, t ≤ 100",
            (0.0, 100.0),
            [0.0, 1.0, 1.0],
            rigid_body,
            rigid_body_g,
            rigid_body_jac,
            ["y1² + y2²", "0.51 y1² + y3²"],
        ),
    )
}
