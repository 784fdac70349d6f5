"""The registry of methods: data and citations over which tests, documentation and benchmarks iterate."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

__all__ = ["METHODS", "Method", "find_method"]


@dataclass(frozen=True)
class Method:
    """A named solver.

    Attributes
    ----------
    name : str
        The name in the MATLAB ODE Suite.
    family : str
        What kind of method it is.
    order : int
        Order of the solution that is propagated.
    extension_order : int
        Order of the continuous extension.
    stages : int
        Evaluations of f per attempted step.
    iterations : int
        Projection iterations per step when invariants are imposed (paper, section 4).
    refine : int
        Points per step that the function of this name returns by default.
    scipy_name : str
        The name of the corresponding method of `scipy.integrate.solve_ivp`, accepted too.
    source : str
        Where the formulas come from.
    """

    name: str
    family: str
    order: int
    extension_order: int
    stages: int
    iterations: int
    refine: int
    scipy_name: str
    source: str


#: The methods by name.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        method.name: method
        for method in (
            Method(
                name="ode23",
                family="explicit Runge-Kutta pair",
                order=3,
                extension_order=3,
                stages=3,
                iterations=1,
                refine=1,
                scipy_name="RK23",
                source="P. Bogacki, L. F. Shampine, A 3(2) pair of Runge-Kutta formulas, "
                "Appl. Math. Lett. 2 (1989) 321-325",
            ),
            Method(
                name="ode45",
                family="explicit Runge-Kutta pair",
                order=5,
                extension_order=4,
                stages=6,
                iterations=2,
                refine=4,
                scipy_name="RK45",
                source="J. R. Dormand, P. J. Prince, A family of embedded Runge-Kutta formulae, "
                "J. Comput. Appl. Math. 6 (1980) 19-26; extension: L. F. Shampine, M. W. Reichelt, "
                "The MATLAB ODE Suite, SIAM J. Sci. Comput. 18 (1997) 1-22",
            ),
        )
    }
)

#: What to use instead of the methods of SciPy that have no counterpart here.
_INSTEAD = {
    "DOP853": "use method='ode45' with a tight rtol for smooth problems at high accuracy",
    "Radau": "stiff problems need an implicit method, which this version does not have",
    "BDF": "stiff problems need an implicit method, which this version does not have",
    "LSODA": "use method='ode45' if the problem is not stiff; this version has no method for stiff problems",
}


def find_method(method: object) -> Method:
    """The registered method of that name, of that name in SciPy, or named as that class of SciPy's."""
    name = method.__name__ if isinstance(method, type) else method
    if not isinstance(name, str):
        raise TypeError(f"method must be the name of a method, one of {_names()}; got {method!r}")
    for candidate in METHODS.values():
        if name in (candidate.name, candidate.scipy_name):
            return candidate
    if name in _INSTEAD:
        raise ValueError(f"method {name!r} of SciPy is not available: {_INSTEAD[name]}. Methods: {_names()}")
    known = [n for m in METHODS.values() for n in (m.name, m.scipy_name)]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"unknown method {name!r}{hint} Methods: {_names()}")


def _names() -> str:
    return ", ".join(f"{m.name!r} (or {m.scipy_name!r})" for m in METHODS.values())
