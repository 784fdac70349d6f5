"""Differential-algebraic equations F(t, y, y') = 0 or F(t, y, y', y'') = 0 of index 0 to 13, with references.

Car axis, Andrews' squeezer, Fekete's points, transistor amplifier, ring modulator and Akzo Nobel are those of the Test
Set for IVP Solvers (F. Mazzia, C. Magherini, 2008), with its references.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

import invariode as iv

GRAVITY = 9.81


@dataclass(frozen=True)
class DaeProblem:
    """A DAE: F, its interval, initial values or guesses, and some components of the solution at the end."""

    F: Callable[..., Any]
    t_span: tuple[float, float]
    y0: ArrayLike
    yp0: ArrayLike | None = None
    order: int = 1
    reference: Callable[[], np.ndarray] | None = None
    components: Sequence[int] = ()
    fixed: Sequence[Any] = ()
    index: int | None = None
    freedom: int | None = None
    floor: float = 1e-3  # components below it are compared with it
    options: dict[str, Any] = field(default_factory=dict)

    def analysed(self) -> iv.Dae:
        return iv.Dae(self.F, self.t_span[0], self.y0, self.yp0, order=self.order)

    def solve(self, method: str, rtol: float, atol: float | None = None, **options: Any) -> iv.Solution:
        given = {"fixed": self.fixed, "order": self.order, **options}
        return iv.solve_dae(
            self.F, self.t_span, self.y0, self.yp0, method=method, rtol=rtol, atol=atol or rtol / 100, **given
        )

    def error(self, sol: iv.Solution) -> float:
        """The largest relative error at the end."""
        expected = self.reference()
        off = np.abs(sol.y[list(self.components), -1] - expected)
        return float((off / np.maximum(np.abs(expected), self.floor)).max())


# ----------------------------------------------------------------------------------------------------------------------
# Pendula


def pendulum(t, y, yp, ypp):
    x, z, tension = y
    return [ypp[0] + x * tension, ypp[1] + z * tension + GRAVITY, x**2 + z**2 - 1]


def pendulum_of_first_order(t, y, yp):
    x, z, u, v, tension = y
    return [yp[0] - u, yp[1] - v, yp[2] + x * tension, yp[3] + z * tension + GRAVITY, x * x + z * z - 1]


@cache
def _by_angle() -> np.ndarray:
    a, w = _precisely(lambda t, y: [y[1], -GRAVITY * np.sin(y[0])], 5.0, [np.pi / 2, 0.0])
    return np.array([np.sin(a), -np.cos(a), w * w + GRAVITY * np.cos(a)])


def _precisely(fun, end, y0):
    return iv.solve_ivp(fun, (0, end), y0, "dop853", rtol=1e-13, atol=1e-15).y[:, -1]


G, STRETCH = 9.8, 0.1  # of the two pendula of DAETS


def two_pendula(t, y, yp, ypp):
    """The length of the second depends on the tension of the first."""
    x, z, first, u, v, second = y
    return [
        *(ypp[0] + x * first, ypp[1] + z * first + G, x * x + z * z - 1),
        *(ypp[3] + u * second, ypp[4] + v * second + G, u * u + v * v - (1 + STRETCH * first) ** 2),
    ]


@cache
def _by_angles() -> np.ndarray:
    def lengths(a, w):
        faster = -G * np.sin(a)
        tension, rate = w**2 + G * np.cos(a), 2 * w * faster - G * np.sin(a) * w
        return faster, tension, 1 + STRETCH * tension, STRETCH * rate

    def slope(t, y):
        a, w, b, v = y
        faster, _, length, growth = lengths(a, w)
        return [w, faster, v, (-2 * growth * v - G * np.sin(b)) / length]

    a, w, b, _ = _precisely(slope, 5.0, [np.pi / 2, 0.0, np.pi / 2, 0.0])
    _, tension, length, _ = lengths(a, w)
    return np.array([np.sin(a), -np.cos(a), tension, length * np.sin(b), -length * np.cos(b)])


def pendula(count: int) -> DaeProblem:
    """A sequence in which the tension of each changes the length of the next: index 2 count + 1."""

    def equations(t, y, yp, ypp):
        residuals, length = [], 1.0
        for x, z, tension, ax, az in zip(y[::3], y[1::3], y[2::3], ypp[::3], ypp[1::3], strict=True):
            residuals += [ax + x * tension, az + z * tension + G, x * x + z * z - length**2]
            length = 1.0 + 0.01 * tension
        return residuals

    return DaeProblem(equations, (0, 0.5), np.tile([1.0, 0, 0], count), order=2, index=2 * count + 1, freedom=2 * count)


def chain(links: int, end: float = 0.3) -> DaeProblem:
    """A chain of equal links that falls from the horizontal: positions, then multipliers."""

    def equations(t, y, yp, ypp):
        at, pulls = y[: 2 * links], y[2 * links :]
        residuals = []
        for k in range(links):
            dx, dz = (at[2 * k] - at[2 * k - 2], at[2 * k + 1] - at[2 * k - 1]) if k else (at[0], at[1])
            fx, fz = pulls[k] * dx, pulls[k] * dz
            if k + 1 < links:
                fx = fx - pulls[k + 1] * (at[2 * k + 2] - at[2 * k])
                fz = fz - pulls[k + 1] * (at[2 * k + 3] - at[2 * k + 1])
            length = (dx * dx + dz * dz - 1 / links**2) / 2
            residuals += [ypp[2 * k] + fx * links, ypp[2 * k + 1] + fz * links + GRAVITY, length]
        return residuals

    y0 = np.zeros(3 * links)
    y0[: 2 * links : 2] = np.arange(1, links + 1) / links
    return DaeProblem(equations, (0, end), y0, 0 * y0, order=2, index=3, freedom=2 * links)


# ----------------------------------------------------------------------------------------------------------------------
# Prescribed motion: no degree of freedom


def robot_arm(t, y, yp, ypp):
    """S. L. Campbell, E. Griepentrog, SIAM J. Sci. Comput. 16 (1995) 257-270: x1 = 1 - e^t, x3 = e^t - t."""
    x1, x2, x3, u1, u2 = y
    c, s = np.cos(x3), np.sin(x3)
    q = 2 - c**2
    a, b, e, d = 2 / q, c / q, s / q, c * s / q
    spin, pull, drive = (yp[0] + yp[2]) ** 2, 2 * x3 - x2, u1 - u2
    px, pz = np.cos(1 - np.exp(t)) + np.cos(1 - t), np.sin(1 - np.exp(t)) + np.sin(1 - t)
    return [
        ypp[0] - (2 * e * spin + yp[0] ** 2 * d + pull * (a + 2 * b) + a * drive),
        ypp[1] - (-2 * e * spin - yp[0] ** 2 * d + pull * (1 - 3 * a - 2 * b) - a * u1 + (a + 1) * u2),
        ypp[2]
        - (-2 * e * spin - yp[0] ** 2 * d + pull * (a - 9 * b) - 2 * yp[0] ** 2 * e - d * spin - (a + b) * drive),
        np.cos(x1) + np.cos(x1 + x3) - px,
        np.sin(x1) + np.sin(x1 + x3) - pz,
    ]


def crane(t, y, yp, ypp):
    """A load follows a path: trolley, force on it, tension over length of the rope, squared length of the rope."""
    trolley, force, pull, square = y
    x, z = 0.5 * (1 - np.cos(t)), -2 + 0.2 * np.sin(t) ** 2
    return [
        0.5 * np.cos(t) + pull * (x - trolley),
        0.4 * np.cos(2 * t) + pull * z + GRAVITY,
        5 * ypp[0] - force - pull * (x - trolley),
        (x - trolley) ** 2 + z**2 - square,
    ]


def crane_solution(t):
    """The crane in closed form: s = x + x''/q with q = -(z'' + g)/z, and F = 5 s'' - q (x - s)."""
    c, s, c2, s2 = np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)
    z, zs = -2 + 0.2 * s**2, [0.2 * s2, 0.4 * c2]  # z', z''
    w = [0.4 * c2 + GRAVITY, -0.8 * s2, -1.6 * c2]  # z'' + g and its derivatives
    q, xpp = -w[0] / z, [0.5 * c, -0.5 * s, -0.5 * c]
    r = -z / w[0]  # 1 / q
    r1 = -(zs[0] * w[0] - z * w[1]) / w[0] ** 2
    r2 = -(zs[1] * w[0] - z * w[2]) / w[0] ** 2 + 2 * w[1] * (zs[0] * w[0] - z * w[1]) / w[0] ** 3
    x = 0.5 * (1 - c)
    trolley = x + xpp[0] * r
    acceleration = 0.5 * c + xpp[2] * r + 2 * xpp[1] * r1 + xpp[0] * r2
    return np.array([trolley, 5 * acceleration + q * (trolley - x), q, (x - trolley) ** 2 + z**2])


def reactor(t, y, yp):
    """The temperature control of an exothermic reactor; C. C. Pantelides and others, 1988."""
    concentration, temperature, rate, coolant = y
    return [
        yp[0] - (1 - concentration) + rate,
        yp[1] - (300 - temperature) - 100 * rate + 2 * (temperature - coolant),
        rate - 2e3 * np.exp(-3000 / temperature) * concentration,
        concentration - (0.5 * np.exp(-t) + 0.2 + 0.05 * np.sin(t)),
    ]


def reactor_solution(t):
    e, s, c = np.exp(-t), np.sin(t), np.cos(t)
    C, C1, C2 = 0.5 * e + 0.2 + 0.05 * s, -0.5 * e + 0.05 * c, 0.5 * e - 0.05 * s
    rate, rate1 = 1 - C - C1, -C1 - C2
    log = np.log(rate / (2000 * C))
    T, T1 = -3000 / log, 3000 / log**2 * (rate1 / rate - C1 / C)
    return np.array([C, T, rate, T + (T1 - (300 - T) - 100 * rate) / 2])


# ----------------------------------------------------------------------------------------------------------------------
# The Test Set for IVP Solvers


def car_axis(t, y, yp):
    xl, yl, xr, yr, first, second = y[0], y[1], y[2], y[3], y[8], y[9]
    k, yb = 5e-4, 0.1 * np.sin(10 * t)
    xb = np.sqrt(1 - yb * yb)
    left, right = np.sqrt(xl**2 + yl**2), np.sqrt((xr - xb) ** 2 + (yr - yb) ** 2)
    return [
        *(yp[i] - y[4 + i] for i in range(4)),
        k * yp[4] - ((0.5 - left) * xl / left + first * xb + 2 * second * (xl - xr)),
        k * yp[5] - ((0.5 - left) * yl / left + first * yb + 2 * second * (yl - yr) - k),
        k * yp[6] - ((0.5 - right) * (xr - xb) / right - 2 * second * (xl - xr)),
        k * yp[7] - ((0.5 - right) * (yr - yb) / right - 2 * second * (yl - yr) - k),
        xb * xl + yb * yl,
        (xl - xr) ** 2 + (yl - yr) ** 2 - 1,
    ]


CAR_AXIS = np.array(
    [
        "0.493455784275402809122e-1",
        "0.496989460230171153861",
        "0.104174252488542151681e1",
        "0.373911027265361256927",
        "-0.770583684040972357970e-1",
        "0.744686658723778553466e-2",
        "0.175568157537232222276e-1",
        "0.770341043779251976443",
        "-0.473688659084893324729e-2",
        "-0.110468033125734368808e-2",
    ],
    float,
)


def squeezer(t, y, yp, ypp):
    """Andrews' squeezing mechanism: seven angles, six multipliers."""
    m1, m2, m3, m4, m5, m6, m7 = 0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498
    xa, ya, xb, yb, xc, yc, c0 = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072, 4530.0
    i1, i2, i3, i4, i5, i6, i7 = 2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5
    d, da, e, ea, rr, ra, l0 = 28e-3, 115e-4, 2e-2, 1421e-5, 7e-3, 92e-5, 7785e-5
    ss, sa, sb, sc, sd, ta, tb = 35e-3, 1874e-5, 1043e-5, 18e-3, 2e-2, 2308e-5, 916e-5
    u, ua, ub, zf, zt, fa, drive = 4e-2, 1228e-5, 449e-5, 2e-2, 4e-2, 1421e-5, 33e-3
    S, C = np.sin, np.cos
    be, th, ga, ph, de, om, ep = y[:7]
    w, pull = ypp[:7], y[7:]
    m21 = m2 * (da**2 - da * rr * C(th)) + i2
    m54 = m4 * ((e - ea) ** 2 + zt * (e - ea) * S(ph)) + i4
    m76 = m6 * ((zf - fa) ** 2 - u * (zf - fa) * S(om)) + i6
    m55 = m4 * (zt**2 + 2 * zt * (e - ea) * S(ph) + (e - ea) ** 2) + m5 * (ta**2 + tb**2) + i4 + i5
    m77 = m6 * ((zf - fa) ** 2 - 2 * u * (zf - fa) * S(om) + u**2) + m7 * (ua**2 + ub**2) + i6 + i7
    inertia = [
        (m1 * ra**2 + m2 * (rr**2 - 2 * da * rr * C(th) + da**2) + i1 + i2) * w[0] + m21 * w[1],
        m21 * w[0] + (m2 * da**2 + i2) * w[1],
        (m3 * (sa**2 + sb**2) + i3) * w[2],
        (m4 * (e - ea) ** 2 + i4) * w[3] + m54 * w[4],
        m54 * w[3] + m55 * w[4],
        (m6 * (zf - fa) ** 2 + i6) * w[5] + m76 * w[6],
        m76 * w[5] + m77 * w[6],
    ]
    xd, yd = sd * C(ga) + sc * S(ga) + xb, sd * S(ga) - sc * C(ga) + yb
    length = np.sqrt((xd - xc) ** 2 + (yd - yc) ** 2)
    spring = -c0 * (length - l0) / length
    fx, fy = spring * (xd - xc), spring * (yd - yc)
    forces = [
        drive - m2 * da * rr * yp[1] * (yp[1] + 2 * yp[0]) * S(th),
        m2 * da * rr * yp[0] ** 2 * S(th),
        fx * (sc * C(ga) - sd * S(ga)) + fy * (sd * C(ga) + sc * S(ga)),
        m4 * zt * (e - ea) * yp[4] ** 2 * C(ph),
        -m4 * zt * (e - ea) * yp[3] * (yp[3] + 2 * yp[4]) * C(ph),
        -m6 * u * (zf - fa) * yp[6] ** 2 * C(om),
        m6 * u * (zf - fa) * yp[5] * (yp[5] + 2 * yp[6]) * C(om),
    ]
    odd, even = pull[0] + pull[2] + pull[4], pull[1] + pull[3] + pull[5]
    reactions = [
        (-rr * S(be) + d * S(be + th)) * odd + (rr * C(be) - d * C(be + th)) * even,
        d * S(be + th) * odd - d * C(be + th) * even,
        -ss * C(ga) * pull[0] - ss * S(ga) * pull[1],
        -e * C(ph + de) * pull[2] - e * S(ph + de) * pull[3],
        (-e * C(ph + de) + zt * S(de)) * pull[2] + (-e * S(ph + de) - zt * C(de)) * pull[3],
        zf * S(om + ep) * pull[4] - zf * C(om + ep) * pull[5],
        (zf * S(om + ep) - u * C(ep)) * pull[4] + (-zf * C(om + ep) - u * S(ep)) * pull[5],
    ]
    X, Y = rr * C(be) - d * C(be + th), rr * S(be) - d * S(be + th)
    return [
        *(a - b + c for a, b, c in zip(inertia, forces, reactions, strict=True)),
        *(X - ss * S(ga) - xb, Y + ss * C(ga) - yb),
        *(X - e * S(ph + de) - zt * C(de) - xa, Y + e * C(ph + de) - zt * S(de) - ya),
        *(X - zf * C(om + ep) - u * S(ep) - xa, Y - zf * S(om + ep) + u * C(ep) - ya),
    ]


