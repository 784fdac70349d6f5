"""Models in SBML, Levels 1 to 3, as problems: ``sbml.load("model.xml")``. Needs python-libsbml, of the extra `sbml`."""

from __future__ import annotations

import os
from typing import Literal

from .library import UnsupportedError
from .model import Model, ModelEvent, Table
from .reading import contents

__all__ = ["Model", "ModelEvent", "Table", "UnsupportedError", "load"]


def load(source: str | os.PathLike[str], *, fast: Literal["refuse", "limit"] = "refuse") -> Model:
    """Load a model in SBML.

    Parameters
    ----------
    source : str or path-like
        The path of a file, or the text of the model: SBML, or Antimony (.ant), which needs the package antimony.
    fast : {"refuse", "limit"}, default "refuse"
        Fast reactions, which SBML had until Level 3 Version 1: "limit" multiplies their rates by 1e7.

    Returns
    -------
    Model

    Raises
    ------
    UnsupportedError
        The model has delays, flux balance or fast reactions, or needs a package that changes its meaning; the message
        names it.
    ValueError
        It is no valid model in SBML: the message says in which lines, and what is wrong there.
    FileNotFoundError
        There is no such file.
    """
    if fast not in ("refuse", "limit"):
        raise ValueError(f"fast must be 'refuse' or 'limit', got {fast!r}")
    return Model(contents(os.fspath(source)), fast == "limit")
