"""Reports of failed runs: the exception or warning that `on_failure` asks for besides the status."""

from __future__ import annotations

from typing import Any


class SolveError(RuntimeError):
    """A run failed, and was asked to raise: ``on_failure="raise"``. The text is the `message` of its solution.

    Parameters
    ----------
    message : str
        Why it failed.
    solution : Solution, EnsembleSolution or EnsembleStore, optional
        The results so far.

    Attributes
    ----------
    solution : Solution, EnsembleSolution, EnsembleStore or None
        The results so far; those of a run that reached a limit can be extended. None where a run failed at its start.
        An ensemble's error also has the exception of its first failed trajectory, if there is one, as ``__cause__``.
    """

    def __init__(self, message: str, solution: Any = None) -> None:
        super().__init__(message)
        self.solution = solution


class InvariantError(SolveError, ValueError):
    """An invariant contradicts the problem: its value at the start, or its Jacobian, or f does not keep it.

    A run raises it at its start, or as soon as it finds the contradiction, with the `solution` up to there; with
    ``on_failure="return"`` that solution, whose status is -2, is returned.
    """


class FailureWarning(UserWarning):
    """A run failed, or some trajectories of an ensemble: what ``on_failure="warn"`` says."""