SQUEEZER_START = np.array(
    [
        "-0.0617138900142764496358948458001",
        "0",
        "0.455279819163070380255912382449",
        "0.222668390165885884674473185609",
        "0.487364979543842550225598953530",
        "-0.222668390165885884674473185609",
        "1.23054744454982119249735015568",
    ],
    float,
)
SQUEEZER = np.array(
    [
        "15.81077119629904",
        "-15.75637105984298",
        "0.04082224013073101",
        "-0.5347301163226948",
        "0.5244099658805304",
        "0.5347301163226948",
        "1.048080741042263",
    ],
    float,
)


def transistors(t, y, yp):
    """The amplifier: y' enters by a singular matrix."""
    c1, c2, c3, c4, c5, r = 1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 9000.0
    first = 1e-6 * (np.exp((y[1] - y[2]) / 0.026) - 1)
    second = 1e-6 * (np.exp((y[4] - y[5]) / 0.026) - 1)
    return [
        -c1 * yp[0] + c1 * yp[1] - (y[0] - 0.1 * np.sin(200 * np.pi * t)) / 1000,
        c1 * yp[0] - c1 * yp[1] - (y[1] / r + (y[1] - 6) / r + 0.01 * first),
        -c2 * yp[2] - (y[2] / r - first),
        -c3 * yp[3] + c3 * yp[4] - ((y[3] - 6) / r + 0.99 * first),
        c3 * yp[3] - c3 * yp[4] - (y[4] / r + (y[4] - 6) / r + 0.01 * second),
        -c4 * yp[5] - (y[5] / r - second),
        -c5 * yp[6] + c5 * yp[7] - ((y[6] - 6) / r + 0.99 * second),
        c5 * yp[6] - c5 * yp[7] - y[7] / r,
    ]


