"""Problems of PEtab, version 1: ``petab.load("problem.yaml")``. Needs python-libsbml and PyYAML, the extra `petab`."""

from __future__ import annotations

from .fitting import Fit
from .likelihood import Evaluation
from .problem import Objective, Problem, load

__all__ = ["Evaluation", "Fit", "Objective", "Problem", "load"]
