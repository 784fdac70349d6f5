"""The native core. Private: `invariode` is the interface."""

from collections.abc import Sequence
from typing import Annotated

import numpy
from numpy.typing import NDArray


def all_finite(values: object) -> bool:
    """
    Return whether all numbers of a contiguous array of float64 or complex128 are finite.
    """

def plainly_posed(t_span: object, y0: object, args: object) -> tuple[tuple[float, float], numpy.ndarray, tuple[object, ...]] | None:
    """
    The three as a problem has them, where they are floats, lists and tuples of these, and arrays of float64; otherwise None.
    """

def plain_times(times: object, t0: float, tf: float) -> numpy.ndarray | None:
    """
    A new array of such times, if they are in order and within the interval; otherwise None.
    """

def plain_course(times: object) -> tuple[numpy.ndarray, tuple[float, float]] | None:
    """
    A new array of such times, with the first and the last, if they rise or fall strictly; otherwise None.
    """

def plain_breakpoints(times: object, t0: float, tf: float, ends: bool) -> numpy.ndarray | None:
    """
    A new array of such finite times, in any order, with those from t0 to tf in the order of integration; `ends`: whether those at the ends too. Otherwise None.
    """

def plain_options(options: object) -> tuple[object, ...] | None:
    """
    Names, values and types of options that cannot change, and whether there are times of output and breakpoints without actions; otherwise None.
    """

class PiecewisePolynomial:
    """Functions of t that are polynomials between times."""

    def __init__(self, times: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], coefficients: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], degree: int, size: int) -> None: ...

    def evaluate(self, t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
        """(len(t), size)"""

    def at(self, t: float) -> float:
        """The one value at t."""

class StepLimit:
    """
    A callback that stops one run after so many steps between two times of its output.
    """

    def __init__(self, times: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], most: int) -> None: ...

    def __call__(self, t: float, y: object) -> bool: ...

class Native:
    """Machine code of the user, and what keeps it alive."""

    def __init__(self, *, address: int, event: bool, owner: object | None, inputs: Sequence[PiecewisePolynomial] = []) -> None: ...

    @property
    def address(self) -> int: ...

class StateFirst:
    """A Python function of (y, t, ...) as one of (t, y, ...)."""

    def __init__(self, fun: object) -> None: ...

    def __call__(self, t: object, y: object, /, *args: object) -> object: ...

    @property
    def __wrapped__(self) -> object:
        """The function as it was given."""

class Filling:
    """A Python function of (t, y, out, ...) that writes its values to out."""

    def __init__(self, fun: object) -> None: ...

    @property
    def __wrapped__(self) -> object:
        """The function as it was given."""

class SecondOrder:
    """f of (t, q) with y'' = f(t, y), as y' of (q, v)."""

    def __init__(self, fun: object) -> None: ...

    @property
    def fun(self) -> object: ...

class Series:
    """Machine code for Taylor coefficients, and what keeps it alive."""

    def __init__(self, *, address: int, order: int, owner: object | None) -> None:
        """
        void (double t, double unit, const double* in, double* out, const double* p) writes the coefficients in s at t + unit s of the powers 0 ... order: of a system from y (n,), (order + 1, n); of a function g of m values from those of y, (order + 1, m).
        """

    @property
    def order(self) -> int: ...

def capsule_address(capsule: object) -> int:
    """The pointer in a capsule."""

def solve_addresses() -> tuple[int, int]:
    """
    Addresses of functions (k, m, numbers) and (k, m, entries, places, numbers) that solve a linear system in place, for generated code.
    """

class Dense:
    """The continuous solution of a run."""

    @staticmethod
    def from_parts(*, t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], end: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], offset: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], data: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], m: int, interpolation: str, extension: str, rtol: float, threshold: float | Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], scale: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, complex: bool, lower: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None = None, upper: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None = None, parameters: int = 0) -> Dense:
        """Rebuild the continuous solution from the result of `parts`."""

    def parts(self) -> dict:
        """Return the contents as arrays, numbers and names."""

    def evaluate(self, t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], problem: object | None) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
        """
        y at each t: (len(t), n); projected, where it projects, onto the invariants of `problem`. With sensitivities Y, (len(t), (1 + k) n).
        """

    def joined(self, next: Dense) -> Dense:
        """This and then `next`, which starts where this ends."""

    @property
    def n(self) -> int:
        """Reals in a state."""

    @property
    def parameters(self) -> int:
        """Number of parameters with sensitivities."""

    @property
    def complex(self) -> bool: ...

    def knots(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]: ...