TRANSISTORS = np.array(
    [
        "-0.5562145012262709e-2",
        "3.006522471903042",
        "2.849958788608128",
        "2.926422536206241",
        "2.704617865010554",
        "2.761837778393145",
        "4.770927631616772",
        "1.236995868091548",
    ],
    float,
)


def ring_modulator(t, y, yp):
    """With C_s = 0: index 2, nonlinear in its algebraic variables."""
    c, cp, r, rp, lh, ls1, ls2, ls3 = 1.6e-8, 1e-8, 25e3, 50.0, 4.45, 2e-3, 5e-4, 5e-4
    rg1, rg2, rg3, ri, rc, gamma, delta = 36.3, 17.3, 17.3, 50.0, 600.0, 40.67286402e-9, 17.7493332
    u1, u2 = 0.5 * np.sin(2e3 * np.pi * t), 2 * np.sin(2e4 * np.pi * t)
    diodes = (y[2] - y[4] - y[6] - u2, -y[3] + y[5] - y[6] - u2, y[3] + y[4] + y[6] + u2, -y[2] - y[5] + y[6] + u2)
    q1, q2, q3, q4 = (gamma * (np.exp(delta * u) - 1) for u in diodes)
    return [
        c * yp[0] - (y[7] - 0.5 * y[9] + 0.5 * y[10] + y[13] - y[0] / r),
        c * yp[1] - (y[8] - 0.5 * y[11] + 0.5 * y[12] + y[14] - y[1] / r),
        *(y[9] - q1 + q4, -y[10] + q2 - q3, y[11] + q1 - q3, -y[12] - q2 + q4),
        cp * yp[6] - (-y[6] / rp + q1 + q2 - q3 - q4),
        *(lh * yp[7] + y[0], lh * yp[8] + y[1]),
        ls2 * yp[9] - (0.5 * y[0] - y[2] - rg2 * y[9]),
        ls3 * yp[10] - (-0.5 * y[0] + y[3] - rg3 * y[10]),
        ls2 * yp[11] - (0.5 * y[1] - y[4] - rg2 * y[11]),
        ls3 * yp[12] - (-0.5 * y[1] + y[5] - rg3 * y[12]),
        ls1 * yp[13] - (-y[0] + u1 - (ri + rg1) * y[13]),
        ls1 * yp[14] - (-y[1] - (rc + rg1) * y[14]),
    ]


