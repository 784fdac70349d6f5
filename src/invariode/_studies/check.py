"""The check of invariants before a run: a report on them at one point."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import ATOL, RTOL, Array, Weights, flag, number, quietly, reals, state, weights_of
from .._base.notebook import html_of_check
from .._base.package import public
from .._base.types import Function, Numbers
from .._functions.compiled import native_parameters
from .._laws.bound import BoundInvariants, bind
from .._problem.core_problem import CoreProblem
from .._problem.invariants import InvariantsLike, to_invariants
from .._problem.problem import Problem
from .._results.messages import wrong_jacobian
from .._run.run import solve
from .precision import sizes_along


@public
@dataclass(frozen=True)
class CheckReport:
    """A report on invariants at a point; prints as a table. Arrays have one value per invariant.

    Attributes
    ----------
    names : list of str
    value : ndarray
        The value held or demanded.
    residual : ndarray
        g(t, y) - value.
    distance : ndarray
        The residual as a distance from the level set, in units of rtol.
    rate : ndarray
        d/dt of the invariant along f, at the nearest point of the manifold.
    angle : ndarray
        The rate in units of the size of its terms: roundoff for an invariant.
    detectable : ndarray
        The smallest angle that the check can distinguish from roundoff and from errors in the derivatives. (A run
        detects smaller ones if its tolerance requires it.)
    redundant : ndarray of bool
        Dependent on the others.
    stationary : ndarray of bool
        The gradient is 0.
    conserved : ndarray of bool
        The rate is roundoff, at the point and at others near it: the angle is at most `detectable`. For
        `invariode.Dissipated` functions, a rate of the right sign suffices.
    senses : list of int
        -1: it may only fall as t grows; 1: it may only rise; 0: it must be conserved.
    on_manifold : ndarray of bool
        The distance is at most 1.
    derivatives : list of str
        How the gradient was computed.
    findings : list of str
        What is wrong or worth knowing, in words; empty if all is well.
    ok : bool
        All are conserved and on the manifold, and no Jacobian is wrong. (Redundant ones do no harm.)
    """

    names: list[str]
    value: Array
    residual: Array
    distance: Array
    rate: Array
    angle: Array
    detectable: Array
    redundant: Array
    stationary: Array
    conserved: Array
    senses: list[int]
    on_manifold: Array
    derivatives: list[str]
    findings: list[str]
    ok: bool

    def __str__(self) -> str:
        width = max([len("invariant"), *map(len, self.names)])
        lines = [f"{'invariant':<{width}} {'value':>13} {'residual':>10} {'rate':>10} {'of its terms':>13}  conserved"]
        for name, value, residual, rate, angle, verdict in self.rows():
            lines.append(f"{name:<{width}} {value:>13} {residual:>10} {rate:>10} {angle:>13}  {verdict}")
        return "\n".join(lines + self.findings)

    __repr__ = __str__

    def verdict(self, i: int) -> str:
        """Return the verdict on invariant i in the table: 'NO', 'yes', or 'falls' or 'rises' for
        `invariode.Dissipated`."""
        return ("yes", "rises", "falls")[self.senses[i]] if self.conserved[i] else "NO"

    def rows(self) -> list[tuple[str, ...]]:
        """Return the table: name, value, residual, rate, rate in units of its terms, verdict of each invariant."""
        numbers = zip(self.names, self.value, self.residual, self.rate, self.angle, strict=True)
        return [
            (name, f"{value:.6g}", f"{residual:.2e}", f"{rate:.2e}", f"{angle:.1e}", self.verdict(i))
            for i, (name, value, residual, rate, angle) in enumerate(numbers)
        ]

    def _repr_html_(self) -> str:
        return html_of_check(self)


@public
def check_invariants(
    fun: Function,
    invariants: InvariantsLike,
    t: float,
    y: ArrayLike,
    args: Iterable[Any] = (),
    *,
    rtol: Numbers = RTOL,
    atol: Numbers = ATOL,
    nearby: bool = True,
) -> CheckReport:
    """Check whether y' = f(t, y) conserves these functions: the tests at the start of a solve, as a report.

    Parameters
    ----------
    fun : callable
        ``f(t, y, *args)``.
    invariants : callable, Invariants, or list or dict of these
        As for `solve_ivp`.
    t : float
        The time.
    y : array_like of shape (n,)
        The point.
    args : tuple, optional
        Extra arguments of the functions.
    rtol : float or array_like of shape (n,), default 1e-3
    atol : float or array_like of shape (n,), default 1e-6
        The weights ``max(|y|, atol / rtol)`` in which gradients and distances are measured.
    nearby : bool, default True
        Whether to test also at points near this one and along a short run: at points of rest and of symmetry many
        functions look conserved.

    Returns
    -------
    CheckReport
        Whether they are finite, on the manifold, independent and conserved on the manifold (constraints are invariant
        only there), and their Jacobians right.

    Raises
    ------
    ValueError, TypeError
        A function returns the wrong shape, or is not finite at the point.

    Examples
    --------
    >>> import invariode as iv
    >>> report = iv.check_invariants(lambda t, y: [y[1], -y[0]], lambda t, y: y[0]**2 + 1.1 * y[1]**2, 0, [1.0, 0.5])
    >>> report.ok
    False
    """
    at, point = number("t", t), state(y)
    listed = to_invariants(invariants)
    if not listed:
        raise ValueError("check_invariants needs at least one invariant")
    problem = Problem(fun, (at, np.inf), point, args=args, invariants=listed)
    return checked_at(problem, at, point, rtol=rtol, atol=atol, nearby=flag("nearby", nearby))


def checked_at(given: Problem, at: float, point: Array, *, rtol: Numbers, atol: Numbers, nearby: bool) -> CheckReport:
    """Return the report on the invariants of a problem at a point."""
    given.require_no_delays("a check of invariants at a point")
    extra, listed = given.args, given.invariants
    weights = weights_of(rtol, atol, point)
    bound = bind(listed, at, point, extra, weights.threshold)
    p = native_parameters(extra, [given.fun, *(f for one in listed for f in (one.fun, one.jac))])
    fun = given.slope.for_core(point, p)
    problem = CoreProblem(
        reals(point), np.iscomplexobj(point), fun, extra, p, invariants=bound.specs, value=bound.value
    )
    found = _core.examine(at, point.view(float), problem, weights)
    if found is None:
        raise ValueError(
            f"an invariant, its Jacobian, or fun is not finite at t = {at}, y = {point}: give a point where all are"
        )
    report = _report(found, bound, at, np.iscomplexobj(point))
    if not (nearby and report.conserved.any()):
        return report
    others = _points_nearby(
        Problem(given.fun, (at, given.t_span[1]), point, args=extra, inputs=given.inputs, name=given.name)
    )
    return _with_points(report, [_examined(*other, problem, weights) for other in others])


#: Points near the one that is checked, and their distance in units of the sizes of the components.
_NEARBY, _SPREAD = 4, 0.05

#: The short run: the number of steps of ode45, and of points checked among them.
_STEPS, _ALONG = 20, 4


def _points_nearby(problem: Problem) -> list[tuple[float, Array]]:
    """Return points of a short run, and others around the start, in every direction; the same ones every time."""
    t, y = problem.t_span[0], problem.y0
    run: list[tuple[float, Array]] = []

    def note(at: float, state: Array) -> bool:
        run.append((at, state.copy()))
        return len(run) >= _STEPS

    # outside its domain f may raise anything: the part of the run so far is enough
    with quietly(), suppress(Exception):
        solve(problem, "ode45", {"callback": note, "keep": "end"})
    sizes = sizes_along(np.array([y, *(state for _, state in run)]).T)
    random = np.random.default_rng(0)
    around = random.standard_normal((_NEARBY, len(y)))
    if np.iscomplexobj(y):
        around = around + 1j * random.standard_normal((_NEARBY, len(y)))
    along = [run[i] for i in np.unique(np.linspace(0, len(run) - 1, min(_ALONG, len(run))).astype(int))]
    return [*along, *((t, y + _SPREAD * sizes * direction) for direction in around)]


class _Elsewhere(NamedTuple):
    """Examination of the invariants at another point."""

    t: float
    y: Array
    found: dict[str, Any]


def _examined(t: float, y: Array, problem: CoreProblem, weights: Weights) -> _Elsewhere | None:
    """Return the examination of the invariants at a point; None if something is not defined there."""
    try:
        found = _core.examine(t, y.view(float), problem, weights)
    except Exception:  # from a user's function, at a point that the user did not choose
        return None
    return None if found is None else _Elsewhere(t, y, found)


#: Words for messages: an invariant is ..., or it ...
_CONSERVED = ("conserved", "changes")


def _with_points(report: CheckReport, others: list[_Elsewhere | None]) -> CheckReport:
    """Return the report, with functions marked as not conserved that are conserved only at its point."""
    conserved, findings = report.conserved.copy(), []
    for i in np.flatnonzero(report.conserved):
        there = [other for other in others if other is not None and not other.found["conserved"][i]]
        if there:
            worst = max(there, key=lambda other: float(other.found["angle"][i]))
            conserved[i] = False
            kept, does = (
                ("dissipated", "falls" if report.senses[i] > 0 else "rises") if report.senses[i] else _CONSERVED
            )
            findings.append(
                f"{report.names[i]} is not {kept} by fun: it looks so at this point, but at t = {worst.t:.6g}, "
                f"y = {np.array2string(worst.y, precision=4, threshold=8)}, it {does} at the rate "
                f"{worst.found['rate'][i]:.3g} ({worst.found['angle'][i]:.1e} of its terms)"
            )
    if not findings:
        return report
    return replace(report, conserved=conserved, findings=[*report.findings, *findings], ok=False)


def _report(found: dict[str, Any], bound: BoundInvariants, t: float, pairs: bool) -> CheckReport:
    """Make the report of an examination. `pairs`: the reals that make up y are pairs."""
    stationary = found["gradient"] == 0
    redundant, conserved = found["redundant"].astype(bool), found["conserved"].astype(bool)
    on_manifold = found["distance"] <= 1
    kinds = [one.jac if isinstance(one.jac, str) else "given" for one in bound.specs for _ in range(one.m)]
    senses = np.array(bound.senses)
    findings = [
        *_each(bound.names, ~conserved & (senses == 0), "{} is not conserved by fun"),
        *_each(bound.names, ~conserved & (senses < 0), "{} is not dissipated by fun: it rises"),
        *_each(bound.names, ~conserved & (senses > 0), "{} is not dissipated by fun: it falls"),
        *_each(bound.names, ~on_manifold, "the point is not on the manifold of {}"),
        *_each(bound.names, stationary & (senses == 0), "{} is stationary here: it holds nothing"),
        *_each(bound.names, redundant & ~stationary, "{} is redundant here: the others imply it"),
    ]
    wrong = found["wrong_jacobian"]
    if wrong is not None:
        i, j, entry, quotient = wrong
        findings.append(wrong_jacobian(bound.names[i], t, j, entry, quotient, pairs))
    return CheckReport(
        names=list(bound.names),
        value=bound.value,
        **{name: found[name] for name in ("residual", "distance", "rate", "angle", "detectable")},
        stationary=stationary,
        redundant=redundant,
        conserved=conserved,
        senses=bound.senses,
        on_manifold=on_manifold,
        derivatives=kinds,
        findings=findings,
        ok=bool(conserved.all() and on_manifold.all() and wrong is None),
    )


def _each(names: list[str], where: Array, text: str) -> list[str]:
    return [text.format(names[i]) for i in np.flatnonzero(where)]
