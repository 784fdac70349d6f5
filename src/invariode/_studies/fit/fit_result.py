"""The result of a fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ..._base.arguments import Array, number, real_numbers, shown
from ..._base.forks import cached_property
from ..._base.notebook import html_of_fit
from ..._base.package import public
from ..._base.suggestions import meant
from ..._results.solution import Solution
from . import picture
from .experiment import Experiment, Failed
from .likelihood import FittedModel
from .profile import Profile, Scale, profile
from .search import Optimum
from .uncertainty import Prediction, Uncertainty, degrees_of_freedom, unit_of_variance

if TYPE_CHECKING:  # an extra, imported when a picture is drawn
    from matplotlib.axes import Axes


@public
class Fit:
    """Result of `fit`: the parameters for which a problem agrees best with data, and their uncertainty.

    Prints as a table.

    Attributes
    ----------
    parameters : dict
        The values of all parameters: the free ones, then those fixed or tied by `equals`.
    standard_errors : dict
        Their standard errors: 0 if fixed, NaN at a bound, infinite if the data do not determine the parameter.
    names : tuple of str
        The free parameters, in the order of the matrices.
    covariance, correlation, fisher : ndarray, (k, k)
        Matrices for the free parameters: covariance, correlation and Fisher information.
    undetermined : list of list of str
        For each combination of parameters that the data do not determine, the names of these parameters.
    at_bound : list of (str, str, float)
        Parameters that ended at a bound: name, "lower" or "upper", and the value of the bound. The standard errors of
        the others are computed with these fixed.
    log_likelihood : float or None
        The log-likelihood of the data at the fit; None with a `loss` other than "linear", and if sigma is estimated
        without degrees of freedom.
    aic : float or None
        Akaike's criterion, 2 k − 2 log L; an unknown sigma is one of the k parameters.
    degrees_of_freedom : int
        The number of data minus the number of parameters, not counting noise levels; 0 if there are as many parameters
        as data, or more. Standard errors are then infinite unless sigma is known.
    reduced_chi_squared : float
        The sum of squares of the residuals in units of sigma, divided by `degrees_of_freedom`: about 1 if sigma is
        right. Of data without sigma, in their own unit: the square of `sigma`, the estimate; that is so for relative
        ones too. NaN without degrees of freedom, and with a `loss` other than "linear", with which outliers would
        dominate it.
    sigma : float or None
        The estimate, from the residuals, of an unknown sigma, or of the factor of relative ones; NaN without degrees
        of freedom, None if sigma is known.
    success : bool
        Whether the search converged.
    message : str
        How the search ended.
    runs : int
        The number of evaluations of the model, including failed ones.
    failures : dict
        The number of failed runs by reason; each is a rejected step.
    starts : list of (float, bool)
        For each start, the final cost (half the sum of squares, or −log L), and whether the search converged; the cost
        is infinite if the model could not be evaluated at the start.
    """

    def __init__(
        self, model: FittedModel, found: Optimum, known: Uncertainty, loss: str, starts: list[tuple[float, bool]]
    ):
        self._model, self._found, self._known, self._loss = model, found, known, loss
        self.starts = starts
        self.success, self.message = found.success, found.message
        self.runs, self.failures = model.runs, dict(model.failures)
        self.names = tuple(one.name for one in model.space.free)
        self.covariance, self.fisher = known.covariance, known.fisher
        self.undetermined, self.at_bound = known.undetermined, known.at_bound
        every = model.space.all(found.at.free)
        self.parameters = {name: value for name, (value, _) in every.items()}
        self.standard_errors = {name: self._error(slope) for name, (_, slope) in every.items()}

    def _error(self, slope: Array) -> float:
        moving = slope != 0
        part = self.covariance[np.ix_(moving, moving)]
        if not moving.any():
            return 0.0
        if np.isinf(np.diag(part)).any():
            return math.inf
        return math.sqrt(float(slope[moving] @ part @ slope[moving]))

    @cached_property
    def correlation(self) -> Array:
        errors = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(errors, errors)

    @property
    def _inner(self) -> int:
        return len(self.names) - len(self.at_bound)

    @property
    def degrees_of_freedom(self) -> int:
        return degrees_of_freedom(self._model, self._found.at)

    @property
    def _unscaled(self) -> bool:
        """True if sigma is to be estimated, and no degrees of freedom are left to do so."""
        return self._known.degrees <= 0

    @property
    def reduced_chi_squared(self) -> float:
        degrees = self.degrees_of_freedom if self._loss == "linear" else 0
        unit = self._model.unit if self._model.relative else 1.0
        return unit**2 * float(np.sum(self._found.at.residuals**2)) / degrees if degrees else math.nan

    @property
    def sigma(self) -> float | None:
        model, at = self._model, self._found.at
        if model.implied is not None:
            return self.parameters[model.implied] * math.sqrt(unit_of_variance(model, at))
        return model.unit * math.sqrt(model.variance(at, self._inner)) if model.relative else None

    @property
    def log_likelihood(self) -> float | None:
        if self._loss != "linear" or self._unscaled:
            return None
        at = self._found.at
        return self._model.log_likelihood(at, at.sigma * math.sqrt(self._model.variance(at)))

    @property
    def aic(self) -> float | None:
        log = self.log_likelihood
        return None if log is None else 2 * (len(self.names) + self._model.relative) - 2 * log

    def confidence(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Compute confidence intervals of all parameters from their standard errors.

        Parameters
        ----------
        level : float, default 0.95
            The probability with which an interval contains the true value.

        Returns
        -------
        dict
            (lower, upper) by name, with quantiles of Student's t, or of the normal distribution if sigma is known. For
            a parameter with ``scale="log"`` the interval is symmetric in its logarithm. Intervals may extend beyond the
            bounds, and are approximate if the model is not linear in the parameters: see `profile`.
        """
        q = self._quantile(level)
        log = {one.name for one in self._model.space.free if one.log}
        found = {}
        for name, value in self.parameters.items():
            error = self.standard_errors[name]
            margin = q * error if error else 0.0  # q may be infinite
            if name in log:
                ratio = math.exp(min(margin / value, 700.0))  # the largest exponent of doubles
                found[name] = (value / ratio, value * ratio) if math.isfinite(error) else (0.0, math.inf)
            else:
                found[name] = (value - margin, value + margin)
        return {name: ends if self.standard_errors[name] == self.standard_errors[name] else (math.nan, math.nan)
                for name, ends in found.items()}  # fmt: skip

    def _quantile(self, level: float) -> float:
        level = number("level", level)
        if not 0 < level < 1:
            raise ValueError(f"level must be between 0 and 1, got {level:g}")
        from scipy import stats  # takes longer to import than everything else

        upper = 0.5 + level / 2
        degrees = self._known.degrees
        if self._unscaled:
            return math.inf
        return float(stats.norm.ppf(upper) if math.isinf(degrees) else stats.t.ppf(upper, degrees))

    def profile(self, name: str = "", level: float = 0.95) -> Profile:
        """Compute the profile likelihood of a parameter, and its confidence interval.

        All other parameters are refitted at each value, so that the interval is also valid if the model is far from
        linear. It takes about 6 to 10 fits, each of a few runs.

        Parameters
        ----------
        name : str
            A free parameter.
        level : float, default 0.95
            The confidence level of the interval.

        Returns
        -------
        Profile
            The interval, `lower` and `upper`, and the points of the profile.
        """
        if name not in self.names:
            what = f"there is no free parameter {shown(name)}" if name else "profile needs the name of a parameter"
            raise ValueError(f"{what}: {', '.join(self.names)}{meant(name, self.names)}")
        if self._loss != "linear":
            raise ValueError(
                f'profile needs a likelihood, which loss="{self._loss}" does not have: fit with loss="linear"'
            )
        if self._unscaled:
            raise ValueError(f"profile needs a sigma: {self._no_sigma()}")
        place = self.names.index(name)
        model, at = self._model, self._found.at
        slope = model.space.slope(at.free)
        scale = Scale(self._quantile(level), unit_of_variance(model, at))
        return profile(model, self._found, place, self.covariance / np.outer(slope, slope), scale, level)

    @cached_property
    def _solutions(self) -> list[Solution]:
        model, free = self._model, self._found.at.free
        return [one.solution(model.space.local(e, free).values) for e, one in enumerate(model.simulations)]

    @property
    def solution(self) -> Any:
        """The `Solution` of the problem with these parameters; a list of them for several experiments."""
        return self._solutions[0] if len(self._solutions) == 1 else self._solutions

    @property
    def residuals(self) -> Any:
        """(Model - data) / sigma, an array like the data, with NaN where nothing was measured. An unknown sigma is
        estimated from the residuals; with log-normal noise, the logarithms are compared. For several experiments, a
        list of arrays."""
        every = [self._residuals(e)[0] for e in range(len(self._model.experiments))]
        return every[0] if len(every) == 1 else every

    @property
    def event_residuals(self) -> Any:
        """(Model - data) / sigma for the times of events: a dict by event name; a list for several experiments."""
        every = [self._residuals(e)[1] for e in range(len(self._model.experiments))]
        return every[0] if len(every) == 1 else every

    def _residuals(self, e: int) -> tuple[Array, dict[str, Array]]:
        experiment, at = self._model.experiments[e], self._found.at
        found = np.full(experiment.data.values.shape, np.nan)
        events = {}
        residuals = at.residuals / math.sqrt(self._model.variance(at, self._inner))
        for one, values in zip(experiment.series, self._model.by_series(e, residuals), strict=True):
            if one.row < len(found):
                found[one.row, one.places] = values
            else:
                events[one.name] = np.full(one.places[-1] + 1, np.nan)
                events[one.name][one.places] = values
        return found, events

    def predict(self, t: ArrayLike, *, experiment: int = 0, level: float = 0.95, noise: bool = False) -> Prediction:
        """Evaluate the fitted model at other times, with bands.

        Parameters
        ----------
        t : array_like of shape (n_t,)
            The times, within the problem's t_span. The prediction is NaN after a terminal event.
        experiment : int, default 0
            The index of the experiment.
        level : float, default 0.95
            The probability of the bands.
        noise : bool, default False
            Whether the bands are prediction bands for new data, including their noise. False: confidence bands of the
            model, from the uncertainty of the parameters. Prediction bands are NaN for a quantity without data in this
            experiment, unless all data share an unknown sigma.

        Returns
        -------
        Prediction
        """
        model = self._model
        one = self._experiment(experiment)
        times = real_numbers("t", t)
        t0, tf = one.problem.t_span
        if times.ndim != 1 or not ((times >= min(t0, tf)) & (times <= max(t0, tf))).all():
            raise ValueError(f"t must be times within the problem's t_span = {(t0, tf)}, got {shown(t)}")
        local = model.space.local(experiment, self._found.at.free)
        curves = model.simulations[experiment].curves(times, local.values)
        if isinstance(curves, Failed):
            raise ValueError(f"the model cannot be evaluated at these times: {curves.reason}")
        q = self._quantile(level)
        slopes = curves.tangent @ local.slopes
        errors = self._errors_of(slopes)
        lognormal = np.array([kind.startswith("log") for kind in one.noise] or [False])[:, None]
        scale = np.divide(errors, np.abs(curves.values), where=lognormal & (curves.values != 0), out=errors.copy())
        if noise:
            scale = np.hypot(scale, self._sigmas(experiment)[:, None])
        margin = np.multiply(q, scale, where=scale != 0, out=np.zeros_like(scale))  # q may be infinite
        lower, upper = (
            np.where(
                lognormal, curves.values * np.exp(np.where(lognormal, sign * margin, 0)), curves.values + sign * margin
            )
            for sign in (-1.0, 1.0)
        )
        return Prediction(times, curves.values, errors, lower, upper, list(one.names))

    def _errors_of(self, slopes: Array) -> Array:
        """Return standard errors of quantities with these derivatives; parameters at a bound count as fixed."""
        covariance = np.where(np.isnan(self.covariance), 0.0, self.covariance)
        open_ = np.isinf(np.diag(covariance))
        finite = np.where(np.isinf(covariance), 0.0, covariance)
        errors = np.sqrt(np.maximum(np.einsum("...i,ij,...j->...", slopes, finite, slopes), 0.0))
        return np.where((slopes[..., open_] != 0).any(axis=-1), np.inf, errors)

    def _sigmas(self, e: int) -> Array:
        """Return the standard deviation of each quantity, which must be one for all times."""
        one = self._model.experiments[e]
        local = self._model.space.local(e, self._found.at.free)
        names = self._model.space.names[e]
        factor = math.inf if self._unscaled else math.sqrt(self._model.variance(self._found.at, self._inner))
        common = any(series.sigma is None for series in one.series if series.row < len(one.names))
        found = np.full(len(one.names), factor * self._model.unit if common else math.nan)
        for series in one.series:
            if series.row >= len(found):
                continue
            if series.formula or series.laplace:
                raise ValueError(f"noise=True needs a normal sigma of {series.name} that is no function")
            known = np.unique(np.ones(1) if series.sigma is None else series.sigma)
            if len(known) != 1:
                raise ValueError(f"noise=True needs one sigma of {series.name}, and its data have different ones")
            level = 1.0 if series.level is None else float(local.values[names.index(series.level)])
            unit = self._model.unit if series.sigma is None else 1.0
            found[series.row] = known[0] * level * factor * unit
        return found

    def _experiment(self, e: Any) -> Any:
        experiments = self._model.experiments
        if not isinstance(e, (int, np.integer)) or not 0 <= e < len(experiments):
            raise ValueError(f"experiment must be an index below {len(experiments)}, got {shown(e)}")
        return experiments[int(e)]

    def _title(self, e: int) -> str | None:
        """Return the title of pictures of an experiment, which says how many others there are."""
        title, several = self._experiment(e).problem._title, len(self._model.experiments)
        return title if several == 1 else f"{title or 'data'}: experiment {e} (0 to {several - 1})"

    def plot(self, *, experiment: int | Literal["all"] = 0, level: float = 0.95, ax: Axes | None = None) -> Axes:
        """Plot the data, the model and its confidence band over time.

        Curves are interrupted where y jumps, as at doses.

        Parameters
        ----------
        experiment : int or "all", default 0
            The index of the experiment; "all": a panel for each one, below each other.
        level : float, default 0.95
            The probability of the band.
        ax : matplotlib.axes.Axes, optional
            The axes for everything, of one experiment. Default: a new figure, with a panel for each unit at the end of
            labels, such as "drug [mg/l]", and for each scale.

        Returns
        -------
        matplotlib.axes.Axes
            The first panel; all are in ``ax.figure.axes``.
        """
        if experiment == "all":
            return self._each(partial(self.plot, level=level), ax)
        one = self._experiment(experiment)
        t, cuts = picture.times(one, self._solutions[experiment])
        band = self.predict(t, experiment=experiment, level=level)
        return picture.draw(one, self._title(experiment), band, cuts, self._errors_of_data(experiment), level, ax)

    def _each(self, draw: Callable[..., Axes], ax: Axes | None) -> Axes:
        """Draw all experiments below each other, and return the first panel."""
        if ax is not None:
            raise ValueError('experiment="all" draws a figure of its own, with a panel for each: leave ax out')
        names = [one.problem._title or "experiment" for one in self._model.experiments]
        panels = picture.column([f"{e}: {name}" for e, name in enumerate(names)])
        for e, panel in enumerate(panels):
            draw(experiment=e, ax=panel)
            panel.set_xlabel("$t$" if panel is panels[-1] else "")
        first: Axes = panels[0]
        return first

    def plot_residuals(self, *, experiment: int | Literal["all"] = 0, ax: Axes | None = None) -> Axes:
        """Plot the residuals of the data over time, in standard deviations.

        If the model and the noise are right, 95 % of the residuals are in the shaded range from −1.96 to 1.96, without
        a pattern.

        Parameters
        ----------
        experiment : int or "all", default 0
            The index of the experiment; "all": a panel for each one, below each other.
        ax : matplotlib.axes.Axes, optional
            The axes, of one experiment. Default: a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            The first panel; all are in ``ax.figure.axes``.
        """
        if experiment == "all":
            return self._each(self.plot_residuals, ax)
        one = self._experiment(experiment)
        return picture.draw_residuals(one, self._title(experiment), self._residuals(experiment)[0], ax)

    def plot_correlation(self, *, ax: Axes | None = None) -> Axes:
        """Plot the correlations of the free parameters as a map: near 1 or −1 the data determine only a combination.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            The axes. Default: a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            Parameters at a bound, and those that the data do not determine, have no correlations: their rows are empty.
        """
        return picture.draw_correlation(self.names, self.correlation, ax)

    def plot_starts(self, *, ax: Axes | None = None) -> Axes:
        """Plot the final costs of all starts in increasing order, above that of the best (a waterfall plot).

        A first step of many starts means that the best minimum is found from most of the region; a single point there
        that others may be better: use more `starts`.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            The axes. Default: a new figure.

        Returns
        -------
        matplotlib.axes.Axes
            Starts at which the model could not be evaluated are counted in the title of the legend.

        Raises
        ------
        ValueError
            The fit had one start.
        """
        if len(self.starts) < 2:
            raise ValueError("the fit had one start: compare several, fit(..., starts=20)")
        return picture.draw_starts(self.starts, ax)

    def _errors_of_data(self, e: int) -> list[Array]:
        """Return the standard deviations of the data, series by series."""
        model, at = self._model, self._found.at
        return model.by_series(e, at.sigma * math.sqrt(model.variance(at, self._inner)))

    def rows(self) -> list[Sequence[str]]:
        """Return rows of the table: name, value, standard error, interval and remark, as text."""
        intervals = self.confidence()
        bounds = {name: f"at its {side} bound" for name, side, _ in self.at_bound}
        open_ = {name for group in self.undetermined for name in group}
        found: list[Sequence[str]] = []
        for name, value in self.parameters.items():
            error = self.standard_errors[name]
            lost = name in open_ or (math.isinf(error) and not self._unscaled)
            remark = bounds.get(name, "not determined" if lost else "")
            remark = remark or ("" if name in self.names else "fixed" if error == 0 else "tied")
            plain = not math.isfinite(error) or error == 0
            ends = "" if plain else "{:.6g} to {:.6g}".format(*intervals[name])
            found.append((name, f"{value:.6g}", "" if plain else f"{error:.2g}", ends, remark))
        return found

    @property
    def remarks(self) -> list[str]:
        """Remarks on convergence, undetermined parameters, bounds, intervals and failed runs."""
        found = self._concerns()
        found += [
            f"the 95 % interval of {name} is wider than its bounds: use profile({name!r})" for name in self._too_wide()
        ]
        if count := sum(map(_after_actions, self._model.experiments)):
            found.append(
                f"data at times of actions, such as doses, are compared with the state after them ({count} of "
                f"{self._model.size}): for those that were measured before, give a time just before"
            )
        if self.failures:
            found.append(f"{sum(self.failures.values())} runs failed, and the steps to them were not taken")
        return found

    def _concerns(self) -> list[str]:
        """Return the remarks on parameters that the fit cannot give, or not as well as it seems."""
        found = [] if self.success else [self.message]
        for group in self.undetermined:
            what = f"{group[0]}" if len(group) == 1 else f"a combination of {' and '.join(group)}"
            found.append(f"the data do not determine {what}")
            alike = [name for name in group if self.parameters[name] == self.parameters[group[0]]]
            idle = not self._found.at.jacobian[:, self.names.index(group[0])].any()
            if len(alike) > 1 or (len(group) == 1 and idle):
                found.append(
                    f"a search that begins where the model is symmetric stalls there: give {' and '.join(alike)} other "
                    "starts, or starts=10"
                )
        found += [f"{name} is at its {side} bound, {value:g}" for name, side, value in self.at_bound]
        return found + ([self._no_sigma()] if self._unscaled else [])

    def _too_wide(self) -> list[str]:
        """Return the parameters whose 95 % interval from standard errors extends beyond their bounds."""
        intervals = self.confidence()
        found = []
        for one in self._model.space.free:
            (low, high), (lower, upper) = intervals[one.name], one.parameter.limits
            if math.isfinite(self.standard_errors[one.name]) and (low < lower or high > upper):
                found.append(one.name)
        return found

    def _no_sigma(self) -> str:
        """Return the reason why there are no standard errors, and what to do."""
        count = self._inner - sum(one.level for one in self._model.space.free)
        return (
            f"{self._model.size} data for {count} parameters leave none to estimate sigma, so that the standard errors "
            "are unknown: give sigma, more data or fewer parameters"
        )

    def __repr__(self) -> str:
        head = ("parameter", "value", "standard error", "95 % interval", "")
        rows = [head, *self.rows()]
        widths = [max(len(row[i]) for row in rows) for i in range(5)]
        lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([*lines, self.summary(), *self.remarks])

    def summary(self) -> str:
        """Summary line: the number of data and the goodness of fit."""
        log = self.log_likelihood
        scale = f", sigma {self.sigma:.4g}" if self.sigma is not None else f", χ²/ν {self.reduced_chi_squared:.4g}"
        if self._found.at.levels or math.isnan(self.reduced_chi_squared):
            scale = ""  # noise levels are in the table
        likelihood = "" if log is None else f", log-likelihood {log:.6g}, AIC {self.aic:.6g}"
        return f"{self._model.size} data, {self.degrees_of_freedom} degrees of freedom{scale}{likelihood}"

    def _repr_html_(self) -> str:
        return html_of_fit(self)


def _after_actions(one: Experiment) -> int:
    """Return how many data are at times of actions in breakpoints."""
    times = [point.t for point in one.problem.breakpoints if point.action is not None]
    return int(np.isfinite(one.data.values[:, np.isin(one.data.t, times)]).sum())
