"""The runs of section 6 of the paper, and the rows that hold its numbers against those computed here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from invariode._base.arguments import Array
from invariode._base.types import MethodName
from invariode._problem.invariants import Invariants
from invariode._problem.methods import METHODS
from invariode._problem.problem import Problem
from invariode._results.solution import Solution
from invariode._solve.ode_functions import ode15s
from invariode.problems import hires, lotka_volterra, pendulum, robertson, three_body

from .matlab import matlab_rows
from .rows import Row, Rule, of_the_paper, within

__all__ = ["Code", "Kinetics", "LotkaVolterra", "Pendulum", "Results", "ThreeBody", "gap", "residual", "run"]

#: The methods for any f.
GENERAL = [name for name, about in METHODS.items() if about.equations == "any"]
#: Points per step in the paper's graphs (p. 69) and in the suite's ode45 by default.
REFINE = 4
#: Width of the orbit in Fig. 1, from x = -1.3 to x = 1.2.
ORBIT_WIDTH = 2.5
#: The paper gives the gap between start and end in words; what a reader of its figure sees is a hundredth of the orbit.
VISIBLE = 0.01 * ORBIT_WIDTH
#: In Fig. 2 a residual below a hundredth of the scale, 7e-3, cannot be told from zero.
ON_THE_AXIS = 7e-5
#: The tolerances at which MATLAB's demonstration solves the three-body problem with ode45 (p. 70).
DEMO_RTOL, DEMO_ATOL = 1e-5, 1e-4
#: What the paper imposes on its three problems (p. 70).
(ORBITS,), (PENDULUM,), (JACOBI,) = (problem().invariants for problem in (lotka_volterra, pendulum, three_body))
#: Relative tolerance for the linear invariants of stiff problems: far above what they drift by.
KINETICS_RTOL = 1e-6


def solved(problem: Problem, method: MethodName, **options: Any) -> Solution:
    """The problem solved as the suite does, with steps up to a tenth of the interval."""
    return problem.solve(method, max_step="tenth", **options)


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
        raw = solved(held, "ode23", refine=REFINE, interpolation="raw", dense_output=True)
        return cls(
            plain=solved(free, "ode23", dense_output=True),
            projected=solved(held, "ode23"),
            evaluated=solved(held, "ode23", fsal="evaluate"),
            raw=raw,
            corrected=solved(held, "ode23", refine=REFINE, interpolation="corrected", dense_output=True),
            continuous=solved(held, "ode23", refine=REFINE, interpolation="projected", dense_output=True),
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
            of_the_paper("Lotka-Volterra, plain", title, "max residual, plain", plain.max(), self.plain.stats),
            of_the_paper(
                "Lotka-Volterra, projected", title, "max residual, projected", projected.max(), self.projected.stats
            ),
            Row(
                title,
                'the same with fsal="evaluate"',
                None,
                residual(ORBITS, self.evaluated).max(),
                stats=self.evaluated.stats,
            ),
            of_the_paper(
                "Lotka-Volterra, inside the last step",
                title,
                "residual inside the last step, raw",
                last.max(),
                self.raw.stats,
            ),
            of_the_paper(
                "Lotka-Volterra, at the ends of the last step",
                title,
                "residual at the ends of that step",
                max(last[0], last[-1]),
                rule=on_the_axis,
            ),
            of_the_paper(
                "Lotka-Volterra, imposed a posteriori",
                title,
                "that step imposed a posteriori",
                imposed[inside].max(),
                rule=one_ulp,
            ),
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
            plain=solved(free, "ode45", refine=REFINE, dense_output=True),
            raw=solved(held, "ode45", refine=REFINE, interpolation="raw"),
            projected=solved(held, "ode45", refine=REFINE),
        )

    def rows(self) -> list[Row]:
        """The numbers of p. 70."""
        title = "Pendulum in Cartesian coordinates, ode45, default tolerances"
        plain, raw, projected = (residual(PENDULUM, sol)[0].max() for sol in (self.plain, self.raw, self.projected))
        return [
            of_the_paper("pendulum, plain", title, "max |x² + y² − 1|, plain", plain, self.plain.stats),
            of_the_paper("pendulum, projected", title, "both invariants imposed, raw output", raw, self.raw.stats),
            Row(title, "both imposed, output projected too", None, projected, stats=self.projected.stats),
        ]


@dataclass(frozen=True)
class ThreeBody:
    """The restricted three-body problem, without and with its Jacobi integral.

    Attributes
    ----------
    adams, adams_projected : Solution
        With ode113 at default tolerances, four points per step: Fig. 1.
    demo, demo_projected : Solution
        With ode45 at the tolerances of MATLAB's demonstration.
    plain, projected : Solution
        With ode45 at default tolerances.
    """

    adams: Solution
    adams_projected: Solution
    demo: Solution
    demo_projected: Solution
    plain: Solution
    projected: Solution

    @classmethod
    def run(cls) -> ThreeBody:
        """Solves the problem in all these ways."""
        free, held = three_body(imposed=False), three_body()
        return cls(
            adams=solved(free, "ode113", refine=REFINE, dense_output=True),
            adams_projected=solved(held, "ode113", refine=REFINE, dense_output=True),
            demo=solved(free, "ode45", rtol=DEMO_RTOL, atol=DEMO_ATOL),
            demo_projected=solved(held, "ode45", rtol=DEMO_RTOL, atol=DEMO_ATOL),
            plain=solved(free, "ode45"),
            projected=solved(held, "ode45"),
        )

    def rows(self) -> list[Row]:
        """Fig. 1 and what p. 70 says of it, and its statements about ode45: all of them words, without a number."""
        figure = "Restricted three-body problem, ode113, default tolerances (Fig. 1): gap between start and end"
        title = "Restricted three-body problem, ode45: gap between start and end"
        closed = Rule(lambda _, value: value < VISIBLE, "if under a hundredth of the width of the orbit")
        open_ = Rule(lambda _, value: value > VISIBLE, "if over a hundredth of the width of the orbit")
        drawn = self.adams_projected
        return [
            of_the_paper("three bodies, ode113, plain", figure, "plain", gap(self.adams), self.adams.stats, open_),
            of_the_paper("three bodies, ode113, projected", figure, "projected", gap(drawn), drawn.stats, closed),
            of_the_paper(
                "three bodies, ode45 at tighter tolerances",
                title,
                "tolerances 1e-5, 1e-4, plain",
                gap(self.demo),
                self.demo.stats,
                closed,
            ),
            Row(
                title,
                "tolerances 1e-5, 1e-4, projected",
                None,
                gap(self.demo_projected),
                stats=self.demo_projected.stats,
            ),
            of_the_paper(
                "three bodies, ode45", title, "default tolerances, plain", gap(self.plain), self.plain.stats, open_
            ),
            Row(title, "default tolerances, projected", None, gap(self.projected), stats=self.projected.stats),
        ]


@dataclass(frozen=True)
class Code:
    """One code on one problem at default tolerances, without and with the invariants.

    Attributes
    ----------
    problem, method : str
    plain, projected : Solution
    residuals : tuple of float
        Largest residual of the invariants at the steps, plain and projected.
    gaps : tuple of float, or None
        Of the closed orbit, the distance between start and end.
    """

    problem: str
    method: str
    plain: Solution
    projected: Solution
    residuals: tuple[float, float]
    gaps: tuple[float, float] | None

    @classmethod
    def run_all(cls) -> list[Code]:
        """All codes on all three problems."""
        problems = (
            ("Lotka–Volterra", lotka_volterra, ORBITS),
            ("pendulum", pendulum, PENDULUM),
            ("three bodies", three_body, JACOBI),
        )
        found = []
        for name, problem, invariants in problems:
            for method in GENERAL:
                plain, projected = (solved(problem(imposed=imposed), method) for imposed in (False, True))
                largest = (float(residual(invariants, plain).max()), float(residual(invariants, projected).max()))
                gaps = (gap(plain), gap(projected)) if problem is three_body else None
                found.append(cls(name, method, plain, projected, largest, gaps))
        return found


@dataclass(frozen=True)
class Kinetic:
    """A stiff problem of chemical kinetics, its absolute tolerances, and its linear invariant in words."""

    problem: Problem
    atol: Any
    invariant: str


#: Problems whose linear invariants need no projection (paper, section 5).
KINETICS = (
    Kinetic(robertson(), [1e-10, 1e-14, 1e-10], "y₁ + y₂ + y₃ = 1"),
    Kinetic(hires(), 1e-9, "y₇ + y₈ = 0.0057"),
)


@dataclass(frozen=True)
class Kinetics:
    """What ode15s makes of the linear invariant of a stiff problem without any projection.

    Attributes
    ----------
    kinetic : Kinetic
    given, differences : Solution
        With the analytic Jacobian, and with differences.
    """

    kinetic: Kinetic
    given: Solution
    differences: Solution

    @property
    def drifts(self) -> tuple[float, float]:
        """Largest difference of the invariant from its value at the start, with the one Jacobian and the other."""
        return self._drift(self.given), self._drift(self.differences)

    def _drift(self, sol: Solution) -> float:
        return float(residual(self.kinetic.problem.invariants[0], sol).max())

    @classmethod
    def run_all(cls) -> list[Kinetics]:
        """Robertson's problem and HIRES."""
        return [cls(one, cls._solve(one, one.problem.matrices.jac), cls._solve(one, None)) for one in KINETICS]

    @staticmethod
    def _solve(one: Kinetic, jac: Callable[..., Any] | None) -> Solution:
        p = one.problem
        return ode15s(p.fun, p.t_span, p.y0, jac=jac, rtol=KINETICS_RTOL, atol=one.atol)


@dataclass(frozen=True)
class Results:
    """All runs, and the rows of the table.

    Attributes
    ----------
    lotka_volterra, pendulum, three_body
        The runs of the paper.
    codes : list of Code
        All codes on its three problems.
    kinetics : list of Kinetics
        Linear invariants of stiff problems.
    matlab : list of Row
        Numbers that MATLAB prints for other problems.
    """

    lotka_volterra: LotkaVolterra
    pendulum: Pendulum
    three_body: ThreeBody
    codes: list[Code]
    kinetics: list[Kinetics]
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
    return Results(
        LotkaVolterra.run(), Pendulum.run(), ThreeBody.run(), Code.run_all(), Kinetics.run_all(), matlab_rows()
    )
