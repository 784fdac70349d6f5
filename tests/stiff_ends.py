"""More stiff problems of the Test Set for IVP Solvers: those whose solution is known at the end, or in some components.

F. Mazzia, C. Magherini, Test Set for Initial Value Problem Solvers, release 2.4, University of Bari, 2008. In the
chemical Akzo Nobel problem and in E5 the one component that the others determine is substituted.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import exp, pi, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dptsv

from stiff import StiffProblem

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
HIGHEST = 700.0  # exp of a higher number overflows: trial steps may go astray

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


def diode(voltage: float) -> float:
    return GAMMA * (exp(min(DELTA * voltage, HIGHEST)) - 1)


def ring_modulator(t: float, y: Array) -> list[float]:
    """With numbers, a fifth of the time that it takes with arrays: a run calls it up to 10⁷ times."""
    v1, v2, v3, v4, v5, v6, v7, i1, i2, i3, i4, i5, i6, i7, i8 = y.tolist()
    carrier = v7 + 2 * sin(2e4 * pi * t)
    a, b = diode(v3 - v5 - carrier), diode(v6 - v4 - carrier)
    c, d = diode(v4 + v5 + carrier), diode(carrier - v3 - v6)
    return [
        (i1 - 0.5 * i3 + 0.5 * i4 + i7 - v1 / R) / C,
        (i2 - 0.5 * i5 + 0.5 * i6 + i8 - v2 / R) / C,
        (i3 - a + d) / CS,
        (-i4 + b - c) / CS,
        (i5 + a - c) / CS,
        (-i6 - b + d) / CS,
        (-v7 / RP + a + b - c - d) / CP,
        -v1 / LH,
        -v2 / LH,
        (0.5 * v1 - v3 - RG2 * i3) / LS2,
        (-0.5 * v1 + v4 - RG2 * i4) / LS2,
        (0.5 * v2 - v5 - RG2 * i5) / LS2,
        (-0.5 * v2 + v6 - RG2 * i6) / LS2,
        (-v1 + 0.5 * sin(2e3 * pi * t) - (RI + RG1) * i7) / LS1,
        (-v2 - (RC + RG1) * i8) / LS1,
    ]


def ring_modulator_jacobian(t: float, y: Array) -> Array:
    J = RING.copy()
    volts = DIODES @ y[2:7] + 2 * sin(2e4 * pi * t) * INPUT
    slopes = GAMMA * DELTA * np.exp(np.minimum(DELTA * volts, HIGHEST))
    J[2:7, 2:7] += CURRENTS @ (slopes[:, None] * DIODES) / CAPACITIES[:, None]
    return J


#: At the end, by radau at rtol = 1e-11; ode89 with 5e8 evaluations of f agrees to 2e-11, the printed solution to 3e-10.
RING_END = [
    -2.339057358439e-02, -7.367485485986e-03, 2.582956709971e-01, -4.064465720605e-01, -4.039455664475e-01,
    2.607966766106e-01, 1.106761861273e-01, 2.939904342448e-07, -2.840029933066e-08, 7.267198267281e-04,
    7.929487197029e-04, -7.255283495773e-04, -7.941401968537e-04, 7.088495416873e-05, 2.390059075277e-05,
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

# ------------------------------------------------------------------------------------------------------------------- E5


def e5_substituted(t: float, y: Array) -> list[float]:
    """E5 with y2 = y3 + y4, so that y is (y1, y3, y4): in the four equations y2 - y3 - y4 is the roundoff of their
    beginning, 1e-26, beside which a solution of 9e-23 has three or four digits."""
    a, c, d = y
    first, second, third, fourth = 7.89e-10 * a, 1.1e7 * a * c, 1.13e9 * (c + d) * c, 1.13e3 * d
    return [-first - second, first - third - second + fourth, second - fourth]


def e5_substituted_jacobian(t: float, y: Array) -> list[list[float]]:
    a, c, d = y
    by_a, by_c = 1.1e7 * c, 1.1e7 * a
    return [
        [-7.89e-10 - by_a, -by_c, 0],
        [7.89e-10 - by_a, -1.13e9 * (2 * c + d) - by_c, -1.13e9 * c + 1.13e3],
        [by_a, by_c, -1.13e3],
    ]


#: At t = 1, 10, ..., 1e13, by SciPy's Radau at rtol = 1e-13; radau agrees to 3e-12. Of the printed solution at the end,
#: y2 = 8.8677e-23 and y3 = 8.8548e-23, which should be equal, the first three digits are right.
E5_TIMES = 10.0 ** np.arange(14)
E5_KNOWN = [
    [1.7599992560697e-03, 1.7599259497678e-03, 1.7534656083428e-03, 1.6180769999073e-03, 7.2404139018971e-04,
     7.4813208224292e-06, 4.9367194167281e-08, 4.7150333630402e-10, 4.5303729679395e-12, 3.1317148329354e-14,
     2.8141371731769e-18, 0, 0, 0],
    [7.6643739897288e-14, 7.6370038530074e-13, 6.0263621401267e-12, 8.2515735006838e-12, 7.9620340000430e-12,
     2.2123586689582e-12, 1.8606924128411e-13, 1.8188812376787e-14, 1.7830698671707e-15, 1.4840957948345e-16,
     1.5712632888933e-18, 1.0192582568129e-20, 8.9677206407008e-22, 8.8612335212909e-23],
    [1.3119559587496e-12, 1.3082581134076e-11, 1.0286424801793e-10, 1.2997212954915e-10, 5.6117937211558e-11,
     1.6111948716243e-13, 8.9418478113214e-17, 8.3484020296322e-20, 7.8635121053421e-23, 4.5243728279776e-26, 0, 0,
     0, 0],
]  # fmt: skip

# ----------------------------------------------------------------------------------------------------------------- Beam

LINKS = 40
ROWS = np.arange(LINKS)
#: G of the beam, (n + 1/2 - max(l, k)), is the inverse of a matrix with this diagonal and -1 beside it.
DIAGONAL = np.array([1.0, *[2] * (LINKS - 2), 3])
G = LINKS - 0.5 - np.maximum.outer(ROWS, ROWS)
#: Differences of the angles with θ[-1] = -θ[0] and θ[n] = θ[n-1]: clamped on the left, free on the right.
BENDING = np.diag([-3.0, *[-2] * (LINKS - 2), -1]) + np.diag(np.ones(LINKS - 1), 1) + np.diag(np.ones(LINKS - 1), -1)
BENDING *= LINKS**4


def beam_force(t: float) -> float:
    """n² times the force at the free end, upwards and to the left."""
    return LINKS**2 * 1.5 * sin(t) ** 2 if t < pi else 0.0


def beam(t: float, y: Array) -> Array:
    """An elastic beam of n inextensible links, their angles and angular velocities (Hairer and Wanner II, IV.1).

    A θ'' + H θ'² = v, with A + iH = (G[l, k] exp(i(θ[l] - θ[k]))). The inverse is C + iD, tridiagonal like that of G,
    so that θ'' = C v + D u, where C u = D v + θ'².
    """
    angles, velocities = y[:LINKS], y[LINKS:]
    turns = np.diff(angles)
    sines, cosines = np.sin(turns), np.cos(turns)
    v = BENDING @ angles + beam_force(t) * (np.cos(angles) + np.sin(angles))
    w = velocities * velocities
    w[:-1] += sines * v[1:]
    w[1:] -= sines * v[:-1]
    u = dptsv(DIAGONAL, -cosines, w)[2]
    accelerations = DIAGONAL * v
    accelerations[:-1] += sines * u[1:] - cosines * v[1:]
    accelerations[1:] -= sines * u[:-1] + cosines * v[:-1]
    return np.concatenate((velocities, accelerations))


def beam_jacobian(t: float, y: Array) -> Array:
    """A θ'' + H θ'² = v, differentiated."""
    angles, velocities = y[:LINKS], y[LINKS:]
    apart = np.subtract.outer(angles, angles)
    A, H = G * np.cos(apart), G * np.sin(apart)
    turned = H * beam(t, y)[LINKS:] - A * velocities**2
    by_angles = BENDING - turned
    by_angles[ROWS, ROWS] += turned.sum(axis=1) + beam_force(t) * (np.cos(angles) - np.sin(angles))
    J = np.zeros((2 * LINKS, 2 * LINKS))
    J[ROWS, LINKS + ROWS] = 1
    J[LINKS:] = np.linalg.solve(A, np.hstack((by_angles, -2 * H * velocities)))
    return J