def akzo(t, y, yp):
    r1, r2 = 18.7 * y[0] ** 4 * np.sqrt(y[1]), 0.58 * y[2] * y[3]
    r3, r4 = 0.58 / 34.4 * y[0] * y[4], 0.09 * y[0] * y[3] ** 2
    r5, inflow = 0.42 * y[5] ** 2 * np.sqrt(y[1]), 3.3 * (0.9 / 737 - y[1])
    return [
        yp[0] + 2 * r1 - r2 + r3 + r4,
        yp[1] + 0.5 * r1 + r4 + 0.5 * r5 - inflow,
        yp[2] - r1 + r2 - r3,
        yp[3] + r2 - r3 + 2 * r4,
        yp[4] - r2 + r3 - r5,
        115.83 * y[0] * y[3] - y[5],
    ]


AKZO = np.array(
    [
        "0.1150794920661702",
        "0.1203831471567715e-2",
        "0.1611562887407974",
        "0.3656156421249283e-3",
        "0.1708010885264404e-1",
        "0.4873531310307455e-2",
    ],
    float,
)


def robertson(t, y, yp):
    return [
        yp[0] + 0.04 * y[0] - 1e4 * y[1] * y[2],
        yp[1] - 0.04 * y[0] + 1e4 * y[1] * y[2] + 3e7 * y[1] ** 2,
        y[0] + y[1] + y[2] - 1,
    ]


