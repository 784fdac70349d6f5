"""Generated from METHODS: `make stubs`."""

from typing import Unpack

from numpy.typing import ArrayLike

from .._base.types import Function, Span
from .._problem.accepted import suite_options
from .._problem.options import AllOptions
from .._results.solution import Solution

__all__ = ["ode23", "ode45", "dop853", "ode78", "ode89", "ode113", "ode15s", "ode23s", "ode23t", "ode23tb", "radau", "taylor", "auto", "rkn64", "rkn86", "rkn1210"]

def ode23(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode45(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def dop853(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode78(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode89(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode113(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode15s(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode23s(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode23t(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def ode23tb(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def radau(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def taylor(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def auto(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def rkn64(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def rkn86(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
def rkn1210(fun: Function, t_span: Span, y0: ArrayLike, **options: Unpack[AllOptions]) -> Solution: raise NotImplementedError(suite_options(**options))
