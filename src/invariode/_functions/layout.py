"""Layout of the further arguments of a function in machine code: numbers are parameters, everything else is
constant."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any, NamedTuple, Self, TypeAlias

import numpy as np

from .._base.arguments import Array, as_array, shown
from .._base.forks import cached_property
from .._base.record import Record
from .contents import content

#: What may become a constant of the code, in the order in which it is tried: truths are always constants, then what may
#: be an index or the count of a loop, then arrays, then single numbers.
TRUTHS, INTEGERS, ARRAYS, ALL = range(4)
#: Numbers whose values change in a run, or are not known, are no constants.
_VARYING = 4


class Numbers:
    """A number or an array of numbers.

    Attributes
    ----------
    shape : tuple of int
        Its shape.
    value : number or array
        The original value.
    rank : int
        From which of `TRUTHS`, `INTEGERS`, `ARRAYS`, `ALL` on it may be a constant.
    fixed : bool
        The value is a constant of the code. Otherwise functions of all values are the same.
    """

    __slots__ = ("_key", "fixed", "rank", "shape", "value")

    def __init__(self, value: Any, fixed: bool = False, varying: bool = False) -> None:
        found = np.asarray(value)
        kind = found.dtype.kind
        self.shape: tuple[int, ...] = found.shape
        self.value = found.copy() if found.ndim else value
        of_kind = {"b": TRUTHS, "i": INTEGERS, "u": INTEGERS}.get(kind, ARRAYS if found.ndim else ALL)
        self.rank = _VARYING if varying else of_kind
        self.fixed = fixed or self.rank == TRUTHS
        self._key = (self.shape, self.rank, (found.dtype.str, found.tobytes()) if self.fixed else None)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Numbers) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    def __reduce__(self) -> tuple[type[Numbers], tuple[Any, ...]]:
        return Numbers, (self.value, self.fixed, self.rank == _VARYING)


class Listed:
    """A list, tuple or record of entries; `kind` makes it of its values."""

    __slots__ = ("entries", "kind")

    def __init__(self, kind: Callable[[Iterable[Any]], Any], entries: tuple[Entry, ...]) -> None:
        self.kind, self.entries = kind, entries

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Listed) and (self.kind, self.entries) == (other.kind, other.entries)

    def __hash__(self) -> int:
        return hash((self.kind, self.entries))


class Constant:
    """Anything that is no number: equal to another one if it had the same content when both were made."""

    __slots__ = ("_content", "value")

    def __init__(self, value: Any) -> None:
        self.value = value
        self._content = content(value)  # at this moment, so that a later change is seen

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constant) and self._content == other._content

    def __hash__(self) -> int:
        return hash(type(self.value))

    def __reduce__(self) -> tuple[type[Constant], tuple[Any, ...]]:
        return Constant, (self.value,)


Entry: TypeAlias = Numbers | Listed | Constant


@dataclass(frozen=True)
class ArgumentLayout:
    """The arguments of a problem, and which of their numbers, in which shapes, are parameters of its machine code.

    The numbers of all arguments follow one another in one array, `numbers`. Two layouts are equal if code for one of
    them serves the other: values count only where they are constants of the code.
    """

    entries: tuple[Entry, ...] = ()  # the arguments, in their order

    @classmethod
    def single(cls, count: int) -> Self:
        """Return `count` single numbers whose values are not known."""
        return cls((Numbers(1.0, varying=True),) * count)

    def whole(self) -> ArgumentLayout:
        """Return all numbers as one array of parameters, as numba and formulas take them."""
        return ArgumentLayout((Numbers(np.ones(self.size), varying=True),) if self.size else ())

    @cached_property
    def size(self) -> int:
        """The number of numbers in all arguments."""
        return sum(math.prod(one.shape) for one in _numbers(self.entries))

    @cached_property
    def numbers(self) -> Array:
        """The original values of all numbers, of shape (size,); read-only."""
        found = np.concatenate(
            [np.zeros(0), *(np.ravel(np.asarray(one.value, float)) for one in _numbers(self.entries))]
        )
        found.flags.writeable = False
        return found

    def fixed(self, most: int) -> ArgumentLayout:
        """Return the arguments with the numbers up to rank `most` as constants."""

        def of(entry: Entry) -> Entry:
            if isinstance(entry, Numbers):
                return Numbers(entry.value, entry.rank <= most, entry.rank == _VARYING)
            return Listed(entry.kind, tuple(map(of, entry.entries))) if isinstance(entry, Listed) else entry

        return ArgumentLayout(tuple(map(of, self.entries)))

    @property
    def ranks(self) -> set[int]:
        """Ranks of the numbers."""
        return {one.rank for one in _numbers(self.entries)} - {_VARYING}

    def known(self) -> Array:
        """Return a boolean array: which of the numbers are constants."""
        return np.concatenate([_NONE, *(np.full(math.prod(one.shape), one.fixed) for one in _numbers(self.entries))])

    def made(self, of_numbers: Callable[[Numbers, int], Any], of_constant: Callable[[Any], Any]) -> list[Any]:
        """The arguments, made of each entry of numbers and the place where they begin, and of each constant."""
        place = 0

        def of(entry: Entry) -> Any:
            nonlocal place
            if isinstance(entry, Listed):
                return entry.kind(map(of, entry.entries))
            if isinstance(entry, Constant):
                return of_constant(entry.value)
            found = of_numbers(entry, place)
            place += math.prod(entry.shape)
            return found

        return [of(entry) for entry in self.entries]

    def given(self, parameters: Array) -> list[Any]:
        """Return the arguments with these numbers in place of their own."""

        def of_numbers(entry: Numbers, place: int) -> Any:
            numbers = np.reshape(parameters[place : place + math.prod(entry.shape)], entry.shape)
            if entry.fixed or np.array_equal(numbers, entry.value):  # of its own type
                return entry.value.copy() if entry.shape else entry.value
            return np.array(numbers) if entry.shape else float(numbers)

        return self.made(of_numbers, lambda value: value)

    def may_vary(self, most: int) -> bool:
        """Return whether code with numbers up to rank `most` as constants takes any other numbers."""
        return all(isinstance(one, Numbers) and one.rank > most for one in _leaves(self.entries))

    def objection(self, rows: Array, most: int) -> str | None:
        """Return why code with numbers up to rank `most` as constants does not take other rows (N, k) of numbers, or
        None."""
        place, found = 0, None
        for entry in _numbers(self.entries):
            size = math.prod(entry.shape)
            if entry.rank <= most and (rows[:, place : place + size] != np.ravel(entry.value)).any():
                found = found or f"{shown(entry.value)} is a constant of the compiled code, and other rows differ"
            place += size
        return found


#: The layout of no arguments.
NO_ARGUMENTS = ArgumentLayout()
_NONE = np.zeros(0, dtype=bool)


def _leaves(entries: Iterable[Entry]) -> Iterator[Numbers | Constant]:
    for one in entries:
        if isinstance(one, Listed):
            yield from _leaves(one.entries)
        else:
            yield one


def _numbers(entries: Iterable[Entry]) -> Iterator[Numbers]:
    return (one for one in _leaves(entries) if isinstance(one, Numbers))


def layout_of(args: Iterable[Any]) -> ArgumentLayout:
    """Return the layout of the arguments of a problem, as a function that is traced takes them."""
    return ArgumentLayout(tuple(map(_entry, args)))


def _entry(value: Any) -> Entry:
    if isinstance(value, _NUMBER):
        return Numbers(value)
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return Numbers(as_array("an array in args", value))
    if is_listed(value):
        return Listed(_kind(value), tuple(map(_entry, value)))
    return Constant(value)


def is_listed(value: Any) -> bool:
    """Return whether a value is split into its entries: lists, tuples and records, but no classes derived from
    these."""
    return type(value) in (list, tuple, Record)


def _kind(value: Any) -> Callable[[Iterable[Any]], Any]:
    return value.names if isinstance(value, Record) else type(value)


_NUMBER = (bool, int, float, np.bool_, np.integer, np.floating)


def numbers_in(value: Any) -> Iterator[tuple[str, Any]]:
    """The numbers of an argument in their order, each with what is added to the argument's name for it."""
    if isinstance(value, _NUMBER):
        yield "", value
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        for place, one in np.ndenumerate(value):
            yield (f"[{', '.join(map(str, place))}]" if place else ""), one
    elif is_listed(value):
        for i, entry in enumerate(value):
            for suffix, one in numbers_in(entry):
                yield f"[{i}]{suffix}", one