def fekete(points: int = 20) -> DaeProblem:
    """Points on a sphere that repel each other: 3 points positions, then multipliers."""
    rings = ((3, np.pi / 13, 3 * np.pi / 8), (7, np.pi / 29, np.pi / 8), (6, np.pi / 7, -2 * np.pi / 15))
    angles = [(2 * np.pi * i / count + turn, height) for count, turn, height in rings for i in range(1, count + 1)]
    angles += [(2 * np.pi * i / 4 + np.pi / 17, -3 * np.pi / 10) for i in range(4)]
    start = np.array([[np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)] for a, b in angles])[:points]

    def equations(t, y, yp, ypp):
        at = [y[3 * i : 3 * i + 3] for i in range(points)]
        force = [[0.0, 0.0, 0.0] for _ in range(points)]
        for i in range(points):
            for j in range(i):
                away = [at[i][k] - at[j][k] for k in range(3)]
                square = away[0] ** 2 + away[1] ** 2 + away[2] ** 2
                for k in range(3):
                    force[i][k] = force[i][k] + away[k] / square
                    force[j][k] = force[j][k] - away[k] / square
        motion = [
            ypp[3 * i + k] + 0.5 * yp[3 * i + k] - force[i][k] - 2 * y[3 * points + i] * at[i][k]
            for i in range(points)
            for k in range(3)
        ]
        return motion + [q[0] ** 2 + q[1] ** 2 + q[2] ** 2 - 1 for q in at]

    y0 = np.concatenate([start.ravel(), np.zeros(points)])
    return DaeProblem(
        equations,
        (0, 1000.0),
        y0,
        0 * y0,
        order=2,
        reference=lambda: FEKETE,
        components=range(9),
        index=3,
        freedom=4 * points,
    )


