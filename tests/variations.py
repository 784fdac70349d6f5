"""Problems with hand-written tangents, for the core of sensitivities alone: what stands between it and users has tests
of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cases import METHODS
from core_problems import core_solver
from invariode import _core
from invariode._base.arguments import Weights
from invariode._problem.bounds import Bounds
from invariode._problem.core_problem import CoreProblem, EventSpec, InvariantSpec, LinearTerms, VariationTerms

NO_NULL_SPACE = (np.zeros(1, np.int32), np.zeros(0, np.int32), np.zeros(0))


@dataclass(frozen=True)
class Varied:
    """M y' = f(t, y, p) with f_y, f_p (k, n) and what goes with it; S0 = dy0/dp, (k, n)."""

    fun: Callable[..., Any]
    jac: Callable[..., Any]
    dfdp: Callable[..., Any]
    p: np.ndarray
    y0: np.ndarray
    S0: np.ndarray
    tf: float
    invariants: tuple[tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any], int], ...] = ()  # g, G, g_p
    held: bool = True
    levels: tuple[tuple[int, tuple[int, ...]], ...] = ()
    mass: Any = None
    null_basis: tuple[np.ndarray, np.ndarray, np.ndarray] = NO_NULL_SPACE
    events: list[Any] = field(default_factory=list)
    jumps: list[Any] = field(default_factory=list)
    bounds: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def start(self) -> np.ndarray:
        """Y0, as the core takes it."""
        return np.vstack([self.y0, self.S0]).ravel()

    def slope(self, t: float, Y: np.ndarray) -> np.ndarray:
        return Y[1:] @ np.asarray(self.jac(t, Y[0], self.p)).T + np.asarray(self.dfdp(t, Y[0], self.p))

    def tangent(self, i: int, t: float, Y: np.ndarray) -> np.ndarray:
        """G S_j + g_pj of block i, (k, m)."""
        _, G, dgdp, m = self.invariants[i]
        return Y[1:] @ np.reshape(G(t, Y[0], self.p), (m, -1)).T + np.reshape(dgdp(t, Y[0], self.p), (-1, m))

    def description(self, sensitivities: bool = True, project: bool = True, atol: Any = 1e-6, scale: Any = 1.0,
                    error_test: bool = True) -> CoreProblem:  # fmt: skip
        """The core's problem; tolerances of S are atol / scale."""
        k, n = self.S0.shape
        invariants, value = [], []
        for i, (g, G, _, m) in enumerate(self.invariants if project else ()):
            level, moves = self.levels[i] if self.levels else (0, ())
            invariants.append(InvariantSpec(lambda t, y, g=g: g(t, y, self.p), lambda t, y, G=G: G(t, y, self.p), m,
                                              "g", self.held, level, list(moves)))  # fmt: skip
            value.extend(np.atleast_1d(g(0, self.y0, self.p)) if self.held else np.zeros(m))
        variations = None
        if sensitivities:
            thresholds = np.broadcast_to(atol / np.broadcast_to(scale, k)[:, None], (k, n)).copy()
            tangents = [lambda t, Y, i=i: self.tangent(i, t, Y) for i in range(len(invariants))]
            variations = VariationTerms(k, self.slope, thresholds, tangents, self.jumps, error_test=error_test)
        linear = LinearTerms(
            structure="dense", n=n, lower=0, upper=0, kind="function",
            jacobian=lambda t, y: np.array(self.jac(t, y, self.p), float), mass=self.mass,
            null_basis=self.null_basis, lapack=None,
        )  # fmt: skip
        return CoreProblem(
            n=n, complex=False, fun=lambda t, y: self.fun(t, y, self.p), args=(), linear=linear, events=self.events,
            invariants=invariants, value=np.array(value, float), bounds=self.bounds and Bounds(*self.bounds),
            variations=variations,
        )  # fmt: skip

    def solver(self, method: str, rtol: float = 1e-6, *, tf: float | None = None, **options: Any) -> _core.Solver:
        """The core's solver with atol = rtol, unless `atol` is given for the problem."""
        names = ("sensitivities", "project", "scale", "error_test")
        described = {name: options.pop(name) for name in names if name in options}
        problem = self.description(atol=rtol, **described)
        tf = self.tf if tf is None else tf
        return core_solver(method, problem, Weights(rtol, 1.0), tf=tf, **{"max_step": abs(tf) / 10, **options})

    def run(self, method: str, rtol: float = 1e-6, **options: Any) -> Points:
        """Points of a run; without sensitivities from y0 alone."""
        start = self.start if options.get("sensitivities", True) else self.y0
        return Points(self.solver(method, rtol, **options).integrate(start), self.S0.shape[1])


