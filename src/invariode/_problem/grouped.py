"""Options that belong together, as one value each: how linear systems are solved, where the Jacobian is zero, where
and how often a run is written to disk, what may end it early."""

from __future__ import annotations

import operator
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

from .._base.arguments import count, either, function, path, positive, shown
from .._base.suggestions import naming_arguments
from .._functions.compiled import is_native

__all__ = [
    "GMRES",
    "JACOBIANS",
    "Banded",
    "Checkpoint",
    "CheckpointLike",
    "Limits",
    "LinearSolver",
    "bandwidth",
    "to_checkpoint",
    "to_limits",
    "to_linear_solver",
]

#: How a Jacobian may be computed from f, in words.
JACOBIANS = ("trace", "complex-step", "differences")


@naming_arguments
@dataclass(frozen=True, kw_only=True)
class GMRES:
    """Linear systems of implicit methods solved without a matrix, by restarted GMRES: ``linear_solver=GMRES(...)``.

    It needs products with the Jacobian only and a few vectors of memory, for systems too large for LU factors. Products
    are those of `jac_product`; else of the problem's `jac`, which may be, or return, a
    `scipy.sparse.linalg.LinearOperator`; else differences of f. Without a preconditioner it may need many iterations.

    Parameters
    ----------
    dimension : int, optional
        Iterations between restarts, which take one vector of memory each and one more; GMRES gives up after six such
        cycles. Default: 10; in radau, whose complex vectors take twice the memory, 5.
    preconditioner : callable, optional
        ``preconditioner(t, y, c, *args)`` returns what solves ``(M - c J) x = b`` approximately, with J at (t, y), M
        the mass matrix or the identity, and a real c (also in radau, which applies it to both parts of its complex
        systems): an object with ``solve(b)``, such as `scipy.sparse.linalg.spilu` returns, a
        `scipy.sparse.linalg.LinearOperator` that maps b to x, or a function of b, each of shape (n,). It is called
        again where c has changed by more than 30 %, after 20 steps, and where GMRES or Newton's iteration has failed.
        Required with a mass matrix.
    jac_product : callable, optional
        ``jac_product(t, y, v, *args)``, the product of the Jacobian of f with v, of shape (n,).

    Raises
    ------
    TypeError, ValueError
        `dimension` is not a positive integer; something else is not a function.

    Notes
    -----
    For ode15s, ode23t, ode23tb, radau (of order 5, unless `max_order` allows more) and auto; not for ode23s, whose
    order needs exact solutions, nor with a singular mass matrix. A solve stops once its error is too small to matter
    to Newton's iteration. Y. Saad and M. H. Schultz, SIAM J. Sci. Stat. Comput. 7 (1986) 856-869.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> x = np.linspace(0, 1, 202)[1:-1]
    >>> def heat(t, u):
    ...     return np.diff(u, n=2, prepend=0, append=0) / (x[1] - x[0]) ** 2
    >>> sol = iv.ode15s(heat, (0, 0.1), np.sin(np.pi * x), linear_solver=iv.GMRES(dimension=20))
    >>> sol.stats.nlu, sol.success
    (0, True)
    """

    dimension: int | None = None
    preconditioner: Callable[..., Any] | None = None
    jac_product: Any = None

    def __post_init__(self) -> None:
        if self.dimension is not None:
            object.__setattr__(self, "dimension", count("dimension of GMRES", self.dimension))
        if self.preconditioner is not None and (
            hasattr(self.preconditioner, "matvec") or not callable(self.preconditioner)
        ):
            raise TypeError(
                "preconditioner of GMRES must be a function preconditioner(t, y, c) that returns what solves "
                f"(M - c J) x = b, got {shown(self.preconditioner)}; if it does not depend on c, "
                "pass lambda t, y, c: solver"
            )
        if self.jac_product is not None and not is_native(self.jac_product):
            function("jac_product of GMRES", self.jac_product, "jac_product(t, y, v)")


@naming_arguments
@dataclass(frozen=True, eq=False)
class Banded:
    """A Jacobian that is zero except for ``i - lower <= j <= i + upper``: ``jac=Banded(lower, upper, fun)``.

    The same as SciPy's ``jac=fun, lband=lower, uband=upper``.

    Parameters
    ----------
    lower, upper : int
        Diagonals below and above the main one, each from 0 to n - 1.
    fun : callable, (lower + upper + 1, n) array_like, 'trace', 'complex-step' or 'differences', optional
        ``fun(t, y, *args)`` returns the bands, an array of shape (lower + upper + 1, n) with entry (i, j) of the
        Jacobian at ``[upper + i - j, j]``; or these bands, if they are constant; or how they are computed from f, as
        for `jac`. Default: complex steps where these are the default of `jac`, else differences; lower + upper + 1
        evaluations of f either way.

    Raises
    ------
    TypeError, ValueError
        A bandwidth is not an integer, or is negative; `fun` is an unknown word or an operator without bands. The
        problem checks what depends on n.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> x = np.linspace(0, 1, 52)[1:-1]
    >>> def heat(t, u):
    ...     return np.diff(u, n=2, prepend=0, append=0) / (x[1] - x[0]) ** 2
    >>> sol = iv.ode15s(heat, (0, 0.1), np.sin(np.pi * x), jac=iv.Banded(1, 1))
    >>> sol.success
    True
    """

    lower: int
    upper: int
    fun: Any = None

    def __post_init__(self) -> None:
        for name in ("lower", "upper"):
            object.__setattr__(self, name, bandwidth(f"{name} of Banded", getattr(self, name)))
        if isinstance(self.fun, str) and self.fun not in JACOBIANS:
            known = either(JACOBIANS)
            raise ValueError(f"fun of Banded must be a function, the bands, {known}, got {shown(self.fun)}")
        if isinstance(self.fun, Banded) or hasattr(self.fun, "matvec"):
            raise TypeError(f"fun of Banded must be a function or the bands, got {shown(self.fun)}")


