"""Damaged fields after valid checksums: whole archives in which one number, size, text or array is another.

The oracle: `load` gives a solution or a ValueError that names the file; what it gives can be evaluated and extended, or
its memory is refused with a ValueError. The process survives.
"""

from __future__ import annotations

import io
import json
import struct
import sys
import warnings
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from methods import GENERAL
from scipy.sparse import csc_array

import invariode as iv

__all__ = ["damaged_field"]

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

END = 3.0
#: So that no damage makes a run long.
STEPS = 300
#: Numbers that readers do not like.
EXTREMES = [0, 1, 2, 255, 256, 2**31 - 1, 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1]


def rates(t, y):
    return [-2 * y[0] + y[1] * y[2], 2 * y[0] - y[1] * y[2] - 5 * y[1] ** 2, 5 * y[1] ** 2]


def sparse_jac(t, y):
    return csc_array([[-2, y[2], y[1]], [2, -y[2] - 10 * y[1], -y[1]], [0, 10 * y[1], 0]])


def total(t, y):
    return y[0] + y[1] + y[2]


def wave(t, y):
    return np.array([y[1], -y[0]]) if t < 1 else np.array([y[1], -2 * y[0]])


def radius(t, y):
    return y[0] ** 2 + y[1] ** 2


def turn(t, y):
    return [y[1], -y[0]]


def crossing(t, y):
    return y[0]


def chain(t, y):
    return np.diff(np.concatenate([[0.0], y, [0.0]]), 2)


def kick(t, y):
    return [y[0], y[1] + 0.1]


#: Problems that fill many fields, with the options that cannot be in a file.
PROBLEMS: list[tuple[dict[str, Any], dict[str, Any]]] = [
    ({"fun": turn, "y0": [1.0, 0.0], "invariants": radius, "events": iv.Event(crossing, terminal=9)}, {}),
    ({"fun": rates, "y0": [1.0, 0.0, 0.0], "invariants": total, "nonnegative": True}, {}),
    ({"fun": rates, "y0": [1.0, 0.0, 0.0], "jac": sparse_jac}, {}),
    ({"fun": turn, "y0": [1.0, 0.0], "invariants": radius, "events": crossing, "sensitivities": "y0"}, {}),
    ({"fun": chain, "y0": np.linspace(0, 1, 40)}, {}),
    ({"fun": wave, "y0": [1.0, 0.0]}, {"breakpoints": [(0.5, kick), (2.5, kick)]}),
    ({"fun": rates, "y0": [1.0, 0.0, 0.0], "invariants": iv.Dissipated(lambda t, y: y[0] + y[1])}, {}),
]  # fmt: skip


@cache
def _saved(method: str, kind: int, checkpoint: bool) -> tuple[dict[str, bytes], iv.Problem, dict[str, Any]] | None:
    """The files of a run that a limit has ended, by name; None: the method does not take the problem."""
    about, functions = PROBLEMS[kind]
    if "jac" in about and "jac" not in iv.METHODS[method].options:
        return None
    problem = iv.Problem(t_span=(0, END), **about)
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / "damaged"
        more = {"checkpoint": iv.Checkpoint(path, every=1e-9)} if checkpoint else {}
        sol = problem.solve(method, max_steps=7, dense_output=True, **functions, **more)
        if sol.status not in (-3, 0):
            return None
        if not checkpoint:
            sol.save(path)
        return {one.name: one.read_bytes() for one in Path(folder).iterdir()}, problem, functions


# ----------------------------------------------------------------------------------------------------------------------
# Damage


def _number(random: Random, before: Any) -> Any:
    choices = [
        random.choice(EXTREMES),
        -random.choice(EXTREMES),
        random.random(),
        np.nan,
        np.inf,
        True,
        None,
    ]
    if isinstance(before, (int, float)):
        choices += [before + 1, before - 1, 2 * before, -before]
    return random.choice([*choices, "", "x" * random.choice([1, 3000]), [], {}, [[]] * 5])


def _damaged_json(random: Random, value: Any) -> Any:
    """One leaf, or branch, is another."""
    if isinstance(value, dict) and value and random.random() < 0.9:
        name = random.choice(list(value))
        kind = random.random()
        if kind < 0.1:
            return {key: one for key, one in value.items() if key != name}
        if kind < 0.15:
            return {**value, str(_number(random, 0)) if random.random() < 0.1 else "more": 1}
        return {**value, name: _damaged_json(random, value[name])}
    if isinstance(value, list) and value and random.random() < 0.8:
        i = random.randrange(len(value))
        return [*value[:i], *([] if random.random() < 0.2 else [_damaged_json(random, value[i])]), *value[i + 1 :]]
    return _number(random, value)


