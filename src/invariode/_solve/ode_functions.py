"""The methods under their own names, `ode45` and the others, made from the registry.

The stub beside this file, for type checkers, is made from it too: ``make stubs``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Unpack

from numpy.typing import ArrayLike

from .._base.arguments import shown
from .._base.types import Function, Span
from .._problem.docstrings import documented
from .._problem.methods import METHODS, Method
from .._problem.options import AllOptions, table_of
from .._results.solution import Solution
from .ivp import solve_ivp

#: What is particular about f.
_FUNCTIONS = {
    "any": "",
    "graph": "; `fun` must be a function that can be traced: see `compile`",
    "second-order": "; `fun` must be a `SecondOrder`, or ``(v, f(t, q))`` of y = (q, v) with `second_order`",
}


def _function_of(method: Method) -> Callable[..., Solution]:
    """Return `solve_ivp` with the method, its own largest step, and its own number of points per step unless other
    options fix the output."""

    def solve(fun: Function, t_span: Span, y0: ArrayLike, *more: Any, **options: Unpack[AllOptions]) -> Solution:
        if more:
            raise TypeError(
                f"{method.name}(fun, t_span, y0) takes options by name, as in rtol=1e-6, got {shown(more[0])} as a "
                "fourth argument; a dict of options is passed as **options"
            )
        keep = options.get("keep")
        if options.get("t_eval") is None and not (isinstance(keep, str) and keep == "end"):
            options.setdefault("refine", method.refine)
        options.setdefault("max_step", method.max_step)
        return solve_ivp(fun, t_span, y0, method.name, **options)

    solve.__name__ = solve.__qualname__ = method.name
    solve.__doc__ = f"""`solve_ivp` with {method.summary}.

    Parameters
    ----------
    fun, t_span, y0
        As in `solve_ivp`{_FUNCTIONS[method.equations]}.
    {{options}}

    Returns
    -------
    Solution

    Notes
    -----
    {method.family}. {method.source}.
    """
    return documented({"refine": method.refine, "max_step": method.max_step}, options=table_of(AllOptions))(solve)


__all__ = [*METHODS]
globals().update({name: _function_of(method) for name, method in METHODS.items()})