class Points:
    """t (n_t,), y (n_t, n) and S (n_t, k, n) of a run."""

    def __init__(self, run: _core.Run, n: int) -> None:
        self.run = run
        self.t, Y, *_ = run.take_points()
        self.Y = Y.T.reshape(len(self.t), -1, n)
        self.y, self.S = self.Y[:, 0], self.Y[:, 1:]
        self.counts = dict(zip(_core.COUNTS, run.counts, strict=True))
        assert run.state == "reached_end", run.state


def lotka_volterra() -> Varied:
    """The form of its invariant depends on all four parameters."""

    def fun(t, y, p):
        return [p[0] * y[0] - p[1] * y[0] * y[1], -p[2] * y[1] + p[3] * y[0] * y[1]]

    def jac(t, y, p):
        return [[p[0] - p[1] * y[1], -p[1] * y[0]], [p[3] * y[1], -p[2] + p[3] * y[0]]]

    def dfdp(t, y, p):
        return [[y[0], 0], [-y[0] * y[1], 0], [0, -y[1]], [0, y[0] * y[1]]]

    def g(t, y, p):
        return [p[3] * y[0] - p[2] * np.log(y[0]) + p[1] * y[1] - p[0] * np.log(y[1])]

    def gradient(t, y, p):
        return [[p[3] - p[2] / y[0], p[1] - p[0] / y[1]]]

    def dgdp(t, y, p):
        return [-np.log(y[1]), y[1], -np.log(y[0]), y[0]]

    p = np.array([1.5, 1.0, 3.0, 1.0])
    return Varied(fun, jac, dfdp, p, np.ones(2), np.zeros((4, 2)), 10.0, ((g, gradient, dgdp, 1),))


def kepler(e: float = 0.5) -> Varied:
    """An orbit of eccentricity e, with the sensitivities to its initial value: energy and momentum are held."""

    def fun(t, y, p):
        r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
        return [y[2], y[3], -y[0] / r3, -y[1] / r3]

    def jac(t, y, p):
        r2 = y[0] ** 2 + y[1] ** 2
        r3, r5 = r2**1.5, r2**2.5
        xx, xy, yy = 3 * y[0] ** 2 / r5 - 1 / r3, 3 * y[0] * y[1] / r5, 3 * y[1] ** 2 / r5 - 1 / r3
        return [[0, 0, 1, 0], [0, 0, 0, 1], [xx, xy, 0, 0], [xy, yy, 0, 0]]

    def g(t, y, p):
        return [(y[2] ** 2 + y[3] ** 2) / 2 - 1 / np.hypot(y[0], y[1]), y[0] * y[3] - y[1] * y[2]]

    def gradient(t, y, p):
        r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
        return [[y[0] / r3, y[1] / r3, y[2], y[3]], [y[3], -y[2], -y[1], y[0]]]

    y0 = np.array([1 - e, 0, 0, np.sqrt((1 + e) / (1 - e))])
    nothing = np.zeros((4, 4))
    return Varied(fun, jac, lambda t, y, p: nothing, np.zeros(4), y0, np.eye(4), 2 * np.pi,
                  ((g, gradient, lambda t, y, p: np.zeros((4, 2)), 2),))  # fmt: skip


