"""The native core. Private: `invariode` is the interface."""

from collections.abc import Sequence
from typing import Annotated

import numpy
from numpy.typing import NDArray


class Dense:
    @staticmethod
    def from_parts(*, t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], end: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], offset: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], data: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], m: int, interpolation: str, extension: str, rtol: float, threshold: float | Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], scale: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, complex: bool) -> Dense:
        """What `parts` gave, put together again."""

    def parts(self) -> dict:
        """What it consists of: arrays, numbers and names."""

    def evaluate(self, t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], *, invariants: Sequence[tuple[object, object, int, str, bool]], value: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], args: tuple, parameters: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
        """y at each t: (len(t), n)."""

    def joined(self, next: Dense) -> Dense:
        """This and then `next`, which starts where this ends."""

    def knots(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]: ...

class Native:
    """Machine code of the user, and what keeps it alive."""

    def __init__(self, *, address: int, event: bool, owner: object | None) -> None: ...

def capsule_address(capsule: object) -> int:
    """The pointer in a capsule."""

class Linear:
    """What is known of the Jacobian of f and of the mass matrix."""

    def __init__(self, *, structure: str, n: int, lower: int, upper: int, kind: str, jacobian: object | None, mass: object | None, null_basis: object | None, lapack: object | None) -> None: ...

    @property
    def algebraic(self) -> int:
        """
        Number of algebraic equations: the dimension of the left null space of M.
        """

class Run:
    """
    Results of `integrate`. Arrays are handed over: each `take_…` works once.
    """

    def take_points(self) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], float, Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')] | None]:
        """
        (t, y) of the points and of the end; the last is None where it is the last point.
        """

    def take_events(self) -> list[tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]]]: ...

    def take_steps(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]: ...

    def take_drift(self) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], float]: ...

    def take_jumps(self) -> list[tuple[int, float, Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]]]: ...

    @property
    def next_h(self) -> float: ...

    def take_dense(self) -> Dense | None: ...

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
    def pure_relative(self) -> bool: ...

    @property
    def event(self) -> int: ...

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
    def counts(self) -> tuple[int, int, int, int, int, int, int, int, int, int, int, int, int]:
        """Numbers, in the order of COUNTS."""

    @property
    def singular(self) -> bool: ...

    @property
    def undefined_jacobian(self) -> bool: ...

    @property
    def projected_start(self) -> bool: ...

    @property
    def derivatives(self) -> list[str]: ...

    @property
    def dropped(self) -> list[int]: ...

    @property
    def dropped_at(self) -> float: ...

    @property
    def harmed(self) -> int: ...

    @property
    def harm(self) -> float: ...

class EnsembleRun:
    """
    Results of `integrate_all`. Arrays are handed over: each `take_…` works once.
    """

    def take_t(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]: ...

    def take_end(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]: ...

    def take_y(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None, None), order='C')]: ...

    def take_drift(self) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]]: ...

    def take_counts(self) -> Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C')]: ...

    def take_states(self) -> Annotated[NDArray[numpy.int8], dict(shape=(None,), order='C')]: ...

    def take_events(self) -> list[tuple[Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]]]: ...

    def failures(self) -> list[tuple[int, Run]]:
        """(trajectory, Run that tells why it ended) of those that failed."""

COUNTS: tuple = ...

STATES: list = ...

def integrate_all(solvers: Sequence[Solver], y0: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], parameters: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], progress: object | None) -> EnsembleRun:
    """
    Integrates from each row of y0, on as many threads as there are solvers.
    """

class Solver:
    """A problem with a method: all that is known before the initial value."""

    def __init__(self, *, method: str, n: int, fun: object, args: tuple, t0: float, tf: float, complex: bool, rtol: float, threshold: float | Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], scale: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, max_step: float, first_step: float, fsal: str, max_order: int, bdf: bool, linear: Linear | None, interpolation: str, refine: int, times: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, dense: bool, save_all: bool, record: bool, check: bool, events: Sequence[tuple[object, int, int, str, object, bool]], callback: object | None, invariants: Sequence[tuple[object, object, int, str, bool]], value: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], iterations: int, negligible: float, parameters: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> None: ...

    @property
    def native(self) -> bool:
        """Whether no function needs the interpreter."""

    def resume(self, seen: Sequence[int], asleep: Sequence[bool]) -> None:
        """
        Its runs go on from where another one ended, with so many occurrences of each event.
        """

    def integrate(self, y0: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], progress: object | None = None) -> Run:
        """
        Integrates from (t0, y0). progress(t, h) is called at most ten times a second, and at the end.
        """

class Stepper:
    """A run that is advanced step by step."""

    def __init__(self, solver: object, y0: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> None:
        """Starts at (t0, y0)."""

    def step(self) -> None:
        """Goes on by one accepted step, if it can: see `state`."""

    def interpolant(self) -> Dense:
        """The continuous solution over the last step."""

    def result(self) -> Run:
        """Why the run ended, and its counts."""

    @property
    def state(self) -> str: ...

    @property
    def t(self) -> float: ...

    @property
    def y(self) -> Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')]: ...

    @property
    def h(self) -> float:
        """|h| that the next step will try."""

    @property
    def order(self) -> int: ...

    @property
    def nfev(self) -> int: ...

    @property
    def njev(self) -> int: ...

    @property
    def nlu(self) -> int: ...

def consistent_start(*, fun: object, args: tuple, t0: float, y0: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], complex: bool, rtol: float, threshold: float | Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], scale: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, linear: Linear, parameters: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C')], str]:
    """
    y0 with the algebraic equations of a singular mass matrix satisfied, and the verdict.
    """

def impose(t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], *, complex: bool, rtol: float, threshold: float | Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], scale: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, invariants: Sequence[tuple[object, object, int, str, bool]], value: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], args: tuple, parameters: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> tuple[Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C')], Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C')]]:
    """
    Projects each row of y to roundoff: (y, converged, residual, iterations).
    """

def distance(t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], *, complex: bool, rtol: float, threshold: float | Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], scale: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, invariants: Sequence[tuple[object, object, int, str, bool]], value: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], args: tuple, parameters: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
    """
    Distances of each row of y from the level sets, in units of rtol: (len(t), m).
    """

def examine(*, fun: object, args: tuple, t: float, y: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], complex: bool, rtol: float, threshold: float | Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], scale: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, invariants: Sequence[tuple[object, object, int, str, bool]], value: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], parameters: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> object:
    """How each invariant stands at one point."""

def residual(t: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], y: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], *, complex: bool, invariants: Sequence[tuple[object, object, int, str, bool]], value: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], args: tuple, parameters: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')]:
    """g(t, y) - value of each row of y: (len(t), m)."""
