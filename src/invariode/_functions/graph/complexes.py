"""Complex arrays as pairs of traced arrays: real and imaginary parts."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from .nodes import TraceError
from .traced import BY_OPERATORS, TracedArray, has_traced

#: Functions that are linear in all their arguments together, or only move elements: applied to both parts.
_LINEAR = BY_OPERATORS - {
    *("dot", "vdot", "inner", "outer", "cross", "kron", "matmul", "tensordot", "cumprod", "prod", "polyval", "einsum"),
    "convolve",
}
#: Those that are linear in each of two arguments.
_BILINEAR = {"dot", "inner", "outer", "cross", "kron", "matmul", "tensordot", "convolve"}


class TracedComplex(np.lib.mixins.NDArrayOperatorsMixin):
    """A traced array of complex numbers.

    - `real`, `imag`: its parts, of one shape
    """

    __slots__ = ("imag", "real")
    __array_priority__ = 2000

    def __init__(self, real: Any, imag: Any) -> None:
        self.real, self.imag = real, imag

    def __repr__(self) -> str:
        return f"{self.real!r} + 1j * {self.imag!r}"

    @property
    def shape(self) -> Any:
        return self.real.shape

    @property
    def ndim(self) -> Any:
        return self.real.ndim

    @property
    def size(self) -> Any:
        return self.real.size

    @property
    def dtype(self) -> Any:
        return np.dtype(complex)

    @property
    def T(self) -> TracedComplex:  # noqa: N802 - NumPy's name
        return TracedComplex(self.real.T, self.imag.T)

    def __len__(self) -> int:
        return len(self.real)

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, key: Any) -> TracedComplex:
        return TracedComplex(self.real[key], self.imag[key])

    def __setitem__(self, key: Any, value: Any) -> None:
        real, imag = parts(value, self.real)
        self.real[key], self.imag[key] = real, imag

    def __bool__(self) -> bool:
        return bool((self.real != 0) | (self.imag != 0))

    def __complex__(self) -> complex:
        return complex(float(self.real), float(self.imag))

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        if method == "reduce" and ufunc.__name__ == "add":
            return TracedComplex(*(np.add.reduce(one, **options) for one in (self.real, self.imag)))
        if method != "__call__" or ufunc.__name__ not in _UFUNCS or options.get("where", True) is not True:
            raise TraceError(f"numpy.{ufunc.__name__} of complex numbers")
        found = _UFUNCS[ufunc.__name__](*(pair(one, self.real) for one in inputs))
        if out is None:
            return found
        (target,) = out
        if not isinstance(target, TracedComplex):
            raise TraceError("complex values that are written into real numbers")
        if not target.ndim:
            return found
        target[...] = found
        return target

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        name = function.__name__
        if name in ("real", "imag", "angle", "shape", "size", "ndim", "conj", "conjugate", "abs", "mean", "norm"):
            return _named(name, self, kwargs)
        if name in ("zeros_like", "empty_like"):
            zero = function(self.real)
            return TracedComplex(zero, function(self.real))
        if name == "where" and len(args) == 3:
            yes, no = (parts(one, self.real) for one in args[1:])
            return TracedComplex(*(np.where(args[0], a, b) for a, b in zip(yes, no, strict=True)))
        if name in _BILINEAR and len(args) == 2:
            (a, b), (c, d) = (parts(one, self.real) for one in args)
            at = functools.partial(function, **kwargs)
            return TracedComplex(at(a, c) - at(b, d), at(a, d) + at(b, c))
        if name not in _LINEAR:
            raise TraceError(f"numpy.{name} of complex numbers")
        kwargs.pop("dtype", None)
        both = [function(*(_part(one, i, self.real) for one in args), **kwargs) for i in (0, 1)]
        if isinstance(both[0], (list, tuple)):
            return [TracedComplex(*each) for each in zip(*both, strict=True)]
        return TracedComplex(*both)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        raise TraceError("a function that takes NumPy's own arrays only")

    def __getattr__(self, name: str) -> Any:
        """Methods of arrays, by NumPy's functions of the same name."""
        function = getattr(np, name, None)
        if name.startswith("_") or not callable(function) or not (name in BY_OPERATORS or name in ("conj", "mean")):
            raise AttributeError(f"a traced array of complex numbers has no {name}")
        return lambda *args, **kwargs: self.__array_function__(function, (), (self, *args), kwargs)

    def copy(self) -> TracedComplex:
        return TracedComplex(self.real.copy(), self.imag.copy())

    def conjugate(self) -> TracedComplex:
        return TracedComplex(self.real, -self.imag)

    conj = conjugate

    def reshape(self, *shape: Any) -> TracedComplex:
        return TracedComplex(self.real.reshape(*shape), self.imag.reshape(*shape))

    def flatten(self, *_: Any) -> TracedComplex:
        return TracedComplex(self.real.ravel(), self.imag.ravel())

    ravel = flatten

    def interleaved(self) -> TracedArray:
        """Return the real numbers that stand for the complex array in memory, real and imaginary parts in turn."""
        found: Any = np.stack([self.real.ravel(), self.imag.ravel()], axis=-1).ravel()
        return cast("TracedArray", found)


def pair(value: Any, like: TracedArray) -> TracedComplex:
    return value if isinstance(value, TracedComplex) else TracedComplex(*parts(value, like))


