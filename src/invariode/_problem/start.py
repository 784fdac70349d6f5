"""Initial values that follow the arguments: y0 as a function of them, with its derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .._base.arguments import Array
from .._base.labelled import by_name
from .._functions.derivatives import derivative_of
from .._functions.graph.python import Formula
from .._functions.with_arguments import Point
from .parameters import ParameterName
from .sensitivities import Sensitivities


class SlopesOfStart:
    """∂y0/∂p as a function of the arguments: the `dy0dp` of a problem whose y0 is a function of them."""

    def __init__(self, start: Callable[..., Any], names: Sequence[ParameterName], n: int) -> None:
        self._start, self._names, self._n = start, names, n

    def __call__(self, *args: Any) -> Array:
        n, at = self._n, Point(0.0, np.zeros(self._n))
        made = derivative_of(of_t_and_y(self._start), (n, n), at=at, args=args, names=self._names, called="y0")
        return made.of_parameters(at.t, at.y)


class ChangedStart:
    """y0 as a function of the arguments, some of whose components are replaced by values.

    - `start`: the function
    - `labels`: names of the components
    - `values`: those that are replaced, by label
    """

    def __init__(self, start: Callable[..., Any], labels: Sequence[str], values: Mapping[str, Any]) -> None:
        self._start, self._labels, self._values = start, [*labels], dict(values)
        self.solves_equations = getattr(start, "solves_equations", False)

    def __call__(self, *args: Any) -> list[Any]:
        return self._changed(by_name("y0", self._start(*args), self._labels, "components"))

    @property
    def formula(self) -> Formula | None:
        """The function as a formula, if it is one."""
        whole = getattr(self._start, "formula", None)
        if not isinstance(whole, Formula):
            return None
        return Formula("y0", lambda: self._changed(whole.outputs), whole.layout)

    def _changed(self, components: Sequence[Any]) -> list[Any]:
        return [self._values.get(name, one) for name, one in zip(self._labels, components, strict=True)]


def of_t_and_y(start: Callable[..., Any]) -> Any:
    """Return y0(\\*args) as a function of (t, y, \\*args), whose graph is known if y0 is a formula."""
    formula = getattr(start, "formula", None)
    if isinstance(formula, Formula):
        return formula

    def of(t: float, y: Array, *args: Any) -> Any:
        return start(*args)

    of.solves_equations = getattr(start, "solves_equations", False)  # type: ignore[attr-defined]
    return of


def follow_start(
    wanted: Sensitivities, start: Callable[..., Any] | None, names: Sequence[ParameterName], n: int
) -> Sensitivities:
    """Return the sensitivities with the derivatives of y0 if it is a function of the arguments, and without the
    derivatives of a former such function. Derivatives that the user gives are kept."""
    if start is wanted.dy0dp is None or not (wanted.dy0dp is None or isinstance(wanted.dy0dp, SlopesOfStart)):
        return wanted
    own = [one for one in names if one.kind == "args"]
    return replace(wanted, dy0dp=SlopesOfStart(start, own, n) if start is not None and own else None)
