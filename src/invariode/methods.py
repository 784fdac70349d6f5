"""The registry of methods: data and citations over which tests, documentation and benchmarks iterate."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

__all__ = ["METHODS", "Method", "find_method"]


@dataclass(frozen=True)
class Method:
    """A named solver.

    Attributes
    ----------
    name : str
        As in MATLAB; of dop853, which is not there, as its authors call it.
    summary : str
        What it is and what it is for, in a few words.
    family : str
        What kind of method it is.
    min_order : int
        Lowest order of the formulas.
    order : int
        Highest order; the lowest too where the order is fixed.
    extension_order : int
        Order of the continuous extension, of the formula of highest order.
    stages : int or None
        Evaluations of f per step of a Runge-Kutta pair; None where they are not a fixed number. Where 'fsal' is not
        among `options` the last of them waits for the accepted value: a failed attempt takes one less.
    extra : int
        Evaluations of f that output or events inside a step take, once per step.
    iterations : int
        Projection iterations per step when invariants are imposed (paper, section 4).
    refine : int
        Points per step that the function of this name returns by default.
    scipy_name : str or None
        The name of the corresponding method of `scipy.integrate.solve_ivp`, accepted too.
    scipy_options : mapping
        What that name implies.
    options : tuple of str
        Options that not every method can use, and this one can.
    source : str
        Where the formulas come from.
    """

    name: str
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
    options: tuple[str, ...]
    scipy_options: Mapping[str, bool] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def fixed_order(self) -> bool:
        return self.min_order == self.order


#: The methods by name.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        method.name: method
        for method in (
            Method(
                name="ode23",
                summary="the Bogacki-Shampine (2,3) pair, for crude tolerances",
                family="explicit Runge-Kutta pair",
                min_order=3,
                order=3,
                extension_order=3,
                stages=3,
                extra=0,
                iterations=1,
                refine=1,
                scipy_name="RK23",
                source="P. Bogacki, L. F. Shampine, A 3(2) pair of Runge-Kutta formulas, "
                "Appl. Math. Lett. 2 (1989) 321-325",
                options=("fsal",),
            ),
            Method(
                name="ode45",
                summary="the Dormand-Prince (4,5) pair, the one to try first",
                family="explicit Runge-Kutta pair",
                min_order=5,
                order=5,
                extension_order=4,
                stages=6,
                extra=0,
                iterations=2,
                refine=4,
                scipy_name="RK45",
                source="J. R. Dormand, P. J. Prince, A family of embedded Runge-Kutta formulae, "
                "J. Comput. Appl. Math. 6 (1980) 19-26; extension: L. F. Shampine, M. W. Reichelt, "
                "The MATLAB ODE Suite, SIAM J. Sci. Comput. 18 (1997) 1-22",
                options=("fsal",),
            ),
            Method(
                name="dop853",
                summary="the eighth-order pair DOP853, for tight tolerances and cheap f",
                family="explicit Runge-Kutta pair",
                min_order=8,
                order=8,
                extension_order=7,
                stages=12,
                extra=3,
                iterations=2,
                refine=1,
                scipy_name="DOP853",
                source="E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, 2nd ed., "
                "Springer, Berlin, 1993, sections II.5 and II.10; not of the MATLAB ODE Suite",
                options=(),
            ),
            Method(
                name="ode78",
                summary="Verner's (7,8) pair, for tight tolerances",
                family="explicit Runge-Kutta pair",
                min_order=8,
                order=8,
                extension_order=7,
                stages=13,
                extra=3,
                iterations=2,
                refine=8,
                scipy_name=None,
                source="J. H. Verner, Numerically optimal Runge-Kutta pairs with interpolants, "
                "Numer. Algorithms 53 (2010) 383-396",
                options=(),
            ),
            Method(
                name="ode113",
                summary="Adams PECE formulas of order 1 to 12, for tight tolerances and costly f",
                family="Adams PECE, variable order",
                min_order=1,
                order=12,
                extension_order=12,
                stages=None,
                extra=0,
                iterations=1,
                refine=1,
                scipy_name=None,
                source="L. F. Shampine, M. K. Gordon, Computer Solution of Ordinary Differential Equations: The "
                "Initial Value Problem, Freeman, San Francisco, 1975, chapters 5 and 10",
                options=("max_order",),
            ),
            Method(
                name="ode15s",
                summary="NDFs of order 1 to 5, for stiff problems and M y' = f",
                family="NDF (or BDF), variable order, for stiff problems and M y' = f",
                min_order=1,
                order=5,
                extension_order=5,
                stages=None,
                extra=0,
                iterations=1,
                refine=1,
                scipy_name="BDF",
                source="L. F. Shampine, M. W. Reichelt, The MATLAB ODE Suite, SIAM J. Sci. Comput. 18 (1997) 1-22, "
                "section 2",
                options=("max_order", "bdf", "jac", "jac_sparsity", "lband", "uband", "mass"),
                scipy_options=MappingProxyType({"bdf": True}),
            ),
        )
    }
)

#: What to use instead of the methods of SciPy that have no counterpart here.
_INSTEAD = {
    "Radau": "use method='ode15s' for stiff problems and index-1 algebraic equations",
    "LSODA": "use method='ode15s' if the problem is stiff, 'ode113' if it is not",
}


def find_method(method: object) -> tuple[Method, Mapping[str, bool]]:
    """The method of that name, of that name in SciPy, or of that class there or in `invariode.scipy`; and what SciPy's
    name implies."""
    name = getattr(method, "_method", method.__name__) if isinstance(method, type) else method
    if not isinstance(name, str):
        raise TypeError(f"method must be the name of a method, one of {_names()}; got {method!r}")
    for candidate in METHODS.values():
        if name == candidate.name:
            return candidate, {}
        if name == candidate.scipy_name:
            return candidate, candidate.scipy_options
    if name in _INSTEAD:
        raise ValueError(f"method {name!r} of SciPy is not available: {_INSTEAD[name]}. Methods: {_names()}")
    known = [n for m in METHODS.values() for n in (m.name, m.scipy_name) if n]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"unknown method {name!r}{hint} Methods: {_names()}")


def _names() -> str:
    return ", ".join(f"{m.name!r}" + (f" (or {m.scipy_name!r})" if m.scipy_name else "") for m in METHODS.values())
