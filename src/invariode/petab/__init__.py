"""Problems of PEtab, version 1: ``petab.load("problem.yaml")``. Needs python-libsbml and PyYAML, the extra `petab`."""

from __future__ import annotations

from .problem import Evaluation, Objective, Problem, load

__all__ = ["Evaluation", "Objective", "Problem", "load"]