FEKETE = np.array(
    [
        "-0.4070263380333202",
        "0.3463758772791802",
        "0.8451942450030429",
        "0.07752934752521549",
        "-0.2628662719972299",
        "0.9617122871829146",
        "0.7100577833343567",
        "0.1212948055586120",
        "0.6936177005172217",
    ],
    float,
)


# ----------------------------------------------------------------------------------------------------------------------
# Small ones


def weissinger(t, y, yp):
    """The example of MATLAB's ode15i, nonlinear in y': y = √(t² + 1/2)."""
    return [t * y[0] ** 2 * yp[0] ** 3 - y[0] ** 3 * yp[0] ** 2 + t * (t * t + 1) * yp[0] - t * t * y[0]]


def gear_petzold(t, y, yp):
    """Linear, of index 2: the derivatives cancel in a combination. y = (e^(-t) - η t cos t, cos t)."""
    eta = 0.7
    right = -np.exp(-t) + np.cos(t)
    return [yp[0] + eta * t * yp[1] + (1 + eta) * y[1] - right, y[0] + eta * t * y[1] - np.exp(-t)]


def resistor(t, y, yp):
    """A capacitor behind a nonlinear resistor: an algebraic equation that is not linear in its unknown."""
    v, e = y
    return [yp[0] - (e - v), 2 * (np.sin(t) - e) - (e - v) - e**3]


