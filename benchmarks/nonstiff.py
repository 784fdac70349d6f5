"""Problems that are not stiff, each written once for all packages: +, -, *, /, and s^(-3/2) as the package has it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
from numba.core.dispatcher import Dispatcher

import invariode as iv
from invariode import problems

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
# Those of invariode.problems, in the form that each package takes


class Inverse:
    """A number to divide by, of which a package has the inverse."""

    def __init__(self, inverse: Any) -> None:
        self._inverse = inverse

    def __rtruediv__(self, x: Any) -> Any:
        return x * self._inverse


@numba.njit(error_model="numpy")
def cube(a: float, b: float) -> float:
    s = a * a + b * b
    return s * math.sqrt(s)


def with_power(formula: Callable[..., Any]) -> Callable[[Power], Function]:
    """Of a formula that may take cubes of distances, f(t, y) by the power that a package has; compiled if that is."""
    takes_cubes = "cube" in inspect.signature(formula).parameters

    def rhs(power: Power) -> Function:
        if isinstance(power, Dispatcher):
            inner, cubed = numba.njit(formula, error_model="numpy"), cube
        else:
            inner, cubed = formula, lambda a, b: Inverse(power(a * a + b * b))
        if takes_cubes:
            return lambda t, y: inner(t, y, cubed)
        return lambda t, y: inner(t, y)

    return rhs


def flat(function: Callable[..., Any], parts: int) -> Function:
    """Rows one after the other, or one number alone, as a tuple for the compiler."""
    inner = numba.njit(function, error_model="numpy")
    if parts == 0:
        return lambda t, y: (inner(t, y),)
    if parts == 1:
        return lambda t, y: inner(t, y)[0]
    return lambda t, y: inner(t, y)[0] + inner(t, y)[1]


def classic(name: str, title: str, problem: iv.Problem, tf: float, exact: Sequence[float] | None = None) -> Problem:
    """A problem of one or two invariants, up to another time."""
    (held,) = problem.invariants
    m = len(held.names)
    return Problem(
        name,
        title,
        (0.0, tf),
        problem.y0.tolist(),
        with_power(problem.fun),
        flat(held.fun, 0) if m == 1 else held.fun,
        flat(held.jac, m),
        held.names,
        exact,
    )


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
        classic("lotka-volterra", "Lotka–Volterra, t ≤ 50", problems.lotka_volterra(), 50.0),
        classic("three-body", "Restricted three-body problem, one period", problems.three_body(), problems.PERIOD),
        classic(
            "kepler",
            "Kepler, e = 0.6, twenty periods",
            problems.kepler(0.6),
            40 * math.pi,
            exact=problems.kepler(0.6).y0.tolist(),
        ),
        classic("henon-heiles", "Hénon–Heiles, energy 1/12, t ≤ 100", problems.henon_heiles(1 / 12, 0.1), 100.0),
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
        classic("rigid-body", "Free rigid body, t ≤ 100", problems.rigid_body(), 100.0),
    )
}
