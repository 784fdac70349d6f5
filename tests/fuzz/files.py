"""Damaged files: what `Solution.save` wrote, with bytes changed, lost or put in, and archives of our own making.

The oracle: `load` gives the solution that was saved, or a ValueError that names the file. An archive that is right in
itself may give another solution, whose dense output can be evaluated.
"""

from __future__ import annotations

import io
import warnings
import zipfile
from functools import cache
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np

import invariode as iv

__all__ = ["damaged_file"]


@cache
def _saved(kind: int) -> tuple[bytes, iv.Solution]:
    options = [
        {},
        {"dense_output": True},
        {"t_eval": [0.0, 1.0]},
        {"dense_output": True, "invariants": lambda t, y: y[0] ** 2 + y[1] ** 2, "events": lambda t, y: y[0]},
        {"dense_output": True, "sensitivities": "y0", "events": lambda t, y: y[0]},
    ][kind]
    sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 2), [1.0, 0.0], **options)
    with TemporaryDirectory() as folder:
        sol.save(Path(folder) / "a.npz")
        return (Path(folder) / "a.npz").read_bytes(), sol


def _damaged(random: Random, whole: bytes) -> bytes:
    """A few bytes changed, anywhere."""
    data = bytearray(whole)
    for _ in range(random.choice([1, 1, 2, 10])):
        at, size = random.randrange(len(data)), random.choice([1, 1, 4, 100])
        kind = random.choice(["change", "flip", "lose", "double", "insert"])
        if kind == "change":
            data[at : at + size] = random.randbytes(min(size, len(data) - at))
        elif kind == "flip":
            data[at] ^= 1 << random.randrange(8)
        elif kind == "lose" and len(data) > 1000:
            del data[at : at + size]
        elif kind == "double":
            data[at:at] = data[at : at + size]
        else:
            data[at:at] = random.randbytes(size)
    return bytes(data)


def _rebuilt(random: Random, whole: bytes) -> bytes:
    """An archive that is right in itself, of members that are not."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(whole)) as old, zipfile.ZipFile(out, "w", random.choice([0, 0, 8])) as new:
        victim = random.choice(old.namelist())
        for name in old.namelist():
            contents = old.read(name)
            if name == victim:
                if random.random() < 0.2:
                    continue
                contents = _damaged(random, contents) if random.random() < 0.7 else contents.replace(b"8", b"4", 1)
                if name == "about.npy" and random.random() < 0.7:  # its text, four bytes a letter
                    text = contents[-400:].replace(b"1\0\0\0", random.choice([b"-\0\0\0", b"9\0\0\0", b'"\0\0\0']))
                    contents = contents[:-400] + text
            new.writestr(name, contents)
    return out.getvalue()


def damaged_file(random: Random) -> str | None:
    """Loads one. What is wrong with what came back, or None."""
    whole, sol = _saved(random.randrange(5))
    damage = random.choice([_damaged, _rebuilt])
    data = damage(random, whole)
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = Path(folder) / "damaged.npz"
        path.write_bytes(data)
        try:
            again = iv.load(path)
        except ValueError as refused:
            return None if "damaged.npz" in str(refused) else f"ValueError: {refused}"
        except Exception as error:
            return f"{type(error).__name__}: {error}"
        if damage is _damaged and not (np.array_equal(again.t, sol.t) and np.array_equal(again.y, sol.y)):
            return "another solution"
        if again.sol is not None:
            again.sol(np.linspace(0, 2, 5))
    return None
