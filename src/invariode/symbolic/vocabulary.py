"""The symbols of a system: which are states, parameters and time, and whether any are unknown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import sympy
from sympy.core.function import AppliedUndef

from .._base.arguments import number


def parsed(what: str, value: Any) -> Any:
    """Return an expression of SymPy's."""
    try:
        expression = sympy.sympify(value, strict=True)
    except sympy.SympifyError:
        expression = None
    if not isinstance(expression, sympy.Expr):
        raise TypeError(f"{what} must be a SymPy expression, got {value!r}")
    return expression.doit()


class Vocabulary:
    """Meaning of the symbols of a system, and their names in the code: t, y[0], y[1], ..., p[0], p[1], ....

    States are symbols or functions of time; the rates of functions can be states, too. `specified` are formulas or
    numbers that stand for other functions of time.
    """

    def __init__(
        self, states: Sequence[Any], parameters: Mapping[Any, Any] | None, specified: Mapping[Any, Any] | None = None
    ) -> None:
        self.states = list(states)
        self._specified = {one: parsed(f"the specified {one}", value) for one, value in (specified or {}).items()}
        self.parameters = {key: number(f"parameter {key}", value) for key, value in (parameters or {}).items()}
        for one in self.parameters:
            if not isinstance(one, sympy.Symbol):
                raise TypeError(f"parameters must be symbols with their values, got {one!r}")
        for one in self.states:
            if not isinstance(one, (sympy.Symbol, AppliedUndef, sympy.Derivative)):
                raise TypeError(f"states must be symbols or functions of time, got {one!r}")
        listed = [*self.states, *self.parameters]
        for one in listed:
            if listed.count(one) > 1:
                raise ValueError(f"{one} occurs twice: each symbol is one state or one parameter")
        self.time = self._time()
        self.t = sympy.Symbol("t", real=True)
        self.y = [sympy.Symbol(f"y[{i}]", real=True) for i in range(len(self.states))]
        self.p = [sympy.Symbol(f"p[{i}]", real=True) for i in range(len(self.parameters))]
        code = [*self.y, *self.p]
        self._to_code = dict(zip(listed, code, strict=True))
        self._to_user = dict(zip(code, listed, strict=True))
        self._to_user[self.t] = self.time

    def _time(self) -> Any:
        """Return the time that the functions depend on; else the symbol t."""
        found = {s for one in self.states for s in one.free_symbols if not isinstance(one, sympy.Symbol)}
        if len(found) > 1:
            raise ValueError(f"states must be functions of one time, got functions of {', '.join(map(str, found))}")
        time = next(iter(found), None)
        if time in self.parameters or time in self.states:
            raise ValueError(f"{time} is the time: call the parameter by another name")
        return time if time is not None else sympy.Symbol("t")

    def coded(self, what: str, expression: Any) -> Any:
        """Return the expression in the symbols of the code.

        Raises ValueError: It has symbols or functions that are neither state nor parameter nor time.
        """
        given = parsed(what, expression)
        if self._specified:
            given = given.xreplace(self._specified).doit()  # with the derivatives of the formulas
        translated = given.xreplace(self._to_code)
        free = {s for s in translated.free_symbols if s not in self._to_user}
        times = {s for s in free if s == self.time or (s.name == "t" and isinstance(self.time, sympy.Symbol))}
        translated = translated.xreplace(dict.fromkeys(times, self.t))
        unknown = [*(free - times), *translated.atoms(AppliedUndef), *translated.atoms(sympy.Derivative)]
        if unknown:
            listed = ", ".join(sorted(str(self.shown(one)) for one in unknown))
            raise ValueError(
                f"{what} has {listed}, which is neither a state nor a parameter: give its value in "
                "parameters={...}, or list it among the states"
            )
        if translated.has(sympy.zoo, sympy.nan, sympy.oo) or translated.has(sympy.I):
            raise ValueError(f"{what} must be finite and real, got {expression}")
        return translated

    def shown(self, expression: Any) -> Any:
        """Return an expression of the code in the user's symbols."""
        return expression.xreplace(self._to_user)

    @property
    def args(self) -> tuple[float, ...]:
        return tuple(self.parameters.values())

    def start(self, name: str, value: Any, states: Iterable[Any]) -> list[float]:
        """Return initial values in the order of the states, from a mapping or a sequence."""
        states = list(states)
        if isinstance(value, Mapping):
            for one in value:
                if one not in states:
                    raise ValueError(f"{name} has {one}, which is not one of {', '.join(map(str, states))}")
            for one in states:
                if one not in value:
                    raise ValueError(
                        f"{name} has no value for {one}: give one for each of {', '.join(map(str, states))}"
                    )
            return [number(f"{name}[{one}]", value[one]) for one in states]
        values = np.atleast_1d(np.asarray(value, dtype=float))
        if values.shape != (len(states),):
            listed = ", ".join(map(str, states))
            raise ValueError(f"{name} must have {len(states)} values, of {listed}, got {value!r}")
        return [float(one) for one in values]
