"""ODE solvers that keep what the equations keep.

The codes of the MATLAB ODE Suite, DOP853 and ode78, with projection onto invariants, after L. F. Shampine, Conservation
laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72.
"""

from importlib.metadata import version

from .check import CheckReport, check_invariants
from .compiled import CompiledFunction, compile
from .discovery import PolynomialInvariant, find_invariants
from .ensemble import EnsembleEvents, EnsembleSolution, EnsembleStats, solve_ensemble
from .events import Event
from .export import load
from .invariants import ImposeResult, InvariantError, Invariants, impose
from .methods import METHODS, Method
from .problem import Problem
from .solution import DenseSolution, Drift, Solution, Stats, Steps
from .suite import dop853, ode15s, ode23, ode45, ode78, ode113, solve_ivp

__all__ = [
    "METHODS",
    "CheckReport",
    "CompiledFunction",
    "DenseSolution",
    "Drift",
    "EnsembleEvents",
    "EnsembleSolution",
    "EnsembleStats",
    "Event",
    "ImposeResult",
    "InvariantError",
    "Invariants",
    "Method",
    "PolynomialInvariant",
    "Problem",
    "Solution",
    "Stats",
    "Steps",
    "check_invariants",
    "compile",
    "dop853",
    "find_invariants",
    "impose",
    "load",
    "ode15s",
    "ode23",
    "ode45",
    "ode78",
    "ode113",
    "solve_ensemble",
    "solve_ivp",
]

__version__ = version("invariode")