def pendulum() -> Varied:
    """In Cartesian coordinates, p = (length, gravity): the rod is imposed first, then that the bob moves along it. The
    start depends on the length."""

    def fun(t, y, p):
        x, z, u, v = y
        pull = (u * u + v * v - p[1] * z) / p[0] ** 2
        return [u, v, -pull * x, -pull * z - p[1]]

    def jac(t, y, p):
        x, z, u, v = y
        L2 = p[0] ** 2
        pull = (u * u + v * v - p[1] * z) / L2
        dz, du, dv = -p[1] / L2, 2 * u / L2, 2 * v / L2
        return [[0, 0, 1, 0], [0, 0, 0, 1], [-pull, -x * dz, -x * du, -x * dv],
                [0, -pull - z * dz, -z * du, -z * dv]]  # fmt: skip

    def dfdp(t, y, p):
        x, z, u, v = y
        pull = (u * u + v * v - p[1] * z) / p[0] ** 2
        by_length, by_gravity = -2 * pull / p[0], -z / p[0] ** 2
        return [[0, 0, -by_length * x, -by_length * z], [0, 0, -by_gravity * x, -by_gravity * z - 1]]

    def rod(t, y, p):
        return [y[0] ** 2 + y[1] ** 2 - p[0] ** 2]

    def along(t, y, p):
        return [y[0] * y[2] + y[1] * y[3]]

    p = np.array([1.0, 9.81])
    return Varied(
        fun, jac, dfdp, p, np.array([1.0, 0, 0, 0]), np.array([[1.0, 0, 0, 0], [0, 0, 0, 0]]), 2.0,
        ((rod, lambda t, y, p: [[2 * y[0], 2 * y[1], 0, 0]], lambda t, y, p: [-2 * p[0], 0], 1),
         (along, lambda t, y, p: [[y[2], y[3], y[0], y[1]]], lambda t, y, p: [0, 0], 1)),
        held=False, levels=((0, (0, 1)), (1, (2, 3))),
    )  # fmt: skip


def robertson() -> Varied:
    """Stiff; the sum of the species is held, so that the sums of their sensitivities are 0."""

    def fun(t, y, p):
        a, b, c = p[0] * y[0], p[1] * y[1] * y[2], p[2] * y[1] ** 2
        return [-a + b, a - b - c, c]

    def jac(t, y, p):
        b1, b2, c1 = p[1] * y[2], p[1] * y[1], 2 * p[2] * y[1]
        return [[-p[0], b1, b2], [p[0], -b1 - c1, -b2], [0, c1, 0]]

    def dfdp(t, y, p):
        b, c = y[1] * y[2], y[1] ** 2
        return [[-y[0], y[0], 0], [b, -b, 0], [0, -c, c]]

    total = (lambda t, y, p: [y.sum()], lambda t, y, p: np.ones((1, 3)), lambda t, y, p: np.zeros(3), 1)
    return Varied(fun, jac, dfdp, np.array([0.04, 1e4, 3e7]), np.array([1.0, 0, 0]), np.zeros((3, 3)), 40.0, (total,))


def semi_explicit() -> Varied:
    """y' = -p y z, 0 = q y² - z: y = (1 + 2 p q t)^-1/2. The start of dz/dp is left to the core."""

    def fun(t, y, p):
        return [-p[0] * y[0] * y[1], p[1] * y[0] ** 2 - y[1]]

    def jac(t, y, p):
        return [[-p[0] * y[1], -p[0] * y[0]], [2 * p[1] * y[0], -1]]

    def dfdp(t, y, p):
        return [[-y[0] * y[1], 0], [0, y[0] ** 2]]

    p = np.array([0.7, 1.3])
    null_basis = (np.array([0, 1], np.int32), np.array([1], np.int32), np.ones(1))
    return Varied(fun, jac, dfdp, p, np.array([1.0, p[1]]), np.zeros((2, 2)), 2.0, mass=np.diag([1.0, 0.0]),
                  null_basis=null_basis)  # fmt: skip


def bouncing_ball() -> Varied:
    """y'' = -g from 1, thrown back with e times its velocity: p = (e, g)."""

    def fun(t, y, p):
        return [y[1], -p[1]]

    def action(t, y):
        return [0.0, -ball.p[0] * y[1]]

    def jump(t, Y, after):
        y, S = Y[0], Y[1:]
        moved = -S[:, 0] / y[1]  # the time of the impact
        gravity = -ball.p[1]
        turned = np.array([[0, 0], [0, -ball.p[0]]])
        by_restitution = np.array([[0, -y[1]], [0, 0]])
        before, behind = np.array([y[1], gravity]), np.array([after[1], gravity])
        return (S + moved[:, None] * before) @ turned.T + by_restitution - moved[:, None] * behind

    ball = Varied(
        fun, lambda t, y, p: [[0, 1], [0, 0]], lambda t, y, p: [[0, 0], [0, -1]], np.array([0.8, 9.81]),
        np.array([1.0, 0]), np.zeros((2, 2)), 1.5,
        events=[EventSpec(lambda t, y: y[0], 0, -1, "ground", action, True, 0)], jumps=[jump],
    )  # fmt: skip
    return ball


PROBLEMS = {"lotka_volterra": lotka_volterra, "kepler": kepler, "pendulum": pendulum}
MASSES = [name for name, method in METHODS.items() if method.mass == "any"]
