"""ODE solvers that keep what the equations keep.

The codes of the MATLAB ODE Suite, DOP853, ode78 and ode89, with projection onto invariants, after L. F. Shampine,
Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72.
"""

from importlib.metadata import version as _version
from types import FunctionType as _FunctionType

from ._base.failures import FailureWarning, InvariantError, SolveError
from ._ensemble.solution import EnsembleEvents, EnsembleSolution, EnsembleStats
from ._ensemble.store import EnsembleStore
from ._functions.compile import compile
from ._functions.compiled import CompiledFunction
from ._laws.imposing import ImposeResult, impose
from ._mechanics.system import MechanicalSystem
from ._problem.dissipation import Dissipated
from ._problem.events import Event
from ._problem.grouped import GMRES, Banded, Checkpoint, Limits
from ._problem.inputs import Input
from ._problem.invariants import AccuracyWarning, Invariants
from ._problem.manifolds import RotationMatrix, UnitQuaternion, UnitVector
from ._problem.methods import METHODS, Method
from ._problem.sensitivities import Sensitivities
from ._results.result import DenseSolution, DiscontinuityWarning, Drift, Stats, Steps, StiffnessWarning
from ._results.solution import Solution
from ._solve.ensemble import solve_ensemble
from ._solve.ivp import solve_ivp
from ._solve.loading import load
from ._solve.ode_functions import *  # noqa: F403 - the registry says what is in it
from ._solve.odepack import odeint
from ._solve.prepared import PreparedSolver
from ._solve.problem import Problem
from ._studies.check import CheckReport, check_invariants
from ._studies.fit.experiment import Experiment
from ._studies.fit.fit import fit
from ._studies.fit.objective import Objective, objective
from ._studies.fit.parameters import Parameter
from ._studies.fit.prediction import Prediction
from ._studies.fit.profile import Profile
from ._studies.fit.result import Fit
from ._studies.search import PolynomialInvariant, find_invariants
from ._studies.sensitivities import SensitivityReport, check_sensitivities
from ._studies.work_precision import plot_work_precision

__all__ = [
    "GMRES",
    "METHODS",
    "AccuracyWarning",
    "Banded",
    "CheckReport",
    "Checkpoint",
    "CompiledFunction",
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
    "MechanicalSystem",
    "Method",
    "Objective",
    "Parameter",
    "PolynomialInvariant",
    "Prediction",
    "PreparedSolver",
    "Problem",
    "Profile",
    "RotationMatrix",
    "Sensitivities",
    "SensitivityReport",
    "Solution",
    "SolveError",
    "Stats",
    "Steps",
    "StiffnessWarning",
    "UnitQuaternion",
    "UnitVector",
    "check_invariants",
    "check_sensitivities",
    "compile",
    "find_invariants",
    "fit",
    "impose",
    "load",
    "objective",
    "odeint",
    "plot_work_precision",
    "solve_ensemble",
    "solve_ivp",
]
__all__ += METHODS

__version__ = _version("invariode")

for _name in __all__:  # the rooms are private: pickles, tracebacks and documentation name what users import
    if isinstance(_public := globals()[_name], (type, _FunctionType)):
        _public.__module__ = __name__


def __dir__() -> list[str]:
    """The public names, for completion."""
    return [name for name in globals() if not name.startswith("_") or name.endswith("__")]