#: Every eighth angle and velocity at the end, as printed.
BEAM_END = {
    7: -0.7510730581979037e-1, 15: -0.1299544113264161, 23: -0.1614248603702127, 31: -0.1744911773840049,
    39: -0.1767201761075488, 47: 0.4916620354601748, 55: 0.8604110305190560, 63: 0.1077857811433353e1,
    71: 0.1170505992596124e1, 79: 0.1186724615113034e1,
}  # fmt: skip

# ------------------------------------------------------------------------------------------------- Transistor amplifier

SUPPLY, THERMAL, GAIN, SATURATION, SOURCE, LOAD = 6.0, 0.026, 0.99, 1e-6, 1e3, 9e3
PAIR = np.array([[-1, 1], [1, -1.0]])  # of one capacity between two nodes
AMPLIFIER_MASS = np.zeros((8, 8))
AMPLIFIER_MASS[:2, :2], AMPLIFIER_MASS[3:5, 3:5], AMPLIFIER_MASS[6:, 6:] = 1e-6 * PAIR, 3e-6 * PAIR, 5e-6 * PAIR
AMPLIFIER_MASS[2, 2], AMPLIFIER_MASS[5, 5] = -2e-6, -4e-6
RESISTORS = np.diag([1 / SOURCE, *np.array([2, 1, 1, 2, 1, 1, 1]) / LOAD])
#: What the current of a transistor adds at its base, emitter and collector.
TERMINALS = np.array([1 - GAIN, -1, GAIN])