def _damaged_bytes(random: Random, memory: bytes) -> bytes:
    """The memory of a run, in which numbers of 1, 4 or 8 bytes are others, or which has another length."""
    data = bytearray(memory)
    for _ in range(random.choice([1, 1, 1, 3])):
        at, width = random.randrange(len(data)), random.choice([1, 4, 8, 8])
        at -= 0 if random.random() < 0.3 else at % 4
        kind = random.random()
        if kind < 0.5:
            new = (random.choice(EXTREMES) % 256**width).to_bytes(width, "little")
        elif kind < 0.7:
            new = struct.pack("<d", random.choice([0.0, -1.0, 1e-320, 1e300, np.nan, np.inf, -np.inf]))
        elif kind < 0.9:
            new = random.randbytes(width)
        else:
            del data[at:]
            return bytes(data)
        data[at : at + len(new)] = new
    return bytes(data[: len(memory)])


def _damaged_array(random: Random, array: np.ndarray) -> np.ndarray:
    if array.dtype == np.uint8:
        return np.frombuffer(_damaged_bytes(random, array.tobytes()), np.uint8)
    kind = random.random()
    if kind < 0.2:
        return array.ravel()[: random.randrange(array.size + 1)]
    if kind < 0.4:
        return np.resize(array, [max(0, size + random.choice([-1, 0, 1, 5])) for size in array.shape])
    if kind < 0.5:
        return array.astype(random.choice([np.int64, np.int8, np.float32, np.complex128, np.bool_]))
    if kind < 0.6:
        return array[None] if random.random() < 0.5 else array.T
    if not array.size:
        return np.ones(3)
    new = array.copy()
    value = random.choice([*EXTREMES[:10], -1, random.random(), np.nan, np.inf])
    with np.errstate(all="ignore"):
        new.flat[random.randrange(new.size)] = value if new.dtype.kind != "i" or np.isfinite(value) else -1
    return new


def _damaged_archive(random: Random, data: bytes) -> bytes:
    with np.load(io.BytesIO(data)) as archive:
        arrays = dict(archive)
    memory = [name for name in arrays if name.endswith("memory")]
    name = random.choice([*arrays, *["about"] * 8, *memory * 12])
    if name.endswith("about"):
        about = _damaged_json(random, json.loads(str(arrays[name])))
        arrays[name] = np.array(json.dumps(about))
    elif random.random() < 0.1:
        del arrays[name]
    else:
        arrays[name] = _damaged_array(random, arrays[name])
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def _damaged_output(random: Random, data: bytes) -> bytes:
    """The output of a checkpoint, one part of which is another."""
    begin = data.index(b"\n") + 1
    parts, at = [], begin
    while at < len(data):
        (size,) = struct.unpack_from("<Q", data, at)
        parts.append(data[at + 12 : at + 12 + size])
        at += 12 + size
    kind, i = random.random(), random.randrange(len(parts))
    if kind < 0.1:
        del parts[i]
    elif kind < 0.2:
        parts.insert(i, parts[random.randrange(len(parts))])
    else:
        parts[i] = _damaged_archive(random, parts[i])
    return data[:begin] + b"".join(struct.pack("<QI", len(one), zlib.crc32(one)) + one for one in parts)


def _lengthened(files: dict[str, bytes], output: str) -> dict[str, bytes]:
    """The state file says how long the output is by now."""
    with np.load(io.BytesIO(files["damaged"])) as archive:
        arrays = dict(archive)
    about = json.loads(str(arrays["about"])) | {"length": len(files[output])}
    out = io.BytesIO()
    np.savez(out, **{**arrays, "about": np.array(json.dumps(about))})
    return {**files, "damaged": out.getvalue()}


def _damaged(random: Random, files: dict[str, bytes]) -> dict[str, bytes]:
    output = next((name for name in files if name != "damaged"), None)
    if output is not None and random.random() < 0.5:
        return _lengthened({**files, output: _damaged_output(random, files[output])}, output)
    return {**files, "damaged": _damaged_archive(random, files["damaged"])}


# ----------------------------------------------------------------------------------------------------------------------
# Cases


def damaged_field(random: Random) -> str | None:
    """Loads one, and uses what comes. What is wrong with that, or None."""
    while True:
        method, kind, checkpoint = (
            random.choice(GENERAL),
            random.randrange(len(PROBLEMS)),
            random.random() < 0.3,
        )
        if (found := _saved(method, kind, checkpoint)) is not None:
            break
    files, problem, functions = found
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, data in _damaged(random, files).items():
            (Path(folder) / name).write_bytes(data)
        path = Path(folder) / "damaged"
        whole = checkpoint or random.random() < 0.8
        try:
            sol = iv.load(path, problem, **functions, trust="code") if whole else iv.load(path)
        except ValueError as refused:
            return None if "damaged" in str(refused) else f"ValueError: {refused}"
        except Exception as error:
            return f"load: {type(error).__name__}: {error}"
        return _used(sol, whole)


def _used(sol: iv.Solution, whole: bool) -> str | None:
    uses: dict[str, Callable[[], object]] = {
        "sol": lambda: sol.sol and sol.sol(np.linspace(-1, END + 1, 7)),
        "drift": sol.drift,
        "extend": lambda: whole and sol.extend(END + 1, max_steps=STEPS, limits=iv.Limits(time=5.0)),
    }
    for name, use in uses.items():
        try:
            use()
        except ValueError:
            pass  # of a memory that is refused, or a solution that other fields spoil
        except Exception as error:
            return f"{name}: {type(error).__name__}: {error}"
    return None
