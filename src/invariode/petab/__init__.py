"""Problems of PEtab, versions 1 and 2: ``petab.load("problem.yaml")``. The extra `petab` installs what it needs."""

from __future__ import annotations

from .estimation_problem import Evaluation, Objective, Problem, load

__all__ = ["Evaluation", "Objective", "Problem", "load"]
