"""f at complex y, for Jacobians by complex steps: the form that the core calls, and whether f is made for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.exceptions import ComplexWarning

from .. import _core
from .._base.arguments import Array
from .._functions.compiled import CompiledFunction, NativeWithInputs, complex_form, is_native
from .._functions.derivatives import Comparison, at_complex, compared, somewhere
from .._functions.layout import ArgumentLayout

#: Steps that were requested are refused only if they are wrong beyond doubt: by this many times the expected error.
_TOLERANT = 10

#: Where f is compared with a difference, in parts of the sizes of y: what is not analytic may not show at y itself.
_BESIDE = (0.1, 0.0)

_INSTEAD = 'or use jac="differences"'


def compiled_at_complex(fun: Any, n: int, parameters: ArgumentLayout) -> _core.Native | None:
    """Machine code of a compiled f for complex y. None: it is not made by `compile`, or not for complex numbers."""
    if isinstance(fun, NativeWithInputs):
        code = compiled_at_complex(fun.fun, n, fun.arguments(parameters))
        return code and _core.Native(address=code.address, event=False, owner=code, inputs=fun.inputs)
    return complex_form(fun.native(n, n, parameters, event=False)) if isinstance(fun, CompiledFunction) else None


def python_at_complex(fun: Callable[..., Any], t: float, y: Array, args: tuple[Any, ...]) -> Callable[..., Any]:
    """A Python f for complex y; NaN where it cannot be evaluated there, so that the core switches to differences.

    Raises
    ------
    TypeError, ValueError
        It does not take complex y, or drops the imaginary part.
    """
    if is_native(fun):
        raise TypeError(
            'jac="complex-step" needs a Python function, or one of invariode.compile that numba compiles for complex '
            f"numbers: this fun is machine code for real y. Give its Jacobian, {_INSTEAD}"
        )
    for part in _BESIDE:
        at = y + part * somewhere(y)
        found = compared(lambda z: fun(t, z, *args), at, somewhere(at))
        if found is not None and found.by_difference.shape == y.shape:  # else the core tells what is wrong with f
            _require_complex(found)
            break
    form: Callable[..., Any] = at_complex(fun, len(y))
    return form


def _require_complex(found: Comparison) -> None:
    """Raise a TypeError unless f accepts complex y and complex steps give derivatives of it."""
    stepped = found.stepped
    if isinstance(stepped, ComplexWarning):
        raise TypeError(
            'jac="complex-step": fun makes real numbers of complex ones, which drops the imaginary part: use NumPy\'s '
            f"functions in place of math's, make arrays with dtype=y.dtype, as np.empty_like(y) does, {_INSTEAD}"
        )
    if isinstance(stepped, (TypeError, ValueError)):
        raise TypeError(
            f'jac="complex-step": fun does not take complex y ({type(stepped).__name__}: {stepped}): use NumPy\'s '
            f"functions in place of math's, and make arrays with dtype=y.dtype, {_INSTEAD}"
        ) from stepped
    if isinstance(stepped, Exception):
        raise stepped
    expected = found.by_difference.shape
    if stepped.shape != expected:
        raise ValueError(f'jac="complex-step": fun returns shape {stepped.shape} for complex y, expected {expected}')
    for i in np.flatnonzero(~found.agree(_TOLERANT)):
        raise ValueError(
            f'jac="complex-step": component {i} of fun drops the imaginary part of y: along a direction its derivative '
            f"is {found.by_difference[i]:.6g}, and the complex step gives {found.by_step[i]:.6g}. Without abs, real, "
            "conj, norms and rounding it would not: write them for complex y (np.sqrt(x * x) for np.abs(x)), "
            f"{_INSTEAD}"
        )
