"""Problems from formulas: f, invariants and their exact Jacobians from SymPy expressions. Needs the extra `symbolic`.

The functions take SymPy symbols and expressions, and return a `SymbolicSystem`, which makes an `invariode.Problem`.
"""

from importlib.util import find_spec

if find_spec("sympy") is None:
    raise ModuleNotFoundError('invariode.symbolic needs sympy: pip install "invariode[symbolic]"', name="sympy")

from .mechanics import hamiltonian, lagrangian
from .multibody import from_mechanics, from_pydy
from .systems import SymbolicSystem, equations

__all__ = ["SymbolicSystem", "equations", "from_mechanics", "from_pydy", "hamiltonian", "lagrangian"]
