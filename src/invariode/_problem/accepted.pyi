"""Generated from the table of options: `make stubs`."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal
from numpy.typing import ArrayLike
from .._base.arguments import Array
from .._base.types import BreakpointsLike, EventsLike, Fsal, Interpolation, Keep, LargestStep, Numbers, OnFailure, OnInterrupt, Progress
from .delays import DelaysLike, HistoryLike
from .grouped import CheckpointLike, Limits, LinearSolver
from .invariants import InvariantsLike
from .sensitivities import SensitivitiesLike
from .options import AllOptions, EnsembleOptions, ExtensionOptions, Options, ProblemEnsembleOptions, SolveOptions, StepperOptions

__all__ = ["ensemble_options", "extension_options", "problem_ensemble_options", "run_options", "solve_options", "stepper_options", "suite_options"]

def solve_options(
    *, invariants: InvariantsLike | None = ..., bounds: Any = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., mass: Any = ..., second_order: bool = ..., inplace: bool = ..., breakpoints:
    BreakpointsLike | None = ..., delays: DelaysLike | None = ..., history: HistoryLike | None = ..., jac: Any = ...,
    jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    sensitivities: SensitivitiesLike | None = ..., rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None =
    ..., max_step: LargestStep = ..., min_step: float | None = ..., calibrate: bool = ..., check: bool |
    Literal['strict'] = ..., max_order: int | None = ..., bdf: bool | None = ..., prefer: tuple[str, str] | None = ...,
    fsal: Fsal = ..., interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ..., callback:
    Callable[[float, Array], object] | None = ..., progress: Progress = ..., max_steps: int | None = ..., limits: Limits
    | None = ..., checkpoint: CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure | None
    = ...
) -> SolveOptions: ...
def run_options(
    *, breakpoints: BreakpointsLike | None = ..., linear_solver: LinearSolver = ..., rtol: Numbers = ..., atol: Numbers
    = ..., first_step: float | None = ..., max_step: LargestStep = ..., min_step: float | None = ..., calibrate: bool =
    ..., check: bool | Literal['strict'] = ..., max_order: int | None = ..., bdf: bool | None = ..., prefer: tuple[str,
    str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output: bool = ..., adjoint: bool |
    Literal['checkpoints'] = ..., interpolation: Interpolation = ..., refine: int = ..., keep: Keep | None = ...,
    callback: Callable[[float, Array], object] | None = ..., progress: Progress = ..., max_steps: int | None = ...,
    limits: Limits | None = ..., checkpoint: CheckpointLike | None = ..., on_interrupt: OnInterrupt = ..., on_failure:
    OnFailure | None = ...
) -> Options: ...
def suite_options(
    *, args: Iterable[Any] | None = ..., vectorized: bool = ..., events: EventsLike = ..., invariants: InvariantsLike |
    None = ..., bounds: Any = ..., nonnegative: bool | int | str | Sequence[int] | Sequence[str] | None = ..., mass: Any
    = ..., second_order: bool = ..., inplace: bool = ..., breakpoints: BreakpointsLike | None = ..., delays: DelaysLike
    | None = ..., history: HistoryLike | None = ..., jac: Any = ..., jac_sparsity: Any = ..., lband: int | None = ...,
    uband: int | None = ..., linear_solver: LinearSolver = ..., sensitivities: SensitivitiesLike | None = ..., rtol:
    Numbers = ..., atol: Numbers = ..., first_step: float | None = ..., max_step: LargestStep = ..., min_step: float |
    None = ..., calibrate: bool = ..., check: bool | Literal['strict'] = ..., max_order: int | None = ..., bdf: bool |
    None = ..., prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., t_eval: ArrayLike | None = ..., dense_output:
    bool = ..., adjoint: bool | Literal['checkpoints'] = ..., interpolation: Interpolation = ..., refine: int = ...,
    keep: Keep | None = ..., callback: Callable[[float, Array], object] | None = ..., progress: Progress = ...,
    max_steps: int | None = ..., limits: Limits | None = ..., checkpoint: CheckpointLike | None = ..., on_interrupt:
    OnInterrupt = ..., on_failure: OnFailure | None = ...
) -> AllOptions: ...
def ensemble_options(
    *, invariants: InvariantsLike | None = ..., bounds: Any = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., mass: Any = ..., second_order: bool = ..., inplace: bool = ..., breakpoints:
    BreakpointsLike | None = ..., delays: DelaysLike | None = ..., history: HistoryLike | None = ..., jac: Any = ...,
    jac_sparsity: Any = ..., lband: int | None = ..., uband: int | None = ..., linear_solver: LinearSolver = ...,
    sensitivities: SensitivitiesLike | None = ..., rtol: Numbers = ..., atol: Numbers = ..., first_step: float | None =
    ..., max_step: LargestStep = ..., min_step: float | None = ..., calibrate: bool = ..., check: bool |
    Literal['strict'] = ..., max_order: int | None = ..., bdf: bool | None = ..., prefer: tuple[str, str] | None = ...,
    fsal: Fsal = ..., interpolation: Interpolation = ..., keep: Keep | None = ..., callback: Callable[[float, Array],
    object] | None = ..., progress: Progress = ..., max_steps: int | None = ..., limits: Limits | None = ...,
    on_interrupt: OnInterrupt = ..., on_failure: OnFailure | None = ..., workers: int | None = ..., lanes:
    Literal['auto', 1] = ..., retry: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = ..., executor: Any = ...,
    chunk: int | None = ..., resume: bool = ..., seed: Any = ...
) -> EnsembleOptions: ...
def problem_ensemble_options(
    *, breakpoints: BreakpointsLike | None = ..., linear_solver: LinearSolver = ..., rtol: Numbers = ..., atol: Numbers
    = ..., first_step: float | None = ..., max_step: LargestStep = ..., min_step: float | None = ..., calibrate: bool =
    ..., check: bool | Literal['strict'] = ..., max_order: int | None = ..., bdf: bool | None = ..., prefer: tuple[str,
    str] | None = ..., fsal: Fsal = ..., interpolation: Interpolation = ..., keep: Keep | None = ..., callback:
    Callable[[float, Array], object] | None = ..., progress: Progress = ..., max_steps: int | None = ..., limits: Limits
    | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure | None = ..., workers: int | None = ..., lanes:
    Literal['auto', 1] = ..., retry: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = ..., executor: Any = ...,
    chunk: int | None = ..., resume: bool = ..., seed: Any = ...
) -> ProblemEnsembleOptions: ...
def extension_options(
    *, first_step: float | None = ..., max_step: LargestStep = ..., check: bool | Literal['strict'] = ..., t_eval:
    ArrayLike | None = ..., callback: Callable[[float, Array], object] | None = ..., progress: Progress = ...,
    max_steps: int | None = ..., limits: Limits | None = ..., on_interrupt: OnInterrupt = ..., on_failure: OnFailure |
    None = ...
) -> ExtensionOptions: ...
def stepper_options(
    *, invariants: InvariantsLike | None = ..., bounds: Any = ..., nonnegative: bool | int | str | Sequence[int] |
    Sequence[str] | None = ..., mass: Any = ..., second_order: bool = ..., inplace: bool = ..., delays: DelaysLike |
    None = ..., history: HistoryLike | None = ..., jac: Any = ..., jac_sparsity: Any = ..., lband: int | None = ...,
    uband: int | None = ..., linear_solver: LinearSolver = ..., sensitivities: SensitivitiesLike | None = ..., min_step:
    float | None = ..., calibrate: bool = ..., check: bool | Literal['strict'] = ..., max_order: int | None = ..., bdf:
    bool | None = ..., prefer: tuple[str, str] | None = ..., fsal: Fsal = ..., interpolation: Interpolation = ...
) -> StepperOptions: ...
