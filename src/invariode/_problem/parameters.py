"""Names of parameters: numbers among the arguments of f, and initial values.

A parameter is called as f calls it: ``k1``; ``p[2]`` in an array, list or tuple p; ``args[0]`` if f takes ``*args``, or
does not tell names; by its own name in the record of ``Problem(parameters=...)``. The initial value of a component is
``y0[label]``, or ``y0[2]``.
"""

from __future__ import annotations

import inspect
import operator
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType
from typing import Any, Literal

import numpy as np

from .._base.arguments import Array, call_name, items, number, shown
from .._base.forks import cached_property
from .._base.record import Record
from .._base.suggestions import meant
from .._functions.compiled import CompiledFunction
from .._functions.graph.python import Formula
from .._functions.layout import numbers_at_places, numbers_in, with_numbers

#: All initial values.
Y0 = "y0"

#: This many names are listed in a message.
_MOST_LISTED = 8

_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


@dataclass(frozen=True, slots=True)
class ParameterName:
    """A parameter: its name, and where its value is."""

    name: str
    kind: Literal["args", "y0"]  # in an argument or in an initial value
    index: int  # the argument or the component
    #: The place among the numbers of the argument, in their order. None: the argument is a number.
    item: int | None = None


def parameter_names(
    fun: Any,
    args: tuple[Any, ...],
    labels: Sequence[str] | None,
    n: int,
    wanted: Any,
    *,
    first: int = 2,
    option: str = "sensitivities",
) -> tuple[ParameterName, ...]:
    """The parameters that are wanted, in the order given.

    Parameters
    ----------
    fun
        f, for the names of its arguments.
    args
        The arguments of f after t and y.
    labels
        Names of the components, if they have any.
    n
        The number of components.
    wanted : bool, str, int, ParameterName, or several of these
        True: all numbers in `args`. "y0": all initial values. An index is that of an argument. An argument of several
        numbers stands for all of them.
    first
        The number of arguments of f before `args`.
    option
        The option in messages.

    Raises
    ------
    TypeError, ValueError
        An unknown name, one that is given twice, an argument without numbers.
    """
    known = _Known(fun, args, labels, n, first, option)
    if wanted is None or wanted is False:
        return ()
    if wanted is True:
        found = [one for i in range(len(args)) for one in known.of_argument(i)]
        if not found:
            raise ValueError(
                f'{option}=True needs numbers in args, got args={shown(args)}: "y0" means the initial values'
            )
        return tuple(found)
    single = isinstance(wanted, (str, ParameterName)) or (listed := items(wanted)) is None
    chosen = [one for each in ([wanted] if single else listed or []) for one in known.found(each)]
    for one, times in Counter(chosen).items():
        if times > 1:
            raise ValueError(f"{option}: {one.name} is given twice")
    if not chosen:
        raise ValueError(f"{option} must name a parameter, got {shown(wanted)}")
    return tuple(chosen)


def values_of(args: tuple[Any, ...], y0: Array, names: Iterable[ParameterName]) -> Array:
    """The values of the parameters, of shape (k,)."""
    names = [*names]
    own = iter(numbers_at_places(args, ((one.index, one.item) for one in names if one.kind != Y0)))
    return np.array([y0[one.index] if one.kind == Y0 else next(own) for one in names], dtype=float)


def with_values(
    args: tuple[Any, ...], y0: Array, names: Iterable[ParameterName], values: Iterable[float]
) -> tuple[tuple[Any, ...], Array]:
    """Return args and y0 with these values of the parameters; the arguments passed stay as they are."""
    start = np.array(y0)
    changes: dict[int, dict[int, float]] = {}
    for one, value in zip(names, values, strict=True):
        if one.kind == Y0:
            start[one.index] = value
        else:
            changes.setdefault(one.index, {})[one.item or 0] = float(value)
    return with_numbers(args, changes), start


