"""Wrong calls: each is a right one with one or two of its arguments replaced, or a function that returns nonsense.

The oracle: whatever was given, the call returns, or it raises a ValueError, a TypeError, or an IsADirectoryError for a
checkpoint, in words of our own.
"""

from __future__ import annotations

import ctypes
import datetime
import fractions
import re
import traceback
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from scipy import sparse

import invariode as iv

__all__ = ["wrong_call"]

PACKAGE = str(Path(iv.__file__).parent)

#: Of NumPy, nanobind, Python: what tells a user of ours nothing.
FOREIGN = re.compile(
    r"incompatible function arguments|truth value of an|inhomogeneous|setting an array element|cannot reshape|"
    r"could not be broadcast|could not broadcast|object is not iterable|too large to convert|has no attribute|"
    r"not subscriptable|unhashable|Singular matrix|did not converge|only length-1|only 0-dimensional|"
    r"could not convert|integer string conversion"
)


class EnoughError(Exception):
    """A run that is right, but long."""


#: Calls of f in one case: a step of 1e-300 is nothing wrong.
MOST_CALLS = 20_000
_calls = 0


def oscillator(t: float, y: Any) -> list[Any]:
    global _calls
    _calls += 1
    if _calls > MOST_CALLS:
        raise EnoughError
    return [y[1], -y[0]]


def energy(t: float, y: Any) -> Any:
    return y[0] ** 2 + y[1] ** 2


@ctypes.CFUNCTYPE(None, ctypes.c_double, *[ctypes.POINTER(ctypes.c_double)] * 3)
def native_energy(t: float, y: Any, out: Any, p: Any) -> None:
    out[0] = y[0] ** 2 + y[1] ** 2


class Hostile:
    """Raises wherever it is used as a number, an array or a truth value."""

    def __float__(self) -> float:
        raise ZeroDivisionError("of the user's own")

    __bool__ = __len__ = __index__ = __float__

    def __repr__(self) -> str:
        raise RuntimeError("of the user's own")


#: A list in a list, and so on, a thousand times.
DEEP: list[Any] = []
for _ in range(1000):
    DEEP = [DEEP]


def _matrix(random: Random) -> Any:
    """A matrix of (2, 2), or nearly: dense, or sparse with indices that point anywhere."""
    size = random.choice([(2, 2), (2, 2), (2, 2), (3, 2), (2, 3), (0, 0), (2, 2, 2)])
    dense = np.array([random.choice([0.0, 1.0, -2.0, 1e300, np.nan]) for _ in range(int(np.prod(size)))]).reshape(size)
    if dense.ndim != 2 or random.random() < 0.3:
        return dense
    matrix = random.choice([sparse.coo_array, sparse.coo_matrix])(dense)
    matrix = matrix.asformat(random.choice(["csc", "csr", "coo", "dia", "lil", "dok"]))
    for name in ("indices", "indptr", "row", "col", "data", "offsets"):
        array = getattr(matrix, name, None)
        if isinstance(array, np.ndarray) and array.size and array.dtype != object and random.random() < 0.3:
            array = array.copy()
            array.flat[random.randrange(array.size)] = random.choice([-1, 0, 1, 2, 3, 10**6, -(10**6)])
            with suppress(AttributeError, ValueError):
                setattr(matrix, name, array if random.random() < 0.8 else array[:-1])
    return matrix


