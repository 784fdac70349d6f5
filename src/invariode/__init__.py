"""ODE solvers that keep what the equations keep.

The codes of the MATLAB ODE Suite, DOP853, ode78 and ode89, with projection onto invariants, after L. F. Shampine,
Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72.
"""

from importlib.metadata import version

from . import ode_functions
from ._moved import announce_moves
from .compiled import CompiledFunction, compile
from .dissipation import Dissipated
from .ensemble import solve_ensemble
from .ensemble_solution import EnsembleEvents, EnsembleSolution, EnsembleStats
from .ensemble_store import EnsembleStore
from .events import Event
from .failures import FailureWarning, InvariantError, SolveError
from .imposing import ImposeResult, impose
from .inputs import Input
from .invariant_check import CheckReport, check_invariants
from .invariant_search import PolynomialInvariant, find_invariants
from .invariants import AccuracyWarning, Invariants
from .ivp import solve_ivp
from .loading import load
from .manifolds import RotationMatrix, UnitQuaternion, UnitVector
from .mechanics import MechanicalSystem
from .methods import METHODS, Method
from .ode_functions import *  # noqa: F403 - the registry says what is in it
from .odepack import odeint
from .pictures.precision import plot_work_precision
from .prepared import PreparedSolver
from .problem import Problem
from .solution import DenseSolution, DiscontinuityWarning, Drift, Solution, Stats, Steps, StiffnessWarning

__all__ = [
    "METHODS",
    "AccuracyWarning",
    "CheckReport",
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
    "FailureWarning",
    "ImposeResult",
    "Input",
    "InvariantError",
    "Invariants",
    "MechanicalSystem",
    "Method",
    "PolynomialInvariant",
    "PreparedSolver",
    "Problem",
    "RotationMatrix",
    "Solution",
    "SolveError",
    "Stats",
    "Steps",
    "StiffnessWarning",
    "UnitQuaternion",
    "UnitVector",
    "check_invariants",
    "compile",
    "find_invariants",
    "impose",
    "load",
    "odeint",
    "plot_work_precision",
    "solve_ensemble",
    "solve_ivp",
]
__all__ += ode_functions.__all__

__version__ = version("invariode")

announce_moves()