def transistor(voltage: float) -> float:
    return SATURATION * exp(min(voltage / THERMAL, HIGHEST))


def amplifier(t: float, y: Array) -> list[float]:
    """Currents into the eight nodes of two stages (index 1: M has rank 5)."""
    a, b, c, d, e, f, g, h = y.tolist()
    first, second = transistor(b - c) - SATURATION, transistor(e - f) - SATURATION
    return [
        (a - 0.1 * sin(200 * pi * t)) / SOURCE,
        (2 * b - SUPPLY) / LOAD + (1 - GAIN) * first,
        c / LOAD - first,
        (d - SUPPLY) / LOAD + GAIN * first,
        (2 * e - SUPPLY) / LOAD + (1 - GAIN) * second,
        f / LOAD - second,
        (g - SUPPLY) / LOAD + GAIN * second,
        h / LOAD,
    ]


def amplifier_jacobian(t: float, y: Array) -> Array:
    J = RESISTORS.copy()
    for base in (1, 4):
        current = transistor(y[base] - y[base + 1]) / THERMAL * TERMINALS
        J[base : base + 3, base] += current
        J[base : base + 3, base + 1] -= current
    return J


AMPLIFIER_START = np.array([0, SUPPLY / 2, SUPPLY / 2, SUPPLY, SUPPLY / 2, SUPPLY / 2, SUPPLY, 0])


def _amplifier_slope() -> Array:
    """y' at the start: M y' = f, and, of the three equations in which M y' cancels, the derivative."""
    cancelling = np.zeros((3, 8))
    for row, node in enumerate((0, 3, 6)):
        cancelling[row, node : node + 2] = 1
    by_t = np.array([-0.1 * 200 * pi / SOURCE, *[0] * 7])
    rows = np.vstack((AMPLIFIER_MASS, cancelling @ amplifier_jacobian(0, AMPLIFIER_START)))
    return np.linalg.lstsq(rows, np.append(amplifier(0, AMPLIFIER_START), -cancelling @ by_t), rcond=None)[0]


#: At the end, as printed; radau agrees to 2e-13.
AMPLIFIER_END = [
    -0.5562145012262709e-2, 0.3006522471903042e1, 0.2849958788608128e1, 0.2926422536206241e1, 0.2704617865010554e1,
    0.2761837778393145e1, 0.4770927631616772e1, 0.1236995868091548e1,
]  # fmt: skip


def _at_end(values: list[float]) -> dict[int, list[float]]:
    """All components, at the one time."""
    return {i: [value] for i, value in enumerate(values)}


PROBLEMS = {
    p.name: p
    for p in (
        KnownProblem(
            "E5",
            e5_substituted,
            e5_substituted_jacobian,
            (0, 1e13),
            y0=np.array([1.76e-3, 0, 0]),
            scale=np.array([1e-6, 1e-24, 1e-15]),
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
            known=_at_end(RING_END),
        ),
        KnownProblem(
            "chemical Akzo Nobel",
            chemical_akzo,
            chemical_akzo_jacobian,
            (0, 180),
            y0=np.array([0.444, 0.00123, 0, 0.007, 0]),
            scale=np.full(5, 1e-4),
            times=np.array([180.0]),
            known=_at_end(CHEMICAL_END),
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
        KnownProblem(
            "beam",
            beam,
            beam_jacobian,
            (0, 5),
            y0=np.zeros(2 * LINKS),
            scale=np.ones(2 * LINKS),
            times=np.array([5.0]),
            known={i: [value] for i, value in BEAM_END.items()},
        ),
        KnownProblem(
            "transistor amplifier",
            amplifier,
            amplifier_jacobian,
            (0, 0.2),
            y0=AMPLIFIER_START,
            scale=np.full(8, 0.1),
            times=np.array([0.2]),
            mass=AMPLIFIER_MASS,
            slope=_amplifier_slope(),
            known=_at_end(AMPLIFIER_END),
        ),
    )
}
