"""`fit`: the parameters for which a problem agrees best with data."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any, Literal, NamedTuple, Unpack

from ..._base.arguments import Array, choice, flag, positive_integer, warn
from ..._base.package import public
from ..._base.types import MethodName
from ..._problem.options import Options
from .experiment import Noise
from .fit_result import Fit
from .likelihood import FittedModel, to_model
from .search import LOSSES, NoStartError, Optimum, search, start_points
from .uncertainty import Uncertainty, uncertainty, unknown_uncertainty


@public
def fit(
    problem: Any,
    t: Any = None,
    data: Any = None,
    parameters: Any = None,
    *,
    observe: Any = None,
    sigma: Any = None,
    noise: Noise | Sequence[Noise] = "normal",
    event_times: Any = None,
    event_sigma: Any = None,
    y0: Literal["steady"] | Callable[..., Any] | None = None,
    absolute_sigma: bool = True,
    starts: int = 1,
    seed: int = 0,
    workers: int = 1,
    loss: Literal["linear", "soft_l1", "huber", "cauchy", "arctan"] = "linear",
    method: MethodName = "ode45",
    **options: Unpack[Options],
) -> Fit:
    """Fit parameters of a problem to data.

    The search is a trust-region method with exact Jacobians from the sensitivities of the runs: Gauss and Newton's for
    sums of squares, Fisher's scoring where parameters change the noise. Invariants are imposed in every trial.

    Parameters
    ----------
    problem : Problem or list of Experiment
        The problem; or several experiments, ``fit(experiments, parameters)``, each with its data.
    t, data, observe, sigma, noise, event_times, event_sigma, y0
        The data and their description, as in `Experiment`. A table with its times may stand in the place of both t and
        data: ``fit(problem, table, parameters)``.
    parameters : dict
        The parameters by name, each a `Parameter` or a pair of bounds. Names are those of the arguments of f, such as
        ``k``, ``p[2]`` in an array, ``args[0]``; ``y0[label]`` is an initial value; keyword-only arguments of `observe`
        and noise levels named in `sigma` are parameters too.
    absolute_sigma : bool, default True
        Whether `sigma` contains standard deviations. False: only the ratios matter, and the residuals give the scale.
    starts : int, default 1
        The number of searches: the first from the start of each parameter, the others from points spread over the
        bounds (a Latin hypercube). If it exceeds 1, each parameter except noise levels needs two finite bounds.
    seed : int, default 0
        The random seed for these points.
    workers : int, default 1
        The number of processes that share the `starts`. The result does not depend on it. More than one pays
        if a search takes longer than starting a process, some 10 ms; functions are sent to the processes as in
        `solve_ensemble`.
    loss : {"linear", "soft_l1", "huber", "cauchy", "arctan"}, default "linear"
        As in SciPy. All except "linear" reduce the influence of residuals above one `sigma`, for data with outliers.
    method : str, default 'ode45'
        The method of the runs, a name in `METHODS`.
    **options
        Options of the runs, as in `Problem.solve`. The defaults of rtol and atol are 1e-6 and 1e-9; that of max_steps
        is 10,000, since runs at parameters for which the solution has a singularity would take 1e5. Not accepted are
        `t_eval`, `dense_output`, `refine`, `keep`, `sensitivities`, `on_failure`, `callback` and `checkpoint`, which
        the fit sets itself, and `events`, which belong to the problem.

    Returns
    -------
    Fit
        The result; prints as a table.

    Raises
    ------
    TypeError, ValueError
        Data have a wrong shape, no experiment has a parameter of this name, a start is outside its bounds, the run at
        the start fails, and so on; the message names the cause.

    Warns
    -----
    UserWarning
        The data do not determine all parameters, a parameter is at a bound, or the search did not converge.

    Notes
    -----
    If the run at a trial point fails, the search rejects the step: ``Fit.failures`` counts the reasons. Noise levels
    are estimated by maximum likelihood together with the other parameters. Priors are weighed against the data: with
    priors, an unknown sigma, or the unknown factor of relative ones, is a noise level too, named "sigma". Standard
    errors account for the degrees of freedom that the fitted parameters use.

    Examples
    --------
    >>> import invariode as iv
    >>> def decay(t, y, k):
    ...     return [-k * y[0]]
    >>> problem = iv.Problem(decay, (0, 4), [1.0], args=(1.0,))
    >>> fit = iv.fit(problem, [1, 2, 4], [[0.61, 0.37, 0.13]], {"k": (0, 5)}, sigma=0.01)
    >>> round(fit.parameters["k"], 2)
    0.5
    """
    described = {
        "observe": observe,
        "sigma": sigma,
        "noise": noise,
        "event_times": event_times,
        "event_sigma": event_sigma,
        "y0": y0,
    }
    choice("loss", loss, LOSSES)
    flag("absolute_sigma", absolute_sigma)
    model = to_model(problem, t, data, parameters, described, absolute_sigma, method, options, weighs_priors=True)
    if loss != "linear" and (model.relative or model.estimates_noise or model.has_laplace):
        raise ValueError(f'loss="{loss}" needs a known sigma: residuals count less from one sigma on')
    points = start_points(model, positive_integer("starts", starts), seed)
    best, ends = _best(_searched(model, points, loss, positive_integer("workers", workers)))
    known = _uncertainty(model, best)
    found = Fit(model, best, known, loss, ends)
    _tell(found)
    return found


def _uncertainty(model: FittedModel, found: Optimum) -> Uncertainty:
    """Return the uncertainty of the best parameters: NaN, with a warning, if it cannot be computed. The search may have
    taken hours, and its result does not depend on the uncertainty."""
    try:
        return uncertainty(model, found)
    except Exception as error:
        reason = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        warn(f"fit: the standard errors could not be computed ({reason}), and are NaN")
        return unknown_uncertainty(len(model.space.free))


class _SearchEnd(NamedTuple):
    """End of one of the searches."""

    number: int  # which of the searches
    found: Optimum | NoStartError  # what it found
    #: runs, failures: what it has cost
    runs: int
    failures: Counter[str]


def _searched(model: FittedModel, points: list[Array], loss: str, workers: int) -> list[_SearchEnd]:
    """Run all searches, in this process or in others, and return their ends in order."""
    if workers == 1 or len(points) == 1:
        return [_search(model, points, loss, i) for i in range(len(points))]
    from ..._ensemble.worker_processes import may_start, solve_rows  # most of the time of importing this module

    if not may_start():
        warn("a daemonic process cannot start workers, and searches alone: start it with daemon=False")
        return [_search(model, points, loss, i) for i in range(len(points))]
    ends: list[_SearchEnd] = []
    with closing(solve_rows(partial(_search, model, points, loss), len(points), workers, _died)) as chunks:
        for chunk in chunks:
            ends += chunk
    for one in ends:
        model.runs += one.runs
        model.failures.update(one.failures)
    return sorted(ends, key=lambda one: one.number)


def _search(model: FittedModel, points: list[Array], loss: str, i: int) -> _SearchEnd:
    runs, failures = model.runs, model.failures.copy()
    found: Optimum | NoStartError
    try:
        found = search(model, points[i], loss)
    except NoStartError as error:
        found = error
    return _SearchEnd(i, found, model.runs - runs, model.failures - failures)


def _died(i: int) -> _SearchEnd:
    return _SearchEnd(
        i, NoStartError("the worker process died: fun ended the process, or memory ran out"), 0, Counter()
    )


def _best(ends: list[_SearchEnd]) -> tuple[Optimum, list[tuple[float, bool]]]:
    """Return the best result, and the cost and success of each search."""
    found = [one.found for one in ends]
    ended = [one for one in found if isinstance(one, Optimum)]
    if not ended:
        raise ValueError(str(found[0])) from None
    costs = [(one.cost, one.success) if isinstance(one, Optimum) else (math.inf, False) for one in found]
    return min(ended, key=lambda one: (one.cost, not one.success)), costs


def _tell(found: Fit) -> None:
    """Issue a warning with the remarks on the fit that concern its parameters."""
    if remarks := found._concerns():
        warn("fit: " + "; ".join(remarks))
