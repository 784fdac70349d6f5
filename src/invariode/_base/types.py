"""Types of arguments: wide enough for what is accepted, narrow enough that type checkers reject what is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from .arguments import Array
from .method_names import MethodName as MethodName


class LowLevelCallable(Protocol):
    """SciPy's, which is not callable in Python. The other native functions are, or are untyped."""

    @property
    def function(self) -> Any: ...
    @property
    def signature(self) -> Any: ...


class Points(Protocol):
    """The points of a result, a `Solution` or SciPy's."""

    @property
    def t(self) -> Any: ...
    @property
    def y(self) -> Any: ...


class RootFunctions(Protocol):
    """An `invariode.Roots`."""

    @property
    def count(self) -> int: ...
    @property
    def on_roots(self) -> Callable[..., Any]: ...


Function: TypeAlias = Callable[..., Any] | LowLevelCallable
EventFunction: TypeAlias = Callable[..., float] | LowLevelCallable
EventsLike: TypeAlias = (
    EventFunction | RootFunctions | Sequence[EventFunction | RootFunctions] | Mapping[str, EventFunction] | None
)

#: One number or several. `ArrayLike` has strings too.
Numbers: TypeAlias = float | np.floating[Any] | np.integer[Any] | Sequence[float] | Array
BreakpointsLike: TypeAlias = Sequence[float | tuple[float, Function | None]] | Mapping[float, Function | None] | Array
Span: TypeAlias = Sequence[float] | Array

#: A length, or a tenth of the interval.
LargestStep: TypeAlias = float | Literal["tenth"]
Interpolation: TypeAlias = Literal["projected", "corrected", "raw"]
InputKind: TypeAlias = Literal["previous", "linear", "cubic"]
Fsal: TypeAlias = Literal["reuse", "evaluate"]
JacobianKind: TypeAlias = Literal["complex-step", "3-point", "2-point"]
Keep: TypeAlias = Literal["all", "outputs", "end"]
OnFailure: TypeAlias = Literal["return", "warn", "raise"]
OnInterrupt: TypeAlias = Literal["raise", "return"]
#: A bar, or a function of the amount done and of the total, None if that is unknown.
Progress: TypeAlias = bool | Callable[[float, float | None], object]
