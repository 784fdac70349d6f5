"""The problem: what describes it, and `solve`."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Any, Unpack, overload

from numpy.typing import ArrayLike

from .._base.types import MethodName
from .._ensemble.solution import EnsembleSolution
from .._ensemble.store import EnsembleStore
from .._problem.accepted import problem_ensemble_options, run_options
from .._problem.description import Description
from .._problem.docstrings import documented
from .._problem.options import CallingOptions, DescribingOptions, Options, ProblemEnsembleOptions, table_of
from .._results.result import default_labels
from .._results.solution import Solution
from .._run.run import solve
from .prepared import PreparedSolver

__all__ = ["Problem"]


@documented(describing=[*table_of(CallingOptions), *table_of(DescribingOptions)])
class Problem(Description):
    """An initial value problem y' = f(t, y), or M y' = f(t, y), y(t0) = y0, with what is known about its solution.

    Parameters
    ----------
    fun : callable
        ``f(t, y, *args)``, the derivative, a sequence or array of shape (n,). y is a new array if the last one is still
        referenced, so it may be kept; the function may return the same buffer every time.
    t_span : (float, float)
        (t0, tf). tf < t0 integrates backwards. With an infinite tf the run goes on until a terminal event, a callback
        or one of its `limits` ends it.
    y0 : array_like of shape (n,)
        Initial state, real or complex.
    {describing}
    parameters : dict of str and float, optional
        Numbers by any name, instead of `args`: f and all other functions of the problem are called as ``f(t, y, p)``
        with a record p that has them as ``p["k1"]`` and ``p.k1``. Sensitivities, fits, ensembles and `replace` use
        these names.
    inputs : Input or list of Input, optional
        Tabulated functions of t: `fun` and `jac` are called with their values after y, ``f(t, y, u, *args)``; native
        ones find these at the beginning of p. A run starts anew where an input jumps, as at `breakpoints`.
    breakpoints : list of float or of (float, callable), or dict of callables by time, optional
        Times at which functions of the problem may jump, and what the solution does there, such as doses, as in
        `solve_ivp`. Every run has them, together with those among its own options; at one time the actions of the
        problem come first. Those beyond `t_span` take effect on other intervals.
    name : str, optional
        For tables and plots.
    labels : sequence of n str, optional
        Names of the components.

    Raises
    ------
    TypeError
        An argument of a wrong type, such as a `fun` that is not callable.
    ValueError
        y0 or `t_span` is not finite (tf may be infinite) or of a wrong shape; the number of `labels` is not n; an input
        does not cover `t_span`; a constant `jac`, `mass` or `jac_sparsity` is no matrix of n components. What functions
        return is checked by `solve`.

    Notes
    -----
    A problem does not change: `replace` makes another one.

    Examples
    --------
    >>> import invariode as iv
    >>> def orbit(t, y):
    ...     return [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]
    >>> problem = iv.Problem(orbit, (0, 10), [1.0, 3.0], labels=["prey", "predators"])
    >>> problem
    Problem('orbit', t_span=(0.0, 10.0), n=2)
    >>> problem.solve("ode23", rtol=1e-4).success
    True

    Parameters by name:

    >>> def decay(t, y, p):
    ...     return [-p["lambda"] * y[0]]
    >>> slow = iv.Problem(decay, (0, 1), [1.0], parameters={"lambda": 0.5})
    >>> fast = slow.replace(parameters={"lambda": 2.0})
    >>> fast.parameters
    {'lambda': 2.0}
    """

    @property
    def labels(self) -> list[str]:
        """Names of the components."""
        return default_labels(len(self.y0)) if self._labels is None else self._labels

    @documented(options=table_of(Options))
    def solve(self, method: MethodName = "ode45", **options: Unpack[Options]) -> Solution:
        """Solve the problem.

        Parameters
        ----------
        method : str, default 'ode45'
            A name in `METHODS`, or SciPy's name of the same method.
        {options}

        Returns
        -------
        Solution

        Raises
        ------
        TypeError, ValueError, InvariantError
            As for `solve_ivp`. The warnings are the same too.
        """
        return solve(self, method, run_options(**options))

    @documented(options=table_of(Options))
    def prepare(self, method: MethodName = "ode45", **options: Unpack[Options]) -> PreparedSolver:
        """Return a solver for this problem with any y0, args and interval, which checks everything else only once.

        For loops of short solves: fitting, shooting, Monte Carlo. A call costs a few µs beyond its steps if all
        functions are native and `keep` is 'end' or 'outputs'. If the problem must be checked again for another
        y0, other arguments or another interval, as for Python functions with invariants or a Jacobian, for algebraic
        equations or mechanical systems, and for `t_eval` on another interval, a call costs as much as a solve.

        Parameters
        ----------
        method : str, default 'ode45'
            As in `solve`.
        {options}

        Returns
        -------
        PreparedSolver
            Called as ``solver(y0=..., args=..., t_span=...)``, by any number of threads at once, it returns the
            `Solution` that ``problem.replace(y0=..., args=..., t_span=...).solve(method, **options)`` returns.

        Raises
        ------
        TypeError, ValueError, InvariantError
            As for `solve`. The warnings are the same too.

        Examples
        --------
        >>> import invariode as iv
        >>> def decay(t, y, rate):
        ...     return [-rate * y[0]]
        >>> solver = iv.Problem(decay, (0, 1), [1.0], args=(1.0,)).prepare("dop853", rtol=1e-9, keep="end")
        >>> [round(float(solver(args=(rate,)).y[0, -1]), 4) for rate in (1.0, 2.0, 3.0)]
        [0.3679, 0.1353, 0.0498]
        """
        return PreparedSolver(self, method, run_options(**options))

    @overload
    def solve_ensemble(
        self,
        y0: ArrayLike | Iterator[tuple[ArrayLike, Any]] | None = None,
        method: MethodName = "ode45",
        *,
        args: Iterable[Any] | ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
        store: None = None,
        **options: Unpack[ProblemEnsembleOptions],
    ) -> EnsembleSolution:
        raise NotImplementedError(problem_ensemble_options(**options))  # never called: editors follow it

    @overload
    def solve_ensemble(
        self,
        y0: ArrayLike | Iterator[tuple[ArrayLike, Any]] | None = None,
        method: MethodName = "ode45",
        *,
        args: Iterable[Any] | ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
        store: str | os.PathLike[str],
        **options: Unpack[ProblemEnsembleOptions],
    ) -> EnsembleStore: ...
    @documented({"on_failure": "warn"}, options=table_of(ProblemEnsembleOptions))
    def solve_ensemble(
        self,
        y0: ArrayLike | Iterator[tuple[ArrayLike, Any]] | None = None,
        method: MethodName = "ode45",
        *,
        args: Iterable[Any] | ArrayLike | None = None,
        t_eval: ArrayLike | None = None,
        store: str | os.PathLike[str] | None = None,
        **options: Unpack[ProblemEnsembleOptions],
    ) -> EnsembleSolution | EnsembleStore:
        """Solve the problem from many initial values, or with many parameter sets, in parallel.

        The result is the same, bit for bit, for any number of workers, and the same as that of single solves. A
        trajectory that fails, also with an exception, gets a status, a message and NaN as its final state; the others
        go on. One warning says how many failed: see `on_failure`.

        Parameters
        ----------
        y0 : array_like of shape (N, n) or (n,), or iterator, optional
            Initial states, one row per trajectory, or one for all. Default: the problem's. An iterator yields pairs
            ``(y0, args)`` of one trajectory, with a tuple of args, or of several, with rows; N need not be known, nor
            fit in memory.
        method : str, default 'ode45'
            As in `solve`.
        args : tuple, or array or list of shape (N, k), or dict, optional
            A tuple: the extra arguments of all trajectories. Rows: row i holds the k extra arguments of trajectory i;
            those of a list may be of any types. For a problem with `parameters`: a dict of numbers or columns of N
            numbers by name, a list of N dicts, or rows of all parameters. Default: the problem's.
        t_eval : array_like, optional
            Times of the output, sorted in the direction of integration. Default: the final states are kept, and no
            others.
        store : str or path-like, optional
            A Zarr store for the results, written part by part: memory does not grow with N. Needs zarr, of the extra
            `cluster`.

        Other Parameters
        ----------------
        {options}

        Returns
        -------
        EnsembleSolution or EnsembleStore
            The second with a `store`.

        Raises
        ------
        FileExistsError
            There is a store of this name, and not `resume`.
        TypeError, ValueError
            An error that affects every trajectory, or a store that belongs to another problem. With several processes
            on a platform that starts them afresh (not by fork): a function that cannot be pickled, such as a lambda or
            one defined in a function or a notebook.
        RuntimeError
            The processes end before they solve anything: they cannot import the functions. An executor lost its
            processes and cannot start others.

        Notes
        -----
        An invariant without `value` is held at its initial value of each trajectory. The options are those of `solve`
        except for `dense_output`, `refine` and those of a single run's course.

        Where all functions are native (`invariode.compile` and the like), trajectories run on threads in the core,
        which take work from each other as they run out of it; memory is the result plus a few vectors per thread.
        Otherwise they run in processes, and each function must be importable there: on platforms without fork define it
        in a module, guard the script by ``if __name__ == "__main__":``, or give ``workers=1``, which stays in this
        process; so does, with a warning, an ensemble in a daemonic process. Workers end with this process, however it
        ends. The result takes 8 (n n_t + 2 n + 3 m) + 136 bytes per trajectory, and 8 (n + 2) per event that occurred.

        Examples
        --------
        >>> import invariode as iv
        >>> def orbit(t, y):
        ...     return [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])]
        >>> problem = iv.Problem(orbit, (0, 10), [1.0, 3.0], labels=["prey", "predators"])
        >>> many = problem.solve_ensemble([[1.0, 3.0], [1.0, 2.0], [1.0, 1.0]], workers=1, rtol=1e-6)
        >>> many
        EnsembleSolution of 3 trajectories, 2 components, 1 times: 3 reached the end
        """
        from .._ensemble.ensemble import Wanted, solve_rows

        return solve_rows(self, Wanted(y0, args, t_eval, store), method, problem_ensemble_options(**options))
