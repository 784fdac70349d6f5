"""`compile`: functions of Python as machine code, by tracing or by numba."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

from .._base.arguments import choice, shown
from .compiled import CompiledFunction
from .derivatives import has_llvm
from .forms import Filling
from .graph.function import TracedFunction
from .numba_code import numba_or_say_so
from .second_order import SecondOrder


def compile(
    fun: Callable[..., Any],
    *,
    by: Literal["auto", "trace", "numba"] = "auto",
    inplace: bool = False,
    elementary: Literal["own", "libm"] = "own",
) -> Any:
    """A function that is compiled to machine code when it is used in a problem.

    It is called with symbolic values, and becomes an expression graph, which is compiled in milliseconds and has exact
    derivatives. What cannot be traced is compiled by numba.

    Parameters
    ----------
    fun : callable
        ``f(t, y, *args)`` with the problem's arguments, as in SciPy. Numbers and arrays of numbers are parameters of
        the code; anything else is a constant of it, and other constants are compiled anew. If it cannot be called
        like that, or numba compiles it, ``f(t, y, p)`` with all numbers in p of shape (k,). It returns a number, a
        tuple, a list or an array, a Jacobian by rows, ``((a, b), (c, d))``, or with its rows one after the other;
        complex values for complex y.
        If it raises, the values are NaN, 'cannot be evaluated here'; an IndexError at the start of a run is raised. If
        it is already compiled by numba or by this function, its Python function is used.
    by : {"auto", "trace", "numba"}, default "auto"
        "trace": functions of numbers and of NumPy's arrays, with helpers, methods, loops whose counts are known, and
        branches on values; anything else is an error that names the line. "numba": the part of Python that numba
        compiles, loops until convergence included; a list or array of the wrong length is NaN, as is what uses an index
        beyond an array (but functions of ``numba.njit`` that it calls test indices only with ``boundscheck=True``), and
        a function that writes to y or p gets copies of them in each call. "auto": by numba if it cannot be traced.
        ``how`` of the result says which it was.
    inplace : bool, default False
        ``f(t, y, out)`` or ``f(t, y, out, p)`` fills `out` instead.
    elementary : {"own", "libm"}, default "own"
        Whose sin, cos, exp, log and powers such as x^1.5 of real numbers a traced function calls. Our own are inlined,
        also into the form for lanes of `invariode.solve_ensemble`, have errors below one unit in the last place (powers
        one for each of two to four operations), and the same bits on every processor. "libm": those of the platform's
        mathematical library, one call for each number, as numba calls them.

    Returns
    -------
    CompiledFunction
        For `fun`, `jac`, invariants and their Jacobians, events and actions; still a Python function.

    Raises
    ------
    ModuleNotFoundError
        llvmlite and numba, the extra `compiled`, are not installed.
    ValueError
        `by` or `elementary` is something else.
    TypeError
        When it is used: the function cannot be traced or compiled, or it takes other arguments or returns another
        number of values than it should.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> decay = iv.compile(lambda t, y, p: -p[0] * y[0])
    >>> sol = iv.solve_ivp(decay, (0, 1), [1.0], args=(2.0,))
    >>> bool(abs(sol.y[0, -1] - np.exp(-2)) < 1e-3)
    True
    """
    if not callable(fun):
        raise TypeError(f"compile takes a function f(t, y), got {shown(fun)}")
    choice("by", by, ("auto", "trace", "numba"))
    choice("elementary", elementary, ("own", "libm"))
    if isinstance(fun, SecondOrder):
        inside = fun.fun
        if by == "numba" or inplace or getattr(inside, "inplace", False):
            return SecondOrder(compile(inside, by=by, inplace=inplace, elementary=elementary))
        if isinstance(inside, TracedFunction):
            by = inside.by if by == "auto" else by
            elementary = "libm" if inside.elementary == "libm" else "own"
        fun = fun.first_order
    if isinstance(fun, CompiledFunction):
        if isinstance(fun, TracedFunction) and fun.elementary == "libm":
            elementary = "libm"
        inplace, fun = inplace or fun.inplace, fun.fun
    if isinstance(fun, Filling):
        inplace, fun = True, fun.fun
    fun = getattr(fun, "py_func", fun)  # numba's
    if by == "numba":
        numba_or_say_so()
        return CompiledFunction(fun, inplace)
    if not has_llvm():
        raise ModuleNotFoundError('invariode.compile needs llvmlite: pip install "invariode[compiled]"')
    return TracedFunction(fun, inplace, elementary, by)
