"""Discovery: polynomials that the equations conserve, found as a null space and verified."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from math import comb
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    Array,
    distinct_labels,
    extra_arguments,
    function,
    interval,
    positive_integer,
    quietly,
    shown,
    state,
)
from .._base.notebook import latex_of_polynomial
from .._base.package import public
from .._base.types import Span
from .._linear.null_space import echelon, null_space
from .._problem.invariants import Invariants
from .._problem.problem import Problem
from .._problem.slope import checked_slope
from .._solve.ivp import solve_ivp

Exponents = tuple[int, ...]
Number = Fraction | float

_MOST_MONOMIALS = 2000
_TRAJECTORIES = 4
_MOST_STEPS = 5000  # of the code for problems that are not stiff
_SPREAD = 0.2  # of starts and sample points, in units of the size of the components
_NULL = 1e-10  # pivots below, in units of the first, are zero,
_GAP = 1e3  # if none stands within this factor above the largest of these
_LEADING = 1e-6  # least coefficient of a leading term, in units of the largest of the polynomials left
_NEGLIGIBLE = 1e-8  # coefficients below, in units of the largest term, are zero
_DENOMINATOR = 1000
_NUMERATOR = 10**6
_RATIONAL = 1e-8  # relative distance from a fraction
_CONSERVED = 1e-9  # rate, in units of its terms
_DRIFT = 1e-6  # over a fresh trajectory of relative accuracy 1e-9
_INDEPENDENT = 1e-7  # smallest pivot of gradients, in units of the first


@public
class PolynomialInvariant(Invariants):
    """A polynomial invariant, ready for ``invariants=``.

    Attributes
    ----------
    coefficients : dict
        Exponents of the components -> coefficient, a Fraction if it is a simple one, else a float.
    degree : int
        Total degree.
    formula : str
        The polynomial as text; also its name.
    """

    def __init__(self, coefficients: dict[Exponents, Number], labels: Sequence[str]) -> None:
        self.coefficients = coefficients
        self.degree = max(sum(e) for e in coefficients)
        self.formula = _formula(coefficients, labels)
        self._labels = list(labels)
        self._terms = [
            (float(c), [(i, e) for i, e in enumerate(exponents) if e]) for exponents, c in coefficients.items()
        ]
        super().__init__(self._value, self._gradient, names=self.formula)

    def __call__(self, y: Any) -> Any:
        """Return the value at y (n,), or at points (n, n_t)."""
        return self._value(0.0, np.asarray(y))

    def _repr_latex_(self) -> str:
        return latex_of_polynomial(self.coefficients, self._labels)

    def _value(self, t: float, y: Any, *args: Any) -> Any:
        total: Any = 0.0
        for c, powers in self._terms:
            product: Any = c
            for i, e in powers:
                product = product * y[i] ** e
            total = total + product
        return total

    def _gradient(self, t: float, y: Any, *args: Any) -> Array:
        gradient = np.zeros(np.shape(y), dtype=np.asarray(y).dtype)
        for c, powers in self._terms:
            for j, f in powers:
                product: Any = c * f * y[j] ** (f - 1)
                for i, e in powers:
                    if i != j:
                        product = product * y[i] ** e
                gradient[j] += product
        return gradient


@public
def find_invariants(
    fun: Callable[..., Any] | Problem,
    t_span: Span | None = None,
    y0: ArrayLike | None = None,
    degree: int = 2,
    args: Iterable[Any] = (),
    *,
    labels: Sequence[str] | None = None,
) -> list[PolynomialInvariant]:
    """Propose polynomials that y' = f(t, y) conserves.

    p is an invariant if ∇p · f = 0. At points around several trajectories this is a linear system for the coefficients
    of the monomials; for each degree, its null space is used if its dimension is numerically unambiguous. The
    polynomials are then verified on other trajectories.

    Parameters
    ----------
    fun : callable or Problem
        ``f(t, y, *args)``; or a problem y' = f(t, y), which has an interval, y0, arguments and labels:
        ``find_invariants(problem, degree=3)``.
    t_span : (float, float)
        Interval of the trajectories, finite.
    y0 : array_like of shape (n,)
        Where one starts; the others start nearby. Real; preferably not a point of symmetry.
    degree : int, default 2
        Highest total degree.
    args : tuple, optional
        Extra arguments of `fun`.
    labels : sequence of n str, optional
        Names of the components in the formulas. Default: y[0], y[1], ...

    Returns
    -------
    list of PolynomialInvariant
        Functionally independent ones, low degrees first: no products or powers of others. Empty if none is found, or
        if the pivots leave doubt: a wrong invariant is worse than a missing one.

    Raises
    ------
    TypeError
        `t_span` or y0 is missing, or given beside a problem.
    ValueError
        A problem with a mass matrix, delays or inputs; more than 2000 monomials; an infinite interval; a complex y0; f
        has the wrong shape, or is not finite at y0. An exception of f comes out if it ends every run from y0 and from
        points around it.

    Notes
    -----
    Invariants that hold only on part of the space, such as a constraint's manifold, are not found, nor are those that
    are not polynomials in y. f is evaluated away from the solution; points where it is zero or not finite are left out,
    and nothing is found where nothing moves. The random points come from a fixed seed.

    Examples
    --------
    >>> import invariode as iv
    >>> iv.find_invariants(lambda t, y: [y[1], -4 * y[0]], (0, 10), [1.0, 0.5], labels=["x", "v"])
    [PolynomialInvariant(x**2 + 1/4*v**2)]
    """
    if isinstance(fun, Problem):
        if t_span is not None or y0 is not None or args or labels is not None:
            raise TypeError("a problem has its own t_span, y0, args and labels: find_invariants(problem, degree=...)")
        fun.require_no_delays("find_invariants")
        if fun.inputs or fun.matrices.mass is not None:
            raise ValueError("find_invariants is for y' = f(t, y, *args), and the problem has inputs or a mass matrix")
        return find_invariants(fun.fun, fun.t_span, fun.y0, degree, fun.args, labels=fun._labels)
    if t_span is None or y0 is None:
        raise TypeError("find_invariants needs a problem, or fun, t_span and y0")
    called, (t0, tf) = function("fun", fun, "f(t, y)"), interval(t_span)
    start, extra = state(y0), extra_arguments(args)
    if not np.isfinite(tf):
        raise ValueError(f"t_span must be finite for find_invariants, got {shown(t_span)}")
    if not len(start):
        raise ValueError("find_invariants needs at least one component, got an empty y0")
    if np.iscomplexobj(start):
        raise ValueError("find_invariants is for real problems; write a complex y0 as its real and imaginary parts")
    degree, n = positive_integer("degree", degree), len(start)
    if comb(n + degree, degree) - 1 > _MOST_MONOMIALS:
        raise ValueError(
            f"{n} components have {comb(n + degree, degree) - 1} monomials up to degree {degree}, more than "
            f"{_MOST_MONOMIALS}: give a smaller degree"
        )
    names = [f"y[{i}]" for i in range(n)] if labels is None else distinct_labels(labels, n)
    search = _Samples(called, (t0, tf), start, extra)
    found: list[PolynomialInvariant] = []
    in_units: list[PolynomialInvariant] = []
    for d in range(1, degree + 1):
        for candidate in search.null_polynomials(_monomials(n, d)):
            polynomial = PolynomialInvariant(search.in_units(candidate), names)
            if search.independent([*in_units, polynomial]) and search.verified(polynomial):
                in_units.append(polynomial)
                found.append(PolynomialInvariant(candidate, names))
    return found


class _Samples:
    """Sample points of a problem, and the rates of polynomials there.

    The unit of y is a power of two of the size of y0: powers of components of any size neither overflow nor underflow,
    and nothing else changes.
    """

    def __init__(self, fun: Callable[..., Any], t_span: tuple[float, float], y0: Array, args: tuple[Any, ...]) -> None:
        self._exponent = math.frexp(np.abs(y0).max(initial=0) or 1.0)[1] - 1
        self._unit = math.ldexp(1.0, self._exponent)
        self._users_fun, self._t_span, self._args = fun, t_span, args
        slope = checked_slope(fun(t_span[0], y0.copy(), *args), y0)  # elsewhere f may not be defined
        if not np.isfinite(slope).all():
            raise ValueError(f"fun is not finite at the start: {shown(slope)} at t = {t_span[0]}; correct fun or y0")
        self._wrong: Exception | None = None  # of what f returned
        self._without_run: Exception | None = None  # the first exception of f
        y0 = y0 / self._unit
        self._random = np.random.default_rng(20260)
        self._largest = np.abs(y0).max(initial=0) or 1.0
        first = self._trajectory(y0, 1e-6)
        self._size = np.abs(first[1]).max(axis=1) if first else np.abs(y0)
        self._size[self._size == 0] = 1.0
        self._y0 = y0
        runs = [first, *(self._trajectory(self._near(y0), 1e-6) for _ in range(_TRAJECTORIES - 1))]
        self._runs = [run for run in runs if run]
        if not self._runs and self._without_run is not None:
            raise self._without_run

    def _fun(self, t: float, y: Array, *args: Any) -> Array:
        given = self._users_fun(t, self._unit * y, *args)
        try:
            return checked_slope(given, y) / self._unit
        except (TypeError, ValueError) as wrong:
            self._wrong = wrong
            raise

    def _near(self, y: Array) -> Array:
        near: Array = y + _SPREAD * self._size * self._random.uniform(-1, 1, y.shape)
        return near

    def _trajectory(self, y0: Array, rtol: float) -> tuple[Array, Array] | None:
        """Return (t, y) of a run, by the code for stiff problems if the other one struggles; None if f is not
        defined."""
        options: dict[str, Any] = {
            "args": self._args,
            "rtol": rtol,
            "atol": 1e-4 * rtol * np.maximum(np.abs(y0), 1e-4 * self._largest),
        }
        try:
            with quietly():
                sol = solve_ivp(self._fun, self._t_span, y0, "ode113", max_steps=_MOST_STEPS, **options)
                if not sol.success:
                    sol = solve_ivp(self._fun, self._t_span, y0, "ode15s", max_steps=_MOST_STEPS, **options)
        except (ArithmeticError, ValueError) as error:  # outside the domain of f, as a perturbed start may be
            self._note(error)
            return None
        return (sol.t, sol.y) if len(sol.t) > 1 else None

    def _note(self, error: Exception) -> None:
        """Store the first reason why there is no run; what f must never return is an error at once."""
        if error is self._wrong:
            raise error
        self._without_run = self._without_run or error

    def _samples(self, count: int) -> tuple[Array, Array]:
        """Return points y (n, count) around the trajectories, and y' there, (n, count)."""
        points: list[Array] = []
        slopes: list[Array] = []
        for _ in range(4 * count):
            if len(points) == count or not self._runs:
                break
            t, y = self._runs[self._random.integers(len(self._runs))]
            k = self._random.integers(len(t))
            point = self._near(y[:, k])
            with np.errstate(all="ignore"):
                try:
                    slope = np.asarray(self._fun(t[k], point.copy(), *self._args), dtype=float)
                except (ArithmeticError, ValueError) as error:
                    if error is self._wrong:
                        raise
                    continue
            if np.isfinite(slope).all() and slope.any():
                points.append(point)
                slopes.append(slope)
        n = len(self._size)
        return np.array(points).reshape(-1, n).T, np.array(slopes).reshape(-1, n).T

    def null_polynomials(self, monomials: list[Exponents]) -> list[dict[Exponents, Number]]:
        """Return a sparse basis of the polynomials with ∇p · f = 0, empty if the rank is in doubt."""
        y, slope = self._samples(2 * len(monomials) + 20)
        if y.shape[1] < len(monomials) + 10:
            return []
        exponents = np.array(monomials)
        x, v = y / self._size[:, None], slope / self._size[:, None]
        rates = np.array([_rate(e, x, v) for e in exponents]).T
        found = null_space(rates, _NULL)
        if len(found.pivots) and found.pivots.min() < _GAP * max(found.left, 1e-14):
            return []
        scale = np.prod(self._size[None, :] ** exponents, axis=1)
        polynomials = [self._tidy(row, monomials, scale) for row in echelon(found.vectors, _LEADING)]
        return sorted(filter(None, polynomials), key=lambda p: (max(map(sum, p)), len(p)))

    def in_units(self, coefficients: dict[Exponents, Number]) -> dict[Exponents, Number]:
        """Return a polynomial of the user's y as one of y in units, with the same first coefficient."""
        first = sum(next(iter(coefficients)))
        return {e: math.ldexp(float(c), self._exponent * (sum(e) - first)) for e, c in coefficients.items()}

    def _tidy(self, row: Array, monomials: list[Exponents], scale: Array) -> dict[Exponents, Number]:
        """Return coefficients for the user's y, the first one 1, fractions if all of them are simple ones. Empty: some
        are beyond doubles."""
        row = np.where(np.abs(row) <= _NEGLIGIBLE * np.abs(row).max(), 0, row)
        kept = np.flatnonzero(row)
        degrees = np.array([sum(monomials[k]) for k in kept])
        values = row[kept] / scale[kept]
        with np.errstate(over="ignore", under="ignore"):
            values = np.ldexp(values / values[0], self._exponent * (degrees[0] - degrees))
        if not np.isfinite(values).all() or (values == 0).any():
            return {}
        fractions = [Fraction(float(v)).limit_denominator(_DENOMINATOR) for v in values]
        close = all(
            abs(float(q) - v) <= _RATIONAL * abs(v) and abs(q.numerator) <= _NUMERATOR
            for q, v in zip(fractions, values, strict=True)
        )
        numbers: list[Number] = [*fractions] if close else [float(v) for v in values]
        return {monomials[k]: number for k, number in zip(kept, numbers, strict=True)}

    def independent(self, polynomials: list[PolynomialInvariant]) -> bool:
        """Return whether the gradients of the polynomials are linearly independent at some point."""
        for _ in range(3):
            y = self._near(self._y0)
            rows = np.array([p._gradient(0.0, y) * self._size for p in polynomials])
            if len(null_space(rows, _INDEPENDENT).pivots) == len(rows):
                return len(polynomials) <= len(self._size)
        return False

    def verified(self, p: PolynomialInvariant) -> bool:
        """Return whether the polynomial is conserved at fresh points, to roundoff, and along fresh trajectories."""
        y, slope = self._samples(50)
        if y.shape[1] < 20:
            return False
        terms = np.array([p._gradient(0.0, y[:, k]) * slope[:, k] for k in range(y.shape[1])])
        if (np.abs(terms.sum(axis=1)) > _CONSERVED * np.abs(terms).sum(axis=1)).any():
            return False
        for _ in range(2):
            run = self._trajectory(self._near(self._y0), 1e-9)
            if run is None:
                continue
            values = p(run[1])
            size = sum(abs(c) * np.abs(np.prod([run[1][i] ** e for i, e in powers], axis=0)) for c, powers in p._terms)
            if np.ptp(values) > _DRIFT * np.max(size):
                return False
        return True


def _monomials(n: int, degree: int) -> list[Exponents]:
    """Return exponents of total degree 1 to `degree`, by degree."""
    found = []
    for d in range(1, degree + 1):
        for chosen in itertools.combinations_with_replacement(range(n), d):
            found.append(tuple(chosen.count(i) for i in range(n)))
    return found


def _rate(exponents: Array, x: Array, v: Array) -> Array:
    """Return d/dt of a monomial along v."""
    total = np.zeros(x.shape[1])
    for j in np.flatnonzero(exponents):
        lowered = exponents.copy()
        lowered[j] -= 1
        total += exponents[j] * np.prod(x ** lowered[:, None], axis=0) * v[j]
    return total


def _formula(coefficients: dict[Exponents, Number], labels: Sequence[str]) -> str:
    text = ""
    for exponents, c in coefficients.items():
        factors = [label if e == 1 else f"{label}**{e}" for label, e in zip(labels, exponents, strict=True) if e]
        size = abs(c)
        if size != 1:
            factors.insert(0, str(size) if isinstance(size, Fraction) else f"{size:.12g}")
        sign = ("-" if c < 0 else "") if not text else (" - " if c < 0 else " + ")
        text += sign + "*".join(factors)
    return text
