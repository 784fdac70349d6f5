"""Mechanisms, with what is known of their motion, as data: what tests and ``benchmarks/mechanics.py`` solve."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from invariode import Problem
from invariode._mechanics.system import MechanicalSystem

Array = NDArray[np.float64]


class Case(NamedTuple):
    """A system with its start and what is known at the end."""

    system: MechanicalSystem
    t_span: tuple[float, float]
    q0: Array
    v0: Array
    end: Array  # (q, v) at the end of t_span
    multipliers: Array = np.zeros(0)  # at the end, where they are published

    def problem(self, correction: Literal["levels", "joint", "none"] = "levels") -> Problem:
        return self.system.problem(self.t_span, self.q0, self.v0, correction=correction)


# A point on a circle of radius 1, mass and gravity 1.


def gravity(t, q, v):
    return [0.0, -1.0]


def circle(t, q):
    return (q[0] ** 2 + q[1] ** 2 - 1) / 2


def swing(constraints=circle, **options):
    return MechanicalSystem([1, 1], gravity, constraints, **options)


# Andrews' squeezing mechanism: seven bodies in the plane, driven by a torque. F. Mazzia, C. Magherini, Test Set for
# Initial Value Problem Solvers, release 2.4, 2008, chapter II-9; E. Hairer, G. Wanner, Solving Ordinary Differential
# Equations II, section VII.7. Masses, moments of inertia, fixed points, lengths, in SI units; the reference is PSIDE's.
_M2, _M4, _M6 = 0.00365, 0.00706, 0.00706
_XA, _YA, _XB, _YB, _XC, _YC = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072
_D, _DA, _E, _EA, _RR, _RA = 0.028, 0.0115, 0.02, 0.01421, 0.007, 0.00092
_SS, _SA, _SB, _SC, _SD = 0.035, 0.01874, 0.01043, 0.018, 0.02
_TA, _TB, _U, _UA, _UB, _ZF, _ZT, _FA = 0.02308, 0.00916, 0.04, 0.01228, 0.00449, 0.02, 0.04, 0.01421
_TORQUE, _STIFFNESS, _SPRING = 0.033, 4530.0, 0.07785
_I1 = 0.04325 * _RA**2 + 2.194e-6
_I2 = 4.410e-7
_I3 = 0.02373 * (_SA**2 + _SB**2) + 5.255e-6
_I4 = 5.667e-7
_I5 = 0.07050 * (_TA**2 + _TB**2) + 1.169e-5
_I6 = 5.667e-7
_I7 = 0.05498 * (_UA**2 + _UB**2) + 1.912e-5


def _squeezer_mass(t: float, q: Array) -> Array:
    _, theta, _, phi, _, omega, _ = q
    m = np.zeros((7, 7))
    m[0, 0] = _I1 + _M2 * (_RR**2 - 2 * _DA * _RR * np.cos(theta) + _DA**2) + _I2
    m[0, 1] = m[1, 0] = _M2 * (_DA**2 - _DA * _RR * np.cos(theta)) + _I2
    m[1, 1] = _M2 * _DA**2 + _I2
    m[2, 2] = _I3
    a = _E - _EA
    m[3, 3] = _M4 * a**2 + _I4
    m[3, 4] = m[4, 3] = _M4 * (a**2 + _ZT * a * np.sin(phi)) + _I4
    m[4, 4] = _M4 * (_ZT**2 + 2 * _ZT * a * np.sin(phi) + a**2) + _I4 + _I5
    b = _ZF - _FA
    m[5, 5] = _M6 * b**2 + _I6
    m[5, 6] = m[6, 5] = _M6 * (b**2 - _U * b * np.sin(omega)) + _I6
    m[6, 6] = _M6 * (b**2 - 2 * _U * b * np.sin(omega) + _U**2) + _I6 + _I7
    return m


def _squeezer_force(t: float, q: Array, v: Array) -> Array:
    _, theta, gamma, phi, _, omega, _ = q
    beta_, theta_, _, phi_, delta_, omega_, epsilon_ = v
    x = _SD * np.cos(gamma) + _SC * np.sin(gamma) + _XB
    y = _SD * np.sin(gamma) - _SC * np.cos(gamma) + _YB
    length = np.hypot(x - _XC, y - _YC)
    pull = -_STIFFNESS * (length - _SPRING) / length
    f, g = pull * (x - _XC), pull * (y - _YC)
    two, four, six = _M2 * _DA * _RR, _M4 * _ZT * (_E - _EA), _M6 * _U * (_ZF - _FA)
    return np.array(
        [
            _TORQUE - two * theta_ * (theta_ + 2 * beta_) * np.sin(theta),
            two * beta_**2 * np.sin(theta),
            f * (_SC * np.cos(gamma) - _SD * np.sin(gamma)) + g * (_SD * np.cos(gamma) + _SC * np.sin(gamma)),
            four * delta_**2 * np.cos(phi),
            -four * phi_ * (phi_ + 2 * delta_) * np.cos(phi),
            -six * epsilon_**2 * np.cos(omega),
            six * omega_ * (omega_ + 2 * epsilon_) * np.cos(omega),
        ]
    )


def _squeezer_constraints(t: float, q: Array) -> Array:
    beta, theta, gamma, phi, delta, omega, epsilon = q
    x = _RR * np.cos(beta) - _D * np.cos(beta + theta)
    y = _RR * np.sin(beta) - _D * np.sin(beta + theta)
    return np.array(
        [
            x - _SS * np.sin(gamma) - _XB,
            y + _SS * np.cos(gamma) - _YB,
            x - _E * np.sin(phi + delta) - _ZT * np.cos(delta) - _XA,
            y + _E * np.cos(phi + delta) - _ZT * np.sin(delta) - _YA,
            x - _ZF * np.cos(omega + epsilon) - _U * np.sin(epsilon) - _XA,
            y - _ZF * np.sin(omega + epsilon) + _U * np.cos(epsilon) - _YA,
        ]
    )


def squeezer() -> Case:
    """Andrews' squeezing mechanism, 0 <= t <= 0.03."""
    q0 = [
        -0.0617138900142764496358948458001,
        0,
        0.455279819163070380255912382449,
        0.222668390165885884674473185609,
        0.487364979543842550225598953530,
        -0.222668390165885884674473185609,
        1.23054744454982119249735015568,
    ]
    end = [
        15.81077119629904,
        -15.75637105984298,
        0.04082224013073101,
        -0.5347301163226948,
        0.5244099658805304,
        0.5347301163226948,
        1.048080741042263,
        1139.920302151208,
        -1424.379294994111,
        11.03291221937134,
        19.29337464421385,
        0.5735699284790808,
        -19.29337464421385,
        0.3231791658026955,
    ]
    system = MechanicalSystem(_squeezer_mass, _squeezer_force, _squeezer_constraints, name="squeezing mechanism")
    return Case(system, (0.0, 0.03), np.array(q0), np.zeros(7), np.array(end))


