"""Problems from formulas are those written by hand: same values, exact Jacobians, and laws that hold."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import sympy
from sympy import Eq, Rational, cos, exp, sin, sqrt
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols
from sympy.physics.mechanics.models import n_link_pendulum_on_cart

import invariode as iv
from invariode import problems
from invariode import symbolic as sy

t = dynamicsymbols._t
EPS = np.finfo(float).eps


def spring(n=30):
    """A chain of masses and springs as first-order equations: many of them, with few entries each."""
    x, v = sympy.symbols(f"x:{n}"), sympy.symbols(f"v:{n}")
    ends = [0, *x, 0]
    pull = {v[i]: ends[i] - 2 * ends[i + 1] + ends[i + 2] - x[i] ** 3 for i in range(n)}
    return sy.equations(dict(zip(x, v, strict=True)) | pull)


def predators():
    a, b, rate = sympy.symbols("a b rate", positive=True)
    kept = (a - sympy.log(a)) / rate + b - sympy.log(b)
    return sy.equations({a: rate * a * (b - 1), b: b * (1 - a)}, invariants={"cycle": kept}, parameters={rate: 2})


def kepler():
    x, y, px, py, mu = sympy.symbols("x y p_x p_y mu")
    return sy.hamiltonian((px**2 + py**2) / 2 - mu / sqrt(x**2 + y**2), [x, y], [px, py], parameters={mu: 1})


def double_pendulum():
    a, b = dynamicsymbols("a b")
    m, g = sympy.symbols("m g")
    x1, y1 = sin(a), -cos(a)
    x2, y2 = x1 + sin(b), y1 - cos(b)
    speeds = [e.diff(t) ** 2 for e in (x1, y1, x2, y2)]
    L = (speeds[0] + speeds[1]) / 2 + m * (speeds[2] + speeds[3]) / 2 - g * (y1 + m * y2)
    return sy.lagrangian(L, [a, b], parameters={m: 2, g: 9.81})


def rod(**options):
    """The paper's pendulum: unit mass, length and gravity."""
    x, y = dynamicsymbols("x y")
    return sy.lagrangian((x.diff() ** 2 + y.diff() ** 2) / 2 - y, [x, y], constraints=[Eq(x**2 + y**2, 1)], **options)


def skate():
    """Chaplygin's skate on a slope: it moves along its edge only."""
    x, y, turn = dynamicsymbols("x y turn")
    L = (x.diff() ** 2 + y.diff() ** 2 + turn.diff() ** 2) / 2 + x
    return sy.lagrangian(L, [x, y, turn], nonholonomic=[x.diff() * sin(turn) - y.diff() * cos(turn)])


def bead():
    """On a wire that is moved: the constraint depends on the time, so the energy is not kept."""
    x, y = dynamicsymbols("x y")
    L = (x.diff() ** 2 + y.diff() ** 2) / 2 - y
    return sy.lagrangian(L, [x, y], constraints=[y - x**2 / 2 - sin(t) / 5])


#: Systems, with a start of each as the arguments of `problem` after the interval.
SYSTEMS = {
    "spring": (spring, [np.linspace(-0.5, 0.8, 60)]),
    "predators": (predators, [{"a": 1.0, "b": 3.0}]),
    "kepler": (kepler, [[1, 0.1], [0.05, 1.1]]),
    "double pendulum": (double_pendulum, [[1, 2], [0.3, -0.2]]),
    "rod": (rod, [[0.6, 0.8], [0.8, -0.6]]),
    "skate": (skate, [[0, 0, 0.5], [0, 0, 1.0]]),
    "bead": (bead, [[1, 0.5], [0.3, 0.5]]),
}


def made(name, compiled, t_span=(0, 3)):
    system, start = SYSTEMS[name]
    system = system()
    if isinstance(start[0], dict):
        start = [{one: start[0][str(one)] for one in system.states}]
    return system.problem(t_span, *start, compiled=compiled)


@pytest.fixture(params=list(SYSTEMS))
def name(request):
    return request.param


def derivative(fun, y):
    """By differences of order 4, columns of ∂f/∂y."""
    h = 1e-3
    columns = []
    for e in np.eye(len(y)):
        near, far = (np.subtract(fun(y + k * h * e), fun(y - k * h * e)) for k in (1, 2))
        columns.append((8 * near - far) / (12 * h))
    return np.transpose(columns)


