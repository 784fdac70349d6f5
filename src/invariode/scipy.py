"""The methods as SciPy's classes, made from the registry: for `scipy.integrate.solve_ivp`, and for stepping by hand.

The stub beside this file, for type checkers, is made from it too: ``make stubs``.

>>> import numpy as np
>>> from scipy.integrate import solve_ivp
>>> from invariode.scipy import ODE113
>>> def pendulum(t, y):
...     return [y[1], -np.sin(y[0])]
>>> def energy(t, y):
...     return y[1] ** 2 / 2 - np.cos(y[0])
>>> sol = solve_ivp(pendulum, (0, 50), [1.0, 0.0], method=ODE113, invariants=energy, dense_output=True)
>>> bool(abs(energy(0, sol.sol(12.3)) - energy(0, [1.0, 0.0])) < 1e-6)
True

>>> solver = ODE113(pendulum, 0, [1.0, 0.0], 50, invariants=energy)
>>> while solver.status == "running" and solver.y[0] > 0:
...     message = solver.step()
>>> bool(solver.dense_output()(solver.t_old)[0] > 0 >= solver.y[0])
True
"""

from __future__ import annotations

from ._problem.methods import METHODS, Method
from ._solve.stepper import Stepper


def _class_of(method: Method, name: str, stands_for: str) -> type[Stepper]:
    about = (Stepper.__doc__ or "").partition(".")[2]
    summary = method.summary[0].upper() + method.summary[1:]
    contents = {"_method": stands_for, "__doc__": f"{summary}.\n{about}", "__module__": __name__}
    return type(name, (Stepper,), contents)


def _classes() -> dict[str, type[Stepper]]:
    """Return the classes by invariode's names, then by SciPy's, as in ``method=LSODA``. They are the same except for
    BDF, which implies an option."""
    ours = {name.upper(): _class_of(method, name.upper(), name) for name, method in METHODS.items()}
    theirs = {
        name: _class_of(method, name, name) if method.scipy_options else ours[method.name.upper()]
        for method in METHODS.values()
        if (name := method.scipy_name)
    }
    return ours | theirs


_CLASSES = _classes()
__all__ = [*_CLASSES]
globals().update(_CLASSES)
