"""ODE solvers that conserve what your equations conserve.

The codes of the MATLAB ODE Suite, DOP853, ode78 and ode89, with projection onto invariants, after L. F. Shampine,
Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72.
"""

import typing as _typing
from importlib import import_module as _import_module
from types import FunctionType as _FunctionType

from ._base.failures import FailureWarning, InvariantError, SolveError
from ._base.package import public as _public
from ._base.package import version as _version
from ._base.suggestions import absent as _absent
from ._ensemble.ensemble_solution import EnsembleEvents, EnsembleSolution, EnsembleStats
from ._ensemble.store import EnsembleStore
from ._functions.compile import compile
from ._functions.compiled import CompiledFunction
from ._functions.second_order import SecondOrder
from ._laws.imposing import ImposeResult, impose
from ._problem.events import Event, Roots
from ._problem.grouped import GMRES, Banded, Checkpoint, Limits
from ._problem.inputs import Input
from ._problem.invariants import AccuracyWarning, Dissipated, Invariants
from ._problem.manifolds import RotationMatrix, UnitQuaternion, UnitVector
from ._problem.methods import METHODS, Method
from ._problem.problem import Problem
from ._problem.sensitivities import Sensitivities
from ._results.records import DiscontinuityWarning, Drift, Marks, Stats, Steps, StiffnessWarning
from ._results.result import DenseSolution
from ._results.solution import Solution
from ._solve.ivp import solve_ivp
from ._solve.loading import load
from ._solve.ode_functions import *  # noqa: F403 - the registry says what is in it
from ._solve.odepack import odeint
from ._solve.prepared_solver import PreparedSolver
from ._solve.solve_ensemble import solve_ensemble

if _typing.TYPE_CHECKING:
    from ._dae.dae import Dae, Start
    from ._dae.dae_solution import DaeSolution
    from ._dae.solve_dae import decic, ode15i, solve_dae
    from ._functions.graph.stored_code import code_cache
    from ._mechanics.system import MechanicalSystem
    from ._results.citations import cite
    from ._solve.dde23 import dde23
    from ._solve.ode import complex_ode, ode
    from ._studies.check import CheckReport, check_invariants
    from ._studies.check_sensitivities import SensitivityReport, check_sensitivities
    from ._studies.find_invariants import PolynomialInvariant, find_invariants
    from ._studies.fit.experiment import Experiment
    from ._studies.fit.fit import fit
    from ._studies.fit.fit_result import Fit
    from ._studies.fit.objective import Objective, objective
    from ._studies.fit.parameter_space import Parameter
    from ._studies.fit.profile import Profile
    from ._studies.fit.uncertainty import Prediction
    from ._studies.steady import SteadyState, steady_state
    from ._studies.work_precision import plot_work_precision

__all__ = [
    "GMRES",
    "METHODS",
    "AccuracyWarning",
    "Banded",
    "CheckReport",
    "Checkpoint",
    "CompiledFunction",
    "Dae",
    "DaeSolution",
    "DenseSolution",
    "DiscontinuityWarning",
    "Dissipated",
    "Drift",
    "EnsembleEvents",
    "EnsembleSolution",
    "EnsembleStats",
    "EnsembleStore",
    "Event",
    "Experiment",
    "FailureWarning",
    "Fit",
    "ImposeResult",
    "Input",
    "InvariantError",
    "Invariants",
    "Limits",
    "Marks",
    "MechanicalSystem",
    "Method",
    "Objective",
    "Parameter",
    "PolynomialInvariant",
    "Prediction",
    "PreparedSolver",
    "Problem",
    "Profile",
    "Roots",
    "RotationMatrix",
    "SecondOrder",
    "Sensitivities",
    "SensitivityReport",
    "Solution",
    "SolveError",
    "Start",
    "Stats",
    "SteadyState",
    "Steps",
    "StiffnessWarning",
    "UnitQuaternion",
    "UnitVector",
    "check_invariants",
    "check_sensitivities",
    "cite",
    "code_cache",
    "compile",
    "complex_ode",
    "dde23",
    "decic",
    "find_invariants",
    "fit",
    "impose",
    "load",
    "objective",
    "ode",
    "ode15i",
    "odeint",
    "plot_work_precision",
    "solve_dae",
    "solve_ensemble",
    "solve_ivp",
    "steady_state",
]
__all__ += METHODS

#: Imported when they are first used, since a solve does not need them.
_LATER = {
    "Dae": "._dae.dae",
    "Start": "._dae.dae",
    "DaeSolution": "._dae.dae_solution",
    "dde23": "._solve.dde23",
    "decic": "._dae.solve_dae",
    "ode15i": "._dae.solve_dae",
    "solve_dae": "._dae.solve_dae",
    "MechanicalSystem": "._mechanics.system",
    "cite": "._results.citations",
    "code_cache": "._functions.graph.stored_code",
    "complex_ode": "._solve.ode",
    "ode": "._solve.ode",
    "CheckReport": "._studies.check",
    "check_invariants": "._studies.check",
    "Experiment": "._studies.fit.experiment",
    "fit": "._studies.fit.fit",
    "Objective": "._studies.fit.objective",
    "objective": "._studies.fit.objective",
    "Parameter": "._studies.fit.parameter_space",
    "Prediction": "._studies.fit.uncertainty",
    "Profile": "._studies.fit.profile",
    "Fit": "._studies.fit.fit_result",
    "PolynomialInvariant": "._studies.find_invariants",
    "find_invariants": "._studies.find_invariants",
    "SensitivityReport": "._studies.check_sensitivities",
    "check_sensitivities": "._studies.check_sensitivities",
    "SteadyState": "._studies.steady",
    "steady_state": "._studies.steady",
    "plot_work_precision": "._studies.work_precision",
}

for _name in {*__all__} - {*_LATER}:
    if isinstance(_found := globals()[_name], (type, _FunctionType)):
        _public(_found)


if _typing.TYPE_CHECKING:  # for whom any other name is an error
    __version__: str
else:

    def __getattr__(name: str) -> object:
        """The version, and the public names of `_LATER`."""
        if name == "__version__":
            return _version()
        if name not in _LATER:
            raise AttributeError(_absent(__name__, name, __all__, ("jax", "problems", "scipy", "symbolic", "torch")))
        globals()[name] = found = getattr(_import_module(_LATER[name], __name__), name)
        return found


def __dir__() -> list[str]:
    """The public names, for completion."""
    return [name for name in {*globals(), *_LATER} if not name.startswith("_") or name.endswith("__")]