def _simple(random: Random) -> Any:
    """Anything that is neither a function nor a matrix."""
    return random.choice([
        None, True, False, 0, 1, -1, 2, 3, 0.5, -0.0, 1e-300, 1e300, np.nan, np.inf, -np.inf, 1j, 2**31, 2**63, 2**64,
        10**400, 10**5000, [10**5000], DEEP,
        "", "x", "ode45", "projected", "1.0", b"1", bytearray(b"1"), [], (), {}, set(), [[]], [None],
        [[1], [1, 2]], [1, [2, 3]], ["a", "b"], [1.0, 2.0], [1.0, np.nan], [10**400, 1.0], (1, 2, 3), {1: 2}, range(2),
        (x for x in (1.0, 2.0)), object(), Hostile(), [Hostile()], int, datetime.date(2020, 1, 1),
        fractions.Fraction(1, 3), memoryview(b"abcdefgh"), np.float32(0.5), np.int64(3), np.bool_(True), np.str_("x"),
        np.array(1.0), np.array([True, False]), np.array(["a"]), np.array([None, 1.0]), np.array([1, 2], dtype=object),
        np.zeros(0),
        np.zeros((0, 2)), np.zeros((2, 0)), np.ones(2), np.ones((2, 2)), np.ones((1, 2, 1)), np.ones(2, complex),
        np.ones(2, np.float16), np.ones(2, np.longdouble), np.array(["2020-01-01"], "M8[D]"), np.ones(2, ">f8"),
        np.ones(4)[::2], np.ma.masked_array([1.0, 2.0], [True, False]), np.zeros(2, [("a", float)]),
    ])  # fmt: skip


def _function(random: Random) -> Any:
    """A function of (t, y) that returns anything, at first or later."""
    value, late = _anything(random, depth=1), random.choice([0, 0, 3, 20])
    calls = 0

    def returning(*args: Any) -> Any:
        nonlocal calls
        calls += 1
        return value if calls > late else random.choice([[0.0, 1.0], 1.0])

    return returning


def _object(random: Random) -> Any:
    """One of ours, made of anything."""
    make: Callable[[], Any] = random.choice([
        lambda: iv.Invariants(energy, **_some(random, ("jac", "value", "names", "iterations", "when"))),
        lambda: iv.Invariants(native_energy, **_some(random, ("jac", "value", "names"))),
        lambda: iv.Invariants(energy, **_some(random, ("level", "moves", "metric", "direction"))),
        lambda: iv.Event(lambda t, y: y[0], **_some(random, ("terminal", "direction", "action", "rehold"))),
        lambda: iv.Event(lambda t, y: y[0], **_some(random, ("at_start", "samples"))),
        lambda: iv.Sensitivities(**{"y0": True, **_some(random, ("args", "y0", "dfdp", "dy0dp", "scale"))}),
        lambda: iv.UnitVector(**{"indices": [0, 1], **_some(random, ("indices", "name", "when"))}),
        lambda: random.choice([iv.UnitQuaternion, iv.RotationMatrix])(_anything(random, depth=1)),
        lambda: [iv.Invariants(energy), _simple(random)],
    ])  # fmt: skip
    return make()


def _anything(random: Random, depth: int = 0) -> Any:
    kinds = [_simple, _simple, _simple, _matrix] + ([_function, _object] if depth == 0 else [])
    return random.choice(kinds)(random)


def _some(random: Random, names: tuple[str, ...]) -> dict[str, Any]:
    return {name: _anything(random, depth=1) for name in random.sample(names, random.choice([1, 1, 2]))}