SECOND = {"order": 2}
PROBLEMS = {
    "pendulum": DaeProblem(
        pendulum, (0, 5), [1.0, 0, 0], **SECOND, reference=_by_angle, components=(0, 1, 2), index=3, freedom=2
    ),
    "pendulum, first order": DaeProblem(
        pendulum_of_first_order,
        *((0, 5), [1.0, 0, 0, 0, 0]),
        reference=_by_angle,
        components=(0, 1, 4),
        index=3,
        freedom=2,
    ),
    "two pendula": DaeProblem(
        two_pendula,
        *((0, 5), [1.0, 0, 0, 1, 0, 0]),
        **SECOND,
        reference=_by_angles,
        components=range(5),
        index=5,
        freedom=4,
    ),
    "robot arm": DaeProblem(
        robot_arm,
        *((0, 1.2), [0.0, 0, 1, 0, 0], [-1, 0, 0, 0, 0]),
        **SECOND,
        reference=lambda: np.array([1 - np.exp(1.2), np.exp(1.2) - 1.2]),
        components=(0, 2),
        index=5,
        freedom=0,
    ),
    "crane": DaeProblem(
        crane,
        *((0, 3), [0.0, 0.1, 1.0, 2.0]),
        **SECOND,
        reference=lambda: crane_solution(3.0),
        components=range(4),
        index=3,
        freedom=0,
    ),
    "reactor": DaeProblem(
        reactor,
        *((0, 2), [0.5, 300.0, 0.01, 300.0]),
        reference=lambda: reactor_solution(2.0),
        components=range(4),
        index=3,
        freedom=0,
    ),
    "car axis": DaeProblem(
        car_axis,
        *((0, 3), [0, 0.5, 1, 0.5, -0.5, 0, -0.5, 0, 0, 0]),
        reference=lambda: CAR_AXIS,
        components=range(10),
        index=3,
        freedom=4,
    ),
    "squeezer": DaeProblem(
        squeezer,
        *((0, 0.03), np.append(SQUEEZER_START, np.zeros(6)), np.zeros(13)),
        **SECOND,
        reference=lambda: SQUEEZER,
        components=range(7),
        index=3,
        freedom=2,
    ),
    "transistors": DaeProblem(
        transistors,
        *((0, 0.2), [0, 3.0, 3, 6, 3, 3, 6, 0]),
        reference=lambda: TRANSISTORS,
        components=range(8),
        index=1,
        freedom=5,
    ),
    "ring modulator": DaeProblem(ring_modulator, (0, 1e-3), np.zeros(15), index=2, freedom=10),
    "akzo": DaeProblem(
        akzo,
        *((0, 180), [0.444, 0.00123, 0, 0.007, 0, 0.36]),
        reference=lambda: AKZO,
        components=range(6),
        index=1,
        freedom=5,
    ),
    "robertson": DaeProblem(
        robertson,
        *((0, 1e11), [1.0, 0, 0]),
        reference=lambda: np.array([0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050]),
        components=range(3),
        index=1,
        freedom=2,
        floor=1e-20,
    ),
    "weissinger": DaeProblem(
        weissinger,
        *((1, 10), [np.sqrt(1.5)], [0.8]),
        reference=lambda: np.array([np.sqrt(100.5)]),
        components=(0,),
        fixed=(0,),
        index=0,
        freedom=1,
    ),
    "Gear and Petzold": DaeProblem(
        gear_petzold,
        *((0, 3), [1.0, 0.0]),
        reference=lambda: np.array([np.exp(-3.0) - 3 * 0.7 * np.cos(3.0), np.cos(3.0)]),
        components=(0, 1),
        freedom=0,
    ),
    "resistor": DaeProblem(resistor, (0, 10), [0.0, 0.0], index=1, freedom=1),
}


def opaque(equations):
    """Return a function with the residuals of `equations`, computed from bytes, which symbolic values do not become."""

    def unpacked(t, y, yp, *args):
        given = struct.pack(f"{2 * len(y)}d", *y, *yp)
        unpacked.calls += 1
        values = struct.unpack(f"{2 * len(y)}d", given)
        return equations(t, values[: len(y)], values[len(y) :], *args)

    unpacked.calls = 0
    return unpacked