def parts(value: Any, like: TracedArray) -> tuple[Any, Any]:
    """Real and imaginary part of numbers, arrays, and lists of traced ones."""
    if isinstance(value, TracedComplex):
        return value.real, value.imag
    if isinstance(value, (list, tuple)) and any(has_traced(one) or isinstance(one, TracedComplex) for one in value):
        each = [parts(one, like) for one in value]
        return np.stack([one for one, _ in each]), np.stack([one for _, one in each])
    if isinstance(value, TracedArray):
        return value, value * 0.0
    found = np.asarray(value)
    return like.constant(found.real), like.constant(found.imag if found.dtype.kind == "c" else np.zeros(found.shape))


def _part(value: Any, which: int, like: TracedArray) -> Any:
    """Return the real or the imaginary part of an argument and of the entries of a list; integers, which count or
    index, stay."""
    if isinstance(value, (list, tuple)):
        return type(value)(_part(one, which, like) for one in value)
    numbers = isinstance(value, (TracedArray, TracedComplex, complex, float)) or (
        isinstance(value, np.ndarray) and value.dtype.kind in "fc"
    )
    return parts(value, like)[which] if numbers else value


def _named(name: str, z: TracedComplex, kwargs: Any) -> Any:
    if name in ("real", "imag", "shape", "size", "ndim"):
        return getattr(z, name)
    if name in ("conj", "conjugate"):
        return z.conjugate()
    if name == "angle":
        return np.arctan2(z.imag, z.real)
    if name == "mean":
        return TracedComplex(np.mean(z.real, **kwargs), np.mean(z.imag, **kwargs))
    square = z.real * z.real + z.imag * z.imag
    return np.hypot(z.real, z.imag) if name == "abs" else np.sqrt(np.sum(square, **kwargs))


def _times(a: TracedComplex, b: TracedComplex) -> TracedComplex:
    return TracedComplex(a.real * b.real - a.imag * b.imag, a.real * b.imag + a.imag * b.real)


def _over(a: TracedComplex, b: TracedComplex) -> TracedComplex:
    size = b.real * b.real + b.imag * b.imag
    over = _times(a, b.conjugate())
    return TracedComplex(over.real / size, over.imag / size)


def _exp(a: TracedComplex) -> TracedComplex:
    size = np.exp(a.real)
    return TracedComplex(size * np.cos(a.imag), size * np.sin(a.imag))


def _log(a: TracedComplex) -> TracedComplex:
    return TracedComplex(np.log(np.hypot(a.real, a.imag)), np.arctan2(a.imag, a.real))


def _sqrt(a: TracedComplex) -> TracedComplex:
    larger = np.sqrt((np.hypot(a.real, a.imag) + np.abs(a.real)) / 2)  # without cancellation
    other = np.where(larger == 0, 0.0, np.abs(a.imag) / (2 * larger))
    real, imag = np.where(a.real < 0, other, larger), np.where(a.real < 0, larger, other)
    return TracedComplex(real, np.where(a.imag < 0, -imag, imag))


#: Larger integer powers are exponentials.
_MOST_FACTORS = 16


def _power(a: TracedComplex, b: TracedComplex) -> TracedComplex:
    exponents = {one.value if one.op == "number" else None for one in b.real.cells.flat}
    real = all(one.is_number(0.0) for one in b.imag.cells.flat)
    (exponent,) = exponents if len(exponents) == 1 else (None,)
    if real and exponent is not None and exponent == int(exponent) and 0 < exponent <= _MOST_FACTORS:
        found = a
        for _ in range(int(exponent) - 1):
            found = _times(found, a)
        return found
    if real and exponent == 0:
        return TracedComplex(a.real * 0.0 + 1.0, a.imag * 0.0)
    if real and exponent == 0.5:
        return _sqrt(a)
    found = _exp(_times(b, _log(a)))
    if real and exponent is not None and exponent > 0:  # 0 at 0
        at_zero = (a.real == 0) & (a.imag == 0)
        return TracedComplex(np.where(at_zero, 0.0, found.real), np.where(at_zero, 0.0, found.imag))
    return found


_UFUNCS: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: TracedComplex(a.real + b.real, a.imag + b.imag),
    "subtract": lambda a, b: TracedComplex(a.real - b.real, a.imag - b.imag),
    "multiply": _times,
    "divide": _over,
    "true_divide": _over,
    "negative": lambda a: TracedComplex(-a.real, -a.imag),
    "positive": lambda a: a,
    "conjugate": lambda a: a.conjugate(),
    "square": lambda a: _times(a, a),
    "power": _power,
    "absolute": lambda a: np.hypot(a.real, a.imag),
    "exp": _exp,
    "log": _log,
    "sqrt": _sqrt,
    "sin": lambda a: TracedComplex(np.sin(a.real) * np.cosh(a.imag), np.cos(a.real) * np.sinh(a.imag)),
    "cos": lambda a: TracedComplex(np.cos(a.real) * np.cosh(a.imag), -(np.sin(a.real) * np.sinh(a.imag))),
    "equal": lambda a, b: (a.real == b.real) & (a.imag == b.imag),
    "not_equal": lambda a, b: (a.real != b.real) | (a.imag != b.imag),
    "matmul": lambda a, b: TracedComplex(a.real @ b.real - a.imag @ b.imag, a.real @ b.imag + a.imag @ b.real),
}

TracedArray.paired = TracedComplex
