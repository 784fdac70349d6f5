"""Solutions as differentiable functions for JAX: extra ``jax``.

`solve` runs on the CPU by way of a callback, in double precision, with f written for NumPy. Derivatives are those of
`Sensitivities`, or of the adjoint, and not of the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ._base.package import extra
from ._base.types import MethodName
from ._functions.contents import content
from ._problem.options import Options
from ._problem.problem import Problem
from ._solve.bridge import Bridge

if TYPE_CHECKING:
    from ._problem.accepted import run_options

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
        Arguments of f. Derivatives are with respect to floats and arrays of floats. Everything else, such as integers,
        arrays of integers or truth values, lists and strings, is passed on as it is. Default: those of the problem.
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
    if TYPE_CHECKING:
        run_options(**options)  # editors complete options from this call
    bridge = Bridge.of(problem, t, method, options)
    given = bridge.operands(y0 if y0 is None or hasattr(y0, "dtype") else jnp.asarray(y0), args)
    places = tuple(i for i, one in enumerate(given) if i == 0 or _is_operand(i, one))
    numbers = [given[i] if i and _is_whole(given[i]) else jnp.asarray(given[i], float) for i in places]
    constant = tuple(None if i in places else one for i, one in enumerate(given))
    dtype = numbers[0].dtype
    key = content(constant), places, dtype
    return bridge.faces.find(key, lambda: _solved(bridge, constant, places, dtype))(*numbers)


def _solved(bridge: Bridge, constant: Sequence[Any], places: Sequence[int], dtype: Any) -> Callable[..., Any]:
    """Return the solution as a function of the operands at these places. It is made once for all calls: JAX keeps what
    it has compiled of a function, as long as that is the same object."""
    y = jax.ShapeDtypeStruct(bridge.shape, dtype)

    def operands(found: Sequence[Any]) -> list[Any]:
        every = list(constant)
        for i, one in zip(places, found, strict=True):
            every[i] = np.asarray(one) if _is_whole(one) else np.asarray(one, float)
        return every

    values = _called(lambda *x: bridge.values(operands(x)), y)

    @cache
    def slopes(moving: tuple[int, ...], shapes: tuple[tuple[int, ...], ...]) -> Callable[..., Any]:
        wanted = tuple(places[j] for j in moving)
        S = [jax.ShapeDtypeStruct(bridge.shape + shape, dtype) for shape in shapes]
        return _called(lambda *x: bridge.tangent(operands(x), wanted), (y, S))

    def tangent(x: Sequence[Any], dx: Sequence[Any]) -> Any:
        fixed = jax.custom_derivatives.SymbolicZero
        moving = tuple(j for j, one in enumerate(dx) if not (isinstance(one, fixed) or _is_whole(x[j])))
        found, S = slopes(moving, tuple(x[j].shape for j in moving))(*x)
        return found, sum(jnp.tensordot(one, dx[j], dx[j].ndim) for one, j in zip(S, moving, strict=True))

    @cache
    def backwards(moving: tuple[int, ...], shapes: tuple[tuple[int, ...], ...]) -> Callable[..., Any]:
        wanted = tuple(places[j] for j in moving)

        def pulled(w: Any, *x: Any) -> Any:
            of = operands(x)
            return bridge.pullback(bridge.solution(of), of, wanted, np.asarray(w, float))

        return _called(pulled, [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes])

    def pullback(x: Sequence[Any], w: Any) -> Any:
        moving = tuple(j for j, one in enumerate(x) if not _is_whole(one))
        found = iter(backwards(moving, tuple(x[j].shape for j in moving))(w, *x))
        return tuple(np.zeros(one.shape, jax.dtypes.float0) if _is_whole(one) else next(found) for one in x)

    if bridge.adjoint:
        reverse: Callable[..., Any] = jax.custom_vjp(values)
        reverse.defvjp(lambda *x: (values(*x), x), pullback)  # type: ignore[attr-defined]
        return reverse
    either: Callable[..., Any] = jax.custom_jvp(values)
    either.defjvp(tangent, symbolic_zeros=True)  # type: ignore[attr-defined]
    return either


def _is_operand(i: int, one: Any) -> bool:
    """Return whether an argument goes through the callback: floats, which have derivatives, and arrays of JAX."""
    if isinstance(one, jax.Array):
        if jnp.issubdtype(one.dtype, jnp.complexfloating):
            raise TypeError(f"args[{i - 1}] is a complex array of JAX: pass its real and imaginary parts")
        return True
    if any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(one)):
        raise TypeError(f"args: {type(one).__name__} with arrays of JAX: give one array instead")
    return isinstance(one, float) or (hasattr(one, "dtype") and bool(jnp.issubdtype(one.dtype, jnp.floating)))


def _is_whole(one: Any) -> bool:
    """Return whether an operand holds integers or truth values, which have no derivatives."""
    return hasattr(one, "dtype") and not jnp.issubdtype(one.dtype, jnp.floating)


def _called(host: Callable[..., Any], like: Any) -> Callable[..., Any]:
    """Return a function of NumPy arrays as one of arrays of JAX, with values of these types and no derivative."""

    def converted(*x: Any) -> Any:
        return jax.tree.map(lambda one, as_: np.asarray(one, as_.dtype), host(*x), like)

    def refused(*_: Any) -> Any:
        raise NotImplementedError("invariode.jax.solve has first derivatives only")

    call: Callable[..., Any]
    call = jax.custom_jvp(lambda *x: jax.pure_callback(converted, like, *x, vmap_method="sequential"))
    call.defjvp(refused)  # type: ignore[attr-defined]
    return call
