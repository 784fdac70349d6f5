"""libSBML, imported when it is used, and what is raised for models that have no equations here."""

from __future__ import annotations

from typing import Any

from .._base.package import extra


def libsbml() -> Any:
    """Return the module libsbml.

    Raises ModuleNotFoundError: The extra `sbml` is not installed.
    """
    return extra("libsbml", "invariode.sbml needs", "sbml", called="python-libsbml")


class UnsupportedError(ValueError):
    """A model uses something that `invariode.sbml` has no equations for, or that has no solution.

    Attributes
    ----------
    feature : str
        What it is, in a word: 'delay', 'flux balance', 'fast reaction', and so on.
    """

    def __init__(self, feature: str, message: str) -> None:
        super().__init__(message)
        self.feature = feature

    def __reduce__(self) -> tuple[Any, ...]:
        return UnsupportedError, (self.feature, self.args[0])
