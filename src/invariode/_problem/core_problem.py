"""Records of which the core reads a problem: it takes their fields by their names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .._base.arguments import Array
from .._functions.layout import ArgumentLayout
from .bounds import Bounds
from .breakpoints import Breakpoint


class InvariantSpec(NamedTuple):
    """An invariant."""

    fun: Any
    jac: Any  # a function, or how the Jacobian is computed without one
    m: int  # number of its values
    name: str
    held: bool  # at its initial value; False: at one that was demanded
    level: int = 0
    moves: Sequence[int] = ()  # the reals of y that its correction may move; none: all
    metric: Any = None  # in which its correction is smallest: a function, or flat values
    metric_size: int = 0  # number of its values
    sense: int = 0  # -1: it never rises as t grows; 1: it never falls; 0: it keeps its value
    along_steps: bool = False  # its correction is along the stages of the step
    starts: Sequence[int] = ()  # where the entries of each row of a sparse `jac` begin; none: it has all entries
    columns: Sequence[int] = ()  # the components to which these entries belong
    users: bool = False  # `jac` is the user's function: where it returns NaN, the solution stops


class EventSpec(NamedTuple):
    """An event."""

    fun: Any  # None: a component of a vector
    terminal: int  # the occurrence that ends the integration, 0 for none
    direction: int
    name: str
    action: Any
    rehold: bool
    samples: int = 0  # points inside a step; 0: the usual number, -1: adaptive
    series: Any = None  # along polynomials, for methods whose steps are such
    touching: bool = False  # zeros without a change of sign are reported too
    at_jumps: bool = True  # it occurs where jumps change its sign


class VectorSpec(NamedTuple):
    """The functions of a `Roots`; they are events from number `first` on."""

    fun: Any
    first: int
    size: int
    name: str
    action: Any


class LinearTerms(NamedTuple):
    """Known properties of the Jacobian of f and of the mass matrix."""

    structure: str  # of the Jacobian
    n: int
    lower: int
    upper: int
    kind: str  # of the Jacobian
    jacobian: Any  # its values or its function, with the pattern of a sparse one; for sparse differences the pattern
    mass: Any  # None, the values of a constant one, or M(t)
    null_basis: tuple[Array, Array, Array]  # of M from the left: (starts, rows, values)
    lapack: Any  # None, or a function that returns capsules by name
    found_pattern: int = 0  # evaluations of f that found the pattern; 0: it was given
    rate: Any = None  # ∂f/∂t
    product: Any = None
    preconditioner: Any = None
    dimension: int = 0  # of the Krylov space

    @property
    def algebraic(self) -> int:
        """Number of algebraic equations: the dimension of the left null space of M."""
        return len(self.null_basis[0]) - 1


class VariationTerms(NamedTuple):
    """Sensitivities to k parameters, with which a run integrates Y of shape (1 + k, n): y, then dy/dp_j. A list of
    functions is empty where none is needed.

    With delays, the delayed values stand behind y after in jumps, which return (2 k, n): S after, then a row for each
    parameter that begins with the derivative of the time of the jump; and events that do not act have one too."""

    k: int
    slope: Any  # (t, Y) -> (k, n): J S_j + f_pj
    thresholds: Array  # (k, n), absolute tolerances of S
    invariants: Sequence[Any] = ()  # for each (t, Y) -> (k, m): G S_j + g_pj
    events: Sequence[Any] = ()  # for each (t, Y before, y after) -> S after, (k, n), or None if it does not act
    breakpoints: Sequence[Any] = ()  # for each such a function
    landings: Any = None  # such a function for all landings
    error_test: bool = True  # False: S has no part in the error test
    quadratures: bool = False  # the slope is a function of (t, y) alone, and M the identity for S


class DelayTerms(NamedTuple):
    """Constant delays."""

    lags: Sequence[float]
    parameters: Sequence[int]  # of each delay its number among the parameters, or -1
    constant: Array | None  # the history, if it is constant
    history: Any  # otherwise a function (t, y, *args) -> y
    jumps: Sequence[float]  # times before t0 at which it jumps
    rates: Sequence[float]  # derivatives for the parameters of sensitivities, one row for each delay
    varied: int = 0  # the number k of these, if the history returns (1 + k, n), y and its derivatives


class MechanicsTerms(NamedTuple):
    """A mechanical system, except its arguments."""

    n_q: int
    n_v: int
    m_phi: int
    m_psi: int
    functions: dict[str, Any]  # mass, force, jacobian; constraints, velocity_constraints, kinematics with derivatives
    mass_writes: str
    mass: Any
    jacobian_entries: bool
    phi: Any  # patterns of Jacobians
    psi: Any
    kinematics: Any
    kept: Sequence[bool]  # constraints that are imposed
    sparse: bool
    dependent: float


class CoreProblem(NamedTuple):
    """A problem, except its initial value."""

    n: int  # reals that make up y
    complex: bool
    fun: Any
    args: tuple[Any, ...]
    parameters: ArgumentLayout = ArgumentLayout()  # `args` for native functions
    linear: LinearTerms | None = None
    events: Sequence[EventSpec] = ()
    vectors: Sequence[VectorSpec] = ()
    breakpoints: Sequence[Breakpoint] = ()
    landings: tuple[Any, Any, Any] = ((), (), ())  # single times in order; first times and periods of progressions
    callback: Any = None
    invariants: Sequence[InvariantSpec] = ()
    value: Array = np.zeros(0)  # at which they are held
    bounds: Bounds | None = None  # of y
    signed_states: bool = False  # none that falls below 0 is reported
    autonomous: bool = False  # f does not depend on t
    variations: VariationTerms | None = None
    series: Any = None  # of the solution, for methods by series
    conditions: Any = None  # `condition_count` values along it; one changes its sign where f changes its branch
    condition_count: int = 0
    delays: DelayTerms | None = None
