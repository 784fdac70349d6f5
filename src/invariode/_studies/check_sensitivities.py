"""Check user-supplied derivatives for sensitivities."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, number, shown, state
from .._base.matrices import as_dense
from .._base.package import public
from .._functions.derivatives import Derivative, Given, derivative_of
from .._functions.increments import somewhere
from .._functions.with_arguments import Point
from .._problem.problem import Problem
from .._sensitivity.variations import given_derivatives

#: Tolerated discrepancies of entries, relative to the largest in their column: from exact derivatives, and from finite
#: differences.
_ROUNDOFF, _OF_DIFFERENCES = 1e-9, 1e-5
#: Displacements from the point, in multiples of the sizes of y: at the point itself an error may not show.
_BESIDE = (0.0, 0.1)


@public
@dataclass(frozen=True)
class SensitivityReport:
    """Report of `check_sensitivities` on user-supplied derivatives; prints as text.

    Attributes
    ----------
    names : list of str
        The parameters.
    compared : list of str
        The supplied derivatives that were compared: 'jac', 'dfdp', 'dy0dp'.
    derivatives : str
        The reference: 'traced' (exact, from expressions), 'complex step' or 'differences'.
    findings : list of str
        A description of each wrong entry; empty if all are right.
    ok : bool
        Whether there are no findings.
    """

    names: list[str]
    compared: list[str]
    derivatives: str
    findings: list[str]

    @property
    def ok(self) -> bool:
        return not self.findings

    def __str__(self) -> str:
        what = ", ".join(self.compared) or "nothing is given, and nothing"
        return "\n".join([f"parameters {', '.join(self.names)}: {what} compared ({self.derivatives})", *self.findings])

    __repr__ = __str__


@public
def check_sensitivities(
    problem: Problem, t: float | None = None, y: ArrayLike | None = None, *, y0: Callable[..., Any] | None = None
) -> SensitivityReport:
    """Compare the derivatives supplied to a problem for its sensitivities with those computed from its functions.

    Parameters
    ----------
    problem : Problem
        A problem with `sensitivities`. Its `jac` and the `dfdp` of its `Sensitivities` are compared with the
        derivatives of `fun`: from its expressions, otherwise by complex steps, otherwise by finite differences.
    t : float, optional
        The time of the comparison. Default: the start.
    y : array_like of shape (n,), optional
        The state of the comparison. Default: `y0` of the problem. A point near it is tested too.
    y0 : callable, optional
        ``y0(*args)`` returns the initial values. `dy0dp` is compared with its derivatives, and only if this is given.

    Returns
    -------
    SensitivityReport

    Raises
    ------
    TypeError, ValueError
        The problem has no `sensitivities`, or a derivative has a wrong shape.

    Examples
    --------
    >>> import invariode as iv
    >>> def decay(t, y, rate):
    ...     return [-rate * y[0]]
    >>> wrong = iv.Sensitivities(dfdp=lambda t, y, rate: [[y[0]]])
    >>> iv.check_sensitivities(iv.Problem(decay, (0, 1), [1.0], args=(2.0,), sensitivities=wrong))
    parameters rate: dfdp compared (traced)
    dfdp[0, 0], of rate, is 1 at t = 0; expected -1
    """
    wanted = getattr(problem, "sensitivities", None)
    if wanted is None:
        raise ValueError(f"a Problem with sensitivities is needed, got {shown(problem)}")
    problem._require_real("check_sensitivities")
    names = problem.parameter_names()
    own = [one.name for one in names if one.kind == "args"]
    point = problem.y0 if y is None else state(problem.by_component("y", y), "y")
    at = Point(problem.t_span[0] if t is None else number("t", t), point)
    n = len(problem.y0)
    fun, given = given_derivatives(problem, names)
    computed = derivative_of(fun, (n, n), at=at, args=problem.args, names=names, called="fun")
    findings: list[str] = []
    compared = [what for what, one in (("jac", given.jac), ("dfdp", given.dfdp)) if one is not None]
    for part in _BESIDE:
        y_here = at.y + part * somewhere(at.y)
        findings += _wrong(computed, given, Point(at.t, y_here), own)
        if findings:
            break
    if y0 is not None and wanted.dy0dp is not None:
        compared.append("dy0dp")
        start = derivative_of(lambda t, y, *args: y0(*args), (n, n), at=at, args=problem.args, names=names, called="y0")
        found = wanted.start(names, problem.args, n)[:, [one.kind == "args" for one in names]]
        findings += _differences("dy0dp", found, _columns(start, at), start.how, own)
    return SensitivityReport([one.name for one in names], compared, computed.how, findings)


def _columns(function: Derivative, at: Point) -> Array:
    """Return ∂F/∂p of the parameters in args, (m, k)."""
    return function.of_parameters(at.t, at.y)[:, [one.kind == "args" for one in function.names]]


def _wrong(computed: Derivative, given: Given, at: Point, own: list[str]) -> Iterator[str]:
    """Describe the wrong entries at a point."""
    n, args = computed.n, computed.args
    if given.jac is not None:
        matrix = given.jacobian("fun", (n, n), args, at.t, at.y)
        right = computed.jacobian(at.t, at.y)
        yield from _differences("jac", as_dense(matrix), right, computed.how, [f"y[{j}]" for j in range(n)], at.t)
    if given.dfdp is not None:
        found = given.of_parameters("fun", (n, len(own)), args, at.t, at.y)
        yield from _differences("dfdp", found, _columns(computed, at), computed.how, own, at.t)


def _differences(
    what: str, found: Array, right: Array, how: str, columns: list[str], t: float | None = None
) -> Iterator[str]:
    tolerance = _OF_DIFFERENCES if how.endswith("differences") else _ROUNDOFF
    size = np.maximum(np.abs(right), np.abs(found)).max(axis=0, initial=0)
    where = "" if t is None else f" at t = {t:.6g}"
    for i, j in zip(*np.nonzero(~(np.abs(found - right) <= tolerance * size)), strict=True):
        yield f"{what}[{i}, {j}], of {columns[j]}, is {found[i, j]:.6g}{where}; expected {right[i, j]:.6g}"
