"""Types of arguments: wide enough for what is accepted, narrow enough that type checkers reject what is not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from ._arguments import Array

if TYPE_CHECKING:
    from .invariants import Invariants


class LowLevelCallable(Protocol):
    """SciPy's, which is not callable in Python. The other native functions are, or are untyped."""

    @property
    def function(self) -> Any: ...
    @property
    def signature(self) -> Any: ...


Function: TypeAlias = Callable[..., Any] | LowLevelCallable
EventFunction: TypeAlias = Callable[..., float] | LowLevelCallable
EventsLike: TypeAlias = EventFunction | Sequence[EventFunction] | None
InvariantsLike: TypeAlias = "Function | Invariants | Iterable[Function | Invariants]"

#: One number or several. `ArrayLike` has strings too.
Numbers: TypeAlias = float | np.floating[Any] | np.integer[Any] | Sequence[float] | Array
Span: TypeAlias = Sequence[float] | Array
#: A name in `METHODS`, or SciPy's name or class. The registry may grow, so that names are not part of the type.
MethodName: TypeAlias = str | type[Any]

Interpolation: TypeAlias = Literal["projected", "corrected", "raw"]
Fsal: TypeAlias = Literal["reuse", "evaluate"]
JacobianKind: TypeAlias = Literal["complex-step", "3-point", "2-point"]
Save: TypeAlias = Literal["all", "outputs", "end"]


class StepOptions(TypedDict, total=False):
    """The options of every kind of solve; `invariode.solve_ivp` says what they mean."""

    rtol: Numbers
    atol: Numbers
    first_step: float | None
    max_step: float | None
    interpolation: Interpolation
    fsal: Fsal
    max_order: int | None
    bdf: bool | None
    callback: Callable[[float, Array], object] | None
    save: Save | None
    check: bool
    min_step: float | None


class EnsembleOptions(StepOptions, total=False):
    """Those of `solve_ensemble`."""

    t_eval: ArrayLike | None


class RefinedOptions(StepOptions, total=False):
    """Those of `solve_ivp` that its signature does not spell out."""

    refine: int
    progress: bool


class Options(RefinedOptions, total=False):
    """Those of `Problem.solve`."""

    t_eval: ArrayLike | None
    dense_output: bool


class AllOptions(Options, total=False):
    """Those of the suite's functions: with what describes a problem."""

    events: EventsLike
    vectorized: bool
    args: Iterable[Any] | None
    invariants: InvariantsLike | None
    jac: Any
    jac_sparsity: Any
    lband: int | None
    uband: int | None
    mass: Any
