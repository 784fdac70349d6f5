"""Invariants: what a solution keeps, in the user's terms."""

from __future__ import annotations

import copy
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Literal, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import (
    LARGEST_INT,
    Array,
    call_name,
    choice,
    encodable,
    flag,
    function,
    items,
    positive_integer,
    real_numbers,
    shown,
)
from .._base.suggestions import naming_arguments
from .._base.types import Function, JacobianKind, Numbers
from .._functions.compiled import is_native
from .._functions.forms import unlambdified

#: How a Jacobian is computed without a function for it.
_KINDS = ("complex-step", "3-point", "2-point")


@naming_arguments
class Invariants:
    """Functions of the solution that keep their values, imposed by projection (paper, sections 2-4).

    Parameters
    ----------
    fun : callable
        ``g(t, y, *args)``, a number or an array of shape (m,); y has shape (n,). For complex y the values are real.
    jac : callable or {'complex-step', '3-point', '2-point'}, optional
        ``jac(t, y, *args)``, the Jacobian ∂g/∂y of shape (m, n), or (n,) for m = 1. From n = 100 on it may return a
        sparse matrix, which stores all entries that can differ from zero. For complex y row i holds
        ∂g_i/∂(Re y) + 1j ∂g_i/∂(Im y). Or how to compute it: by complex steps, Im g(y + i h e_j) / h, exact to
        roundoff, n evaluations of g at complex y; by central differences, 2n evaluations; by forward differences,
        n + 1. Default: for a compiled g, and for one in Python with 16 components of y or more whose code only
        calculates, exact derivatives of its expressions; otherwise complex steps where g takes complex y and they
        agree with a difference at the start, else central differences. ``stats.derivatives`` says which.
    value : float or array_like of shape (m,), optional
        The value to hold; 0 for constraints. Default: the value of g at the initial point.
    names : str or sequence of m str, optional
        For messages and tables. Default: the name of `fun`.
    iterations : int, optional
        Projection iterations per step. Default: the method's, which is 1, or 2 for the pairs of order 5 and higher
        (paper, section 4).
    when : {'always', 'needed'}, default 'always'
        Project after every step (paper, section 4), or only if the distance from the manifold exceeds 0.01 of the
        tolerance, which saves evaluations of the Jacobian.
    level : int, default 0
        Order of correction. Invariants of level 0 are imposed first. Corrections of a later level do not disturb the
        earlier ones, to first order; they are repeated until only roundoff is left, at most `iterations` times, by
        default 10. If all invariants are at level 0, one correction serves them all (paper, section 3).
    moves : sequence of int, optional
        The components of y that the correction may move; one set for all invariants of a level. Default: all. The
        distance to the manifold is measured in these alone: an invariant must depend on some of them.
    direction : {'gradient', 'stages'}, default 'gradient'
        Direction of the corrections: 'gradient' allows any (the smallest is along the gradients); 'stages' restricts
        them to the span of the stages of the step (the slopes of a Runge-Kutta or Rosenbrock method, the differences of
        a multistep method), which keep whatever is linear in y. Linear invariants that are not listed, such as momenta
        and total masses, then survive the projection onto others to roundoff, in the output between steps too. All
        invariants of a run share one direction; 'stages' requires level 0 and excludes `metric`, `bounds` and mass
        matrices. See Notes.
    metric : array_like of shape (k,) or (k, k), or callable, optional
        The matrix G that measures corrections: the one with the smallest δᵀ G δ is made. Its diagonal or all of it,
        constant or ``G(t, y, *args)``, for the k components of `moves`, in their order; one for all invariants of a
        level; only for real problems. Default, also used wherever G is not positive definite: the diagonal 1 / w², with
        the weights w of the error test.

    Notes
    -----
    The units of g do not matter: distances to the manifold are measured in the weights of the error test. Redundant
    invariants are dropped with a warning. A function that the equations do not conserve is an error.

    Constraints of mechanics have levels: positions are put on φ(q) = 0 by moving q alone, then velocities on φ̇ = 0 by
    moving v alone, so that errors of v do not move q. In the metric of the mass matrix the smallest correction acts as
    constraint forces do, and changes no momentum that these conserve. `MechanicalSystem` sets all this.

    With ``direction="stages"`` the correction is the smallest one in the span of the stages (M. Kojima, BIT 56 (2016)
    1087-1102; M. Najafian, B. C. Vermeire, arXiv:2409.18328). If the gradients are nearly orthogonal to that span, for
    example because the stages differ only by roundoff, corrections become long: an invariant is not corrected in a step
    where less than 0.01 of its gradient is in the span.

    Examples
    --------
    >>> import invariode as iv
    >>> circle = iv.Invariants(lambda t, y: y[0] ** 2 + y[1] ** 2, value=1, names="radius²")
    >>> circle
    Invariants(radius², value=[1.0])
    >>> sol = iv.solve_ivp(lambda t, y: [-y[1], y[0]], (0, 100), [1.0, 0.0], invariants=circle)
    >>> bool(abs(sol.residual).max() < 1e-9)
    True
    """

    def __init__(
        self,
        fun: Function,
        jac: Function | JacobianKind | None = None,
        value: Numbers | None = None,
        names: str | Sequence[str] | None = None,
        iterations: int | None = None,
        when: Literal["always", "needed"] = "always",
        level: int = 0,
        moves: Sequence[int] | None = None,
        metric: ArrayLike | Function | None = None,
        direction: Literal["gradient", "stages"] = "gradient",
    ) -> None:
        self.fun: Any = fun if is_native(fun) else unlambdified(function("the invariant", fun, "g(t, y)"))
        self.jac: Any = jac
        if isinstance(jac, str):
            choice("jac of the invariant", jac, _KINDS)
        elif jac is not None and not is_native(jac):
            function("jac of the invariant", jac, "jac(t, y)")
        self.value = None if value is None else demanded_values(value)
        self.names = None if names is None else _names(names)
        self.iterations = None if iterations is None else positive_integer("iterations", iterations)
        self.when = choice("when", when, ("always", "needed"))
        self.level = _level(level)
        self.moves = None if moves is None else _components(moves)
        self.metric: Any = None if metric is None else _metric(metric)
        self.direction = _direction(direction)

    @staticmethod
    def plain(fun: Any) -> Invariants:
        """Return the invariants of machine code with all defaults, which takes less time than to check these."""
        one = Invariants.__new__(Invariants)
        one.__dict__.update(_DEFAULTS, fun=fun)
        return one

    @property
    def sense(self) -> int:
        """Direction in which the value may change: 0, none. See `invariode.Dissipated`."""
        return 0

    def _in_core(self, n: int) -> tuple[Any, Any] | None:
        """The function and its Jacobian for n real components, if the core has them built in."""
        return None

    def __repr__(self) -> str:
        held = "" if self.value is None else f", value={self.value.tolist()}"
        return f"{type(self).__name__}({', '.join(self.names or [call_name(self.fun, 'g')])}{held})"


