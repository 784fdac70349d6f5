"""The registry of methods: data and citations over which tests, documentation and benchmarks iterate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from .. import _core
from .._base.arguments import shown
from .._base.method_names import OwnName
from .._base.suggestions import meant
from .._base.types import LargestStep


@dataclass(frozen=True)
class Method:
    """A named solver.

    Attributes
    ----------
    name : str
        As in MATLAB, or as the authors call methods that MATLAB does not have; 'auto' chooses between two.
    summary : str
        Summary: the method and its use in a few words.
    family : str
        Kind of method.
    min_order : int
        Lowest order of the formulas.
    order : int
        Highest order; also the lowest if the order is fixed.
    extension_order : int
        Order of the continuous extension, of the formula of highest order.
    stages : int or None
        Evaluations of f per step of a Runge-Kutta pair; None if their number is not fixed. If 'fsal' is not among
        `options` the last of them waits for the accepted value: a failed attempt takes one fewer.
    extra : int
        Further evaluations of f in a step with output or events inside it.
    iterations : int
        Projection iterations per step when invariants are imposed (paper, section 4).
    refine : int
        Points per step that the function of this name returns by default.
    scipy_name : str or None
        The name of the corresponding method of `scipy.integrate.solve_ivp`, accepted too.
    scipy_options : mapping
        The options that this name implies.
    mass : str
        Mass matrices that it takes: 'none', 'regular' (constant, regular ones), or 'any'.
    equations : str
        What it takes for f: 'any' function of (t, y), one whose expression 'graph' is known, or f of a 'second-order'
        system y'' = f(t, y).
    delays : bool
        Whether f may take values of the solution at earlier times: see `delays` of `solve_ivp`.
    options : tuple of str
        Options that this method can use and others cannot.
    source : str
        Source of the formulas.
    """

    name: OwnName
    summary: str
    family: str
    min_order: int
    order: int
    extension_order: int
    stages: int | None
    extra: int
    iterations: int
    refine: int
    scipy_name: str | None
    source: str
    mass: str
    equations: str
    delays: bool
    options: tuple[str, ...]
    scipy_options: Mapping[str, bool] = field(default_factory=lambda: MappingProxyType({}))

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, ({**vars(self), "scipy_options": {**self.scipy_options}},)  # a proxy cannot be pickled

    @property
    def fixed_order(self) -> bool:
        return self.min_order == self.order

    @property
    def max_step(self) -> LargestStep:
        """The `max_step` of the function of this name by default: 'tenth' for MATLAB's codes, whose names begin with
        ode, as it is there; infinite for the others, as in `solve_ivp`."""
        return "tenth" if self.name.startswith("ode") else math.inf


def _restored(given: dict[str, Any]) -> Method:
    """Return a method that was pickled."""
    return Method(**{**given, "scipy_options": MappingProxyType(given["scipy_options"])})


def _from_core(row: dict[str, Any]) -> Method:
    implied = {"bdf": True} if row.pop("scipy_bdf") else {}
    return Method(**row, scipy_options=MappingProxyType(implied))


#: The methods by name, as the core lists them.
METHODS: Mapping[OwnName, Method] = MappingProxyType(
    {method.name: method for method in map(_from_core, _core.methods())}
)


#: The method here for a solver or method of other packages.
_COUNTERPARTS = {
    **dict.fromkeys(("vode", "zvode", "cvode", "ida"), "ode15s"),
    **dict.fromkeys(("dopri5", "tsit5"), "ode45"),
    **dict.fromkeys(("rodas", "rosenbrock23"), "ode23s"),
}
#: Methods of fixed step that a beginner may ask for.
_FIXED_STEP = frozenset({"euler", "midpoint", "heun", "rk2", "rk4", "leapfrog", "verlet", "symplectic"})


def find_method(method: object) -> tuple[Method, Mapping[str, bool]]:
    """The method of that name, of that name in SciPy, or of that class there or in `invariode.scipy`; and what SciPy's
    name implies."""
    name = getattr(method, "_method", method.__name__) if isinstance(method, type) else method
    if not isinstance(name, str):
        options = "; options are passed by name, as in rtol=1e-6, or as **options" * isinstance(name, Mapping)
        raise TypeError(f"`method` must be one of {_names()}, by name; got {shown(method)}{options}")
    for candidate in METHODS.values():
        if name == candidate.name:
            return candidate, {}
        if name == candidate.scipy_name:
            return candidate, candidate.scipy_options
    known = [n for m in METHODS.values() for n in (m.name, m.scipy_name) if n]
    near = "; there are no methods of fixed step." if name.lower() in _FIXED_STEP else meant(name, known)
    if name.lower() in _COUNTERPARTS:
        near = f"; its counterpart is {_COUNTERPARTS[name.lower()]!r}."
    raise ValueError(f"unknown method {name!r}{near or '.'} `method` must be one of {_names()}")


def _names() -> str:
    return ", ".join(f"{m.name!r}" + (f" (or {m.scipy_name!r})" if m.scipy_name else "") for m in METHODS.values())
