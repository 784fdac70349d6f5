"""What a solve returns."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, Unpack

from .._base.arguments import Array, unknown_option, warn
from .._base.notebook import html_of_solution
from .._problem.options import TABLE, ExtensionOptions
from .export import Exports
from .pictures.thumbnail import thumbnail
from .plots import Plots
from .result import DenseSolution, DiscontinuityWarning, Drift, Stats, Steps, StiffnessWarning

__all__ = ["DenseSolution", "DiscontinuityWarning", "Drift", "Origin", "Solution", "Stats", "Steps", "StiffnessWarning"]


class Origin(Protocol):
    """What a solution was made from: what is needed to continue it."""

    @property
    def imposed(self) -> bool:
        """Whether its extension will be projected to roundoff."""

    @property
    def y(self) -> Array:
        """Where it ended."""

    @property
    def next_h(self) -> float | None:
        """The step to go on with; None: the method chooses one."""

    @property
    def memory(self) -> bytes:
        """What the method remembers,"""

    @property
    def memory_version(self) -> int:
        """in this version."""

    def extend(self, sol: Solution, t_end: float, options: ExtensionOptions) -> Solution: ...

    def slopes(self, t: Array, y: Array) -> tuple[Array, Array] | None:
        """Slopes of the solution after and before each output, (n, n_t), if these are the steps of a differential
        equation."""

    def field(self, y: Array) -> Array | None:
        """f at the start of the run, in other states (n, k)."""

    def identity(self) -> tuple[dict[str, Any], dict[str, Array]]:
        """What tells its run from another, in JSON's types, and arrays by name."""

    def imposing(self) -> Origin:
        """The same for the projected solution: its extension will be projected too."""


@dataclasses.dataclass(eq=False, repr=False, init=False)
class Solution(Plots, Exports):
    """Result of a solve, a dict. The fields up to `success` are those of `scipy.integrate.solve_ivp`.

    Fields are attributes and items, as in SciPy: ``sol.t`` is ``sol["t"]``. So is whatever the user adds.

    Attributes
    ----------
    t : ndarray, (n_t,)
        Times.
    y : ndarray, (n, n_t)
        The solution at t.
    sol : DenseSolution or None
        The solution as a function of t, with ``dense_output=True``.
    t_events : list of ndarray, or None
        The times of each event, (k,). None without events.
    y_events : list of ndarray, or None
        The states at each event, (k, n); of one that did not occur, as in SciPy, (0,).
    nfev : int
        Evaluations of f.
    njev : int
        Evaluations of its Jacobian.
    nlu : int
        Factorisations.
    status : int
        0 reached the end, 1 a terminal event, 2 stopped by `callback` or by Ctrl-C, -1 the step failed, -2 a given
        invariant is not conserved, -3 a limit was reached (`max_steps`, `time_limit`, `max_points`).
    message : str
        Why the integration ended.
    success : bool
        status >= 0.
    stats : Stats
        All counts.
    steps : Steps or None
        The accepted steps, with ``keep="all"``: the default without `t_eval`.
    t_end : float
        Where the run ended: the end of the interval, or where an event, the callback or a failure ended it. The output
        may end earlier.

    Notes
    -----
    A solution can be copied and pickled. The functions of its invariants go with it: pickle takes only functions
    defined in a module, no lambdas; `save` needs none. Other functions are left out: a copy from a pickle cannot be
    extended.
    """

    _origin: Origin | None = None  # None: there are no functions

    def impose(self) -> Solution:
        """This solution with y, the event states and ``sol(t)`` projected to roundoff onto the run's own invariants.

        Returns
        -------
        Solution
            Points that did not converge are unchanged, with a warning. Dissipated functions are not imposed.
        """
        g = self._invariants.equalities()
        if len(g) == 0:
            raise ValueError("the run had no invariants; use invariode.impose(invariants, solution)")
        if g.along_steps:
            raise ValueError(
                'the invariants of the run have direction="stages", and outputs have no stages; use '
                "invariode.impose(invariants, solution) with others"
            )

        def project(t: Array, y: Array, pieces: Array) -> Array:
            if y.shape[1] == 0:
                return y
            result = g.impose(t, y, self._rtol, self._atol, pieces)
            if not result.converged.all():
                left = int((~result.converged).sum())
                warn(f"impose: {left} of {len(t)} points did not converge and are unchanged")
            return result.y

        events = self.y_events
        if events is not None and self.t_events is not None:
            events = [
                project(t, y.T, g.pieces_at(t, "left")).T if len(t) else y
                for t, y in zip(self.t_events, events, strict=True)
            ]
        dense = self.sol and self.sol.imposed(self._rtol, self._atol)
        y = project(self.t, self.y, g.pieces_of_output(len(self.t)))
        origin = self._origin and self._origin.imposing()
        return self.changed(y=y, y_events=events, sol=dense, _origin=origin)

    def extend(self, t_end: float, **options: Unpack[ExtensionOptions]) -> Solution:
        """Continues the run to `t_end`: the solution on the old interval and the new one.

        If the run ended between two steps, the method goes on from its memory; after a limit or Ctrl-C the run is, to
        the last bit, the one that had not been ended. If it ended inside a step, at a terminal event, the method starts
        anew from there, and one of several orders builds its order up again. Problem and options are those of the run.
        Invariants keep the values at which they are held. An event that ended the run, or occurred at its very end, is
        not found again; one with ``terminal=True`` ends the extension at its next occurrence, and an integer `terminal`
        continues its count. The action of an event that ended the run was not taken, and is not taken now.

        Parameters
        ----------
        t_end : float
            The new end, in the direction of integration beyond the point where the run ended, whether the end of its
            interval, an event, the callback or a limit ended it. May be infinite.
        t_eval : array_like, optional
            Times of the output in the new interval, if the run had `t_eval`. Default: those it has not reached, or no
            output if there are none. Those beyond `t_end` are left for a further extension.
        max_step : float, optional
            Default: the run's, or a tenth of the whole interval.
        first_step, callback, check, progress, on_interrupt : optional
            As in `solve_ivp`.
        max_steps, time_limit, max_points : optional
            Likewise, for the extension alone. Default: the run's.

        Returns
        -------
        Solution
            A new one, with the outputs, steps, events and ``sol(t)`` of both parts, and the sums of their counts;
            `status` and `message` come from the second part. This solution does not change.

        Raises
        ------
        TypeError
            An option that an extension cannot change.
        ValueError
            `t_end` is not beyond the end; the run failed; or the solution comes from a file or a pickle, without the
            functions.

        Examples
        --------
        >>> import invariode as iv
        >>> half = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1.0, 0.0], rtol=1e-8, atol=1e-10)
        >>> sol = half.extend(20)
        >>> (float(half.t[-1]), float(sol.t[-1]), bool(abs(sol.y[0, -1] - np.cos(20)) < 1e-6))
        (10.0, 20.0, True)
        """
        for name in options:
            if name not in ExtensionOptions.__annotations__:
                raise _of_the_run(name)
        if self._origin is None:
            raise ValueError(
                "this solution comes from a file or a pickle, without the functions of its problem: it cannot be "
                "extended. Solve from its final state"
            )
        return self._origin.extend(self, t_end, options)

    def _repr_html_(self) -> str:
        return html_of_solution(self, thumbnail(self))


def _of_the_run(name: str) -> TypeError:
    own = ExtensionOptions.__annotations__
    if name not in TABLE:
        return unknown_option(name, own)
    return TypeError(
        f"{name} cannot change within a run: extend takes {', '.join(own)}. For another {name} solve from the final "
        "state"
    )