def arevalo() -> Case:
    """Arévalo's problem, 0 <= t <= 3: a particle on the unit circle at q = (sin t², cos t²), λ = -4 t²."""
    system = MechanicalSystem(
        [1, 1], lambda t, q, v: [2 * q[1], -2 * q[0]], lambda t, q: (q[0] ** 2 + q[1] ** 2 - 1) / 2, name="particle"
    )
    end = [np.sin(9), np.cos(9), 6 * np.cos(9), -6 * np.sin(9)]
    return Case(system, (0.0, 3.0), np.array([0.0, 1.0]), np.zeros(2), np.array(end), np.array([-4.0 * 9]))


def car_axis() -> Case:
    """Two loads on springs, above an axis of which one end goes over a bumpy road: 0 <= t <= 3, φ depends on t.

    Test Set, chapter II-10; references by GAMD. With ε = 0.01 the springs are stiff.
    """
    epsilon, load, length, rest, height, speed, gravity = 1e-2, 10.0, 1.0, 0.5, 0.1, 10.0, 1.0
    mass = load * epsilon**2 / 2

    def bumped(t: float) -> tuple[float, float]:
        y = height * np.sin(speed * t)
        return np.sqrt(length**2 - y**2), y

    def springs(t: float, q: Array, v: Array) -> Array:
        x, y = bumped(t)
        left, right = q[:2], q[2:] - [x, y]
        pulls = [(rest - one_length) * one / one_length for one in (left, right) for one_length in [np.hypot(*one)]]
        return np.concatenate(pulls) - mass * gravity * np.array([0, 1, 0, 1])

    def axis(t: float, q: Array) -> Array:
        x, y = bumped(t)
        return np.array([x * q[0] + y * q[1], (q[0] - q[2]) ** 2 + (q[1] - q[3]) ** 2 - length**2])

    end = [
        0.4934557842755629e-1, 0.4969894602303324, 0.1041742524885400e1, 0.3739110272652214,
        -0.7705836840321485e-1, 0.7446866596327776e-2, 0.1755681574942899e-1, 0.7703410437794031,
    ]  # fmt: skip
    system = MechanicalSystem(np.full(4, mass), springs, axis, name="car axis")
    q0, v0 = np.array([0, rest, length, rest]), np.array([-rest / length, 0, -rest / length, 0])
    return Case(system, (0.0, 3.0), q0, v0, np.array(end), np.array([-0.4736886750784630e-2, -0.1104680411345730e-2]))


