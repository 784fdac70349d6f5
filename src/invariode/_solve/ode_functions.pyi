"""Generated from METHODS and the table of options: `make stubs`."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any
from numpy.typing import ArrayLike
from .._base.arguments import Array
from .._base.types import BreakpointsLike, EventsLike, Fsal, Function, Interpolation, Keep, Numbers, OnFailure, OnInterrupt, Span
from .._problem.grouped import CheckpointLike, Limits, LinearSolver
from .._problem.invariants import InvariantsLike
from .._results.solution import Solution

__all__ = ["ode23", "ode45", "dop853", "ode78", "ode89", "ode113", "ode15s", "ode23s", "ode23t", "ode23tb", "radau", "auto"]

def ode23(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode45(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def dop853(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode78(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode89(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode113(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode15s(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode23s(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode23t(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def ode23tb(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def radau(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
def auto(
    fun: Function, t_span: Span, y0: ArrayLike, *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events:
    EventsLike = ..., invariants: InvariantsLike | None = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., bounds: Any = ..., mass: Any = ..., breakpoints: BreakpointsLike | None = ..., jac: Any
    = ..., jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: float | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool = ..., max_order: int | None = ..., bdf: bool | None = ...,
    prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ...,
    interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: bool = ..., max_steps: int | None = ..., limits: Limits | None = ..., checkpoint:
    CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure = ...
) -> Solution: ...
