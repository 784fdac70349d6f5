"""What describes a problem, validated once."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Self, Unpack

from numpy.typing import ArrayLike

from ._arguments import call_name, distinct_labels, extra_arguments, function, interval, shown, state
from ._bounds import limits
from ._formulas import unlambdified
from ._options import ProblemArguments
from ._slope import Slope
from ._types import EventsLike, Function, Span
from .compiled import is_native
from .events import direction_sign, terminal_count, to_events
from .inputs import InputsLike, to_inputs
from .invariants import InvariantsLike, to_invariants
from .notebook import html_of_problem

__all__ = ["Description", "Matrices"]


@dataclass(frozen=True)
class Matrices:
    """∂f/∂y and M as a problem gives them: functions, constants, or what is known of their structure; products with
    ∂f/∂y, and a preconditioner."""

    jac: Any
    jac_sparsity: Any
    lband: Any
    uband: Any
    mass: Any
    jac_product: Any = None
    preconditioner: Any = None


class Description:
    """The data of a `Problem`."""

    def __init__(
        self,
        fun: Function,
        t_span: Span,
        y0: ArrayLike,
        *,
        args: Iterable[Any] | None = (),
        invariants: InvariantsLike | None = None,
        events: EventsLike = None,
        jac: Any = None,
        jac_sparsity: Any = None,
        lband: int | None = None,
        uband: int | None = None,
        mass: Any = None,
        jac_product: Any = None,
        preconditioner: Any = None,
        nonnegative: Any = None,
        bounds: Any = None,
        inputs: InputsLike | None = None,
        name: str | None = None,
        labels: Sequence[str] | None = None,
    ) -> None:
        self.fun = fun if is_native(fun) else unlambdified(function("fun", fun, "f(t, y)"))
        self.t_span = interval(t_span)
        self.y0 = state(y0)
        self.args = extra_arguments(args)
        self.invariants = to_invariants(invariants)
        self.events = to_events(events)
        for event in self.events:
            terminal_count(event), direction_sign(event)
        self.matrices = Matrices(jac, jac_sparsity, lband, uband, mass, jac_product, preconditioner)
        self.inputs = to_inputs(inputs, self.t_span)
        if name is not None and not isinstance(name, str):
            raise TypeError(f"name of the problem must be a str, got {shown(name)}")
        self.name = call_name(self.fun, "problem") if name is None else name
        self._title = name
        self._labels = None if labels is None else distinct_labels(labels, len(self.y0))
        self._bounds_as_given = {"nonnegative": nonnegative, "bounds": bounds}
        self.limits = limits(nonnegative, bounds, self.y0, self._labels)

    @property
    def slope(self) -> Slope:
        """f as runs call it."""
        return Slope(self.fun, self.inputs, self.args)

    def replace(self, **changes: Unpack[ProblemArguments]) -> Self:
        """A copy of this problem with some arguments changed.

        Parameters
        ----------
        **changes
            Arguments of `Problem` by name, `fun`, `t_span` and `y0` included.

        Returns
        -------
        Problem

        Raises
        ------
        TypeError, ValueError
            As for `Problem`; also a name that `Problem` does not know.

        Examples
        --------
        >>> import invariode as iv
        >>> def decay(t, y, rate):
        ...     return [-rate * y[0]]
        >>> slow = iv.Problem(decay, (0, 1), [1.0], args=(1,))
        >>> fast = slow.replace(args=(10,), name="fast decay")
        >>> slow, fast
        (Problem('decay', t_span=(0.0, 1.0), n=1), Problem('fast decay', t_span=(0.0, 1.0), n=1))
        """
        now = {
            "fun": self.fun,
            "t_span": self.t_span,
            "y0": self.y0,
            "args": self.args,
            "invariants": self.invariants,
            "events": self.events,
            **vars(self.matrices),
            **self._bounds_as_given,
            "inputs": self.inputs,
            "name": self._title,
            "labels": self._labels,
        }
        for given in changes:
            if given not in now:
                near = difflib.get_close_matches(given, now, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else f"; choose from {', '.join(now)}"
                raise TypeError(f"Problem has no argument {given!r}{hint}")
        return type(self)(**{**now, **changes})

    def _repr_html_(self) -> str:
        return html_of_problem(self)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, t_span={self.t_span}, n={len(self.y0)})"
