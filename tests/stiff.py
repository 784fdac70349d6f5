"""The stiff test set, as data: right-hand sides, analytic Jacobians, linear invariants and reference solutions; more
problems stand in stiff_ends.py.

After Hairer & Wanner, Solving Ordinary Differential Equations II (2nd ed., 1996), and the Test Set for IVP Solvers
(Mazzia & Magherini, release 2.4, 2008). ``benchmarks/references.py`` computes the references.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from invariode import problems as classic

DATA = Path(__file__).with_name("data") / "stiff.npz"


@dataclass(frozen=True)
class StiffProblem:
    """y' = fun(t, y, *args), whose outputs at `times` are known for every `every`-th component.

    `jac(t, y, *args)` is dense; packed, ``ab[uband + i - j, j] = J[i, j]``, if there are bands; sparse (CSC) and of the
    pattern `jac_sparsity` if that is given. `scale` is the size below which a component counts as small: a solver's
    ``atol`` is ``rtol * scale``. `invariants` are the rows c with c·fun = 0. With a matrix `mass` M the system is
    M y' = fun(t, y), and `slope` is y' at the start.
    """

    name: str
    fun: Callable[..., Any]
    jac: Callable[..., Any]
    t_span: tuple[float, float]
    y0: np.ndarray
    scale: np.ndarray
    times: np.ndarray
    args: tuple[float, ...] = ()
    invariants: np.ndarray | None = None
    lband: int | None = None
    uband: int | None = None
    jac_sparsity: sparse.csc_array | None = None
    every: int = 1
    mass: np.ndarray | None = None
    slope: np.ndarray | None = None

    def difference(self, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """|y - z| / max(|z|, scale) of the sampled components, of shape (components, times)."""
        return np.abs(y - z) / np.maximum(np.abs(z), self.scale[:: self.every, None])

    def error(self, y: np.ndarray) -> float:
        """Largest weighted error of y, of shape (n, len(times)), at `times`."""
        return float(self.difference(y[:: self.every], references()[self.name]).max())


@cache
def references() -> dict[str, np.ndarray]:
    """The sampled components of each solution at `times`, of shape (components, times), by name of problem."""
    with np.load(DATA) as data:
        return dict(data)


# ----------------------------------------------------------------------------------------------------------------------
# Chemical kinetics


def as_array(function):
    """Return its value as an array: these tests take slices of it, and its parts along complex steps."""
    return lambda t, y: np.array(function(t, y))


robertson, hires = as_array(classic.robertson().fun), as_array(classic.hires().fun)
robertson_jacobian, hires_jacobian = (as_array(p.matrices.jac) for p in (classic.robertson(), classic.hires()))


def oregonator(t, y, s=77.27, q=8.375e-6, w=0.161):
    """The Belousov-Zhabotinsky reaction (Field & Noyes, 1974)."""
    a, b, c = y
    return np.array([s * (b + a * (1 - q * a - b)), (c - (1 + a) * b) / s, w * (a - c)])


def oregonator_jacobian(t, y, s=77.27, q=8.375e-6, w=0.161):
    a, b, _ = y
    return np.array([[s * (1 - 2 * q * a - b), s * (1 - a), 0], [-b / s, -(1 + a) / s, 1 / s], [w, 0, -w]])


# Pyrolysis of four species (problem E5 of Enright, Hull and Lindberg, 1975; Test Set for IVP Solvers): y2 grows to
# 2e-10 and falls as 1/t, with y2 = y3 + y4 throughout. f3 is written as f2 - f4, so that f keeps that to roundoff.
E5_START = np.array([1.76e-3, 0, 0, 0])
E5_END, E5_Y2, E5_Y3 = 1e13, 8.8676655517642120e-23, 8.8548146262688380e-23


def e5(t, y):
    a, b, c, d = y
    first, second, third, fourth = 7.89e-10 * a, 1.1e7 * a * c, 1.13e9 * b * c, 1.13e3 * d
    two, four = first - third, second - fourth
    return np.array([-first - second, two, two - four, four])


def e5_jacobian(t, y):
    a, b, c, _ = y
    two = np.array([7.89e-10, -1.13e9 * c, -1.13e9 * b, 0])
    four = np.array([1.1e7 * c, 0, 1.1e7 * a, -1.13e3])
    one = np.array([-7.89e-10 - 1.1e7 * c, 0, -1.1e7 * a, 0])
    return np.array([one, two, two - four, four])


# Air pollution (Verwer, 1994): 25 reactions of 20 species, each `rate: reactants > products`.
POLLUTION = """
0.35: 1 > 2 3         | 26.6: 2 4 > 1        | 1.23e4: 5 2 > 6 1    | 8.6e-4: 7 > 5 5 8    | 8.2e-4: 7 > 8
1.5e4: 7 6 > 5 8      | 1.3e-4: 9 > 10 5 8   | 2.4e4: 9 6 > 11      | 1.65e4: 11 2 > 10 1 12 | 9e3: 11 1 > 13
0.022: 13 > 11 1      | 1.2e4: 10 2 > 14 1   | 1.88: 14 > 7 5       | 1.63e4: 1 6 > 15     | 4.8e6: 3 > 4
3.5e-4: 4 > 16        | 0.0175: 4 > 3        | 1e8: 16 > 6 6        | 4.44e11: 16 > 3      | 1240: 17 6 > 18 5
2.1: 19 > 2           | 5.78: 19 > 1 3       | 0.0474: 1 4 > 19     | 1780: 19 1 > 20      | 3.12: 20 > 1 19
"""


def _reactions(text):
    """Rates (m,), reactants (2, m) and stoichiometry (n, m); a missing second reactant is component n, which is 1."""
    rates, reactants, changes = [], [], []
    for reaction in text.replace("\n", "|").strip("|").split("|"):
        rate, _, formula = reaction.partition(":")
        left, right = ([int(species) - 1 for species in side.split()] for side in formula.split(">"))
        rates.append(float(rate))
        reactants.append([*left, 20][:2])
        changes.append(np.bincount(right, minlength=20) - np.bincount(left, minlength=20))
    return np.array(rates), np.array(reactants).T, np.array(changes, dtype=float).T


RATES, (FIRST, SECOND), STOICHIOMETRY = _reactions(POLLUTION)


def pollution(t, y):
    y = np.append(y, 1.0)
    return STOICHIOMETRY @ (RATES * y[FIRST] * y[SECOND])


def pollution_jacobian(t, y):
    y, reaction = np.append(y, 1.0), np.arange(len(RATES))
    slope = np.zeros((len(RATES), len(y)))
    np.add.at(slope, (reaction, FIRST), RATES * y[SECOND])
    np.add.at(slope, (reaction, SECOND), RATES * y[FIRST])
    return STOICHIOMETRY @ slope[:, :-1]


# ----------------------------------------------------------------------------------------------------------------------
# Van der Pol, as it is and with time divided by mu: eps = mu**-2


def van_der_pol(t, y, mu):
    a, b = y
    return np.array([b, mu * (1 - a * a) * b - a])


def van_der_pol_jacobian(t, y, mu):
    a, b = y
    return np.array([[0, 1], [-2 * mu * a * b - 1, mu * (1 - a * a)]])


def van_der_pol_scaled(t, y, eps):
    a, b = y
    return np.array([b, ((1 - a * a) * b - a) / eps])


def van_der_pol_scaled_jacobian(t, y, eps):
    a, b = y
    return np.array([[0, 1], [(-2 * a * b - 1) / eps, (1 - a * a) / eps]])


# ----------------------------------------------------------------------------------------------------------------------
# Brusselator, method of lines; u and v are interleaved

POINTS = 500
DIFFUSION = (POINTS + 1) ** 2 / 50
X = np.arange(1, POINTS + 1) / (POINTS + 1)


def brusselator(t, y):
    """u = 1 and v = 3 at both ends."""
    padded = np.concatenate(([1, 3], y, [1, 3]))
    dy = DIFFUSION * (padded[:-4] - 2 * y + padded[4:])
    u, v = y[::2], y[1::2]
    uuv = u * u * v
    dy[::2] += 1 + uuv - 4 * u
    dy[1::2] += 3 * u - uuv
    return dy


def brusselator_jacobian(t, y):
    u, v = y[::2], y[1::2]
    ab = np.zeros((5, len(y)))
    ab[0, 2:] = ab[4, :-2] = DIFFUSION
    ab[1, 1::2] = u * u
    ab[2, ::2] = 2 * u * v - 4 - 2 * DIFFUSION
    ab[2, 1::2] = -u * u - 2 * DIFFUSION
    ab[3, ::2] = 3 - 2 * u * v
    return ab


SIDE = 100  # points of the unit square in each direction, boundary included
DIFFUSION_2D = (SIDE - 1) ** 2 / 10


def brusselator_2d(t, y):
    """No flux through the boundary: the points beyond it mirror those within."""
    w = y.reshape(SIDE, SIDE, 2)
    neighbours = np.empty_like(w)
    neighbours[1:-1] = w[:-2] + w[2:]
    neighbours[0], neighbours[-1] = 2 * w[1], 2 * w[-2]
    neighbours[:, 1:-1] += w[:, :-2] + w[:, 2:]
    neighbours[:, 0] += 2 * w[:, 1]
    neighbours[:, -1] += 2 * w[:, -2]
    dy = DIFFUSION_2D * (neighbours.ravel() - 4 * y)
    u, v = y[::2], y[1::2]
    uuv = u * u * v
    dy[::2] += 1 + uuv - 4.4 * u
    dy[1::2] += 3.4 * u - uuv
    return dy


def _diffusion():
    """Diffusion's part of the Jacobian: rows, columns, values."""
    line = sparse.diags_array([np.ones(SIDE - 1), np.full(SIDE, -2.0), np.ones(SIDE - 1)], offsets=[-1, 0, 1]).tolil()
    line[0, 1] = line[-1, -2] = 2
    eye = sparse.eye_array(SIDE)
    matrix = sparse.kron(sparse.kron(line, eye) + sparse.kron(eye, line), DIFFUSION_2D * sparse.eye_array(2)).tocoo()
    return matrix.row, matrix.col, matrix.data