class Run:
    """
    Results of `integrate`. Arrays are handed over: each `take_…` works once.
    """

    def take_points(self) -> tuple[numpy.ndarray, numpy.ndarray]:
        """(t, y) of the points, y of shape (n, n_t)."""

    @property
    def end(self) -> numpy.ndarray:
        """y at the end."""

    def take_events(self) -> list[tuple[numpy.ndarray, numpy.ndarray]]: ...

    def record(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
        """The accepted steps, in rows that belong to the run."""

    @property
    def drift(self) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], float]: ...

    @property
    def jumps(self) -> list[tuple[int, float, Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]]]: ...

    @property
    def value(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]: ...

    def put_into(self, items: dict) -> None:
        """
        Sets `t` and `y`, handed over as by `take_points`, the counts `nfev`, `njev` and `nlu`, and `t_end` among the items of a solution.
        """

    def take_dense(self) -> Dense | None: ...

    def take_sections(self) -> list[tuple[int, float, bytes]]:
        """
        (accepted steps before, t, memory for `Solver.resume`) of each section.
        """

    @property
    def state(self) -> str: ...

    @property
    def t(self) -> float: ...

    @property
    def h(self) -> float: ...

    @property
    def cause(self) -> str: ...

    @property
    def component(self) -> int: ...

    @property
    def coefficient(self) -> int | None: ...

    @property
    def pure_relative(self) -> bool: ...

    @property
    def fastest(self) -> tuple[int, float, float] | None: ...

    @property
    def undefined_below_zero(self) -> tuple[int, float, float] | None: ...

    @property
    def singular(self) -> bool: ...

    @property
    def unsolved(self) -> str: ...

    @property
    def unsolved_t(self) -> float: ...

    @property
    def undefined_mass(self) -> bool: ...

    @property
    def undefined_jacobian(self) -> bool: ...

    @property
    def event(self) -> int: ...

    @property
    def circle(self) -> list[int]: ...

    @property
    def limit(self) -> str: ...

    @property
    def steps_to_limit(self) -> int: ...

    @property
    def seconds_to_limit(self) -> float: ...

    @property
    def finding(self) -> str: ...

    @property
    def finding_invariant(self) -> int: ...

    @property
    def finding_component(self) -> int: ...

    @property
    def finding_t(self) -> float: ...

    @property
    def finding_size(self) -> float: ...

    @property
    def finding_distance(self) -> float: ...

    @property
    def counts(self) -> tuple[int, int, int, int, int, int, int, int, int, int, int, int, int, int, int, int, int, int, int, int]:
        """Numbers, in the order of COUNTS."""

    @property
    def steps(self) -> int: ...

    @property
    def t_end(self) -> float: ...

    @property
    def correction(self) -> float: ...

    @property
    def nfev(self) -> int: ...

    @property
    def njev(self) -> int: ...

    @property
    def nlu(self) -> int: ...

    @property
    def projected_start(self) -> bool: ...

    @property
    def derivatives(self) -> list[str]: ...

    @property
    def left_complex_steps(self) -> float: ...

    @property
    def enlargements(self) -> int: ...

    @property
    def misfit(self) -> tuple[str, float, int, int, int, int, float, float] | None: ...

    @property
    def pattern(self) -> tuple[int, int]: ...

    @property
    def dropped(self) -> list[int]: ...

    @property
    def unresolved(self) -> list[float]: ...

    @property
    def dropped_at(self) -> float: ...

    @property
    def harmed(self) -> int: ...

    @property
    def harm(self) -> float: ...

    @property
    def stiff(self) -> bool: ...

    @property
    def stiff_since(self) -> float: ...

    @property
    def remarkable(self) -> bool: ...

    @property
    def below_zero(self) -> tuple[int, float, float] | None: ...

    @property
    def ordinary(self) -> bool:
        """
        True if the state of the run describes its end, and nothing else is to be reported.
        """

    @property
    def told(self) -> tuple[bool, bool, bool]:
        """
        True for each remark made during the run: it is stiff, f is discontinuous, the solution sticks.
        """

    @property
    def sticks_since(self) -> float | None: ...

    @property
    def accumulation(self) -> tuple[int, float, float, int] | None:
        """
        Event whose actions come closer and closer until it is passed: its number, the last t, the interval before it, and the number of actions.
        """

    @property
    def marks(self) -> list[float]: ...

    @property
    def discontinuities(self) -> list[float]: ...

    @property
    def clipped(self) -> float: ...

    @property
    def next_h(self) -> float: ...

    @property
    def memory(self) -> bytes:
        """
        Internal state of the run, for `Solver.resume`; empty if it cannot be resumed.
        """

