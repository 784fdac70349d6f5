"""`fit`: the parameters for which a problem agrees best with data."""

from __future__ import annotations

import math
from typing import Any, Literal, Unpack

from ..._base.arguments import choice, flag, positive_integer, warn
from ..._base.public import public
from ..._base.types import MethodName
from ..._problem.options import Options
from .likelihood import Model, to_model
from .result import Fit
from .search import LOSSES, Found, NoStartError, search, start_points
from .uncertainty import uncertainty


@public
def fit(
    problem: Any,
    t: Any = None,
    data: Any = None,
    parameters: Any = None,
    *,
    observe: Any = None,
    sigma: Any = None,
    noise: Literal["normal", "lognormal"] = "normal",
    event_times: Any = None,
    event_sigma: Any = None,
    y0: Literal["steady"] | None = None,
    absolute_sigma: bool = True,
    starts: int = 1,
    seed: int = 0,
    loss: Literal["linear", "soft_l1", "huber", "cauchy", "arctan"] = "linear",
    method: MethodName = "ode45",
    **options: Unpack[Options],
) -> Fit:
    """Fit parameters of a problem to data.

    The search uses `scipy.optimize.least_squares` with exact Jacobians from the sensitivities of the runs. Invariants
    are imposed in every trial.

    Parameters
    ----------
    problem : Problem or list of Experiment
        The problem; or several experiments, ``fit(experiments, parameters)``, each with its data.
    t, data, observe, sigma, noise, event_times, event_sigma, y0
        The data and their description, as in `Experiment`.
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
    loss : {"linear", "soft_l1", "huber", "cauchy", "arctan"}, default "linear"
        As in SciPy. All except "linear" reduce the influence of residuals above one `sigma`, for data with outliers.
    method : str, default 'ode45'
        The method of the runs, a name in `METHODS`.
    **options
        Options of the runs, as in `Problem.solve`. The defaults of rtol and atol are 1e-6 and 1e-9. Not accepted are
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
    are estimated by maximum likelihood together with the other parameters. Standard errors account for the degrees of
    freedom that the fitted parameters use.

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
    model = to_model(problem, t, data, parameters, described, flag("absolute_sigma", absolute_sigma), method, options)
    if loss != "linear" and (model.relative or any(one.level for one in model.space.free)):
        raise ValueError(f'loss="{loss}" needs a known sigma: residuals count less from one sigma on')
    priors = [one.name for one in model.space.free if one.parameter.prior is not None]
    if model.relative and priors:  # the prior and the data have no common unit
        raise ValueError(
            f"the prior of {priors[0]} needs the standard deviation of the data, to weigh the two: give sigma, or make "
            'it a noise level by name: sigma="s", with "s": (lower, upper) among the parameters'
        )
    count = positive_integer("starts", starts)
    best, ends = _searched(model, count, seed, loss)
    known = uncertainty(model, best)
    found = Fit(model, best, known, loss, ends)
    _tell(found)
    return found


def _searched(model: Model, count: int, seed: int, loss: str) -> tuple[Found, list[tuple[float, bool]]]:
    """Run all searches: the best result, and the cost and success of each."""
    best: Found | None = None
    ends: list[tuple[float, bool]] = []
    first: NoStartError | None = None
    for start in start_points(model, count, seed):
        try:
            found = search(model, start, loss)
        except NoStartError as error:
            ends.append((math.inf, False))
            first = first or error
            continue
        ends.append((found.cost, found.success))
        if best is None or (found.cost, not found.success) < (best.cost, not best.success):
            best = found
    if best is None:
        raise ValueError(str(first)) from None
    return best, ends


def _tell(found: Fit) -> None:
    """Issue a warning with the remarks on the fit, except failed runs."""
    remarks = found.remarks()[: len(found.remarks()) - bool(found.failures)]
    if remarks:
        warn("fit: " + "; ".join(remarks))