RUN: Mapping[str, Any] = {"fun": oscillator, "t_span": (0, 1), "y0": [1.0, 0.0], "method": "ode45"}
OPTIONS = tuple(sorted(iv.Problem.solve.__signature__.parameters.keys() - {"self", "method"}))  # type: ignore[attr-defined]  # ours
DESCRIBING = (
    *("args", "invariants", "events", "jac", "jac_sparsity", "lband", "uband", "mass", "nonnegative", "bounds"),
    "sensitivities",
)
CALLS: dict[str, tuple[Callable[..., Any], Mapping[str, Any], tuple[str, ...]]] = {
    "solve_ivp": (iv.solve_ivp, RUN, (*OPTIONS, *DESCRIBING, "vectorized")),
    "ode15s": (iv.ode15s, {k: v for k, v in RUN.items() if k != "method"}, (*OPTIONS, *DESCRIBING, "vectorized")),
    "Problem": (
        lambda **given: iv.Problem(**given).solve().drift(),
        {k: v for k, v in RUN.items() if k != "method"},
        (*DESCRIBING, "name", "labels"),
    ),
    "impose": (iv.impose, {"invariants": energy, "t": 0.0, "y": [1.0, 0.1]}, ("value", "args", "rtol", "atol")),
    "check_invariants": (
        iv.check_invariants,
        {"fun": oscillator, "invariants": energy, "t": 0.0, "y": [1.0, 0.1]},
        ("args", "rtol", "atol"),
    ),
    "find_invariants": (
        iv.find_invariants,
        {"fun": oscillator, "t_span": (0, 1), "y0": [1.0, 0.1]},
        ("degree", "args", "labels"),
    ),
    "solve_ensemble": (
        lambda **given: iv.solve_ensemble(**{"workers": 1, **given}),
        {"fun": oscillator, "t_span": (0, 1), "y0": [[1.0, 0.1], [0.5, 0.2]]},
        (*(name for name in OPTIONS if name not in ("refine", "dense_output", "progress")), *DESCRIBING),
    ),
    "odeint": (
        iv.odeint,
        {"func": lambda y, t: oscillator(t, y), "y0": [1.0, 0.0], "t": [0.0, 0.5, 1.0]},
        (
            *("args", "Dfun", "col_deriv", "full_output", "ml", "mu", "rtol", "atol", "tcrit", "h0", "hmax", "hmin"),
            *("ixpr", "mxstep", "mxhnil", "mxordn", "mxords", "printmessg", "tfirst", "method", "invariants"),
        ),
    ),
    "GMRES": (iv.GMRES, {}, ("dimension", "preconditioner", "jac_product")),
    "Banded": (
        lambda **given: iv.solve_ivp(**{**RUN, "method": "ode15s"}, jac=iv.Banded(**given)),
        {"lower": 1, "upper": 1},
        ("fun",),
    ),
    "Checkpoint": (iv.Checkpoint, {"path": "run"}, ("every",)),
    "Limits": (
        lambda **given: iv.solve_ivp(**RUN, limits=iv.Limits(**given)),
        {},
        ("steps", "time", "points", "bytes"),
    ),
    "Input": (iv.Input, {"times": [0.0, 1.0], "values": [0.0, 1.0]}, ("kind", "breakpoints")),
    "sol": (lambda t: iv.solve_ivp(**RUN, dense_output=True).sol(t), {"t": 0.5}, ()),
    "extend": (
        lambda **given: iv.solve_ivp(**RUN).extend(**given),
        {"t_end": 2.0},
        ("t_eval", "first_step", "max_step", "callback", "check", "progress", "max_steps", "limits"),
    ),
}


def wrong_call(random: Random) -> str | None:
    """Makes one. What is wrong with the answer, or None."""
    global _calls
    _calls = 0
    name = random.choice(list(CALLS))
    call, right, optional = CALLS[name]
    given = dict(right)
    if "method" in given:
        given["method"] = random.choice(list(iv.METHODS))
    pool = [*right, *optional]
    try:
        for changed in random.sample(pool, min(len(pool), random.choice([1, 1, 2]))):
            given[changed] = _anything(random)
    except Exception as refused:  # by one of our objects
        return _complaint(refused, name, {})
    given.pop("progress", None)  # draws
    if isinstance(given.get("refine"), int) and given["refine"] > 1000:
        given["refine"] = 2**31  # what fits would fill the memory, as it should
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            call(**given)
        except Exception as refused:
            return _complaint(refused, name, given)
    return None


def _complaint(refused: Exception, name: str, given: dict[str, Any]) -> str | None:
    """Is the error one of ours, or of the user's own?"""
    innermost = traceback.extract_tb(refused.__traceback__)[-1]
    if innermost.filename == __file__ or innermost.name == "__bool__":  # an object's, that a callback returned
        return None
    ours = isinstance(refused, (ValueError, TypeError, IsADirectoryError)) and innermost.filename.startswith(PACKAGE)
    return None if ours and not FOREIGN.search(str(refused)) else _told(refused, name, given)


def _told(error: Exception, name: str, given: dict[str, Any]) -> str:
    where = traceback.extract_tb(error.__traceback__)[-1]
    try:
        arguments = repr({k: v for k, v in given.items() if k not in RUN or RUN[k] is not v})[:400]
    except Exception:  # a repr that raises, an integer too long to be written
        arguments = f"{list(given)}"
    return f"{name}: {type(error).__name__}: {str(error)[:200]} ({where.filename}:{where.lineno}) with {arguments}"
