"""The result of a solve."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Unpack

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, choice, flag, warn
from .._base.notebook import html_of_solution
from .._problem.given_options import unknown_option
from .._problem.invariants import InvariantsLike
from .._problem.options import TABLE, ExtensionOptions
from .._problem.sensitivities import SensitivitiesLike
from .export import Exports
from .pictures import drift, over_time, phase, sensitivity_plots, steps
from .pictures.canvas import require_matplotlib
from .pictures.whole_run import thumbnail

if TYPE_CHECKING:
    from .._problem.accepted import extension_options
if TYPE_CHECKING:  # an extra, imported when a picture is drawn
    from matplotlib.axes import Axes

    from .animation import Film
from typing import TYPE_CHECKING


@dataclasses.dataclass(eq=False, repr=False, init=False)
class Solution(Exports):
    """Result of a solve, a dict. The fields up to `success` are those of `scipy.integrate.solve_ivp`.

    Fields are attributes and items, as in SciPy: ``sol.t`` is ``sol["t"]``. So is whatever the user adds.

    Attributes
    ----------
    t : ndarray, (n_t,)
        Times.
    y : ndarray, (n, n_t)
        The solution at t.
    sol : DenseSolution or None
        The solution as a function of t, with ``dense_output=True``; else None, as in SciPy.
    t_events : list of ndarray, or None
        The times of each event, (k,), in the order of the events, also by name: ``sol.t_events["ground"]``. None
        without events.
    y_events : list of ndarray, or None
        The states at each event, (k, n); of one that did not occur, as in SciPy, (0,). By number or name.
    nfev : int
        Evaluations of f.
    njev : int
        Evaluations of its Jacobian.
    nlu : int
        Factorisations.
    status : int
        0 reached the end, 1 a terminal event, 2 stopped by `callback` or by Ctrl-C, -1 the step failed, -2 a given
        invariant is not conserved, -3 a limit was reached (see `Limits`).
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
    y_end : ndarray, (n,)
        The state at `t_end`, after the last jump there. The output need not hold it: `t_eval` may end earlier.

    Notes
    -----
    A solution can be copied and pickled. A pickle includes the functions of the invariants, so these must be defined in
    a module (not lambdas); `save` has no such restriction. Other functions are left out: a copy from a pickle cannot be
    extended.
    """

    def impose(self) -> Solution:
        """Project y, the event states and ``sol(t)`` to roundoff onto the run's own invariants.

        Returns
        -------
        Solution
            Points that did not converge are unchanged, with a warning. Dissipated functions are not imposed.
            Sensitivities stay as they are.
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
            events = events.replaced(
                project(t, y.T, g.pieces_at(t, "left")).T if len(t) else y
                for t, y in zip(self.t_events, events, strict=True)
            )
        dense = self.sol and self.sol.imposed(self._rtol, self._atol)
        y = project(self.t, self.y, g.pieces_of_output(len(self.t)))
        end = np.array([self.t_end])
        y_end = project(end, self.y_end[:, None], g.pieces_at(end, "right"))[:, 0]
        origin = self._origin and self._origin.imposing()
        return self.changed(y=y, y_events=events, sol=dense, _y_end=y_end, _origin=origin)

    def extend(self, t_end: float, **options: Unpack[ExtensionOptions]) -> Solution:
        """Continue the run to `t_end`: the solution on the old interval and the new one.

        If the run ended between two steps, the method goes on from its memory; after a limit or Ctrl-C the result is
        bitwise identical to that of an uninterrupted run. If it ended inside a step, at a terminal event, the method
        starts anew from there, and one of several orders builds its order up again. Problem and options are those of
        the run. Invariants keep the values at which they are held. An event that ended the run, or occurred at its very
        end, is not found again; one with ``terminal=True`` ends the extension at its next occurrence, and an integer
        `terminal` continues its count. The action of an event that ended the run was not taken, and is not taken now.

        Parameters
        ----------
        t_end : float
            The new end, in the direction of integration beyond the point where the run ended, whether the end of its
            interval, an event, the callback or a limit ended it. May be infinite. If the run has already ended
            there, this solution is returned.
        t_eval : array_like, optional
            Times of the output in the new interval, if the run had `t_eval`. Default: those it has not reached, or no
            output if it has reached all. Times beyond `t_end` are kept for a further extension.
        max_step : float or 'tenth', optional
            Default: the run's; 'tenth' is a tenth of the whole interval.
        first_step, callback, check, progress, on_interrupt : optional
            As in `solve_ivp`.
        max_steps, limits : optional
            Likewise, for the extension alone; of these two one replaces the other. Default: the run's.

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
            `t_end` is before the end; the run failed; or the solution comes from a file or a pickle, without the
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
        if TYPE_CHECKING:
            extension_options(**options)  # editors complete options from this call
        extended: Solution = self._run.extend(self, t_end, options)
        return extended

    def gradient(
        self,
        dG_dy: ArrayLike | None = None,
        dG_dp: ArrayLike | None = None,
        wrt: SensitivitiesLike | None = None,
        *,
        t: ArrayLike | None = None,
        integrand: Callable[..., Any] | None = None,
    ) -> Array:
        """Compute the gradient of a scalar function of the solution with respect to parameters.

        It takes one backward run of the adjoint equations, whatever the number of parameters; `sensitivities`, the
        alternative, adds a system of the size of y for each parameter. The run must have `adjoint` or `dense_output`.
        With ``adjoint="checkpoints"`` it is solved again, section by section, in less memory.

        Parameters
        ----------
        dG_dy : array_like of shape (n,) or (n, m), optional
            The derivatives of G(y(t_1), y(t_2), ...) with respect to the solution at m times; shape (n,) is for one
            time. If y is complex, ∂G/∂Re y - i ∂G/∂Im y. Default: 0.
        dG_dp : array_like of shape (k,), optional
            The derivatives of G with respect to the parameters with y fixed. Default: 0.
        wrt : bool, str, int, list of these, or Sensitivities, optional
            The parameters, specified as for `sensitivities`. Default: those of the problem's `sensitivities`, or else
            all numbers in `args`.
        t : array_like of shape (m,), optional
            The times at which G depends on y. Default: the end if m is 1, otherwise the times ``sol.t``.
        integrand : callable, optional
            ``g(t, y, *args)`` returns a number: ∫ g dt from the start to the end is added to G.

        Returns
        -------
        ndarray of shape (k,)
            About as accurate as the solution: it agrees with `sensitivities` to within a few tolerances. It is complex
            if initial values of a complex y are among the parameters: ∂G/∂Re y0 - i ∂G/∂Im y0.

        Raises
        ------
        TypeError, ValueError
            A shape is wrong; or the run has neither a continuous solution nor checkpoints (which are not in files), no
            functions since it was loaded or unpickled, other steps when it is solved again from its checkpoints,
            several actions at one time, discontinuities of f together with a mass matrix, a singular mass matrix whose
            null spaces depend on t or which couples a component at rest on a bound with others, a `MechanicalSystem`,
            `Dissipated`, or complex y0 with a mass matrix.

        Notes
        -----
        Y. Cao, S. Li, L. Petzold and R. Serban, SIAM J. Sci. Comput. 24 (2003) 1076-1089. Where invariants are imposed,
        the solution stays on the manifold and its sensitivities in the tangent space, so that only the tangential part
        of ∂G/∂y enters the adjoint. The integral of λᵀ ∂f/∂p is in the error test of the backward run. At the time of
        an action, G depends on the state after it. If f has conditions at which it jumps, the problem is solved again
        to locate them. The end of the run counts as fixed, even if a terminal event has determined it.

        Examples
        --------
        >>> import invariode as iv
        >>> def decay(t, y, rate):
        ...     return [-rate * y[0]]
        >>> sol = iv.solve_ivp(decay, (0, 1), [1.0], args=(2.0,), rtol=1e-8, atol=1e-10, adjoint=True)
        >>> bool(np.allclose(sol.gradient([1.0], wrt=["rate", "y0"]), [-np.exp(-2), np.exp(-2)], rtol=1e-6))
        True
        """
        return self._run.gradient(self, dG_dy, dG_dp, wrt, t, integrand)

    def plot(
        self,
        components: Any = None,
        *,
        ax: Axes | None = None,
        log: Literal["x", ""] | None = None,
        marks: bool = False,
        **line: Any,
    ) -> Axes:
        """Draw components of the solution over t.

        The curves are continuous: those of ``sol.sol`` with dense output, else cubics through the steps with the slopes
        of f, which is evaluated for them once per point (with implicit methods, monotone cubics). Without output, steps
        of radau, ode23t and ode23tb may be too long for a curve: give them `dense_output`. Output at `t_eval`, which
        says nothing about the solution in between, is joined by straight lines, and marked if it is sparse. A long run
        is drawn by its extremes in each column of the page, and as a range if it fills the page. The real part of a
        complex component is solid, the imaginary part dashed. Curves are interrupted at jumps; occurrences of
        events are open marks, at the state before the action.

        Parameters
        ----------
        components : int, str, or sequence of these, optional
            Indices or labels. Default: all. More than twelve share a sequence of colours, and only some are named.
        ax : matplotlib.axes.Axes, optional
            Where to draw everything. Default: a new figure, with a panel for each group of components of one kind and
            of similar sizes, which differ from those of other groups by a factor of more than 1000. The kind is the
            unit at the end of the label, as in "drug [mg/l]"; the positions and the velocities of mechanical systems
            and second-order problems, and those of labels such as x and x', are two kinds.
        log : {'x', ''}, optional
            'x': a logarithmic axis of time, on which t = 0 has no place; '': a linear one. Default: linear, but in a
            new figure logarithmic if half of the output lies in the first thousandth of the time and the steps span
            six decades, as those of stiff runs do.
        marks : bool, default False
            Of a run with delays: draw a vertical line at each of its `marks`, thinner with each level.
        **line
            Properties of the lines, as for ``Axes.plot``. A `label` tells this solution from others on the same axes;
            a `marker` marks the points of the output.

        Returns
        -------
        matplotlib.axes.Axes
            The first of several panels; all are in ``ax.figure.axes``.

        Raises
        ------
        ValueError
            There is no such component; the run kept its final state only.
        """
        if log is not None:
            choice("log", log, ("x", ""))
        return over_time.draw(self, ax, components, log, flag("marks", marks), line)

    def plot_phase(
        self,
        i: int | str,
        j: int | str | None = None,
        k: int | str | None = None,
        *,
        ax: Axes | None = None,
        field: bool = False,
        **line: Any,
    ) -> Axes:
        """Draw two or three components of the solution against each other, with marks at start (dot) and end (square).

        Both axes have the same scale if their extents are similar, as for orbits. Curves, jumps and events are as in
        `plot`.

        Parameters
        ----------
        i, j : int or str
            Components for the horizontal and the vertical axis, indices or labels. If the solution is complex, only `i`
            is drawn, in the complex plane.
        k : int or str, optional
            A third component: the curve is drawn in space.
        ax : matplotlib.axes.Axes, optional
            Where to draw; in space, axes with ``projection="3d"``. Default: a new figure.
        field : bool, default False
            Whether to draw arrows in the direction of f, at the initial time, behind the curve. Only for problems of
            two real components.
        **line
            Properties of the line, as for ``Axes.plot``. A `marker` marks the points of the output.

        Raises
        ------
        ValueError
            There is no such component; two components of a complex solution, or one of a real one; a field for another
            kind of problem; the run kept only its final state.
        """
        return phase.draw(self, (i, j, k), ax, flag("field", field), line)

    def plot_drift(
        self,
        *,
        ax: Axes | None = None,
        invariants: InvariantsLike | None = None,
        relative: bool = False,
        **line: Any,
    ) -> Axes:
        """Draw how far the invariants are from their values, on a logarithmic axis.

        Solid: ``|g - value|`` at the outputs, after projection. Dotted: the largest before projection
        (`invariode.Solution.drift`). Shaded: below ε ``|value|``, where rounding alone makes residuals.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Where to draw. Default: a new figure.
        invariants : callable, Invariants, or list or dict of these, optional
            What to draw instead of the run's own invariants, to see how a run that did not impose them drifts. They are
            compared with their demanded values, else with their values at the first output and after each jump. They
            get the arguments of the run.
        relative : bool, default False
            Whether residuals are drawn in units of the values: ``|g - value| / |value|``.
        **line
            Properties of the lines, as for ``Axes.plot``. A `label` tells this solution from others on the same axes.

        Raises
        ------
        ValueError
            There are no invariants; the output is empty; the value of one is 0, with `relative`.

        Notes
        -----
        Zeros have no logarithm. They are drawn at half the smallest residual that is not zero; nothing is drawn below
        ε/2 times the larger of ``|value|`` and the largest residual. At points that define a value, such as the first
        one, residuals below all later ones are left out. The axis begins where drift has grown: residuals of the first
        tenth of the outputs do not stretch it. The legend lists curves from that with the largest residual to the
        smallest. If there are more than twelve invariants, the first twelve are drawn, or the largest of each level.
        Lines of level 0 are solid, of level 1 dashed, of level 2 dash-dotted; a constraint and its rate share a colour.
        """
        return drift.draw(self, ax, invariants, flag("relative", relative), line)

    def plot_sensitivities(
        self,
        components: Any = None,
        parameters: Any = None,
        *,
        kind: Literal["lines", "map"] = "lines",
        relative: bool | None = None,
        ax: Axes | None = None,
        **line: Any,
    ) -> Axes:
        """Draw ∂y/∂p over t, of a run with `sensitivities`.

        With dense output the curves are continuous; otherwise lines join the outputs. They are interrupted at jumps.

        Parameters
        ----------
        components : int, str, or sequence of these, optional
            Indices or labels. Default: all; in a new figure with lines, of more than six the first six.
        parameters : int, str, or sequence of these, optional
            Indices or names of parameters, among `sensitivity_names`. Default: all.
        kind : {'lines', 'map'}, default 'lines'
            'lines': a panel for each component, with a line for each parameter. 'map': a row of colours for each
            derivative (a heat map), red where y increases with p and blue where it decreases, for at most 60 of them.
        relative : bool, optional
            True: ``|p| ∂y_i/∂p`` divided by the largest ``|y_i|`` among the outputs, numbers without unit that can be
            compared: 0.5 means that 1 % more of p changes y_i by 0.5 % of its largest value. Default: True for a map.
        ax : matplotlib.axes.Axes, optional
            Where to draw everything. Default: a new figure.
        **line
            Properties of the lines, as for ``Axes.plot``. A `label` tells this solution from others on the same axes.

        Returns
        -------
        matplotlib.axes.Axes
            The first of several panels; all are in ``ax.figure.axes``.

        Raises
        ------
        ValueError
            The run had no sensitivities; there is no such component or parameter; there are fewer than two outputs; a
            map of a complex solution, or of more than 60 rows; `relative`, of a solution from a file, which has no
            values of parameters.
        """
        choice("kind", kind, ("lines", "map"))
        if relative is not None:
            flag("relative", relative)
        return sensitivity_plots.draw(self, components, parameters, kind, relative, ax, line)

    def plot_steps(self, *, axes: Any = None, **line: Any) -> Array:
        """Draw the accepted steps over t: their size ``|h|``, their order, and their estimated error in units of rtol.

        If invariants were imposed, the corrections by projection are drawn with the errors, in the same unit.

        Parameters
        ----------
        axes : sequence of one to three matplotlib.axes.Axes, optional
            Where to draw, beginning with the size. Default: three on a new figure.
        **line
            Properties of the lines, as for ``Axes.plot``.

        Returns
        -------
        ndarray of matplotlib.axes.Axes

        Raises
        ------
        ValueError
            The steps were not kept, as with `t_eval`: ``keep="all"`` keeps them; or there are not one to three axes.

        Notes
        -----
        Failed attempts are not kept. Errors and corrections below 1e-6, as in the first steps, are cut off.
        """
        return steps.draw(self, axes, line)

    def animate(
        self,
        points: Any,
        *,
        links: Iterable[Sequence[int]] = (),
        trace: Iterable[int] = (),
        duration: float | None = None,
        fps: float = 25,
        ax: Axes | None = None,
        **line: Any,
    ) -> Film:
        """Show the motion of points in the plane or in space as a film.

        Parameters
        ----------
        points : callable or array_like of shape (k, 2) or (k, 3)
            ``points(t, y)`` returns where the points are, an array of shape (k, 2) or (k, 3); y has shape (n,). Fixed
            points, such as the pivot of a pendulum, are points too. Or the components that are coordinates, a row of
            indices or labels for each point.
        links : sequence of sequences of int, optional
            Points to be joined by lines: ``[(0, 1), (1, 2, 3)]``. Default: none.
        trace : sequence of int, optional
            Points whose path so far is drawn. Default: none.
        duration : float, optional
            Seconds that the film takes. Default: in real time, if t is in seconds and the motion takes 4 to 20; 4 for
            a shorter motion, 8 for a longer one.
        fps : float, default 25
            Frames per second.
        ax : matplotlib.axes.Axes, optional
            Where to draw; for points in space, axes with ``projection="3d"``. Default: a new figure.
        **line
            Properties of the links, as for ``Axes.plot``.

        Returns
        -------
        Film
            A ``matplotlib.animation.FuncAnimation``. ``film.save("motion.gif")`` makes a file: a GIF, a page with
            controls (``.html``), or, if ffmpeg is installed, a video (``.mp4``). In a notebook it shows itself.

        Raises
        ------
        ValueError
            `points` returns the wrong shape, or values that are not finite; `links` or `trace` name points that do not
            exist; the axes have the wrong number of dimensions.

        Notes
        -----
        Frames are equally spaced in t, at states of ``sol.sol``, or without dense output on the curves of `plot`.
        Output at `t_eval` says nothing about the solution in between: each frame shows the nearest point, so give many.
        """
        require_matplotlib()
        from .animation import animated

        return animated(self, points, links, trace, duration, fps, ax, line)

    def _repr_html_(self) -> str:
        return html_of_solution(self, thumbnail(self))


def _of_the_run(name: str) -> TypeError:
    own = ExtensionOptions.__annotations__
    if name == "y0":
        return TypeError(
            "an extension continues from the end: to change y there, give the event an action, or solve anew"
        )
    if name not in TABLE:
        return unknown_option(name, own)
    return TypeError(
        f"{name} cannot change within a run: extend takes {', '.join(own)}. For another {name} solve from the final "
        "state"
    )


class HasPoints:
    """A system whose motion can be shown as that of its points."""

    def _places(self, sol: Any) -> Callable[[float, Array], Any]:
        """Return the points as a function of t and y, shape (k, 2) or (k, 3); a `ValueError` if there are no points."""
        raise NotImplementedError

    def animate(self, sol: Any, **options: Any) -> Film:
        """Show the motion of the `points` of the system as a film.

        Parameters
        ----------
        sol : Solution
            Of a problem of this system.
        **options
            Those of `invariode.Solution.animate`: links, trace, duration, fps, ax, and properties of the links.

        Returns
        -------
        Film

        Raises
        ------
        ValueError
            The system was made without `points`.
        """
        film: Film = sol.animate(self._places(sol), **options)
        return film
