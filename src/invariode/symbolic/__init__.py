"""Problems from formulas: symbols in; f, invariants and all their exact Jacobians out. Needs the extra `symbolic`.

The functions take SymPy's symbols and expressions, and return a `SymbolicSystem`, which makes an `invariode.Problem` of
them.
"""

from importlib.util import find_spec

if find_spec("sympy") is None:
    raise ModuleNotFoundError("invariode.symbolic needs sympy: pip install invariode[symbolic]", name="sympy")

from .mechanics import hamiltonian, lagrangian
from .multibody import from_mechanics
from .systems import SymbolicSystem, equations

__all__ = ["SymbolicSystem", "equations", "from_mechanics", "hamiltonian", "lagrangian"]
