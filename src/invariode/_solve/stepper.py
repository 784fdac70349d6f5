"""One step at a time: the base of the classes in `invariode.scipy`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Unpack

from numpy.typing import ArrayLike
from scipy.integrate import DenseOutput, OdeSolver

from .. import _core
from .._base.arguments import ATOL, RTOL, Array, flag, warn
from .._base.types import Numbers
from .._functions.compiled import is_native
from .._problem.accepted import stepper_options
from .._problem.description import Description
from .._problem.docstrings import documented
from .._problem.invariants import AccuracyWarning
from .._problem.options import (
    TABLE,
    DescribingOptions,
    Options,
    StepperOptions,
    parted,
    table_of,
    unknown_option,
    unused,
)
from .._results.messages import about_jumps_of_fun, harmful_projection, limited_by_stability
from .._results.result import DenseSolution, DiscontinuityWarning, StiffnessWarning, default_labels
from .._run.plan import make_plan, solver
from .ivp import one_column

_OPTIONS = table_of(StepperOptions)
#: Before this many steps nothing can be said about harm: one step in eight is examined.
FEW_STEPS = 64


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
        As in `invariode.solve_ivp`, in the order of `scipy.integrate.RK45`. `max_step` is a tenth of the interval by
        default here too; ``inf`` lifts that.

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

    _method: ClassVar[str]

    def __init__(
        self,
        fun: Callable[..., Any],
        t0: float,
        y0: ArrayLike,
        t_bound: float,
        max_step: float | None = None,
        rtol: Numbers = RTOL,
        atol: Numbers = ATOL,
        vectorized: bool = False,
        first_step: float | None = None,
        **options: Unpack[StepperOptions],
    ) -> None:
        if wrong := next((name for name in options if name not in _OPTIONS), None):
            raise self._refused(wrong)
        describing, stepping = parted(stepper_options(**options), DescribingOptions)
        if describing.get("sensitivities"):
            raise ValueError(f"{type(self).__name__} steps y alone: sensitivities are those of solve_ivp and Problem")
        unused(self._method, describing)
        # The user's own function, not SciPy's wrapper of it, which refers to this object and would count calls twice.
        alone = one_column(fun) if flag("vectorized", vectorized) and not is_native(fun) else fun
        problem = Description(alone, (t0, t_bound), y0, **describing)
        super().__init__(alone, t0, problem.y0, t_bound, False, support_complex=True)
        given: Options = stepping
        given |= {"max_step": max_step, "rtol": rtol, "atol": atol, "first_step": first_step, "keep": "end"}
        plan = make_plan(problem, self._method, given)
        # The matrices of the plan, which the garbage collector cannot look into, would keep what refers to this alive.
        self._plan = plan._replace(functions=plan.functions._replace(linear=None))
        self._stepper = _core.Stepper(solver(plan), plan.y0.view(float))
        if self._stepper.state in ("invariant_refused", "start_contradicts", "start_out_of_bounds"):
            raise self._plan.exception(self._stepper.result()) or AssertionError
        self.y = self._state()
        self._steps, self._warned, self._warned_stiff, self._warned_discontinuous = 0, False, False, False
        self._count()

    @classmethod
    def _refused(cls, name: str) -> TypeError:
        if name in TABLE:
            return TypeError(f"{name} is an option of solve_ivp, not of {cls.__name__}")
        return unknown_option(name, (*_OPTIONS, "max_step", "rtol", "atol", "first_step", "vectorized"))

    def _step_impl(self) -> tuple[bool, str | None]:
        if self._stepper.state == "running":
            self._stepper.step()
            self._count()
            self._watch_run()
        elif self._stepper.state == "interrupted":
            raise RuntimeError(
                "a function raised an exception in an earlier step: start a new solver from the last t and y"
            )
        if self._stepper.state not in ("running", "reached_end"):
            return False, self._plan.verdict(self._stepper.result())[1]
        self.t, self.y = self._stepper.t, self._state()
        return True, None

    def _watch_run(self) -> None:
        """One warning each, if projection does harm, if stability limits the steps, and if f jumps. A solver does not
        learn that a run ends before t_bound, so this is checked in steps 64, 128, 256, … too."""
        self._steps += 1
        if self._stepper.state == "running" and not (self._steps >= FEW_STEPS and self._steps.bit_count() == 1):
            return
        if not self._warned:
            self._watch_accuracy()
        since = self._stepper.stiff_since
        if since is not None and not self._warned_stiff:
            self._warned_stiff = True
            warn(f"{self._plan.method.name}: {limited_by_stability(since)}", StiffnessWarning)
        text = about_jumps_of_fun(self._stepper)
        if text and not self._warned_discontinuous:
            self._warned_discontinuous = True
            warn(f"{self._plan.method.name}: {text}", DiscontinuityWarning)

    def _watch_accuracy(self) -> None:
        harmed = self._stepper.harmed
        if harmed < 0 or self._stepper.state not in ("running", "reached_end"):
            return
        self._warned = True
        component = default_labels(len(self.y))[harmed // 2 if self._plan.functions.complex else harmed]
        distance = f"{self._stepper.harm:.2g} times its estimated errors"
        warn(harmful_projection(component, distance), AccuracyWarning)

    def _dense_output_impl(self) -> _Interpolant:
        if self.status == "failed":
            raise RuntimeError("a failed step has no dense output: use that of the last accepted step")
        dense = self._stepper.interpolant()
        self._count()  # the extension may take evaluations of its own
        return _Interpolant(self.t_old, self.t, DenseSolution(dense, self._plan.y0.dtype, self._plan.bound))

    @property
    def order(self) -> int:
        return self._stepper.order

    @property
    def h(self) -> float:
        return self._stepper.h

    def _state(self) -> Array:
        y: Array = self._stepper.y.view(self._plan.y0.dtype)
        return y

    def _count(self) -> None:
        self.nfev, self.njev, self.nlu = self._stepper.nfev, self._stepper.njev, self._stepper.nlu
