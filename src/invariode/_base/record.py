"""Records: numbers with names, as functions of a problem take its parameters."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from .arguments import number, shown
from .labelled import named, require_names
from .suggestions import meant


class Record(tuple[Any, ...]):
    """The parameters of a problem, ``p["k1"]`` or ``p.k1``: a tuple of numbers, in the order in which they were given.

    Names that Python cannot take as attributes, such as ``lambda`` or ``S(t)``, are items only; so are those of the
    methods of tuples.
    """

    names: RecordNames

    def __new__(cls, names: RecordNames, values: Iterable[Any]) -> Record:
        made = super().__new__(cls, values)
        made.__dict__["names"] = names
        if len(made) != len(names.names):
            raise ValueError(f"a record of {len(names.names)} parameters got {len(made)} values")
        return made

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            return super().__getitem__(key)
        place = self.names.places.get(key)
        if place is None:
            raise KeyError(f"there is no parameter {key!r}{meant(key, self.names.names)}")
        return super().__getitem__(place)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or "names" not in self.__dict__:
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError as error:
            raise AttributeError(str(error.args[0])) from None

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError("parameters do not change: problem.replace(parameters=...) makes another problem")

    def keys(self) -> Sequence[str]:
        """The names, in order."""
        return self.names.names

    def items(self) -> Iterator[tuple[str, Any]]:
        """Names with values."""
        return zip(self.names.names, self, strict=True)

    def changed(self, given: Any, components: Sequence[str] = ()) -> Record:
        """Return the record with other values of some parameters, given by name. `components`: names of those of y.

        Raises TypeError, ValueError: They have no names, or a name is not one of its names.
        """
        values, given = [*self], record_of(given)
        for name in given.names.names:
            if name in components and name not in self.names.places:
                raise ValueError(
                    f"parameters names {name!r}, which is a component of y: its initial value is y0[{name}], given as "
                    f'y0={{"{name}": value}}'
                )
        require_names("parameters", given.keys(), self.names.names, "parameters of the problem", complete=False)
        for name, value in given.items():
            values[self.names.places[name]] = value
        return Record(self.names, values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Record) and self.names == other.names and tuple(self) == tuple(other)

    def __hash__(self) -> int:
        return hash((self.names, tuple(self)))

    def __reduce__(self) -> tuple[Any, ...]:
        return Record, (self.names, tuple(self))

    def __repr__(self) -> str:
        return f"Record({', '.join(f'{name}={value!r}' for name, value in self.items())})"


class RecordNames:
    """The names of a record, in order; called with values they make one."""

    __slots__ = ("names", "places")

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self.places = {name: i for i, name in enumerate(self.names)}

    def __call__(self, values: Iterable[Any]) -> Record:
        return Record(self, values)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, RecordNames) and self.names == other.names

    def __hash__(self) -> int:
        return hash(self.names)

    def __reduce__(self) -> tuple[Any, ...]:
        return RecordNames, (self.names,)


def record_of(given: Any) -> Record:
    """Return the record of a dict of numbers.

    Raises TypeError: It is not a dict from names to real numbers.
    """
    if isinstance(given, Record):
        return given
    nameless = isinstance(given, Mapping) and any(not isinstance(one, str) for one in given)
    if nameless or (found := named("parameters", given)) is None:
        raise TypeError(f'parameters must be a dict of numbers by name, such as {{"k1": 0.1}}, got {shown(given)}')
    return Record(RecordNames(found), [number(f"parameter {name}", value) for name, value in found.items()])