ROWS, COLUMNS, DIFFUSIVE = _diffusion()
U, V = np.arange(2 * SIDE**2).reshape(-1, 2).T
ROWS, COLUMNS = np.concatenate((ROWS, U, U, V, V)), np.concatenate((COLUMNS, U, V, U, V))


def brusselator_2d_jacobian(t, y):
    u, v = y[::2], y[1::2]
    reactive = (2 * u * v - 4.4, u * u, 3.4 - 2 * u * v, -u * u)
    # Duplicates add up and zeros are kept, so that the pattern is always the same.
    return sparse.csc_array((np.concatenate((DIFFUSIVE, *reactive)), (ROWS, COLUMNS)), shape=(len(y), len(y)))


def _brusselator_2d_start():
    x, y = np.meshgrid(np.linspace(0, 1, SIDE), np.linspace(0, 1, SIDE), indexing="ij")
    return np.stack((22 * y * (1 - y) ** 1.5, 27 * x * (1 - x) ** 1.5), axis=-1).ravel()


# ----------------------------------------------------------------------------------------------------------------------

# Times keep off the jumps of relaxation oscillations: within a jump, an error in phase of 1e-10 is one of any size.
# Van der Pol's jumps are at 0.807 and 1.614 in time over mu, the Oregonator's in 20-25 and 322-328.
PHASES = np.concatenate((np.linspace(0.05, 0.75, 12), np.linspace(0.9, 1.55, 12), np.linspace(1.7, 2, 6)))