def integrate_all(solvers: Sequence[Solver], y0: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], parameters: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], progress: object | None, lanes: tuple[str, Sequence[int]] | None = None, tolerances: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None = None, request: StopRequest | None = None) -> dict:
    """
    Integrates from each row of y0, on as many threads as there are solvers. lanes: the name of an instruction set and where the code of the functions is in its lanes: of f, the slope of sensitivities, of an invariant g, its Jacobian and its tangent, of events. tolerances: absolute ones of the sensitivities, in rows. A `request` cancels the trajectories that are not solved yet, whose states are then the last one. Returns by name: arrays with a row for each trajectory; events, (trajectory, t, y) of each; failures, pairs of a trajectory and a Run that tells why it ended; alone, the numbers of trajectories that the lanes left to scalar code, by cause: a value that is not finite or a step too short, stability, the invariant, an event or output inside a step, max_steps, and too many left. stiff_since, discontinuity, and accumulation, after which actions of an event are missing because they came ever closer together: times, or NaN where this did not happen.
    """

def instruction_sets() -> list[tuple[str, int]]:
    """(name, lanes) of each that this processor has, the best first."""

class StopRequest:
    """A wish to end a run."""

    def __init__(self) -> None: ...

    def make(self) -> None:
        """From any thread, or in a handler of signals."""

class Solver:
    """A problem with a method: all that is known before the initial value."""

    def __init__(self, method: str, problem: object, tolerances: object, course: object, settings: object) -> None:
        """From a CoreProblem, Weights, a Course and Settings."""

    def integrate_anew(self, y0: object, functions: object | None, args: object, parameters: object | None, course: object, breakpoints: object | None, limit: StepLimit | None, remember: bool, remarks: object | None, value: object | None, tolerances: object | None) -> Run | None:
        """
        Integrates from y0 on another course (t0, tf, max_step, times, max_points, max_bytes), with other arguments. functions: those in place of the Python functions that it was made with, in the order of their making, and with them breakpoints, without actions and in order, and another limit of steps; it keeps none of them. None: its own. parameters: of native functions, if `args` are not floats. remember: the run can be resumed. remarks: as in `integrate`. value: of the invariants; None: that at y0. tolerances: absolute ones of the sensitivities. Returns None if y0 is not finite, or something is not of the right size or type.
        """

    @property
    def native(self) -> bool:
        """True if no function needs the interpreter."""

    @property
    def members(self) -> tuple:
        """
        The names of the methods that make the steps: one, or the explicit and the implicit one that take turns.
        """

    @property
    def obstacle_to_lanes(self) -> str | None:
        """Reason why trajectories cannot be integrated in SIMD lanes, or None."""

    def lanes(self, instructions: str) -> int:
        """
        Return the number of trajectories that are integrated at once in SIMD lanes.
        """

    @property
    def motion_work(self) -> object:
        """
        Work of a mechanical system so far: calls of its functions and factorisations.
        """

    def integrate(self, y0: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], progress: object | None = None, request: StopRequest | None = None, keep: object | None = None, every: float = 0.0, remarks: object | None = None) -> Run:
        """
        Integrates from (t0, y0). progress(t, h) is called at most ten times a second, and at the end. `request` ends the run after the step in which it is made. keep(part) is called at the start, after `every` seconds, and at the end, with a Run of what has come since the last time. remarks(stiff_since, discontinuities, sticks_since) is called once a second if there is something new, and when the run is interrupted.
        """

    def resume(self, memory: bytes, anew: bool, progress: object | None = None, request: StopRequest | None = None, keep: object | None = None, every: float = 0.0, remarks: object | None = None) -> Run:
        """
        Goes on from the `Run.memory` of a run of the same problem. `anew`: the method starts again.
        """

