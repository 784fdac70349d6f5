"""Steppers, which advance a problem one step at a time: the base of the classes in `invariode.scipy`."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Unpack

from numpy.typing import ArrayLike
from scipy.integrate import DenseOutput, OdeSolver

from .._base.arguments import ATOL, RTOL, Array, flag
from .._base.types import LargestStep, MethodName, Numbers
from .._plan.planning import make_plan
from .._plan.walk import Walk
from .._problem.docstrings import documented
from .._problem.given_options import parted, unknown_option, unused
from .._problem.options import TABLE, DescribingOptions, Options, StepperOptions, table_of
from .._problem.problem import Problem
from .._results.result import DenseSolution
from .ivp import one_column

if TYPE_CHECKING:
    from .._problem.accepted import stepper_options

_OPTIONS = table_of(StepperOptions)


class _Interpolant(DenseOutput):
    """The solution over one step, as `invariode.DenseSolution` has it; it outlives its solver."""

    def __init__(self, t_old: float, t: float, solution: DenseSolution) -> None:
        super().__init__(t_old, t)
        self._solution = solution

    def _call_impl(self, t: Array) -> Array:
        return self._solution(t)


@documented(options=_OPTIONS)
class Stepper(OdeSolver):
    """Advances an initial value problem step by step.

    Parameters
    ----------
    fun : callable
        ``fun(t, y)``, the derivative, of shape (n,).
    t0, t_bound : float
        Start and end; ``t_bound`` may be infinite.
    y0 : array_like of shape (n,)
        Initial state, real or complex.
    max_step, rtol, atol, first_step, vectorized : optional
        As in `invariode.solve_ivp`, in the order of `scipy.integrate.RK45`.

    Other Parameters
    ----------------
    {options}

    Attributes
    ----------
    t, y, t_old, step_size, status, direction, n, t_bound, nfev, njev, nlu
        As in `scipy.integrate.OdeSolver`. `nfev` counts all evaluations by the method.
    order : int
        Order of the last step.
    h : float
        Size of the next step to be tried.

    Raises
    ------
    TypeError, ValueError
        Wrong arguments; an unknown option.
    InvariantError
        At the start, y0 is off a demanded value, a Jacobian is wrong, or an invariant is not conserved.

    Notes
    -----
    Invariants are called as ``g(t, y)``: SciPy's solve_ivp passes `args` only to `fun`, `jac` and events.
    """

    _method: ClassVar[MethodName]

    def __init__(
        self,
        fun: Callable[..., Any],
        t0: float,
        y0: ArrayLike,
        t_bound: float,
        max_step: LargestStep = math.inf,
        rtol: Numbers = RTOL,
        atol: Numbers = ATOL,
        vectorized: bool = False,
        first_step: float | None = None,
        **options: Unpack[StepperOptions],
    ) -> None:
        if wrong := next((name for name in options if name not in _OPTIONS), None):
            raise self._refused(wrong)
        if TYPE_CHECKING:
            stepper_options(**options)  # editors complete options from this call
        describing, stepping = parted(options, DescribingOptions)
        if describing.get("sensitivities"):
            raise ValueError(f"{type(self).__name__} steps y alone: sensitivities are those of solve_ivp and Problem")
        unused(self._method, describing)
        # The user's own function, not SciPy's wrapper of it, which refers to this object and would count calls twice.
        alone = one_column(fun, describing) if flag("vectorized", vectorized) else fun
        problem = Problem(alone, (t0, t_bound), y0, **describing)
        alone = problem.fun if problem.inplace else alone
        super().__init__(alone, t0, problem.y0, t_bound, False, support_complex=True)
        given: Options = stepping
        given |= {"max_step": max_step, "rtol": rtol, "atol": atol, "first_step": first_step, "keep": "end"}
        plan = make_plan(problem, self._method, given)
        self._walk = Walk(plan, plan.y0)
        self.y = self._walk.y
        self._count()

    @classmethod
    def _refused(cls, name: str) -> TypeError:
        if name in TABLE:
            return TypeError(f"{name} is an option of solve_ivp, not of {cls.__name__}")
        return unknown_option(name, (*_OPTIONS, "max_step", "rtol", "atol", "first_step", "vectorized"))

    def _step_impl(self) -> tuple[bool, str | None]:
        walk = self._walk
        if walk.state == "running":
            walk.step()
            self._count()
        elif walk.state == "interrupted":
            raise RuntimeError(
                "a function raised an exception in an earlier step: start a new solver from the last t and y"
            )
        if walk.state not in ("running", "reached_end"):
            return False, walk.failure[1]
        self.t, self.y = walk.t, walk.y
        return True, None

    def _dense_output_impl(self) -> _Interpolant:
        if self.status == "failed":
            raise RuntimeError("a failed step has no dense output: use that of the last accepted step")
        solution = self._walk.over_last_step()
        self._count()  # the extension may take evaluations of its own
        return _Interpolant(self.t_old, self.t, solution)

    @property
    def order(self) -> int:
        return self._walk.core.order

    @property
    def h(self) -> float:
        return self._walk.core.h

    def _count(self) -> None:
        core = self._walk.core
        self.nfev, self.njev, self.nlu = core.nfev, core.njev, core.nlu