class AccuracyWarning(UserWarning):
    """Projection changes a component by much more than its estimated error, and may make it less accurate.

    Given once: for a run, for all trajectories of an ensemble, or by one of the classes in ``invariode.scipy``.
    """


#: Invariants as arguments: a function, an `Invariants`, or several of these, in a list or by name.
InvariantsLike: TypeAlias = (
    Function | Invariants | Iterable[Function | Invariants] | Mapping[str, Function | Invariants]
)


def demanded_values(value: ArrayLike) -> Array:
    try:
        values = np.atleast_1d(real_numbers("value of an invariant", value))
    except TypeError:
        raise TypeError(f"value of an invariant must be a number or an array of numbers, got {shown(value)}") from None
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"value of an invariant must be finite, of shape (m,) with m >= 1, got {shown(value)}")
    return values


def _names(names: object) -> list[str]:
    if isinstance(names, str):
        return [encodable(names)]
    listed = items(names)
    if listed is None or not all(isinstance(name, str) for name in listed):
        raise TypeError(f"names of invariants must be str, or a list of str, got {shown(names)}")
    if not listed:
        raise ValueError("names of an invariant must be one str for each of its values, got none; leave names out")
    return [encodable(name) for name in listed]


def _level(level: object) -> int:
    try:
        result = operator.index(level)  # type: ignore[arg-type]  # anything but an integer is caught here
    except TypeError:
        result = -1
    if not 0 <= result <= LARGEST_INT:
        raise ValueError(f"level of an invariant must be an integer from 0 to {LARGEST_INT}, got {shown(level)}")
    return result


