"""The picture of the front page and of the README: `python docs/picture.py` writes it to docs/pendulum.svg."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from invariode import problems
from invariode._base.style import LOOK, PLAIN, PROJECTED

FILE = Path(__file__).parent / "pendulum.svg"


def runs() -> tuple[Any, Any]:
    """The pendulum at default tolerances, plain and projected."""
    plain, kept = (problems.pendulum(imposed=one).solve("ode45", refine=6) for one in (False, True))
    return plain, kept


def summary() -> str:
    """What the picture shows, in numbers; in the file, for a test that it is up to date."""
    return "; ".join(f"{sol.stats.steps} steps, {np.hypot(*sol.y[:2, -1]):.4f}" for sol in runs())


def draw() -> Any:
    """Left, the path of the bob; right, the error of the rod's length."""
    import matplotlib.pyplot as plt

    with matplotlib.rc_context(LOOK):
        figure, (path, drift) = plt.subplots(1, 2, figsize=(7, 2.9), layout="constrained")
    for sol, label, colour in zip(runs(), ("plain", "projected"), (PLAIN, PROJECTED), strict=True):
        path.plot(*sol.y[:2], colour, lw=1)
        off = np.abs(np.hypot(*sol.y[:2]) - 1)
        drift.semilogy(sol.t[1:], off[1:] + 1e-17, colour, lw=1, label=label)
    path.set(xlabel="x", ylabel="z", title="path of a pendulum's bob", aspect="equal")
    drift.set(xlabel="t", title="length of the rod, off by", ylim=(1e-17, 10))
    drift.legend(loc="center right")
    return figure


if __name__ == "__main__":
    matplotlib.use("svg")
    with matplotlib.rc_context({"svg.hashsalt": "invariode", "figure.facecolor": "white"}):
        draw().savefig(FILE, metadata={"Date": None, "Description": summary()})