class Stepper:
    """A run that is advanced step by step. Threads take turns."""

    def __init__(self, solver: object, y0: object) -> None:
        """Starts at (t0, y0)."""

    def restart(self, t0: float, tf: float, y0: object, first_step: float) -> None:
        """
        Starts again at (t0, y0), with the end tf; first_step: 0 if the method is to choose it. The run must not have times of output.
        """

    def step(self) -> None:
        """Goes on by one accepted step, if it can: see `state`."""

    def advance(self, t: float, most: int) -> int:
        """
        Goes on by accepted steps, at most so many, until t is reached or passed or the run has ended. Returns how many steps it has made.
        """

    def interpolant(self) -> Dense:
        """The continuous solution over the last step."""

    def at(self, t: float, problem: object | None) -> numpy.ndarray | None:
        """
        y at a time within the last step, of a run that has not ended, projected as by `Dense.evaluate`; None: t is not within it.
        """

    def result(self) -> Run:
        """Return the result of the run so far, and why it ended, if it has."""

    @property
    def state(self) -> str: ...

    @property
    def t(self) -> float: ...

    @property
    def t_old(self) -> float:
        """Time at which the last accepted step began."""

    @property
    def y(self) -> numpy.ndarray:
        """A new array."""

    @property
    def h(self) -> float:
        """|h| that the next step will try."""

    @property
    def order(self) -> int: ...

    @property
    def remarkable(self) -> bool:
        """
        True if the steps have shown harm by projection, a fall below 0, stiffness or a discontinuity.
        """

    @property
    def nfev(self) -> int: ...

    @property
    def nfev_check(self) -> int: ...

    @property
    def njev(self) -> int: ...

    @property
    def nlu(self) -> int: ...

MEMORY_VERSION: int = 14

STATES: list = ...

COUNTS: tuple = ...

def residual(t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], problem: object) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
    """g(t, y) - value of each row of y: (len(t), m)."""

def distance(t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], problem: object, tolerances: object) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
    """
    Distances of each row of y from the level sets, in units of rtol: (len(t), m).
    """

def impose(t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], problem: object, tolerances: object) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C')]]:
    """
    Projects each row of y to roundoff: (y, converged, residual, iterations).
    """

def examine(t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], problem: object, tolerances: object) -> dict | None:
    """
    Examine each invariant at one point; None where g, its Jacobian or f is not finite there.
    """

def consistent_start(t0: float, y0: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], problem: object, tolerances: object) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], str]:
    """
    y0 with the algebraic equations of a singular mass matrix satisfied, and the verdict.
    """

def jacobian(t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], problem: object, tolerances: object) -> tuple[Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]]:
    """
    The Jacobian of f at a point, as an implicit method begins with it: (rows, columns, values).
    """

def sparsity(t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], problem: object, most_calls: int, sparse_only: bool) -> tuple[tuple[Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C')]] | None, int, int]:
    """
    (starts, rows) of the pattern of the Jacobian of f near a point, or None if it is not sparse or f may not be evaluated more often; the evaluations of f; those that differences take with it.
    """

class MotionPart:
    """
    A function of (t, y) that a mechanical system has: its slope, one of its laws.
    """

    def __init__(self, mechanics: object, part: str) -> None:
        """mechanics: a MechanicsTerms."""

class Differentiable:
    """A function of t and x with its arguments, and its derivatives."""

    def __init__(self, forms: object, name: str, n_q: int, n_v: int, m: int, args: tuple, parameters: Sequence[float]) -> None: ...

    def value(self, t: float, x: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]:
        """Return the values at (t, x), of shape (m,)."""

    def complex_value(self, z: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]:
        """Return the complex form at (t, x); complex numbers are pairs of reals."""

    def slope(self, t: float, x: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], dt: float, dx: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]:
        """d/ds at (t + s dt, x + s dx), s = 0."""

    def curvature(self, t: float, x: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], dt: float, dx: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]:
        """d²/ds² of the same."""

    def jacobian(self, t: float, x: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], pattern: object) -> tuple:
        """∂/∂x, as (starts, rows, values) in the pattern of such a matrix."""

class Motion:
    """The equations of motion of a mechanical system with its arguments."""

    def __init__(self, mechanics: object, args: tuple, parameters: Sequence[float]) -> None: ...

    def evaluate(self, part: str, t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]:
        """One of its functions of (t, y); matrices row by row."""

    def rows(self, t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> tuple:
        """A, as (starts, rows, values), and γ of A v' = γ."""

    def mass(self, t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> tuple:
        """M, as (starts, rows, values)."""

    def accelerations(self, t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], bool]:
        """v', λ, and whether they are unique."""

    @property
    def sparse(self) -> bool:
        """True if sparse factors are tried first."""

    @property
    def work(self) -> dict:
        """Calls of functions and factorisations so far."""

def solve_saddle(mass: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], rows: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], force: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], right: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], threshold: float) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], int, bool]:
    """
    a and λ of M a = Q + Aᵀ λ, A a = γ; the rank of A; whether a is unique (else it is NaN).
    """

class Quadratic:
    """
    Sums of products of two components, or their Jacobian, as a function of the core.
    """

    def __init__(self, n: int, terms: int, first: Sequence[int], second: Sequence[int], gradient: bool) -> None: ...

def methods() -> list[dict]:
    """The registry of methods: the fields of each, by name."""
