"""f at complex y, for Jacobians by complex steps: the form that the core calls, and whether f is made for it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.exceptions import ComplexWarning

from .. import _core
from .._base.arguments import EPS, Array
from .._functions.compiled import CompiledFunction, NativeWithInputs, complex_form, is_native
from .._functions.derivatives import somewhere
from .._laws.bound import at_complex

__all__ = ["compiled_at_complex", "python_at_complex"]

#: Complex increment: its square is negligible against 1, and products of y and it do not vanish.
_TINY = 1e-40
#: Relative increment of a central difference, and what counts as agreement with it.
_INCREMENT, _SAME = EPS ** (1 / 3), 1e-5
#: Where f is compared with a difference, in parts of the sizes of y: what is not analytic may not show at y itself.
_BESIDE = (0.1, 0.0)

_INSTEAD = 'or use jac="differences"'


def compiled_at_complex(fun: Any, n: int, parameters: int) -> _core.Native | None:
    """Machine code of a compiled f for complex y. None: it is not made by `compile`, or not for complex numbers."""
    if isinstance(fun, NativeWithInputs):
        code = compiled_at_complex(fun.fun, n, parameters + fun.size)
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
        if _compared(fun, t, y + part * somewhere(y), args):
            break
    form: Callable[..., Any] = at_complex(fun, len(y))
    return form


def _compared(fun: Callable[..., Any], t: float, y: Array, args: tuple[Any, ...]) -> bool:
    """Whether f is defined around this real y, so that its complex step has been compared with a difference."""
    direction = somewhere(y)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            up, down = (np.ravel(fun(t, y + side * _INCREMENT * direction, *args)) for side in (1, -1))
        except (ValueError, ArithmeticError):
            return False
        if up.dtype.kind not in "biuf" or up.shape != y.shape or not (np.isfinite(up) & np.isfinite(down)).all():
            return False  # the core tells what is wrong with these values
        stepped = _at_complex_step(fun, t, y + 1j * _TINY * direction, args)
    if stepped.shape != y.shape:
        raise ValueError(f'jac="complex-step": fun returns shape {stepped.shape} for complex y, expected {y.shape}')
    by_step, by_difference = np.imag(stepped) / _TINY, (up - down) / (2 * _INCREMENT)
    noise = 100 * EPS / _INCREMENT * np.maximum(np.abs(up), np.abs(by_difference) * _INCREMENT)
    wrong = ~(np.abs(by_step - by_difference) <= _SAME * np.maximum(np.abs(by_step), np.abs(by_difference)) + noise)
    if not wrong.any():
        return True
    i = int(np.flatnonzero(wrong)[0])
    raise ValueError(
        f'jac="complex-step": component {i} of fun drops the imaginary part of y: along a direction its derivative is '
        f"{by_difference[i]:.6g}, and the complex step gives {by_step[i]:.6g}. Without abs, real, conj, norms and "
        f"rounding it would not: write them for complex y (np.sqrt(x * x) for np.abs(x)), {_INSTEAD}"
    )


def _at_complex_step(fun: Callable[..., Any], t: float, y: Array, args: tuple[Any, ...]) -> Array:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", ComplexWarning)
            return np.ravel(np.asarray(fun(t, y, *args), dtype=complex))
    except ComplexWarning:
        raise TypeError(
            'jac="complex-step": fun makes real numbers of complex ones, which drops the imaginary part: use NumPy\'s '
            f"functions in place of math's, make arrays with dtype=y.dtype, as np.empty_like(y) does, {_INSTEAD}"
        ) from None
    except (TypeError, ValueError) as error:
        raise TypeError(
            f'jac="complex-step": fun does not take complex y ({type(error).__name__}: {error}): use NumPy\'s '
            f"functions in place of math's, and make arrays with dtype=y.dtype, {_INSTEAD}"
        ) from error
