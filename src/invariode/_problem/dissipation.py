"""Functions that only fall along a solution, or only rise: dissipated energies, entropies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from numpy.typing import ArrayLike

from .._base.arguments import call_name, flag
from .._base.types import Function, JacobianKind
from .invariants import Invariants


class Dissipated(Invariants):
    """Functions G(t, y) that must not increase with t, such as a dissipated energy (or, with ``rises=True``, must not
    decrease).

    Pass it as `invariants`, alone or in a list with others. A step that would raise G above its smallest value so far
    is projected onto that value; other steps are left alone.

    Parameters
    ----------
    fun : callable
        ``G(t, y, *args)``, a number or an array of shape (m,), each of which is kept from rising.
    rises : bool, default False
        True: G never falls, like an entropy.
    jac : callable or {'complex-step', '3-point', '2-point'}, optional
        Its Jacobian, or how to compute it: as for `invariode.Invariants`.
    names : str or sequence of m str, optional
        For messages and tables. Default: the name of `fun`.
    level, moves, metric, direction : optional
        As for `invariode.Invariants`. With constraints in levels, give it a level after theirs.

    Notes
    -----
    At the steps G never rises by more than roundoff, ``10 ε (|G| + Σ_j |∂G/∂y_j y_j|)``. Between them ``sol(t)``, with
    the default ``interpolation="projected"``, and events see values of G between those at the ends of the step; within
    one step G may still rise, by no more than the error of the interpolant. After the action of an event, or at a
    breakpoint, G starts from its value there; with ``rehold=False`` an action must not raise it.

    Monotonicity refers to increasing t: in a backward run G never falls.

    A solve evaluates G once per step, and its Jacobian only in steps that are projected. There the law is tested: if
    g_t + J f has the wrong sign beyond roundoff, the run ends with status -2, or is refused at its start with an
    `invariode.InvariantError`. ``sol.residual`` says how far G has risen above its smallest value at earlier outputs.

    `invariode.impose` does not accept `Dissipated`: a single point has no earlier value to compare with.

    Examples
    --------
    >>> import invariode as iv
    >>> import numpy as np
    >>> def pendulum(t, y):
    ...     return [y[1], -np.sin(y[0]) - 0.01 * y[1]]
    >>> energy = iv.Dissipated(lambda t, y: y[1] ** 2 / 2 - np.cos(y[0]), names="energy")
    >>> sol = iv.solve_ivp(pendulum, (0, 100), [2.0, 0.0], invariants=energy)
    >>> G = sol.y[1] ** 2 / 2 - np.cos(sol.y[0])
    >>> bool(np.diff(G).max() < 1e-14)
    True
    """

    def __init__(
        self,
        fun: Function,
        rises: bool = False,
        *,
        jac: Function | JacobianKind | None = None,
        names: str | Sequence[str] | None = None,
        level: int = 0,
        moves: Sequence[int] | None = None,
        metric: ArrayLike | Function | None = None,
        direction: Literal["gradient", "stages"] = "gradient",
    ) -> None:
        super().__init__(fun, jac, names=names, level=level, moves=moves, metric=metric, direction=direction)
        self.rises = flag("rises", rises)

    @property
    def sense(self) -> int:
        """Direction in which the value may change as t grows: 1, it never decreases; -1, it never increases."""
        return 1 if self.rises else -1

    def __repr__(self) -> str:
        rises = ", rises=True" if self.rises else ""
        return f"Dissipated({', '.join(self.names or [call_name(self.fun, 'G')])}{rises})"