def undefined_arguments(args: Iterable[Any]) -> str:
    """Return which number of the arguments is NaN, in words; empty if none is."""
    for index, value in enumerate(args):
        for suffix, one in numbers_in(value):
            if one != one:
                return f"args[{index}]{suffix} is NaN"
    return ""


def numbers_at_places(args: Sequence[Any], places: Iterable[tuple[int, int | None]]) -> list[Any]:
    """Return the original numbers at these places (argument, place among its numbers)."""
    inside: dict[int, list[Any]] = {}
    found = []
    for index, item in places:
        if index not in inside:
            inside[index] = [one for _, one in numbers_in(args[index])]
        found.append(inside[index][item or 0])
    return found


def place_of(args: Sequence[Any], index: int, item: int | None) -> int:
    """The place of a number of an argument among those of all arguments."""
    return layout_of(args[:index]).size + (item or 0)


def with_numbers(args: Sequence[Any], changes: Mapping[int, Mapping[int, Any]]) -> tuple[Any, ...]:
    """The arguments with other numbers: by argument, and by place among its numbers."""
    return tuple(_changed(value, changes[i], count()) if i in changes else value for i, value in enumerate(args))


def _changed(value: Any, numbers: Mapping[int, Any], places: Iterator[int]) -> Any:
    if isinstance(value, _NUMBER):
        return numbers.get(next(places), value)
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        inside = {i: numbers[place] for i, place in zip(range(value.size), places, strict=False) if place in numbers}
        if not inside:
            return value
        made = np.array(value, dtype=np.result_type(float, *inside.values()))
        for i, number in inside.items():
            made.flat[i] = number
        return made
    if is_listed(value):
        return _kind(value)(_changed(one, numbers, places) for one in value)
    return value


class Shape(NamedTuple):
    """Sizes of the arguments and results of machine code."""

    n: int
    size: int
    parameters: ArgumentLayout
    event: bool
    second: int = 0  # components of a second vector, of the n
    is_complex: bool = False
    real_time: bool = False  # of a complex one: t is no part of y_

    @property
    def complex_time(self) -> bool:
        return self.is_complex and not self.real_time

    @property
    def vectors(self) -> list[str]:
        return ["y", "v"] if self.second else ["y"]

    def unpacked(self) -> list[str]:
        """Lines that bind what the function takes, from y_: (t,) q and v, in succession."""
        first = int(self.complex_time)
        middle = first + self.n - self.second
        if not first and not self.second:
            return [f"y = given(carray(y_, ({self.n},)))"]
        lines = [f"x = given(carray(y_, ({first + self.n},)))", f"y = x[{first}:{middle}]"]
        lines += ["t = x[0]"] if first else []
        return [*lines, *([f"v = x[{middle}:{first + self.n}]"] if self.second else [])]