def _direction(direction: object) -> Literal["gradient", "stages"]:
    if isinstance(direction, str) and direction == "relaxation":
        raise ValueError(
            'direction of an invariant cannot be "relaxation", which changes the length of a step, so that it misses '
            'times of output, events and the end of the interval, and which keeps only one invariant: use "stages", '
            "whose corrections include that direction, and which keeps linear invariants too"
        )
    return cast("Literal['gradient', 'stages']", choice("direction", direction, ("gradient", "stages")))


def _metric(metric: object) -> Any:
    if callable(metric) or is_native(metric):
        return metric
    constant = real_numbers("metric of an invariant", metric)
    if constant.ndim not in (1, 2) or constant.shape != constant.shape[:1] * constant.ndim or constant.size == 0:
        raise ValueError(f"metric of an invariant must have shape (k,) or (k, k), got {constant.shape}")
    if not np.isfinite(constant).all():
        raise ValueError("metric of an invariant must be finite")
    return constant


def _components(moves: object) -> list[int]:
    listed = items(moves)
    try:
        indices = [operator.index(index) for index in listed]  # type: ignore[union-attr]  # likewise
    except TypeError:
        raise TypeError(f"moves must be a list of indices of components of y, got {shown(moves)}") from None
    if not indices or min(indices) < 0 or len(set(indices)) < len(indices):
        raise ValueError(f"moves must list different components of y, from 0 on, got {shown(moves)}")
    return indices


#: The attributes of invariants that state nothing besides their function.
_DEFAULTS: Mapping[str, Any] = vars(Invariants(lambda t, y: 0.0))


def to_invariants(invariants: object) -> list[Invariants]:
    """The argument `invariants` as a list: a function, an Invariants, or several of these, in a list or by name."""
    if invariants is None:
        return []
    if isinstance(invariants, Invariants):
        return [invariants]
    if is_native(invariants):
        return [Invariants.plain(invariants)]
    if callable(invariants):
        return [Invariants(cast("Callable[..., Any]", invariants))]
    if isinstance(invariants, Mapping):
        return [_named(name, one) for name, one in invariants.items()]
    listed = None if isinstance(invariants, (str, bytes)) else items(invariants)
    if listed is not None:
        with suppress(RecursionError):
            return [one for item in listed for one in to_invariants(item)]
    raise TypeError(
        f"invariants must be a function g(t, y), an Invariants, or a list or dict of these, got {shown(invariants)}"
    )


def _named(name: object, given: object) -> Invariants:
    """An entry of a dict of invariants: the function or Invariants with its key as its name."""
    if not isinstance(name, str):
        raise TypeError(f"the keys of a dict of invariants are their names, str, got {shown(name)}")
    try:
        (one,) = to_invariants(given)
    except (TypeError, ValueError):
        raise TypeError(
            f"in a dict of invariants {shown(name)} must be a function g(t, y) or an Invariants, got {shown(given)}"
        ) from None
    if one.names is not None:
        raise ValueError(f"the invariant {shown(name)} of the dict has names of its own: {', '.join(one.names)}")
    named = copy.copy(one)
    named.names = _names(name)
    return named


@naming_arguments
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
