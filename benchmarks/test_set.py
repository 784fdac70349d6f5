"""Stiff problems of the Test Set for IVP Solvers that the tests do not have, with their solutions.

F. Mazzia, C. Magherini, Test Set for Initial Value Problem Solvers, release 2.4, University of Bari, 2008. Systems that
SciPy and CVODE cannot take (M y' = f with a singular M) are left out, or, as in the chemical Akzo Nobel problem, have
their one algebraic variable substituted.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from math import pi, sin, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from stiff import E5_START, StiffProblem, e5, e5_jacobian

Array = NDArray[np.float64]


@dataclass(frozen=True)
class KnownProblem(StiffProblem):
    """One whose solution is known in some components, by index, at its times."""

    known: dict[int, list[float]] = field(default_factory=dict)

    def error(self, y: Any) -> float:
        """Largest weighted error of the known components."""
        exact = np.array(list(self.known.values()))
        scale = self.scale[list(self.known), None]
        return float(np.max(np.abs(y[list(self.known)] - exact) / np.maximum(np.abs(exact), scale)))


# ------------------------------------------------------------------------------------------------------- Ring modulator

C, CS, CP, R, RP, LH, LS1, LS2 = 1.6e-8, 2e-12, 1e-8, 25e3, 50.0, 4.45, 2e-3, 5e-4
RG1, RG2, RI, RC = 36.3, 17.3, 50.0, 600.0
GAMMA, DELTA = 40.67286402e-9, 17.7493332

#: What the voltages of the four diodes take from y3 ... y7, and from the second input.
DIODES = np.array([[1, 0, -1, 0, -1], [0, -1, 0, 1, -1], [0, 1, 1, 0, 1], [-1, 0, 0, -1, 1.0]])
INPUT = np.array([-1, -1, 1, 1.0])
#: What the currents of the diodes add to y3' ... y7', as currents.
CURRENTS = np.array([[-1, 0, 0, 1], [0, 1, -1, 0], [1, 0, -1, 0], [0, -1, 0, 1], [1, 1, -1, -1.0]])
CAPACITIES = np.array([CS, CS, CS, CS, CP])


def _ring_linear() -> Array:
    """The part of ∂f/∂y without diodes."""
    A = np.zeros((15, 15))
    A[0, [7, 9, 10, 13, 0]] = np.array([1, -0.5, 0.5, 1, -1 / R]) / C
    A[1, [8, 11, 12, 14, 1]] = np.array([1, -0.5, 0.5, 1, -1 / R]) / C
    A[2, 9], A[3, 10], A[4, 11], A[5, 12] = 1 / CS, -1 / CS, 1 / CS, -1 / CS
    A[6, 6] = -1 / (RP * CP)
    A[7, 0] = A[8, 1] = -1 / LH
    for row, source, voltage, sign in ((9, 0, 2, 1), (10, 0, 3, -1), (11, 1, 4, 1), (12, 1, 5, -1)):
        A[row, [source, voltage, row]] = np.array([0.5 * sign, -sign, -RG2]) / LS2
    A[13, [0, 13]] = np.array([-1, -(RI + RG1)]) / LS1
    A[14, [1, 14]] = np.array([-1, -(RC + RG1)]) / LS1
    return A


RING = _ring_linear()


def ring_modulator(t: float, y: Array) -> Array:
    f = RING @ y
    volts = DIODES @ y[2:7] + 2 * sin(2e4 * pi * t) * INPUT
    f[2:7] += CURRENTS @ (GAMMA * np.expm1(DELTA * volts)) / CAPACITIES
    f[13] += 0.5 * sin(2e3 * pi * t) / LS1
    return f


def ring_modulator_jacobian(t: float, y: Array) -> Array:
    J = RING.copy()
    volts = DIODES @ y[2:7] + 2 * sin(2e4 * pi * t) * INPUT
    slopes = GAMMA * DELTA * np.exp(DELTA * volts)
    J[2:7, 2:7] += CURRENTS @ (slopes[:, None] * DIODES) / CAPACITIES[:, None]
    return J


#: At the end, as printed.
RING_END = [
    -0.2339057358486745e-1, -0.7367485485540825e-2, 0.2582956709291169, -0.4064465721283450, -0.4039455665149794,
    0.2607966765422943, 0.1106761861269975, 0.2939904342435596e-6, -0.2840029933642329e-7, 0.7267198267264553e-3,
    0.7929487196960840e-3, -0.7255283495698965e-3, -0.7941401968526521e-3, 0.7088495416976114e-4,
    0.2390059075236570e-4,
]  # fmt: skip

# -------------------------------------------------------------------------------------------------- Chemical Akzo Nobel

K1, K2, K3, K4, EQUILIBRIUM, KLA, KS, PRESSURE, HENRY = 18.7, 0.58, 0.09, 0.42, 34.4, 3.3, 115.83, 0.9, 737.0


def chemical_akzo(t: float, y: Array) -> list[float]:
    a, b, c, d, e = y
    root = sqrt(b) if b > 0 else 0.0
    r1, r2, r3, r4 = K1 * a**4 * root, K2 * c * d, K2 / EQUILIBRIUM * a * e, K3 * a * d * d
    r5 = K4 * (KS * a * d) ** 2 * root
    supply = KLA * (PRESSURE / HENRY - b)
    return [
        -2 * r1 + r2 - r3 - r4, -0.5 * r1 - r4 - 0.5 * r5 + supply, r1 - r2 + r3, -r2 + r3 - 2 * r4, r2 - r3 + r5,
    ]  # fmt: skip


def chemical_akzo_jacobian(t: float, y: Array) -> Array:
    a, b, c, d, e = y
    root = sqrt(b) if b > 0 else 0.0
    half = 0.5 / root if root > 0 else 0.0
    six = KS * a * d
    r1 = np.array([4 * K1 * a**3 * root, K1 * a**4 * half, 0, 0, 0])
    r2 = np.array([0, 0, K2 * d, K2 * c, 0])
    r3 = K2 / EQUILIBRIUM * np.array([e, 0, 0, 0, a])
    r4 = K3 * np.array([d * d, 0, 0, 2 * a * d, 0])
    r5 = K4 * np.array([2 * six * KS * d * root, six**2 * half, 0, 2 * six * KS * a * root, 0])
    supply = np.array([0, -KLA, 0, 0, 0])
    return np.array([
        -2 * r1 + r2 - r3 - r4, -0.5 * r1 - r4 - 0.5 * r5 + supply, r1 - r2 + r3, -r2 + r3 - 2 * r4, r2 - r3 + r5,
    ])  # fmt: skip


#: At the end, as printed; radau agrees to 2e-13.
CHEMICAL_END = [
    0.1150794920661702, 0.1203831471567715e-2, 0.1611562887407974, 0.3656156421249283e-3, 0.1708010885264404e-1,
]  # fmt: skip

# --------------------------------------------------------------------------------------------------- Medical Akzo Nobel

POINTS = 200
ZETA = np.arange(1, POINTS) / POINTS
DRIFT = 2 * (ZETA - 1) ** 3 / 16 * POINTS / 2  # α / (2 Δζ)
SPREAD = (ZETA - 1) ** 4 / 16 * POINTS**2  # β / Δζ²
REACTION = 100.0


def medical_akzo(t: float, y: Array) -> Array:
    """Antibodies u spread into tissue that binds them, v. The supply ends at t = 5."""
    u, v = y[::2], y[1::2]
    left = np.empty(POINTS - 1)
    left[0], left[1:] = (2.0 if t <= 5 else 0.0), u[:-2]
    f = np.repeat(-REACTION * u * v, 2)
    f[:-2:2] += DRIFT * (u[1:] - left) + SPREAD * (left - 2 * u[:-1] + u[1:])
    return f


def medical_akzo_jacobian(t: float, y: Array) -> Array:
    u, v = y[::2], y[1::2]
    ab = np.zeros((5, 2 * POINTS))
    ab[2, ::2] = -REACTION * v
    ab[2, :-2:2] -= 2 * SPREAD
    ab[2, 1::2] = ab[1, 1::2] = -REACTION * u
    ab[3, ::2] = -REACTION * v
    ab[0, 2::2] = SPREAD + DRIFT  # ∂/∂u of the point on the right
    ab[4, :-4:2] = (SPREAD - DRIFT)[1:]
    return ab


#: At the end, by radau at rtol = 1e-12 with a breakpoint at t = 5. SciPy's LSODA in two parts agrees to 2e-10, the
#: printed solution to 7e-9.
MEDICAL_END = {
    78: 2.3399422229503e-4, 132: 3.5768359668028e-4, 170: 3.0859498406290e-4, 198: 1.1737412961582e-4,
    199: 6.1908220245334e-6,
}  # fmt: skip

#: E5 at t = 1, 10, ..., 1e6, by SciPy's Radau at rtol = 1e-13; radau agrees to 1e-12. At the end of its interval, 1e13,
#: y2 = y3 + y4 has fallen so far that only three digits are above the roundoff of its beginning.
E5_TIMES = 10.0 ** np.arange(7)
E5_KNOWN = [
    [1.7599992560697e-03, 1.7599259497678e-03, 1.7534656083428e-03, 1.6180769999073e-03, 7.2404139018971e-04,
     7.4813208224289e-06, 4.9367194167258e-08],
    [1.3885996986469e-12, 1.3846281519377e-11, 1.0889061015806e-10, 1.3822370304984e-10, 6.4079971211600e-11,
     2.3734781561205e-12, 1.8615865976209e-13],
    [7.6643739897287e-14, 7.6370038530074e-13, 6.0263621401268e-12, 8.2515735006837e-12, 7.9620340000430e-12,
     2.2123586689582e-12, 1.8606924128415e-13],
    [1.3119559587496e-12, 1.3082581134076e-11, 1.0286424801794e-10, 1.2997212954915e-10, 5.6117937211558e-11,
     1.6111948716243e-13, 8.9418478113183e-17],
]  # fmt: skip

PROBLEMS = {
    p.name: p
    for p in (
        KnownProblem(
            "E5",
            e5,
            e5_jacobian,
            (0, 1e6),
            y0=E5_START,
            scale=np.array([1e-6, 1e-15, 1e-15, 1e-15]),
            times=E5_TIMES,
            known=dict(enumerate(E5_KNOWN)),
        ),
        KnownProblem(
            "ring modulator",
            ring_modulator,
            ring_modulator_jacobian,
            (0, 1e-3),
            y0=np.zeros(15),
            scale=np.full(15, 1e-4),
            times=np.array([1e-3]),
            known={i: [value] for i, value in enumerate(RING_END)},
        ),
        KnownProblem(
            "chemical Akzo Nobel",
            chemical_akzo,
            chemical_akzo_jacobian,
            (0, 180),
            y0=np.array([0.444, 0.00123, 0, 0.007, 0]),
            scale=np.full(5, 1e-4),
            times=np.array([180.0]),
            known={i: [value] for i, value in enumerate(CHEMICAL_END)},
        ),
        KnownProblem(
            "medical Akzo Nobel",
            medical_akzo,
            medical_akzo_jacobian,
            (0, 20),
            y0=np.tile([0.0, 1.0], POINTS),
            scale=np.full(2 * POINTS, 1e-4),
            times=np.array([20.0]),
            lband=2,
            uband=2,
            known={i: [value] for i, value in MEDICAL_END.items()},
        ),
    )
}