def test_jacobians_are_those_of_the_functions(name):
    """f and every invariant are differentiated; the difference quotient of order 4 is off by h⁴ and by roundoff / h."""
    problem = made(name, compiled=False)
    y, args = problem.y0, problem.args
    jacobian = problem.matrices.jac(0.3, y, *args)
    dense = jacobian.toarray() if name == "spring" else jacobian
    np.testing.assert_allclose(dense, derivative(lambda y: problem.fun(0.3, y, *args), y), rtol=1e-8, atol=1e-8)
    for one in problem.invariants:
        quotient = derivative(lambda y, one=one: one.fun(0.3, y, *args), y)
        np.testing.assert_allclose(one.jac(0.3, y, *args), quotient, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", [name for name in SYSTEMS if name != "rod"])
def test_compiled_and_not_are_the_same_problem(name):
    """The code is the same text; libraries of functions may differ in the last place. The rod has its published counts
    below, compiled and not."""
    pair = [made(name, compiled) for compiled in (True, False)]
    for method in ("ode45", "ode15s"):
        runs = [problem.solve(method, rtol=1e-6) for problem in pair]
        assert all(run.success for run in runs)
        np.testing.assert_allclose(runs[0].y[:, -1], runs[1].y[:, -1], rtol=1e-7, atol=1e-9)
        assert runs[0].stats.derivatives == runs[1].stats.derivatives
        assert runs[0].stats.derivatives in ("given", None)


def test_laws_that_are_found_hold_along_the_plain_solution(name):
    problem = made(name, compiled=False, t_span=(0, 1))
    tight = problem.replace(invariants=None).solve("dop853", rtol=1e-11, atol=1e-12)
    for one in problem.invariants:
        values = [one.fun(time, y, *problem.args)[0] for time, y in zip(tight.t, tight.y.T, strict=True)]
        assert np.ptp(values) < 1e-8, one.names


def laws(L, q, **options):
    return list(sy.lagrangian(L, q, **options).laws)


class TestLaws:
    x, y, z = dynamicsymbols("x y z")
    m, k = sympy.symbols("m k", positive=True)
    free = (x.diff() ** 2 + y.diff() ** 2 + z.diff() ** 2) / 2

    def test_of_a_central_force_in_space(self):
        found = laws(self.free - sqrt(self.x**2 + self.y**2 + self.z**2), [self.x, self.y, self.z])
        assert found == ["energy", *(f"angular momentum of {pair}" for pair in ("x, y", "x, z", "y, z"))]

    def test_of_three_bodies_in_the_plane(self):
        q = dynamicsymbols("x1 y1 x2 y2 x3 y3")
        masses = sympy.symbols("m1:4")
        bodies = [q[0:2], q[2:4], q[4:6]]
        L = sum(m * (x.diff() ** 2 + y.diff() ** 2) / 2 for m, (x, y) in zip(masses, bodies, strict=True))
        for i, j in ((0, 1), (0, 2), (1, 2)):
            (x, y), (u, v) = bodies[i], bodies[j]
            L += masses[i] * masses[j] / sqrt((x - u) ** 2 + (y - v) ** 2)
        found = sy.lagrangian(L, q, parameters=dict.fromkeys(masses, 1)).laws
        assert sorted(found) == [
            "angular momentum of x1, y1, x2, y2, x3, y3",
            "energy",
            "momentum of x1, x2, x3",
            "momentum of y1, y2, y3",
        ]
        assert (
            sympy.expand(
                found["momentum of x1, x2, x3"] - sum(m * x.diff() for m, (x, _) in zip(masses, bodies, strict=True))
            )
            == 0
        )

    def test_of_a_cyclic_angle(self):
        r, phi = dynamicsymbols("r phi")
        found = sy.lagrangian(
            (r.diff() ** 2 + r**2 * phi.diff() ** 2) / 2 - self.k / r, [r, phi], parameters={self.k: 1}
        )
        assert found.laws["momentum of phi"] == r**2 * phi.diff()

    def test_a_parameter_may_break_a_symmetry(self):
        L = self.free - (self.x**2 + self.k * self.y**2 + self.z**2) / 2
        assert laws(L, [self.x, self.y, self.z], parameters={self.k: 1}) == ["energy", "angular momentum of x, z"]

    def test_time_and_friction_leave_no_energy(self):
        assert laws(self.free - self.x * sin(t), [self.x, self.y, self.z])[0] == "momentum of y"
        assert "energy" not in laws(self.free, [self.x, self.y, self.z], forces=[-self.x.diff(), 0, 0])

    def test_a_force_that_does_no_work_leaves_the_energy(self):
        """A charge in a magnetic field, as a force: the rotation about the field does not follow from L alone."""
        turning = {self.x: self.y.diff(), self.y: -self.x.diff()}
        found = laws(self.free, [self.x, self.y, self.z], forces=turning)
        assert found[0] == "energy"
        assert "momentum of z" in found
        assert "momentum of x" not in found

    def test_constraints_can_break_symmetries_and_keep_them(self):
        sphere = self.x**2 + self.y**2 + self.z**2 - 1
        found = laws(self.free - self.z, [self.x, self.y, self.z], constraints=[sphere])
        assert found == ["constraint 1", "rate of constraint 1", "energy", "angular momentum of x, y"]
        assert "energy" not in laws(self.free, [self.x, self.y, self.z], constraints=[self.x - t])

    def test_dependent_laws_are_left_out_at_the_start(self):
        """The energy of a free body on a line is a function of the momentum."""
        line = sy.lagrangian(self.x.diff() ** 2 / 2, [self.x])
        assert list(line.laws) == ["energy", "momentum of x"]
        assert len(line.problem((0, 1), [0], [1], compiled=False).invariants) == 1

    def test_without_laws_constraints_stay(self):
        problem = rod().problem((0, 1), [1, 0], [0, 0], laws=False, compiled=False)
        assert [one.names[0] for one in problem.invariants] == ["constraint 1", "rate of constraint 1"]


@pytest.mark.parametrize("compiled", [True, False])
def test_the_papers_pendulum_has_its_published_counts(compiled):
    """The counts are those by hand in tests/test_counts.py."""
    problem = rod().problem((0, 50), [1, 0], [0, 0], laws=False, correction="joint", compiled=compiled)
    kept = problem.solve("ode45").stats
    assert (kept.steps, kept.failed, kept.nfev) == (113, 9, 733)
    plain = problem.replace(invariants=None).solve("ode45").stats
    assert (plain.steps, plain.failed, plain.nfev) == (98, 10, 649)
    by_hand = problems.pendulum().solve("ode45").stats
    assert (by_hand.steps, by_hand.failed, by_hand.nfev) == (113, 9, 733)


def test_the_pendulum_as_it_is_known_to_many_digits():
    """x″ = -xλ, y″ = -yλ - 1, x² + y² = 1 from (1, 0, 0, 1), at t = 1."""
    known = [0.867348640604551746, 0.497701050476373918, -0.0337480180329866458, 0.0588130114660715686]
    sol = rod().problem((0, 1), [1, 0], [0, 1], compiled=False).solve("dop853", rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(sol.y[:, -1], known, atol=1e-10)


def test_a_skate_does_not_slip_and_keeps_its_energy():
    sol = made("skate", compiled=False, t_span=(0, 20)).solve(rtol=1e-5, atol=1e-7)
    assert sol.success
    assert list(sol.drift().names)[:2] == ["velocity constraint 1", "energy"]
    assert abs(sol.residual).max() < 1e-8
    assert sol.y[5] == pytest.approx(1)  # nothing turns it but its own inertia


def test_parameters_are_args():
    system = double_pendulum()
    problem = system.problem((0, 2), [1, 2], [0, 0], compiled=False)
    assert problem.args == (2.0, 9.81)
    other = problem.replace(args=(1.0, 5.0)).solve(rtol=1e-6)
    m, g = system.parameters
    a, b = system.states[:2]
    assert problem.labels == ["a", "b", "a'", "b'"]
    again = double_pendulum()
    again._words.parameters.update({m: 1.0, g: 5.0})
    direct = again.problem((0, 2), {a: 1, b: 2}, {b: 0, a: 0}, compiled=False).solve(rtol=1e-6)
    np.testing.assert_array_equal(other.y, direct.y)


def test_large_sparse_jacobians_are_sparse():
    assert made("spring", compiled=False).matrices.jac(0.0, np.zeros(60)).nnz < 60 * 4
    runs = [made("spring", compiled).solve("ode15s", rtol=1e-6) for compiled in (True, False)]
    assert runs[0].njev == runs[1].njev > 0


def test_where_formulas_are_not_defined_the_run_ends_with_a_status():
    x = sympy.Symbol("x")
    for compiled in (True, False):
        problem = sy.equations({x: -1 / sqrt(x)}).problem((0, 2), {x: 1}, compiled=compiled)
        sol = problem.solve(rtol=1e-6)
        assert sol.status == -1
        assert sol.t[-1] == pytest.approx(2 / 3, abs=1e-3)  # x^(3/2) = 1 - 3t/2


@pytest.mark.parametrize("compiled", [True, False])
def test_a_step_has_the_value_at_zero_that_was_given(compiled):
    """SymPy's default is 1/2; beside zero all are alike."""
    x, z = sympy.symbols("x z")
    for given, at_zero in (((), 0.5), ((0,), 0.0), ((1,), 1.0), ((Rational(1, 4),), 0.25)):
        problem = sy.equations({x: sympy.Heaviside(x, *given), z: x}).problem((0, 1), {x: 0, z: 0}, compiled=compiled)
        for value, expected in ((0.0, at_zero), (-0.0, at_zero), (1e-300, 1.0), (-1e-300, 0.0)):
            assert problem.slope(np.zeros(1), np.array([[value], [0.0]]))[0, 0] == expected


def test_functions_of_many_kinds_are_code():
    x, y = sympy.symbols("x y")
    rate = sympy.Abs(x) + sympy.Max(x, y) + sympy.Piecewise((x, x > y), (y, True)) + sympy.sign(x) + sympy.pi
    rate += sympy.atan2(y, x) + exp(-(x**2)) + sympy.cosh(y) + Rational(1, 3) * x ** Rational(1, 3)
    expected = float(rate.subs({x: 0.7, y: -0.4}))
    for compiled in (True, False):
        problem = sy.equations({x: rate, y: 0}).problem((0, 1e-9), [0.7, -0.4], compiled=compiled)
        sol = problem.solve()
        assert (sol.y[0, -1] - 0.7) / 1e-9 == pytest.approx(expected, rel=1e-6)


class TestFromMechanics:
    def test_a_chain_on_a_cart_by_kanes_method(self):
        """The energy is not used by Kane's method: that it is kept says that the equations are the right ones."""
        method = n_link_pendulum_on_cart(n=2, cart_force=False, joint_torques=False)
        free = (method.mass_matrix.free_symbols | method.forcing.free_symbols) - {t}
        values = {one: 9.81 if one.name == "g" else 1.0 for one in free}
        q, u = list(method.q), list(method.u)
        m, length, g = sympy.symbols("m0:3"), sympy.symbols("l0:2"), sympy.Symbol("g")
        speed, height, energy = [u[0], 0], 0, m[0] * u[0] ** 2 / 2
        for i in (1, 2):
            speed = [speed[0] - length[i - 1] * cos(q[i]) * u[i], speed[1] - length[i - 1] * sin(q[i]) * u[i]]
            height = height + length[i - 1] * cos(q[i])
            energy += m[i] * (speed[0] ** 2 + speed[1] ** 2) / 2 + m[i] * g * height
        system = sy.from_mechanics(method, parameters=values, invariants={"energy": energy})
        for compiled in (True, False):
            problem = system.problem((0, 2), [0, 0.4, 0.7, 0, 0, 0], compiled=compiled)
            sol = problem.solve("dop853", rtol=1e-8, atol=1e-8)
            assert sol.success
            assert abs(sol.residual).max() < 1e-9
        y, args = problem.y0 + 0.1, problem.args
        quotient = derivative(lambda y: problem.fun(0.0, y, *args), y)
        np.testing.assert_allclose(problem.matrices.jac(0.0, y, *args), quotient, rtol=1e-7, atol=1e-7)

    def test_lagranges_method_is_our_own_lagrangian(self):
        x, y = dynamicsymbols("x y")
        rod_ = x**2 + y**2 - 1
        method = LagrangesMethod((x.diff() ** 2 + y.diff() ** 2) / 2 - y, [x, y], hol_coneqs=[rod_])
        with pytest.raises(ValueError, match="call its kanes_equations or form_lagranges_equations first"):
            sy.from_mechanics(method)
        method.form_lagranges_equations()
        system = sy.from_mechanics(method, invariants=[Eq(rod_, 0)])
        theirs = system.problem((0, 5), [1, 0, 0, 0], laws=False, compiled=False)
        ours = rod().problem((0, 5), [1, 0], [0, 0], laws=False, compiled=False)
        np.testing.assert_allclose(theirs.solve(rtol=1e-9).y[:, -1], ours.solve(rtol=1e-9).y[:, -1], atol=1e-7)

    def test_anything_else_is_refused(self):
        with pytest.raises(TypeError, match="method must be a KanesMethod or a LagrangesMethod"):
            sy.from_mechanics(3)


X, Y = sympy.symbols("x y")
Q, P = dynamicsymbols("q p")
K = sympy.Symbol("k")


def crank_of_lagranges_method(**options):
    """A slider crank: an angle, the angle of the rod and the slider's place, joined by two equations."""
    a, b, x = dynamicsymbols("a b x")
    r, length = 1, sympy.Integer(3)
    loop = [r * cos(a) + length * cos(b) - x, r * sin(a) + length * sin(b)]
    L = (a.diff() ** 2 + b.diff() ** 2 + x.diff() ** 2) / 2 - r * sin(a)
    method = LagrangesMethod(L, [a, b, x], hol_coneqs=loop)
    method.form_lagranges_equations()
    return sy.from_mechanics(method, **options), loop, (a, b, x)


class TestConstraints:
    def levels(self, problem):
        return [
            (one.names[0], one.level, None if one.moves is None else [int(i) for i in one.moves])
            for one in problem.invariants
        ]

    def test_they_are_imposed_in_levels(self):
        problem = rod().problem((0, 20), [1, 0], [0, 0], compiled=False)
        assert self.levels(problem) == [
            ("constraint 1", 0, [0, 1]),
            ("rate of constraint 1", 1, [2, 3]),
            ("energy", 2, None),
        ]
        sol = problem.solve("ode45", rtol=1e-5)
        assert sol.success
        assert abs(sol.residual[:2]).max() < 1e-14
        by_functions = iv.MechanicalSystem(
            [1, 1],
            lambda t, q, v: [0, -1],
            lambda t, q: q[0] ** 2 + q[1] ** 2 - 1,
            energy=lambda t, q, v: (v @ v) / 2 + q[1],
        )
        other = by_functions.problem((0, 20), [1, 0], [0, 0]).solve("ode45", rtol=1e-5)
        np.testing.assert_allclose(sol.y[:, -1], other.y[:, -1], atol=1e-6)

    def test_together_or_not_at_all(self):
        joint = rod().problem((0, 1), [1, 0], [0, 0], correction="joint", compiled=False)
        assert {one[1:] for one in self.levels(joint)} == {(0, None)}
        assert not rod().problem((0, 1), [1, 0], [0, 0], correction="none", compiled=False).invariants
        with pytest.raises(ValueError, match="correction must be"):
            rod().problem((0, 1), [1, 0], [0, 0], correction="some")
        with pytest.raises(ValueError, match="consistent must be"):
            rod().problem((0, 1), [1, 0], [0, 0], consistent="no")

    def test_without_constraints_laws_are_imposed_together(self):
        assert self.levels(double_pendulum().problem((0, 1), [1, 2], [0, 0], compiled=False)) == [("energy", 0, None)]

    def test_an_inconsistent_start_is_projected_where_it_is_asked_for(self):
        with pytest.warns(UserWarning, match="the start was moved onto the constraints"):
            problem = rod().problem((0, 1), [1.1, 0], [0.1, 0.2], consistent="project", compiled=False)
        np.testing.assert_allclose(problem.y0, [1, 0, 0, 0.2], atol=1e-12)
        with pytest.raises(iv.InvariantError, match="q0, v0 do not satisfy the constraints: constraint 1"):
            rod().problem((0, 1), [1.1, 0], [0, 0], correction="none", compiled=False)

    def test_redundant_ones_are_left_out_with_a_warning_that_names_them(self):
        x, y = dynamicsymbols("x y")
        L = (x.diff() ** 2 + y.diff() ** 2) / 2 - y
        circle = x**2 + y**2
        twice = sy.lagrangian(L, [x, y], constraints=[circle - 1, 3 * circle - 3])
        with pytest.warns(UserWarning, match="redundant constraints are left out: constraint 2") as said:
            problem = twice.problem((0, 5), [1, 0], [0, 0], laws=False, compiled=False)
        assert len(said) == 1
        assert [one.names[0] for one in problem.invariants] == ["constraint 1", "rate of constraint 1"]
        once = rod().problem((0, 5), [1, 0], [0, 0], laws=False, compiled=False)
        np.testing.assert_allclose(problem.solve().y[:, -1], once.solve().y[:, -1], atol=1e-9)

    def test_contradictions_and_motion_without_mass_are_told(self):
        x, y = dynamicsymbols("x y")
        L = x.diff() ** 2 / 2
        with pytest.raises(iv.InvariantError, match="contradict each other"):
            sy.lagrangian(L + y.diff() ** 2, [x, y], constraints=[x, x - 1]).problem((0, 1), [0, 0], [0, 0])
        with pytest.raises(ValueError, match="mass is not positive definite on the velocities"):
            sy.lagrangian(L, [x, y], constraints=[x - 1]).problem((0, 1), [1, 0], [0, 0])

    def test_of_lagranges_method_are_held_without_being_asked_for(self):
        system, loop, (a, b, x) = crank_of_lagranges_method()
        start = {a: 0, b: 0, x: 4, a.diff(): 1, b.diff(): -1 / 3, x.diff(): 0}
        problem = system.problem((0, 3), start, compiled=False)
        names = [(name, level) for name, level, _ in self.levels(problem)]
        assert names == [
            ("constraint 1", 0),
            ("constraint 2", 0),
            ("rate of constraint 1", 1),
            ("rate of constraint 2", 1),
            ("energy", 2),
        ]
        sol = problem.solve("ode45", rtol=1e-6)
        assert sol.success
        assert abs(sol.residual).max() < 1e-13
        named, *_ = crank_of_lagranges_method(invariants={"level": Eq(loop[1], 0), "other": Eq(-loop[0], 0)})
        assert list(named.laws) == ["other", "level", "rate of other", "rate of level", "energy"]
        with pytest.warns(UserWarning, match="was moved"):
            rough = system.problem((0, 3), [0.3, 0, 4, 1, 0, 0], consistent="project", compiled=False)
        assert abs(rough.invariants[1].fun(0, rough.y0)[0]) < 1e-12

    def test_of_kanes_method_too(self):
        """A pendulum in Cartesian coordinates, with one dependent coordinate and speed."""
        system = sy.from_mechanics(kanes_pendulum(), parameters={K: 1})
        problem = system.problem((0, 3), [0.6, 0.8, 0.8, -0.6], compiled=False)
        assert self.levels(problem) == [
            ("constraint 1", 0, [0, 1]),
            ("velocity constraint 1", 1, [2, 3]),
            ("energy", 2, None),
        ]
        sol = problem.solve("ode45", rtol=1e-6)
        np.testing.assert_allclose(np.hypot(*sol.y[:2]), 1, atol=1e-14)
        with pytest.warns(UserWarning, match="was moved"):
            rough = system.problem((0, 3), [0.66, 0.88, 0.8, -0.5], consistent="project", compiled=False)
        x, y, u, v = rough.y0
        np.testing.assert_allclose([x**2 + y**2, x * u + y * v], [1, 0], atol=1e-12)
        with pytest.raises(iv.InvariantError, match="constraint 1"):
            system.problem((0, 3), [0.66, 0.88, 0.8, -0.5], compiled=False).solve()


def kanes_pendulum():
    from sympy.physics.mechanics import KanesMethod, Particle, Point, ReferenceFrame

    x, y, u, v = dynamicsymbols("x y u v")
    frame, origin = ReferenceFrame("N"), Point("O")
    origin.set_vel(frame, 0)
    bob = origin.locatenew("P", x * frame.x + y * frame.y)
    bob.set_vel(frame, u * frame.x + v * frame.y)
    method = KanesMethod(
        frame,
        q_ind=[x],
        q_dependent=[y],
        u_ind=[u],
        u_dependent=[v],
        kd_eqs=[x.diff() - u, y.diff() - v],
        configuration_constraints=[x**2 + y**2 - 1],
        velocity_constraints=[x * u + y * v],
    )
    method.kanes_equations([Particle("B", bob, 1)], [(bob, -K * frame.y)])
    return method


def kanes_spring(load=lambda q, u: -K * q, kinematics=lambda q, u: u, driven=0):
    """A particle on a line, of mass 2, in a frame that may be driven, with a load along the line."""
    from sympy.physics.mechanics import KanesMethod, Particle, Point, ReferenceFrame

    q, u = dynamicsymbols("q u")
    frame, origin = ReferenceFrame("N"), Point("O")
    origin.set_vel(frame, 0)
    bob = Point("P")
    bob.set_vel(frame, (kinematics(q, u) + driven) * frame.x)
    method = KanesMethod(frame, q_ind=[q], u_ind=[u], kd_eqs=[q.diff() - kinematics(q, u)])
    method.kanes_equations([Particle("B", bob, 2)], [(bob, load(q, u) * frame.x)])
    return method


class TestLawsOfSymPysMechanics:
    def test_the_energy_of_kanes_method(self):
        """The energy is found where all speeds are independent, where some are not, and where q' is not u."""
        q, u = dynamicsymbols("q u")
        spring = sy.from_mechanics(kanes_spring(), parameters={K: 3})
        assert sympy.simplify(spring.laws["energy"] - (u**2 + K * q**2 / 2)) == 0
        bent = sy.from_mechanics(kanes_spring(kinematics=lambda q, u: u / (2 + q**2)), parameters={K: 3})
        assert sympy.simplify(bent.laws["energy"] - (u**2 / (2 + q**2) ** 2 + K * q**2 / 2)) == 0
        _, y, v, w = [*(method := kanes_pendulum()).q, *method.u]
        pendulum = sy.from_mechanics(method, parameters={K: 1})
        assert sympy.simplify(pendulum.laws["energy"] - ((v**2 + w**2) / 2 + K * y)) == 0
        for system in (spring, bent):
            problem = system.problem((0, 5), [0.4], [0.3], compiled=False)
            assert [one.names for one in problem.invariants] == [["energy"]]
            sol = problem.solve(rtol=1e-8, atol=1e-8)
            assert abs(sol.residual).max() < 1e-14

    @pytest.mark.parametrize(
        "method",
        [
            {"load": lambda q, u: -K * q - u / 9},
            {"load": lambda q, u: -K * q + cos(t)},
            {"driven": sympy.Rational(1, 3)},
            {"driven": cos(t)},
        ],
        ids=["damped", "pushed", "driven", "shaken"],
    )
    def test_no_energy_is_claimed_where_none_is_kept(self, method):
        """A moving frame does work, and so may a load; the mass matrix alone does not show a driven frame."""
        system = sy.from_mechanics(kanes_spring(**method), parameters={K: 3})
        assert "energy" not in system.laws

    def test_a_law_of_the_users_own_takes_the_place_of_the_same_one(self):
        q, u = dynamicsymbols("q u")
        system = sy.from_mechanics(kanes_spring(), parameters={K: 3}, invariants={"H": 5 - u**2 - K * q**2 / 2})
        assert list(system.laws) == ["H"]

    def test_lagranges_method_has_the_laws_of_lagrangian(self):
        _, loop, (a, b, x) = crank_of_lagranges_method()
        ours = sy.lagrangian((a.diff() ** 2 + b.diff() ** 2 + x.diff() ** 2) / 2 - sin(a), [a, b, x], constraints=loop)
        theirs, *_ = crank_of_lagranges_method()
        assert list(theirs.laws) == list(ours.laws)
        start = [0.3, float(-np.arcsin(np.sin(0.3) / 3)), 0.0]
        start[2] = float(np.cos(start[0]) + 3 * np.cos(start[1]))
        ends = []
        for system in (ours, theirs):
            sol = system.problem((0, 2), start, [0, 0, 0], compiled=False).solve(rtol=1e-9, atol=1e-9)
            ends.append([*sol.y[:, -1], *system.multipliers(sol)[:, -1]])
        np.testing.assert_allclose(ends[1], ends[0], rtol=1e-6, atol=1e-7)

    def test_multipliers_are_the_forces_of_the_constraints(self):
        """On a unit circle under unit gravity, M v' = Q + Φᵀ λ says 2 λ = y - v²; redundant ones share it."""
        x, y = dynamicsymbols("x y")
        L, circle = (x.diff() ** 2 + y.diff() ** 2) / 2 - y, x**2 + y**2 - 1
        one = sy.lagrangian(L, [x, y], constraints=[circle])
        sol = one.problem((0, 3), [1, 0], [0, 0], compiled=False).solve(rtol=1e-8, atol=1e-8)
        forces = (sol.y[1] - sol.y[2] ** 2 - sol.y[3] ** 2) / 2
        np.testing.assert_allclose(one.multipliers(sol)[0], forces, atol=1e-12)
        two = sy.lagrangian(L, [x, y], constraints=[circle, 2 * circle])
        np.testing.assert_allclose([1, 2] @ two.multipliers(sol), forces, atol=1e-12)
        with pytest.raises(ValueError, match="Kane's method has eliminated them"):
            sy.from_mechanics(kanes_pendulum(), parameters={K: 1}).multipliers(sol)


class TestPyDy:
    def system(self, **given):
        method = given.pop("method", None) or kanes_pendulum()
        x, y, u, v = [*method.q, *method.u]
        start = {"constants": {K: 2.0}, "initial_conditions": {x: 0.6, y: 0.8, u: 0.8, v: -0.6}}
        return pytest.importorskip("pydy.system").System(method, **(start | given))

    def test_it_brings_what_it_knows(self):
        system = sy.from_pydy(self.system(times=np.linspace(0, 1, 11)))
        problem = system.problem(compiled=False)
        np.testing.assert_array_equal(problem.y0, [0.6, 0.8, 0.8, -0.6])
        assert problem.args == (2.0,)
        assert problem.t_span == (0.0, 1.0)
        assert sy.from_pydy(self.system(), parameters={K: 3}).parameters == {K: 3.0}

    def test_the_solution_is_pydys(self):
        theirs = self.system(times=np.linspace(0, 1, 11))
        sol = sy.from_pydy(theirs).problem(compiled=False).solve(rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(sol.y[:, -1], theirs.integrate()[-1], atol=1e-5)

    def test_what_it_does_not_know_is_what_pydy_takes(self):
        method = kanes_pendulum()
        system = sy.from_pydy(self.system(method=method, constants={}, initial_conditions={method.q[1]: 1.0}))
        problem = system.problem((0, 1), compiled=False)
        assert (problem.args, problem.y0.tolist()) == ((1.0,), [0, 1, 0, 0])

    def test_specified_quantities_are_numbers_or_formulas(self):
        q, u = dynamicsymbols("q u")
        push = dynamicsymbols("F")
        pydy = pytest.importorskip("pydy.system")
        theirs = pydy.System(kanes_spring(load=lambda q, u: push - q), initial_conditions={q: 0.4, u: 0})
        theirs.specifieds = {push: 3.0}
        problem = sy.from_pydy(theirs).problem((0, 1), compiled=False)
        np.testing.assert_allclose(problem.fun(0.0, [0.4, 0.1]), [0.1, 1.3])
        theirs.specifieds = {(push,): lambda x, t: [np.cos(t)]}
        with pytest.raises(TypeError, match="is specified by a function: give specifieds"):
            sy.from_pydy(theirs)
        problem = sy.from_pydy(theirs, specifieds={push: cos(t) - u}).problem((0, 1), compiled=False)
        np.testing.assert_allclose(problem.fun(0.5, [0.4, 0.1]), [0.1, (np.cos(0.5) - 0.5) / 2])

    def test_anything_else_is_refused(self):
        with pytest.raises(TypeError, match=r"from_pydy takes a pydy\.system\.System"):
            sy.from_pydy(kanes_pendulum())
        with pytest.raises(TypeError, match="problem needs q0 and v0, the initial values of x"):
            sy.from_mechanics(kanes_pendulum(), parameters={K: 1}).problem((0, 1))
        with pytest.raises(TypeError, match="problem needs t_span"):
            sy.from_pydy(self.system()).problem()


class TestPoints:
    def test_a_system_shows_its_points(self):
        a = dynamicsymbols("a")
        length = sympy.Symbol("l")
        system = sy.lagrangian(
            length**2 * a.diff() ** 2 / 2 + length * cos(a),
            [a],
            parameters={length: 2},
            points=[(0, 0), (length * sin(a), -length * cos(a))],
        )
        problem = system.problem((0, 1), [0.5], [0], compiled=False)
        for bob, args in ((2.0, (2.0,)), (3.0, (3.0,))):
            sol = problem.replace(args=args).solve(dense_output=True)
            film = system.animate(sol, links=[(0, 1)], fps=5)
            np.testing.assert_allclose(film.points[0], [[0, 0], [bob * np.sin(0.5), -bob * np.cos(0.5)]])
            film._draw_was_started = True

    def test_without_points_or_with_wrong_ones_it_says_so(self):
        sol = rod().problem((0, 1), [1, 0], [0, 0], compiled=False).solve()
        with pytest.raises(ValueError, match="the system has no points: make it with points="):
            rod().animate(sol)
        with pytest.raises(ValueError, match="each of two or each of three coordinates"):
            sy.equations({X: 1}, points=[(X, 0), (X, 0, 0)])
        with pytest.raises(ValueError, match="point 0 has k, which is neither"):
            sy.equations({X: 1}, points=[(X, K)])


def test_python_functions_can_be_pickled():
    problem = made("kepler", compiled=False)
    f = pickle.loads(pickle.dumps(problem.fun))
    assert f(0.0, problem.y0, *problem.args) == problem.fun(0.0, problem.y0, *problem.args)


def test_systems_show_their_equations():
    x, y = sympy.symbols("x y")
    assert repr(sy.equations({x: -y, y: x})) == "Equations(x' = -y, y' = x)"
    assert sy.equations({x: -y, y: x})._repr_latex_() == (
        r"$\displaystyle\begin{aligned} x' &= - y \\ y' &= x \end{aligned}$"
    )
    assert repr(rod()).startswith("Lagrangian(L = -y(t) + Derivative")
    assert repr(sy.from_mechanics(kanes_pendulum(), parameters={K: 1})) == "Multibody(x' = u(t), y' = v(t))"
    assert r"\frac{\mu}{\sqrt{x^{2} + y^{2}}}" in kepler()._repr_latex_()


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: sy.equations({X: K * X}),
            ValueError,
            "derivative of x has k, which is neither a state nor a parameter",
        ),
        (lambda: sy.equations({X: sympy.Function("h")(X)}), ValueError, r"has h\(x\), which is neither"),
        (lambda: sy.equations({X: X}, parameters={X: 1}), ValueError, "x occurs twice"),
        (lambda: sy.equations([X]), TypeError, "rates must be a dict"),
        (lambda: sy.equations({X: "x**2"}), TypeError, "must be a SymPy expression, got 'x"),
        (lambda: sy.equations({X: X}, invariants=[K], parameters={K: 1}), ValueError, "does not depend on the state"),
        (lambda: sy.equations({X: X}, parameters={K: "a"}), TypeError, "parameter k must be a real number"),
        (lambda: sy.equations({X: sympy.I}), ValueError, "must be finite and real"),
        (lambda: sy.equations({X: 1}).problem((0, 1), {Y: 1}), ValueError, "y0 has y, which is not one of x"),
        (lambda: sy.equations({X: 1, Y: 1}).problem((0, 1), {Y: 1}), ValueError, "y0 has no value for x"),
        (lambda: sy.equations({X: 1}).problem((0, 1), [1, 2]), ValueError, r"must have 1 values, of x, got \[1, 2\]"),
        (
            lambda: sy.equations({X: sympy.besselj(0, X)}).problem((0, 1), [1], compiled=False),
            ValueError,
            "no code for",
        ),
        (lambda: sy.hamiltonian(X, [X], [Y, K]), ValueError, "got 1 q and 2 p"),
        (lambda: sy.hamiltonian(X, X, Y), TypeError, r"q must be a list of symbols, got x: write \[x\]"),
        (
            lambda: sy.lagrangian(X, [X]),
            TypeError,
            "q must be functions of time, got x: make them with dynamicsymbols",
        ),
        (lambda: sy.lagrangian(Q.diff(), [Q]), ValueError, "mass matrix ∂²L/∂v² is singular"),
        (lambda: sy.lagrangian(Q.diff() ** 2, [Q], constraints=[Q.diff()]), ValueError, "list it in nonholonomic"),
        (lambda: sy.lagrangian(Q.diff() ** 2, [Q], constraints=[t]), ValueError, "does not depend on q"),
        (lambda: sy.lagrangian(Q.diff() ** 2, [Q], nonholonomic=[Q]), ValueError, "list it in constraints"),
        (lambda: sy.lagrangian(Q.diff() ** 2, [Q], nonholonomic=[Q.diff() ** 2]), ValueError, "not linear in the vel"),
        (
            lambda: sy.lagrangian(Q.diff() ** 2, [Q], forces={P: 1}),
            ValueError,
            r"forces has p\(t\), which is not one of",
        ),
        (lambda: sy.lagrangian(Q.diff() ** 2, [Q, Q]), ValueError, r"q\(t\) occurs twice"),
        (lambda: sy.hamiltonian(X, [X], [X]), ValueError, "x occurs twice"),
        (lambda: sy.from_mechanics(kanes_pendulum()), ValueError, "has k, which is neither a state nor a parameter"),
        (lambda: sy.lagrangian(Q.diff() ** 2, [Q], forces=[1, 2]), ValueError, "forces must have 1 entries"),
        (lambda: rod().problem((0, 1), [2, 0], [0, 0], compiled=False).solve(), iv.InvariantError, "constraint 1"),
    ],
)
def test_what_makes_no_sense_is_named(make, error, message):
    with pytest.raises(error, match=message):
        make()