def with_named(
    fun: Any, args: tuple[Any, ...], labels: Sequence[str] | None, changes: Mapping[str, Any], first: int
) -> tuple[Any, ...]:
    """Return args with other values of the arguments that are named as f calls them, or of numbers in them.

    Raises TypeError, ValueError: Names that f does not have, values that are no real numbers.
    """
    known = _Known(fun, args, labels, 0, first, "args")
    whole = {known.names.index(name): value for name, value in changes.items() if name in known.names}
    inside = {name: number(f"args: {name}", value) for name, value in changes.items() if name not in known.names}
    for name in inside:
        if name == Y0 or name.startswith(f"{Y0}["):
            label = name[len(Y0) + 1 : -1]
            raise ValueError(f"args: {name} is an initial value: give it in y0, by name, as in y0={{{label!r}: value}}")
    found = [one for name in inside for one in known.found(name)]
    changed, _ = with_values(args, np.zeros(0), found, inside.values())
    return tuple(whole.get(i, one) for i, one in enumerate(changed))


class _Known:
    """The parameters of a problem by name."""

    def __init__(
        self, fun: Any, args: tuple[Any, ...], labels: Sequence[str] | None, n: int, first: int, option: str
    ) -> None:
        self._fun, self._args, self._labels, self._n, self._option = fun, args, labels, n, option
        self.names = names_of_arguments(fun, len(args), first)
        self._inside: dict[int, list[ParameterName]] = {}

    def of_argument(self, index: int) -> list[ParameterName]:
        """The numbers of an argument."""
        if index not in self._inside and isinstance(record := self._args[index], Record):
            self._inside[index] = [ParameterName(one, "args", index, i) for i, one in enumerate(record.keys())]
        if index not in self._inside:
            name = self.names[index]
            found = [(i, suffix) for i, (suffix, value) in enumerate(numbers_in(self._args[index])) if _is_real(value)]
            self._inside[index] = [
                ParameterName(name + suffix, "args", index, i if suffix else None) for i, suffix in found
            ]
        return self._inside[index]

    @cached_property
    def _by_name(self) -> dict[str, ParameterName]:
        """Map of both names of all numbers in `args` to their parameters; the first one of a name counts."""
        found: dict[str, ParameterName] = {}
        for index, argument in enumerate(self.names):
            for one in self.of_argument(index):
                found.setdefault(one.name, one)
                if not isinstance(self._args[index], Record):
                    found.setdefault(f"args[{index}]{one.name[len(argument) :]}", one)
        return found

    @cached_property
    def _in_records(self) -> dict[str, ParameterName]:
        """The parameters of records: their names come before what else a name could mean."""
        records = [i for i, one in enumerate(self._args) if isinstance(one, Record)]
        return {one.name: one for i in records for one in self.of_argument(i)}

    def of_y0(self, index: int) -> ParameterName:
        """An initial value."""
        return ParameterName(f"{Y0}[{self._labels[index] if self._labels else index}]", "y0", index)

    def found(self, given: Any) -> list[ParameterName]:
        """The parameters that one item of what was given stands for."""
        if isinstance(given, ParameterName):
            given = given.name
        if isinstance(given, str):
            return self._named(given)
        try:
            index = operator.index(given)
        except TypeError:
            index = None
        if index is None or isinstance(given, (bool, np.bool_)):
            raise TypeError(f"{self._option} must be True, names or indices of arguments, got {shown(given)}")
        if not 0 <= index < len(self._args):
            raise ValueError(
                f"{self._option}: there is no argument {shown(given)}, args has {len(self._args)}: {self._listed()}"
            )
        return self._all_of(index)

    def _named(self, name: str) -> list[ParameterName]:
        if name in self._in_records:
            return [self._in_records[name]]
        if name in self.names:
            return self._all_of(self.names.index(name))
        if name == Y0:
            if Y0 in _parameters_of(self._fun):
                called = call_name(self._fun, "fun")
                raise ValueError(
                    f"{self._option}: {called} has an argument {Y0!r}, which is also the word for the initial values: "
                    f"name {Y0}[...] of single components, or args[...] for the argument"
                )
            return [self.of_y0(i) for i in range(self._n)]
        if together := [i for i, one in enumerate(self.names) if one.startswith(f"{name}[")]:
            return [one for i in together for one in self._all_of(i)]
        if name in self._by_name:
            return [self._by_name[name]]
        plain = [f"args[{i}]" for i in range(len(self._args))]
        return self._all_of(plain.index(name)) if name in plain else [self.of_y0(self._component(name))]

    def _all_of(self, index: int) -> list[ParameterName]:
        found = self.of_argument(index)
        if not found:
            raise ValueError(
                f"{self._option}: {self.names[index]} is {shown(self._args[index])}, and parameters are real numbers"
            )
        return found

    def _component(self, name: str) -> int:
        """Return the index of the component in ``y0[label]``."""
        inside = name[len(Y0) + 1 : -1] if name.startswith(f"{Y0}[") and name.endswith("]") else None
        if inside is not None and self._labels is not None and inside in self._labels:
            return list(self._labels).index(inside)
        if inside is not None and inside.isdecimal() and int(inside) < self._n:
            return int(inside)
        names = [*self.names, *(one.name for i in range(len(self._args)) for one in self.of_argument(i)), Y0]
        names += [self.of_y0(i).name for i in range(self._n)]
        raise ValueError(
            f"{self._option}: {call_name(self._fun, 'fun')} takes no parameter {name!r}; parameters are "
            f"{self._listed()}{meant(name, names)}"
        )

    def _listed(self) -> str:
        """Return the known names of parameters as text for messages."""
        names = [one.name for i in range(len(self._args)) for one in self.of_argument(i)]
        more = ["..."] if len(names) > _MOST_LISTED else []
        label = self.of_y0(0).name if self._n else Y0
        return ", ".join([*names[:_MOST_LISTED], *more, f"{label} and so on" if self._n > 1 else label])


