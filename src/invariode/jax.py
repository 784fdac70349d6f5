"""Solutions as differentiable functions for JAX: extra ``jax``.

`solve` runs on the CPU by way of a callback, in double precision, with f written for NumPy. Derivatives are those of
`Sensitivities`, or of the adjoint, and not of the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ._base.extras import extra
from ._base.types import MethodName
from ._problem.accepted import run_options
from ._problem.options import Options
from ._solve.bridge import Bridge
from ._solve.problem import Problem

__all__ = ["solve"]

jax: Any = extra("jax", "invariode.jax needs", "jax")
jnp: Any = extra("jax.numpy", "invariode.jax needs", "jax")


def solve(
    problem: Problem,
    y0: ArrayLike | None = None,
    args: Iterable[Any] | None = None,
    *,
    t: ArrayLike | None = None,
    method: MethodName = "ode45",
    **options: Unpack[Options],
) -> Any:
    """Solve a problem, as a function of y0 and args that JAX can differentiate, compile and vectorise.

    Parameters
    ----------
    problem : Problem
        The problem. Its f and other functions are written for NumPy, as for `Problem.solve`.
    y0 : array_like of shape (n,), optional
        Initial state. Default: that of the problem.
    args : tuple, optional
        Arguments of f. Derivatives are with respect to floats and arrays of floats; everything else, such as integers,
        lists and strings, is passed on as it is. Default: those of the problem.
    t : array_like of shape (n_t,), optional
        Times of the output, sorted, which are constants; the run ends at the last one. Default: the end of the
        problem's t_span.
    method : str, default 'ode45'
        The method.
    **options
        As in `Problem.solve`. With ``adjoint=True``, or "checkpoints", gradients are computed by one run backwards, for
        many parameters; then there is only reverse mode (`jax.grad`, `jax.vjp`), and a second run forwards for each
        gradient. Without it, derivatives are forward sensitivities, for either mode.
        ``on_failure="raise"``, here the default, raises an error if the run does not reach all times; with "return" the
        values it does not reach are NaN, and so are gradients of this run.

    Returns
    -------
    jax.Array of shape (n, n_t) or (n,)
        The solution at `t`, or at the end. The run is in double precision. The result has JAX's default type of floats,
        to which y0 and args are rounded before: float32, unless ``jax_enable_x64`` is set.

    Raises
    ------
    TypeError, ValueError
        Wrong arguments, as for `Problem.solve`.
    jax.errors.JaxRuntimeError
        The run failed, or one of the functions raised an exception; the text contains it.

    Notes
    -----
    Invariants are imposed on the solution and, as tangents, on its derivatives. Second derivatives are not available,
    and raise an error. Under `jax.vmap`, runs are solved one after the other.
    """
    bridge = Bridge(problem, t, method, run_options(**options))
    given = [problem.y0 if y0 is None else y0, *(problem.args if args is None else args)]
    places = [i for i, one in enumerate(given) if i == 0 or _is_float(one)]
    numbers = [jnp.asarray(given[i], float) for i in places]
    y = jax.ShapeDtypeStruct(bridge.shape, numbers[0].dtype)

    def operands(found: Sequence[Any]) -> list[Any]:
        every = list(given)
        for i, one in zip(places, found, strict=True):
            every[i] = np.asarray(one, float)
        return every

    def values(*x: Any) -> Any:
        return _called(lambda *x: bridge.values(operands(x)), y, *x)

    def tangent(x: Sequence[Any], dx: Sequence[Any]) -> Any:
        moving = [j for j, one in enumerate(dx) if not isinstance(one, jax.custom_derivatives.SymbolicZero)]
        wanted = tuple(places[j] for j in moving)
        S = [jax.ShapeDtypeStruct(bridge.shape + x[j].shape, y.dtype) for j in moving]
        found, slopes = _called(lambda *x: bridge.tangent(operands(x), wanted), (y, S), *x)
        return found, sum(jnp.tensordot(one, dx[j], dx[j].ndim) for one, j in zip(slopes, moving, strict=True))

    def pullback(x: Sequence[Any], w: Any) -> Any:
        def backwards(w: Any, *x: Any) -> Any:
            of = operands(x)
            return bridge.pullback(bridge.solution(of), of, tuple(places), np.asarray(w, float))

        return tuple(_called(backwards, [jax.ShapeDtypeStruct(one.shape, one.dtype) for one in x], w, *x))

    if bridge.adjoint:
        solved = jax.custom_vjp(values)
        solved.defvjp(lambda *x: (values(*x), x), pullback)
    else:
        solved = jax.custom_jvp(values)
        solved.defjvp(tangent, symbolic_zeros=True)
    return solved(*numbers)


def _is_float(one: Any) -> bool:
    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(one)) and not isinstance(one, jax.Array):
        raise TypeError(f"args: {type(one).__name__} with arrays of JAX: give one array instead")
    return isinstance(one, float) or (hasattr(one, "dtype") and bool(jnp.issubdtype(one.dtype, jnp.floating)))


def _called(host: Callable[..., Any], like: Any, *x: Any) -> Any:
    """Return the values of a function of NumPy arrays, as arrays of these types; they have no derivative."""

    def converted(*x: Any) -> Any:
        return jax.tree.map(lambda one, as_: np.asarray(one, as_.dtype), host(*x), like)

    def refused(*_: Any) -> Any:
        raise NotImplementedError("invariode.jax.solve has first derivatives only")

    call = jax.custom_jvp(lambda *x: jax.pure_callback(converted, like, *x, vmap_method="sequential"))
    call.defjvp(refused)
    return call(*x)