def bandwidth(name: str, value: object, n: int | None = None) -> int:
    """A number of diagonals of a matrix of n components, if n is known."""
    try:
        width = operator.index(value)  # type: ignore[arg-type]  # what has no index is told apart right here
        error: type[Exception] = ValueError
    except TypeError:
        width, error = -1, TypeError
    if width < 0 or (n is not None and width >= max(n, 1)):
        largest = "n - 1" if n is None else max(n - 1, 0)
        raise error(f"{name} must be a bandwidth, an integer from 0 to {largest}, got {shown(value)}")
    return width


@naming_arguments
@dataclass(frozen=True)
class Checkpoint:
    """A run that is written to disk while it goes on: ``checkpoint=Checkpoint(path, every=10)``, or just the path.

    If the process dies, ``load(path, problem).extend(tf)`` continues the run, bit for bit. The state of the run is one
    file, replaced whole; the output is appended to a second one beside it, PATH.output-TOKEN.

    Parameters
    ----------
    path : str or path-like
        The file. Its folder must exist. It is overwritten only if its run has reached the end of the interval or a
        terminal event: one that was killed, interrupted, stopped by a limit or its callback, or that failed raises a
        ValueError before anything is computed. So does a second run with the same file.
    every : float, default 60.0
        Minimum time between two checkpoints, in seconds; ``inf``: only at the start and at the end.

    Raises
    ------
    TypeError
        `path` is neither a str nor path-like, or `every` is not a number.
    ValueError
        `every` is not positive.
    """

    path: str | os.PathLike[str]
    every: float = field(default=60.0, kw_only=True)

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", path("path of Checkpoint", self.path))
        object.__setattr__(self, "every", positive("every of Checkpoint", self.every))


@naming_arguments
@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits that end a run early, with status -3, a message and all results so far.

    ``limits=Limits(steps=10**6, time=60)`` sets two of them. ``Solution.extend`` continues such a run, with
    the same limits again unless it is given others (``max_steps=None``: none).

    Parameters
    ----------
    steps : int, optional
        Maximum number of accepted steps; ``max_steps=`` is its short form. Default: no limit.
    time : float, optional
        Maximum time that the run may take, in seconds, tested after each attempted step. Default: no limit.
    points : int, optional
        Maximum number of points kept: outputs (or steps of the continuous solution, if there are more) and occurrences
        of events.
    bytes : int, optional
        Maximum size of these points. Default of the two: 10 million points or 4 GiB, whichever is less, beyond those of
        `t_eval`, so that no run fills the memory by accident; if one of them is given, the other has no limit.

    Raises
    ------
    TypeError, ValueError
        A limit is not a positive number; `steps`, `points` and `bytes` are integers.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def decay(t, y):
    ...     return -y
    >>> sol = iv.solve_ivp(decay, (0, np.inf), [1.0], limits=iv.Limits(steps=20))
    >>> sol.status, sol.stats.steps
    (-3, 20)
    """

    steps: int | None = None
    time: float | None = None
    points: int | None = None
    bytes: int | None = None

    def __post_init__(self) -> None:
        for name, check in (("steps", count), ("time", positive), ("points", count), ("bytes", count)):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, check(f"{name} of Limits", value))


CheckpointLike = str | os.PathLike[str] | Checkpoint
#: The direct solver, GMRES, or a short name of either.
LinearSolver = Literal["direct", "gmres"] | GMRES


def to_linear_solver(name: str, value: object) -> Literal["direct"] | GMRES:
    """The linear solver that an option names."""
    if isinstance(value, GMRES):
        return value
    if isinstance(value, str) and value in ("direct", "gmres"):
        return GMRES() if value == "gmres" else "direct"
    raise ValueError(f"{name} must be 'direct', 'gmres' or invariode.GMRES(...), got {shown(value)}")


def to_checkpoint(name: str, value: object) -> Checkpoint:
    """The checkpoint that an option names, perhaps by its path alone."""
    return value if isinstance(value, Checkpoint) else Checkpoint(path(name, value))


def to_limits(name: str, value: object) -> Limits:
    if not isinstance(value, Limits):
        raise TypeError(f"{name} must be invariode.Limits(...), as in Limits(steps=1000), got {shown(value)}")
    return value
