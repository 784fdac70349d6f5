"""The campaign of wrong and right invariants: what the guard finds, what it costs not to be found, whom it accuses.

Each problem is conservative and has a parameter in its invariant. Multiplied by 1 + p, with |p| from 1e-2 to 1e-9, the
invariant is wrong by about that much of its terms; with p = 0 it is right. Starts, methods and tolerances are random.

    python tests/fuzz/campaign_invariants.py 2000 --seed 1
"""

from __future__ import annotations

import argparse
import dataclasses
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from methods import FIRST_ORDER

import invariode as iv

EXPONENTS = (2, 3, 4, 5, 6, 7, 8, 9)
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
#: Of methods of low order: below, they take too many steps.
LEAST = {"ode23": 1e-8, "ode15s": 1e-9, "ode23s": 1e-8, "ode23t": 1e-8, "ode23tb": 1e-8}
#: Relative accuracy of the reference, and of what is compared with it.
REFERENCE, RESOLVED = 1e-13, 1e-11


@dataclass(frozen=True)
class Family:
    """y' = f and g(t, y, p), an invariant for p = 0."""

    name: str
    fun: Callable[..., Any]
    g: Callable[..., Any]
    start: Callable[[np.random.Generator], list[float]]
    value: Any = None


def _henon_heiles(t: float, y: Any) -> list[Any]:
    return [y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 + y[1] ** 2]


def _kepler(t: float, y: Any) -> list[Any]:
    r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
    return [y[2], y[3], -y[0] / r3, -y[1] / r3]


def _body(t: float, y: Any) -> Any:
    """The unit quaternion and the angular velocity of a body with moments 1, 2, 3."""
    a, b, c, d, u, v, w = y
    return [
        0.5 * (-b * u - c * v - d * w),
        0.5 * (a * u + c * w - d * v),
        0.5 * (a * v + d * u - b * w),
        0.5 * (a * w + b * v - c * u),
        -v * w,
        u * w,
        -u * v / 3,
    ]


def _momentum(t: float, y: Any, p: float) -> list[Any]:
    a, b, c, d = y[:4]
    u, v, w = y[4] * (1 + p), 2 * y[5], 3 * y[6]
    return [
        a * a + b * b + c * c + d * d,
        y[4] ** 2 + 2 * y[5] ** 2 + 3 * y[6] ** 2,
        (a * a + b * b - c * c - d * d) * u + 2 * (b * c - a * d) * v + 2 * (b * d + a * c) * w,
    ]


def _charge(t: float, y: Any) -> list[Any]:
    """In a field that grows with x, and an electric one along y that swings."""
    return [y[2], y[3], (1 + y[0] / 2) * y[3], -(1 + y[0] / 2) * y[2] + np.cos(t)]


FAMILIES = (
    Family(
        "Henon-Heiles",
        _henon_heiles,
        lambda t, y, p: (y @ y) / 2 + (1 + p) * y[0] ** 2 * y[1] - y[1] ** 3 / 3,
        lambda r: [*r.uniform(-0.15, 0.15, 2), *r.uniform(0.1, 0.3, 2)],
    ),
    Family(
        "Kepler",
        _kepler,
        lambda t, y, p: [
            (y[2] ** 2 + y[3] ** 2) / 2 - (1 + p) / np.sqrt(y[0] ** 2 + y[1] ** 2),
            y[0] * y[3] - y[1] * y[2],
        ],
        lambda r: [(q := r.uniform(0.3, 0.9)), 0, 0, float(np.sqrt((2 - q) / q))],
    ),
    Family(
        "Lotka-Volterra",
        lambda t, y: [2 * y[0] * (1 - y[1]), -y[1] * (1 - y[0])],
        lambda t, y, p: y[0] - (1 + p) * np.log(y[0]) + 2 * (y[1] - np.log(y[1])),
        lambda r: list(r.uniform(0.3, 3, 2)),
    ),
    Family(
        "pendulum",
        lambda t, y: [y[1], -np.sin(y[0])],
        lambda t, y, p: y[1] ** 2 / 2 - (1 + p) * np.cos(y[0]),
        lambda r: [r.uniform(0.3, 2.5), r.uniform(-0.5, 0.5)],
    ),
    Family(
        "rigid body",
        lambda t, y: [y[1] * y[2], -y[0] * y[2], -0.51 * y[0] * y[1]],
        lambda t, y, p: [y[0] ** 2 + (1 + p) * y[1] ** 2, 0.51 * y[0] ** 2 + y[2] ** 2],
        lambda r: list(r.uniform(0.2, 1, 3)),
    ),
    Family("attitude", _body, _momentum, lambda r: [1, 0, 0, 0, *r.uniform(0.2, 1, 3)]),
    Family(
        "quartic",
        lambda t, y: [y[1], -(y[0] ** 3)],
        lambda t, y, p: y[1] ** 2 / 2 + (1 + p) * y[0] ** 4 / 4,
        lambda r: [r.uniform(0.5, 1.5), r.uniform(-0.3, 0.3)],
    ),
    Family(
        "charge in moving fields",
        _charge,
        lambda t, y, p: y[3] + y[0] + (1 + p) * y[0] ** 2 / 4 - np.sin(t),
        lambda r: list(r.uniform(-0.6, 0.6, 4)),
    ),
)