def slider_crank() -> Case:
    """A crank, a connecting rod and a slider, with spring, damper and a constant force, 0 <= t <= 10.

    The example idaSlCrank_dns of SUNDIALS 6, whose output at rtol = atol = 1e-6 has five digits of the positions; the
    velocities are not printed.
    """
    a = 0.5  # half of the crank's length; all else is 1, but for the rod's moment of inertia

    def force(t: float, q: Array, v: Array) -> Array:
        crank, x, rod = q
        turned = np.sin(rod - crank)
        spring = np.sqrt(
            x**2 - x * (np.cos(rod) + a * np.cos(crank)) + (1 + a**2) / 4 + a * np.cos(rod - crank) / 2
        )  # between the middles of crank and rod
        gradient = np.array(
            [
                a * (x * np.sin(crank) + turned / 2),
                2 * x - np.cos(rod) - a * np.cos(crank),
                x * np.sin(rod) - a * turned / 2,
            ]
        ) / (2 * spring)
        pull = (spring - 1) + gradient @ v
        return np.array([0, 1, -np.sin(rod)]) - pull * gradient

    def joints(t: float, q: Array) -> Array:
        return np.array([q[1] - np.cos(q[2]) - a * np.cos(q[0]), -np.sin(q[2]) - a * np.sin(q[0])])

    system = MechanicalSystem([1, 1, 2], force, joints, name="slider crank")
    rod = np.arcsin(-a)
    end = np.array([1.2757, 1.0236, -0.49881, np.nan, np.nan, np.nan])
    return Case(system, (0.0, 10.0), np.array([np.pi / 2, np.cos(rod), rod]), np.zeros(3), end)


def fekete() -> Case:
    """Twenty points on the unit sphere that repel each other and are damped, 0 <= t <= 1000: they come to rest.

    Test Set, chapter II-8; reference by RADAU5 at 1e-12, velocities below 1e-15.
    """
    rings = [(3, 1, 3 / 8, 13), (7, 1, 1 / 8, 29), (6, 1, -2 / 15, 7), (4, 0, -3 / 10, 17)]
    q0 = np.array(
        [
            [np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)]
            for count, first, latitude, shift in rings
            for k in range(first, first + count)
            for a, b in [(2 * np.pi * k / count + np.pi / shift, np.pi * latitude)]
        ]
    )

    def force(t: float, q: Array, v: Array) -> Array:
        p = q.reshape(-1, 3)
        apart = p[:, None] - p
        square = (apart**2).sum(axis=2)
        np.fill_diagonal(square, 1.0)
        return ((apart / square[:, :, None]).sum(axis=1) - v.reshape(-1, 3) / 2).ravel()

    def spheres(t: float, q: Array) -> Array:
        return (q.reshape(-1, 3) ** 2).sum(axis=1) - 1

    def jacobian(t: float, q: Array) -> Array:
        rows = np.zeros((20, 20, 3))
        rows[np.arange(20), np.arange(20)] = 2 * q.reshape(-1, 3)
        return rows.reshape(20, 60)

    system = MechanicalSystem(np.ones(60), force, spheres, jacobian=jacobian, name="Fekete points")
    end = np.loadtxt(Path(__file__).with_name("data") / "fekete.txt").ravel()
    return Case(system, (0.0, 1000.0), q0.ravel(), np.zeros(60), np.append(end, np.zeros(60)))


