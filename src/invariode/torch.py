"""Solutions as differentiable functions for PyTorch: extra ``torch``.

`solve` runs on the CPU, in double precision, with f written for NumPy. Derivatives are those of `Sensitivities`, or of
the adjoint, and not of the steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from ._base.package import extra
from ._base.types import MethodName
from ._problem.options import Options
from ._problem.problem import Problem
from ._solve.bridge import Bridge, leaves

if TYPE_CHECKING:
    from ._problem.accepted import run_options

__all__ = ["solve"]

torch: Any = extra("torch", "invariode.torch needs", "torch")


def solve(
    problem: Problem,
    y0: Any = None,
    args: Iterable[Any] | None = None,
    *,
    t: ArrayLike | None = None,
    method: MethodName = "ode45",
    **options: Unpack[Options],
) -> Any:
    """Solve a problem, as a function of y0 and args that PyTorch can differentiate.

    Parameters
    ----------
    problem : Problem
        The problem. Its f and other functions are written for NumPy, as for `Problem.solve`.
    y0 : Tensor or array_like of shape (n,), optional
        Initial state. Default: that of the problem.
    args : tuple, optional
        Arguments of f: tensors, of which those with ``requires_grad`` have derivatives, and anything else, which is
        passed on as it is. Default: those of the problem.
    t : array_like of shape (n_t,), optional
        Times of the output, sorted, which are constants; the run ends at the last one. Default: the end of the
        problem's t_span.
    method : str, default 'ode45'
        The method.
    **options
        As in `Problem.solve`. With ``adjoint=True``, or "checkpoints", gradients are computed by one run backwards, for
        many parameters. Without it, they are forward sensitivities, computed in the same run.
        ``on_failure="raise"``, here the default, raises an error if the run does not reach all times; with "return" the
        values it does not reach are NaN, and so are gradients of this run.

    Returns
    -------
    Tensor of shape (n, n_t) or (n,)
        The solution at `t`, or at the end, on the CPU. The run is in double precision; the result is float64 if y0 or
        one of the tensors in args is, or if none of them is a tensor of floats, and otherwise float32.

    Raises
    ------
    TypeError, ValueError, SolveError
        As for `Problem.solve`.

    Notes
    -----
    Invariants are imposed on the solution and, as tangents, on its derivatives. Second derivatives and the transforms
    of `torch.func` are not available, and raise an error.
    """
    if TYPE_CHECKING:
        run_options(**options)  # editors complete options from this call
    bridge = Bridge.of(problem, t, method, options)
    if not isinstance(y0, torch.Tensor) and any(isinstance(one, torch.Tensor) for one in leaves(y0)):
        y0 = torch.stack([torch.as_tensor(one, dtype=torch.float64) for one in y0])
    given = bridge.operands(y0, args)
    for i, one in enumerate(given):
        if not isinstance(one, torch.Tensor) and any(isinstance(leaf, torch.Tensor) for leaf in leaves(one)):
            raise TypeError(f"args[{i - 1}] is a {type(one).__name__} that contains tensors: pass one tensor instead")
        if isinstance(one, torch.Tensor) and one.is_complex() and one.requires_grad:
            raise TypeError(f"args[{i - 1}] is complex and requires a gradient: pass its real and imaginary parts")
    return _Solve.apply(bridge, [i for i, one in enumerate(given) if isinstance(one, torch.Tensor)], *given)


class _Solve(torch.autograd.Function):  # type: ignore[misc]
    """The solution, whose derivatives are computed with it, or by the adjoint when they are needed."""

    @staticmethod
    def forward(ctx: Any, bridge: Bridge, places: Sequence[int], *given: Any) -> Any:
        ctx.bridge, ctx.like = bridge, given
        ctx.operands = [_array(one) if i in places else one for i, one in enumerate(given)]
        ctx.wanted = tuple(i for i in places if ctx.needs_input_grad[_BEFORE + i])
        ctx.save_for_backward(*(given[i] for i in places))
        types = [given[i].dtype for i in places if given[i].is_floating_point()]
        dtype = torch.float32 if types and torch.float64 not in types else torch.float64
        if bridge.adjoint and ctx.wanted:
            ctx.solution = bridge.solution(ctx.operands)
            return torch.from_numpy(bridge.outputs(ctx.solution)).to(dtype)
        y, ctx.slopes = bridge.tangent(ctx.operands, ctx.wanted)
        return torch.from_numpy(y).to(dtype)

    @staticmethod
    def backward(ctx: Any, w: Any) -> Any:
        weights = _array(w)
        if ctx.bridge.adjoint:
            parts = ctx.bridge.pullback(ctx.solution, ctx.operands, ctx.wanted, weights)
        else:
            parts = [np.tensordot(weights, S, weights.ndim) for S in ctx.slopes]
        found: list[Any] = [None] * len(ctx.like)
        for i, part in zip(ctx.wanted, parts, strict=True):
            first = torch.from_numpy(np.asarray(part)).to(ctx.like[i])
            found[i] = _Once.apply(first, w, *ctx.saved_tensors) if torch.is_grad_enabled() else first
        return (*[None] * _BEFORE, *found)


class _Once(torch.autograd.Function):  # type: ignore[misc]
    """A first derivative, which depends on what follows it and has no derivative itself."""

    @staticmethod
    def forward(ctx: Any, first: Any, *_: Any) -> Any:
        return first.clone()

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise NotImplementedError("invariode.torch.solve has first derivatives only")


#: Arguments of `_Solve.forward` that are no operands.
_BEFORE = 2


def _array(one: Any) -> Any:
    """Return a copy for NumPy; floats are in double precision."""
    return one.detach().to("cpu", torch.float64 if one.is_floating_point() else one.dtype, copy=True).numpy()