@dataclass(frozen=True)
class Case:
    family: Family
    method: str
    rtol: float
    jac: str | None
    y0: np.ndarray
    size: float  # of the perturbation; 0: the invariant is right

    def solve(self, project: bool = True) -> iv.Solution | None:
        """None: refused at the start."""
        held = iv.Invariants(lambda t, y: self.family.g(t, y, self.size), self.jac, names=None)
        try:
            return iv.solve_ivp(
                self.family.fun,
                (0, 20),
                self.y0,
                self.method,
                rtol=self.rtol,
                atol=self.rtol * 1e-3,
                invariants=held if project else None,
                keep="end",
            )
        except iv.InvariantError:
            return None

    def __str__(self) -> str:
        return (
            f"{self.family.name}, {self.method}, rtol {self.rtol:.0e}, jac {self.jac}, p {self.size:.3e}, "
            f"y0 {self.y0.tolist()}"
        )


def cases(count: int, seed: int, right: bool) -> Iterator[Case]:
    random = np.random.default_rng(seed)
    methods = FIRST_ORDER
    for _ in range(count):
        family = FAMILIES[random.integers(len(FAMILIES))]
        method = methods[random.integers(len(methods))]
        rtol = max(float(random.choice(TOLERANCES)), LEAST.get(method, 0))
        jac = (None, None, "3-point", "2-point")[random.integers(4)]
        p = 0.0 if right else random.choice([-1, 1]) * 10 ** random.uniform(-9, -2)
        yield Case(family, method, rtol, jac, np.array(family.start(random)), p)


def error(case: Case, sol: iv.Solution, reference: np.ndarray) -> float:
    return float(np.linalg.norm(sol.y[:, -1] - reference) / np.linalg.norm(reference))


def accused(case: Case) -> bool:
    sol = case.solve()
    return sol is None or sol.status == -2


def loss(case: Case) -> float | None:
    """How many times the error of the run without the invariant, or of the one with the right invariant if that is
    larger: errors of single runs may be small by chance. None: the wrong invariant was found."""
    sol = case.solve()
    if sol is None or sol.status == -2:
        return None
    others = [case.solve(project=False), dataclasses.replace(case, size=0.0).solve()]
    if not sol.success:
        return float("inf") if any(other is not None and other.success for other in others) else 0.0
    reference = iv.solve_ivp(case.family.fun, (0, 20), case.y0, "dop853", rtol=REFERENCE, atol=REFERENCE * 1e-3).y
    usual = max(error(case, other, reference[:, -1]) for other in others if other is not None and other.success)
    return error(case, sol, reference[:, -1]) / max(usual, RESOLVED, case.rtol / 10)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", type=int)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")

    blamed = [case for case in cases(arguments.count, arguments.seed, right=True) if accused(case)]
    print(f"right: {arguments.count} runs, {len(blamed)} accused")
    for case in blamed:
        print("  accused:", case)

    for exact in (True, False):
        print("derivatives exact" if exact else "by differences")
        table: dict[int, list[float | None]] = {k: [] for k in EXPONENTS}
        worst: list[tuple[float, Case]] = []
        for case in cases(arguments.count, arguments.seed + 1, right=False):
            if (case.jac is None) != exact:
                continue
            harm = loss(case)
            table[int(np.ceil(-np.log10(abs(case.size))))].append(harm)
            if harm is not None:
                worst.append((harm, case))
        for k, values in table.items():
            lost = [v for v in values if v is not None]
            found = len(values) - len(lost)
            print(f"  p up to 1e-{k - 1}: {len(values)} runs, {found} found, largest loss {max(lost, default=0):.3g}")
        for harm, case in sorted(worst, key=lambda one: -one[0])[:8]:
            print(f"  loss {harm:.3g}: {case}")


if __name__ == "__main__":
    main()