def _parameters_of(fun: Any) -> list[str]:
    python = fun.fun if isinstance(fun, CompiledFunction) else fun
    try:
        return _positional(python)[0][2:]
    except (TypeError, ValueError):  # machine code, or a formula
        return []


def names_of_arguments(fun: Any, size: int, first: int) -> list[str]:
    """Return the names of the `size` arguments of f after its `first` ones, as f calls them."""
    plain = [f"args[{i}]" for i in range(size)]
    compiled = isinstance(fun, CompiledFunction)
    python = fun.fun if compiled else fun
    if isinstance(python, Formula) and len(python.parameters) == size:
        return list(python.parameters)
    try:
        names, takes_more = _positional(python)
    except (TypeError, ValueError):  # machine code
        return plain
    names = names[first + bool(compiled and fun.inplace) :]
    if compiled and len(names) == 1 and size > 1 and not takes_more:  # it takes all of them as one array
        return [f"{names[0]}[{i}]" for i in range(size)]
    own = [other if name == Y0 else name for name, other in zip(names[:size], plain, strict=False)]
    return own + plain[len(own) :]


def names_of_last_arguments(fun: Any, size: int) -> list[str]:
    """Return the names of the last `size` arguments of f, as f calls them."""
    try:
        count = len(_positional(fun.fun if isinstance(fun, CompiledFunction) else fun)[0])
    except (TypeError, ValueError):  # machine code, or a formula
        count = 0
    inplace = isinstance(fun, CompiledFunction) and fun.inplace
    return names_of_arguments(fun, size, max(2, count - size - inplace))


def _positional(fun: Any) -> tuple[list[str], bool]:
    """Return the names of the positional parameters of a function, and whether it takes more of them."""
    if type(fun) is FunctionType and not fun.__dict__:  # nothing states another signature, which takes longer to find
        code = fun.__code__
        return list(code.co_varnames[: code.co_argcount]), bool(code.co_flags & inspect.CO_VARARGS)
    found = inspect.signature(fun).parameters.values()
    takes_more = any(one.kind is inspect.Parameter.VAR_POSITIONAL for one in found)
    return [one.name for one in found if one.kind in _POSITIONAL], takes_more


def _is_real(value: Any) -> bool:
    return not isinstance(value, (bool, np.bool_))