def index_3_pendulum() -> Case:
    """x″ = -x λ, y″ = -y λ - 1 from (1, 0, 0, 1) to t = 1, with which solvers of index 3 are tested.

    By the equation of its angle, θ″ = -cos θ, these digits are good to 3e-11. Our λ has the other sign.
    """
    system = MechanicalSystem([1, 1], lambda t, q, v: [0, -1], lambda t, q: (q[0] ** 2 + q[1] ** 2 - 1) / 2)
    end = [0.867348640604551746, 0.497701050476373918, -0.0337480180329866458, 0.0588130114660715686]
    return Case(
        system, (0.0, 1.0), np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array(end), np.array([0.493103151528274442])
    )


def pendulum() -> Case:
    """The paper's pendulum, 0 <= t <= 50; its end is sensitive, and not known."""
    system = MechanicalSystem([1, 1], lambda t, q, v: [0, -1], lambda t, q: q[0] ** 2 + q[1] ** 2 - 1, name="pendulum")
    return Case(system, (0.0, 50.0), np.array([1.0, 0.0]), np.zeros(2), np.full(4, np.nan))


def chain(links: int) -> Case:
    """A chain of unit masses in the plane, let go from a horizontal line; its end is not known."""

    def lengths(t: float, q: Array) -> Array:
        joints = np.vstack([[0, 0], q.reshape(-1, 2)])
        return (np.diff(joints, axis=0) ** 2).sum(axis=1) - 1

    def gravity(t: float, q: Array, v: Array) -> Array:
        return np.tile([0.0, -1.0], links)

    q0 = np.array([(i + 1, 0) for i in range(links)], dtype=float).ravel()
    system = MechanicalSystem(np.ones(2 * links), gravity, lengths, name="chain")
    return Case(system, (0.0, 4.0), q0, np.zeros(2 * links), np.full(4 * links, np.nan))


def closed_chain() -> Case:
    """A closed planar chain of five links: four of length 1, and the ground from (0, 0) to (2, 0)."""
    ends = np.array([0.0, 0.0]), np.array([2.0, 0.0])

    def lengths(t: float, q: Array) -> Array:
        joints = np.vstack([ends[0], q.reshape(-1, 2), ends[1]])
        return (np.diff(joints, axis=0) ** 2).sum(axis=1) - 1

    system = MechanicalSystem(
        np.ones(6), lambda t, q, v: np.tile([0.0, -1.0], 3), lengths, energy=energy_of_unit_masses, name="closed chain"
    )
    side = np.sqrt(3) / 2  # of the first and the last link, which lean inwards by 30 degrees
    q0 = np.array([0.5, side, 1.0, 2 * side, 1.5, side])
    return Case(system, (0.0, 60.0), q0, _swaying(q0), np.full(12, np.nan))


def spatial_chain() -> Case:
    """A chain of ten links of length 1 in space, from a fixed point, unit masses; let go from a straight line."""
    links = 10

    def lengths(t: float, q: Array) -> Array:
        joints = np.vstack([np.zeros(3), q.reshape(-1, 3)])
        return (np.diff(joints, axis=0) ** 2).sum(axis=1) - 1

    def energy(t: float, q: Array, v: Array) -> float:
        return (v @ v) / 2 + q[2::3].sum()

    system = MechanicalSystem(
        np.ones(3 * links), lambda t, q, v: np.tile([0.0, 0.0, -1.0], links), lengths, energy=energy, name="chain"
    )
    number = np.arange(1.0, links + 1)
    q0 = np.column_stack([number, 0 * number, 0 * number]).ravel()
    v0 = np.column_stack([0 * number, 0.1 * number, 0 * number]).ravel()  # across: consistent
    return Case(system, (0.0, 60.0), q0, v0, np.full(60, np.nan))


def energy_of_unit_masses(t: float, q: Array, v: Array) -> float:
    """Return the energy of unit masses in the plane, gravity 1."""
    return (v @ v) / 2 + q[1::2].sum()


def _swaying(q0: Array) -> Array:
    """Velocities across the first and the last link that the middle ones, by symmetry, follow sideways."""
    left, right = q0[:2], q0[4:] - [2, 0]
    sway = 0.3 * np.array([left[1], -left[0], 0, 0, right[1], -right[0]])
    # the middle joint keeps its distances from both neighbours
    middle = q0[2:4]
    rows = np.array([middle - q0[:2], middle - q0[4:]])
    sway[2:4] = np.linalg.solve(rows, [rows[0] @ sway[:2], rows[1] @ sway[4:]])
    return sway
