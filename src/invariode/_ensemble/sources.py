"""The rows of an ensemble in parts: where they come from."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from typing import Any, NamedTuple, TypeVar

import numpy as np

from .._base.arguments import Array, shown

T = TypeVar("T")

#: Single rows that are taken from an iterator at once: NumPy converts them together faster than one by one.
BATCH = 256
#: Bytes of a digest.
DIGEST = 8


class RowBlock(NamedTuple):
    """Consecutive rows of an ensemble."""

    number: int
    start: int
    y0: Array  # (k, n)
    args: Any  # a tuple, for all; an array or a list of rows

    @property
    def stop(self) -> int:
        """Number of the row after the last one."""
        return self.start + len(self.y0)


def rows_of(args: Any, chosen: Any) -> Any:
    """Return the args of some rows; the rows are given as indices or as a slice."""
    if isinstance(args, tuple):
        return args
    if isinstance(args, np.ndarray):
        return args[chosen]
    return args[chosen] if isinstance(chosen, slice) else [args[i] for i in chosen]


class Rows:
    """The rows of an ensemble, in blocks; `size`: how many there are, None if nobody knows yet; `index`: their labels,
    or None."""

    index: Any = None

    def __init__(self, blocks: Iterator[tuple[Array, Any]], size: int | None = None) -> None:
        self._blocks, self.size = blocks, size

    def first(self, count: int) -> tuple[Array, Any]:
        """Return y0 and args of the first `count` rows, or of all if there are fewer; the rows remain to be read."""
        taken: list[tuple[Array, Any]] = []
        while sum(len(y0) for y0, _ in taken) < count and (block := next(self._blocks, None)) is not None:
            taken.append(block)
        self._blocks = chain(taken, self._blocks)
        if not taken:
            return np.zeros((0, 0)), ()
        y0, args = _joined(taken)
        return y0[:count], rows_of(args, slice(count))

    def parts(self, length: int) -> Iterator[RowBlock]:
        """Yield all rows, once, in parts of that length; the last may be shorter."""
        left: list[tuple[Array, Any]] = []
        number = start = waiting = 0
        for block in self._blocks:
            left.append(block)
            waiting += len(block[0])
            if waiting < length:
                continue
            y0, args = _joined(left)
            for begin in range(0, waiting - length + 1, length):
                here = slice(begin, begin + length)
                yield RowBlock(number, start, y0[here], rows_of(args, here))
                number, start = number + 1, start + length
            rest = slice(waiting - waiting % length, None)
            left, waiting = [(y0[rest], rows_of(args, rest))], waiting % length
        if waiting:
            yield RowBlock(number, start, *_joined(left))


class GivenRows(Rows):
    """Rows in arrays."""

    def __init__(self, y0: Array, args: Any, index: Any = None) -> None:
        super().__init__(iter([(y0, args)]), len(y0))
        self.index = index


class StreamedRows(Rows):
    """Rows that an iterator makes, ``(y0, args)`` of one row or of several. `checked` makes (N, n) and args of those of
    an ensemble, and knows what is wrong with them."""

    def __init__(self, rows: Iterator[Any], checked: Callable[[Any, Any], tuple[Array, Any]]) -> None:
        super().__init__(self._checked_blocks(rows, checked))

    @staticmethod
    def _checked_blocks(
        rows: Iterator[Any], checked: Callable[[Any, Any], tuple[Array, Any]]
    ) -> Iterator[tuple[Array, Any]]:
        single: list[tuple[Any, Any]] = []

        def collected() -> Iterator[tuple[Array, Any]]:
            if single:
                extras = [() if args is None else args for _, args in single]
                yield checked([y0 for y0, _ in single], extras if any(map(len, extras)) else ())
                single.clear()

        for item in rows:
            if not isinstance(item, tuple) or len(item) != 2:
                raise TypeError(f"an iterator of an ensemble must yield pairs (y0, args), got {shown(item)}")
            if np.ndim(item[0]) == 1 or isinstance(item[0], Mapping):
                single.append(item)
                if len(single) == BATCH:
                    yield from collected()
                continue
            yield from collected()
            y0, args = checked(*item)
            yield y0, [args] * len(y0) if isinstance(args, tuple) and args else args
        yield from collected()


def _joined(blocks: list[tuple[Array, Any]]) -> tuple[Array, Any]:
    if len(blocks) == 1:
        return blocks[0]
    states, extras = [y0 for y0, _ in blocks], [args for _, args in blocks]
    if len({y0.shape[1] for y0 in states}) > 1:
        raise ValueError(f"the states of an ensemble must be of one size, got {sorted({y0.shape[1] for y0 in states})}")
    y0 = np.concatenate(states)
    if all(isinstance(args, tuple) for args in extras):
        return y0, ()
    if all(isinstance(args, np.ndarray) for args in extras):
        return y0, np.concatenate(extras)
    listed: list[tuple[Any, ...]] = []
    for args, block in zip(extras, states, strict=True):
        listed += [tuple(row) for row in args.tolist()] if isinstance(args, np.ndarray) else args or [()] * len(block)
    return y0, listed


def rejoined(parts: list[RowBlock]) -> tuple[Array, Any]:
    """Return the rows of all parts, in their order."""
    y0, args = _joined([(part.y0, part.args) for part in parts])
    return y0, parts[0].args if isinstance(parts[0].args, tuple) else args


def digest(part: RowBlock) -> int:
    """Return a number that tells the rows of a part from others; never 0."""
    found = hashlib.blake2b(np.ascontiguousarray(part.y0).tobytes(), digest_size=DIGEST)
    for piece in _pieces(part.args):
        found.update(piece)
    return int.from_bytes(found.digest()) or 1


def _pieces(value: Any) -> Iterator[bytes]:
    """Yield bytes that are the same in every process; of objects of unknown types, only the type's name."""
    if isinstance(value, np.ndarray) and value.dtype != object:
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, (list, tuple, np.ndarray)):
        for one in value:
            yield from _pieces(one)
    elif isinstance(value, (bool, int, float, complex, str, bytes, type(None), np.generic)):
        yield repr(value).encode()
    else:
        yield type(value).__qualname__.encode()
