"""The runs of section 6 of the paper, and the rows that hold its numbers against those computed here."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .._arguments import Array
from ..invariants import Invariants
from ..solution import Solution
from .matlab import matlab_rows
from .problems import DEMO_ATOL, DEMO_RTOL, ORBITS, PENDULUM, lotka_volterra, pendulum, three_body
from .rows import Row, Rule, within

__all__ = ["LotkaVolterra", "Pendulum", "Results", "ThreeBody", "gap", "residual", "run"]

#: Points per step in the paper's graphs (p. 69) and in the suite's ode45 by default.
REFINE = 4
#: Width of the orbit in Fig. 1, from x = -1.3 to x = 1.2.
ORBIT_WIDTH = 2.5
#: The paper gives the gap between start and end in words; what a reader of its figure sees is a hundredth of the orbit.
VISIBLE = 0.01 * ORBIT_WIDTH
#: In Fig. 2 a residual below a hundredth of the scale, 7e-3, cannot be told from zero.
ON_THE_AXIS = 7e-5


def residual(invariants: Invariants, sol: Solution) -> Array:
    """|g(t, y) - g(t0, y0)|, (m, n_t), at the outputs of a run, whether the invariants were imposed in it or not."""
    g = np.atleast_2d(np.asarray(invariants.fun(sol.t, sol.y)))
    difference: Array = np.abs(g - g[:, :1])
    return difference


def gap(sol: Solution) -> float:
    """Distance in position between the start and the end of an orbit."""
    return float(np.hypot(*(sol.y[:2, -1] - sol.y[:2, 0])))


@dataclass(frozen=True)
class LotkaVolterra:
    """Lotka-Volterra with ode23 and default tolerances.

    Attributes
    ----------
    plain, projected, evaluated : Solution
        Without the invariant; with it; with it and f evaluated again where the paper saves that evaluation.
    raw, corrected, continuous : Solution
        With the invariant and four points per step: by the method's own interpolant, by the one that meets the ends of
        the step, and by the one that is also projected.
    imposed : Solution
        `raw` projected a posteriori.
    """

    plain: Solution
    projected: Solution
    evaluated: Solution
    raw: Solution
    corrected: Solution
    continuous: Solution
    imposed: Solution

    @classmethod
    def run(cls) -> LotkaVolterra:
        """Solves the problem in all these ways."""
        free, held = lotka_volterra(imposed=False), lotka_volterra()
        raw = held.solve("ode23", refine=REFINE, interpolation="raw", dense_output=True)
        return cls(
            plain=free.solve("ode23", dense_output=True),
            projected=held.solve("ode23"),
            evaluated=held.solve("ode23", fsal="evaluate"),
            raw=raw,
            corrected=held.solve("ode23", refine=REFINE, interpolation="corrected", dense_output=True),
            continuous=held.solve("ode23", refine=REFINE, interpolation="projected", dense_output=True),
            imposed=raw.impose(),
        )

    def rows(self) -> list[Row]:
        """The numbers of pp. 70-71 and Fig. 2."""
        title = "Lotka–Volterra, ode23, default tolerances"
        inside = slice(-REFINE - 1, None)  # the last step, both its ends included
        last = np.abs(self.raw.residual[0, inside])
        imposed = np.abs(self.imposed.residual[0])
        plain, projected = residual(ORBITS, self.plain), residual(ORBITS, self.projected)
        ulp = float(np.spacing(ORBITS.fun(0.0, self.raw.y[:, 0])))
        one_ulp = within(ulp, f"to one unit in the last place of g, {ulp:.1e}")
        on_the_axis = Rule(lambda _, value: value < ON_THE_AXIS, "if under a hundredth of the scale of Fig. 2")
        return [
            Row(title, "max residual, plain", "9.12", plain.max(), "p. 71", stats=self.plain.stats),
            Row(title, "max residual, projected", "8.80e-5", projected.max(), "p. 71", stats=self.projected.stats),
            Row(
                title,
                'the same with fsal="evaluate"',
                None,
                residual(ORBITS, self.evaluated).max(),
                stats=self.evaluated.stats,
            ),
            Row(title, "residual inside the last step, raw", "7e-3", last.max(), "Fig. 2", stats=self.raw.stats),
            Row(
                title,
                "residual at the ends of that step",
                "virtually zero",
                max(last[0], last[-1]),
                "p. 71",
                on_the_axis,
            ),
            Row(title, "that step imposed a posteriori", "1.4e-14", imposed[inside].max(), "p. 71", one_ulp),
            Row(title, "the whole run imposed a posteriori", None, imposed.max()),
        ]


@dataclass(frozen=True)
class Pendulum:
    """The pendulum with ode45 and default tolerances, four points per step.

    Attributes
    ----------
    plain, raw, projected : Solution
        Without its invariants; with both and the method's own interpolant; with both, between steps too.
    """

    plain: Solution
    raw: Solution
    projected: Solution

    @classmethod
    def run(cls) -> Pendulum:
        """Solves the problem in all these ways."""
        free, held = pendulum(imposed=False), pendulum()
        return cls(
            plain=free.solve("ode45", refine=REFINE, dense_output=True),
            raw=held.solve("ode45", refine=REFINE, interpolation="raw"),
            projected=held.solve("ode45", refine=REFINE),
        )

    def rows(self) -> list[Row]:
        """The numbers of p. 70."""
        title = "Pendulum in Cartesian coordinates, ode45, default tolerances"
        plain, raw, projected = (residual(PENDULUM, sol)[0].max() for sol in (self.plain, self.raw, self.projected))
        return [
            Row(title, "max |x² + y² − 1|, plain", "1.19", plain, "p. 70", stats=self.plain.stats),
            Row(title, "both invariants imposed, raw output", "3.36e-4", raw, "p. 70", stats=self.raw.stats),
            Row(title, "both imposed, output projected too", None, projected, stats=self.projected.stats),
        ]


@dataclass(frozen=True)
class ThreeBody:
    """The restricted three-body problem with ode45, without and with its Jacobi integral.

    Attributes
    ----------
    demo, demo_projected : Solution
        At the tolerances of MATLAB's demonstration.
    plain, projected : Solution
        At default tolerances.
    """

    demo: Solution
    demo_projected: Solution
    plain: Solution
    projected: Solution

    @classmethod
    def run(cls) -> ThreeBody:
        """Solves the problem in all these ways."""
        free, held = three_body(imposed=False), three_body()
        return cls(
            demo=free.solve("ode45", rtol=DEMO_RTOL, atol=DEMO_ATOL),
            demo_projected=held.solve("ode45", rtol=DEMO_RTOL, atol=DEMO_ATOL),
            plain=free.solve("ode45", dense_output=True),
            projected=held.solve("ode45", dense_output=True),
        )

    def rows(self) -> list[Row]:
        """The statements of p. 70 about ode45."""
        title = "Restricted three-body problem, ode45: gap between start and end"
        closed = Rule(lambda _, value: value < VISIBLE, "if under a hundredth of the width of the orbit")
        open_ = Rule(lambda _, value: value > VISIBLE, "if over a hundredth of the width of the orbit")
        return [
            Row(title, "tolerances 1e-5, 1e-4, plain", "periodic", gap(self.demo), "p. 70", closed, self.demo.stats),
            Row(
                title,
                "tolerances 1e-5, 1e-4, projected",
                None,
                gap(self.demo_projected),
                stats=self.demo_projected.stats,
            ),
            Row(title, "default tolerances, plain", "substantial", gap(self.plain), "p. 70", open_, self.plain.stats),
            Row(title, "default tolerances, projected", None, gap(self.projected), stats=self.projected.stats),
        ]


@dataclass(frozen=True)
class Results:
    """All runs, and the rows of the table.

    Attributes
    ----------
    lotka_volterra, pendulum, three_body
        The runs of the paper.
    matlab : list of Row
        Numbers that MATLAB's ode45 prints for other problems.
    """

    lotka_volterra: LotkaVolterra
    pendulum: Pendulum
    three_body: ThreeBody
    matlab: list[Row]

    @cached_property
    def paper(self) -> list[Row]:
        """The rows of the paper's own experiments."""
        return [*self.lotka_volterra.rows(), *self.pendulum.rows(), *self.three_body.rows()]

    @property
    def rows(self) -> list[Row]:
        """All rows."""
        return [*self.paper, *self.matlab]

    @property
    def compared(self) -> list[Row]:
        """The rows with a published value."""
        return [row for row in self.rows if row.agrees is not None]

    @property
    def agree(self) -> bool:
        """Whether every published value is met."""
        return all(row.agrees for row in self.compared)


def run() -> Results:
    """Runs all experiments.

    Returns
    -------
    Results
        The solutions and the rows of the table.
    """
    return Results(LotkaVolterra.run(), Pendulum.run(), ThreeBody.run(), matlab_rows())