PROBLEMS = {
    p.name: p
    for p in (
        StiffProblem(
            "Robertson",
            robertson,
            robertson_jacobian,
            (0, 4e11),
            y0=np.array([1.0, 0, 0]),
            scale=np.array([1e-6, 1e-10, 1e-6]),
            times=np.append(np.logspace(-3, 11, 29), 4e11),
            invariants=np.ones((1, 3)),
        ),
        StiffProblem(
            "HIRES",
            hires,
            hires_jacobian,
            (0, 321.8122),
            y0=np.array([1, 0, 0, 0, 0, 0, 0, 0.0057]),
            scale=np.full(8, 1e-4),
            times=np.append(np.geomspace(0.01, 300, 27), (310, 315, 321.8122)),
            invariants=np.array([[0, 0, 0, 0, 0, 0, 1.0, 1]]),
        ),
        StiffProblem(
            "Oregonator",
            oregonator,
            oregonator_jacobian,
            (0, 360),
            y0=np.array([1.0, 2, 3]),
            scale=np.ones(3),
            times=np.concatenate((np.arange(2.0, 17, 2), np.linspace(28, 316, 17), np.linspace(330, 360, 7))),
        ),
        StiffProblem(
            "van der Pol, mu = 1e3",
            van_der_pol,
            van_der_pol_jacobian,
            (0, 2000),
            y0=np.array([2.0, 0]),
            scale=np.array([1, 1e-3]),
            times=1e3 * PHASES,
            args=(1e3,),
        ),
        *(
            StiffProblem(
                f"van der Pol, eps = {eps}",
                van_der_pol_scaled,
                van_der_pol_scaled_jacobian,
                (0, 2),
                y0=np.array([2.0, 0]),
                scale=np.ones(2),
                times=PHASES,
                args=(float(eps),),
            )
            for eps in ("1e-6", "1e-12")
        ),
        StiffProblem(
            "pollution",
            pollution,
            pollution_jacobian,
            (0, 60),
            y0=np.array([0, 0.2, 0, 0.04, 0, 0, 0.1, 0.3, 0.01, 0, 0, 0, 0, 0, 0, 0, 0.007, 0, 0, 0]),
            scale=10.0 ** -np.array([2, 1, 9, 3, 7, 7, 2, 1, 3, 8, 8, 3, 4, 5, 3, 18, 3, 4, 6, 5]),
            times=np.geomspace(1e-3, 60, 30),
            # Nitrogen, carbon, and the species 17 and 18, which only one reaction has
            invariants=np.array(
                [
                    [1.0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 1, 2],
                    [0, 0, 0, 0, 0, 0, 1, 1, 2, 1, 2, 1, 2, 1, 0, 0, 0, 0, 0, 0],
                    [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 0, 0],
                ]
            ),
        ),
        StiffProblem(
            "Brusselator",
            brusselator,
            brusselator_jacobian,
            (0, 10),
            y0=np.stack((1 + np.sin(2 * np.pi * X), np.full(POINTS, 3.0)), axis=1).ravel(),
            scale=np.ones(2 * POINTS),
            times=np.array([0.1, 0.3, 0.6, 1, 1.5, 2, 3, 4, 5, 6, 8, 10]),
            lband=2,
            uband=2,
            every=7,
        ),
        StiffProblem(
            "Brusselator, 2-D",
            brusselator_2d,
            brusselator_2d_jacobian,
            (0, 2),
            y0=_brusselator_2d_start(),
            scale=np.ones(2 * SIDE**2),
            times=np.array([0.01, 0.1, 0.25, 0.5, 0.75, 1, 1.5, 2]),
            jac_sparsity=sparse.csc_array((np.ones(len(ROWS)), (ROWS, COLUMNS))).sign(),
            every=97,
        ),
    )
}
