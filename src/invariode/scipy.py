"""The methods as classes of SciPy's: for `scipy.integrate.solve_ivp`, and for stepping by hand.

>>> from scipy.integrate import solve_ivp
>>> from invariode.scipy import ODE113
>>> def pendulum(t, y):
...     return [y[1], -np.sin(y[0])]
>>> def energy(t, y):
...     return y[1] ** 2 / 2 - np.cos(y[0])
>>> sol = solve_ivp(pendulum, (0, 50), [1.0, 0.0], method=ODE113, invariants=energy, dense_output=True)
>>> bool(abs(energy(0, sol.sol(12.3)) - energy(0, [1.0, 0.0])) < 1e-6)
True

>>> solver = ODE113(pendulum, 0, [1.0, 0.0], 50, invariants=energy)
>>> while solver.status == "running" and solver.y[0] > 0:
...     message = solver.step()
>>> bool(solver.dense_output()(solver.t_old)[0] > 0 >= solver.y[0])
True
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

from numpy.typing import ArrayLike
from scipy.integrate import DenseOutput, OdeSolver

from . import _core
from ._arguments import Array, flag, unknown_option
from ._types import Numbers
from .compiled import is_native
from .methods import find_method
from .problem import Problem, warn_unused
from .solution import DenseSolution
from .suite import one_column

__all__ = ["DOP853", "ODE15S", "ODE23", "ODE45", "ODE78", "ODE113"]

_DESCRIBING = ("invariants", "jac", "jac_sparsity", "lband", "uband", "mass")
_OPTIONS = (*_DESCRIBING, "interpolation", "fsal", "max_order", "bdf", "check", "min_step")

#: Options of `invariode.solve_ivp` that are the caller's business here.
_OF_THE_CALLER = ("events", "args", "t_eval", "dense_output", "refine", "callback", "save", "progress")


class _Interpolant(DenseOutput):
    """The solution over one step, as `invariode.DenseSolution` has it; it outlives its solver."""

    def __init__(self, t_old: float, t: float, solution: DenseSolution) -> None:
        super().__init__(t_old, t)
        self._solution = solution

    def _call_impl(self, t: Array) -> Array:
        return self._solution(t)


class _Solver(OdeSolver):
    """Advances an initial value problem step by step.

    Parameters
    ----------
    fun : callable
        ``fun(t, y)``, the derivative, of shape (n,).
    t0, t_bound : float
        Start and end; ``t_bound`` may be infinite.
    y0 : array_like of shape (n,)
        Initial state, real or complex.
    max_step, rtol, atol, first_step, vectorized
        As in `invariode.solve_ivp`. As there, `max_step` is a tenth of the interval by default; ``inf`` lifts that.
    invariants, jac, jac_sparsity, lband, uband, mass, interpolation, fsal, max_order, bdf, check : optional
        As in `invariode.solve_ivp`, too. Invariants are called ``g(t, y)``: the `args` of SciPy's solve_ivp reach its
        `fun`, `jac` and events only.

    Attributes
    ----------
    t, y, t_old, step_size, status, direction, n, t_bound, nfev, njev, nlu
        As in `scipy.integrate.OdeSolver`. `nfev` counts all evaluations by the method.
    order : int
        Of the last step.
    h : float
        Size of the next step to be tried.

    Raises
    ------
    TypeError, ValueError
        Arguments that are wrong; an option that is unknown.
    InvariantError
        y0 is off a demanded value, a Jacobian is wrong, or an invariant is none already at the start.
    """

    _method: ClassVar[str]

    def __init__(
        self,
        fun: Callable[..., Any],
        t0: float,
        y0: ArrayLike,
        t_bound: float,
        max_step: float | None = None,
        rtol: Numbers = 1e-3,
        atol: Numbers = 1e-6,
        *,
        vectorized: bool = False,
        first_step: float | None = None,
        **options: Any,
    ) -> None:
        for name in options:
            if name in _OF_THE_CALLER:
                raise TypeError(f"{name} is an option of solve_ivp, not of {type(self).__name__}")
            if name not in _OPTIONS:
                raise unknown_option(name, (*_OPTIONS, "max_step", "rtol", "atol", "first_step", "vectorized"))
        describing = {name: options.pop(name) for name in _DESCRIBING if name in options}
        method = find_method(self._method)[0]
        for name, given in list(describing.items()):
            if name in ("jac", "jac_sparsity", "lband", "uband") and name not in method.options:
                warn_unused(method, name, given)
        # The user's own function, not SciPy's wrapper of it, which refers to this object and would count calls twice.
        alone = one_column(fun) if flag("vectorized", vectorized) and not is_native(fun) else fun
        problem = Problem(alone, (t0, t_bound), y0, **describing)
        super().__init__(alone, t0, problem.y0, t_bound, False, support_complex=True)
        plan = problem.plan(
            self._method, max_step=max_step, rtol=rtol, atol=atol, first_step=first_step, save="end", **options
        )
        # The matrices of the plan, which the garbage collector cannot look into, would keep what refers to this alive.
        self._plan = replace(plan, solver={name: plan.solver[name] for name in ("rtol", "complex")})
        self._stepper = _core.Stepper(plan.solver_object(), plan.y0.view(float))
        if self._stepper.state == "invariant_refused":
            raise self._plan.exception(self._stepper.result()) or AssertionError
        self.y = self._state()
        self._count()

    def _step_impl(self) -> tuple[bool, str | None]:
        if self._stepper.state == "running":
            self._stepper.step()
            self._count()
        elif self._stepper.state == "interrupted":
            raise RuntimeError("a function raised in an earlier step: start a new solver from the last t and y")
        if self._stepper.state not in ("running", "reached_end"):
            return False, self._plan.verdict(self._stepper.result())[1]
        self.t, self.y = self._stepper.t, self._state()
        return True, None

    def _dense_output_impl(self) -> _Interpolant:
        if self.status == "failed":
            raise RuntimeError("there is no dense output of a step that failed")
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


class ODE23(_Solver):
    """The Bogacki-Shampine (2,3) pair, for crude tolerances."""

    _method = "ode23"


class ODE45(_Solver):
    """The Dormand-Prince (4,5) pair."""

    _method = "ode45"


class DOP853(_Solver):
    """The eighth-order pair DOP853, for tight tolerances and cheap f."""

    _method = "dop853"


class ODE78(_Solver):
    """Verner's (7,8) pair, for tight tolerances."""

    _method = "ode78"


class ODE113(_Solver):
    """Adams PECE formulas of order 1 to 12, for tight tolerances and costly f."""

    _method = "ode113"


class ODE15S(_Solver):
    """NDFs of order 1 to 5, for stiff problems and M y' = f."""

    _method = "ode15s"


for _class in (ODE23, ODE45, DOP853, ODE78, ODE113, ODE15S):
    _class.__doc__ = f"{_class.__doc__}\n{(_Solver.__doc__ or '').partition('.')[2]}"
del _class
