"""Suggestions for unknown names in error messages: "did you mean …?"."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

_Class = TypeVar("_Class", bound=type)

#: Functions of MATLAB's ODE Suite, and what does their work here.
_OF_MATLAB = {
    "odeset": "options are keyword arguments, as in ode45(f, (t0, tf), y0, rtol=1e-6)",
    "odeget": "options are keyword arguments, as in ode45(f, (t0, tf), y0, rtol=1e-6)",
    "deval": "pass dense_output=True, and call sol.sol(t)",
    "odextend": "call sol.extend(tf)",
    "odeplot": "call sol.plot()",
    "odephas2": "call sol.plot_phase(i, j)",
    "odephas3": "call sol.plot_phase(i, j, k)",
    **dict.fromkeys(
        ("bvp4c", "bvp5c"), "boundary values: scipy.integrate.solve_bvp, or shooting with fit or a root finder"
    ),
    "ddeset": "options are keyword arguments, as in dde23(f, lags, history, (t0, tf), rtol=1e-6)",
    **dict.fromkeys(("ddesd", "ddensd"), "only constant delays are supported, with dde23"),
    "ode23i": "pass method='ode23t' to solve_dae; ode15i has the formulas of ode15s",
    "odeprint": "pass progress=True, or a callback=",
}


def nearest(given: object, known: Iterable[str]) -> str | None:
    """The known name most like the given one; None if none is like it."""
    by_case = {name.lower(): name for name in known}
    near = difflib.get_close_matches(given.lower(), list(by_case), n=1) if isinstance(given, str) else []
    return by_case[near[0]] if near else None


def absent(module: str, name: str, public: Iterable[str], modules: Iterable[str]) -> str:
    """The message for a name that a package does not have: of a module to import first, of SciPy's, or misspelt."""
    text = f"module {module!r} has no attribute {name!r}"
    if name.startswith("_"):
        return text
    if name in modules:
        return f"{text} yet: import {module}.{name}"
    if name in _OF_MATLAB:
        return f"{text}: {_OF_MATLAB[name]}"
    from scipy import integrate

    if name in integrate.__all__ and isinstance(getattr(integrate, name), type):
        return f"{text}: it is scipy.integrate.{name}; SciPy's classes with our methods are in {module}.scipy"
    if name in integrate.__all__:
        theirs = [one for one in public if one in integrate.__all__ and not one.endswith("Warning")]
        return f"{text}: it is scipy.integrate.{name}. Of SciPy's functions {module} has {', '.join(theirs)}"
    return f"{text}{meant(name, public)}"


def first_few(listed: Sequence[str], most: int = 6) -> str:
    """Return a list for a message: the first of them, and how many more there are."""
    return ", ".join(listed[:most]) + (f", and {len(listed) - most} more" if len(listed) > most else "")


def meant(given: object, known: Iterable[str]) -> str:
    """The end of a message: the known name that was probably meant; empty if none is like the given one."""
    near = nearest(given, known)
    return "" if near is None else f"; did you mean {near!r}?"


def naming_arguments(cls: _Class) -> _Class:
    """Make the class name an argument that it does not have, and the one that was probably meant."""
    made: Any = cls.__init__  # type: ignore[misc]
    code = made.__code__
    known = code.co_varnames[1 : code.co_argcount + code.co_kwonlyargcount]

    @functools.wraps(made)
    def checked(self: Any, *args: Any, **named: Any) -> None:
        for name in named:
            if name not in known:
                raise TypeError(f"{cls.__name__} has no argument {name!r}{meant(name, known)}")
        made(self, *args, **named)

    cls.__init__ = checked  # type: ignore[misc]
    return cls
