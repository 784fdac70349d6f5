"""Scripts for SciPy may do here with results, functions and arguments what they do there."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import scipy.integrate

import invariode as iv
import invariode.scipy


def decay(t, y):
    return -0.5 * y


def solution(solve_ivp=iv.solve_ivp, **options):
    return solve_ivp(decay, (0, 1), [1.0, 2.0], **options)


def popped(sol):
    return [sol.pop("success"), "success" in sol, sol.pop("success", "gone")]


def updated(sol):
    sol.update(mass=2, nfev=0)
    return [sol.mass, sol["mass"], sol.nfev, sol["nfev"]]


def assigned(sol):
    sol["x"] = sol["y"][0]
    sol.label = "run"
    return [sol.x[0], sol["label"], list(sol)[-2:]]


def replaced(sol):
    sol.y = sol.y[0]
    return [sol["y"].ndim, sol.y[0]]


def deleted(sol):
    del sol["t"]
    del sol.y
    return ["t" in sol, hasattr(sol, "y")]


def joined(sol):
    both = sol | {"mass": 2}
    other = {"mass": 2, "status": 5} | sol
    sol |= {"mass": 3}
    return [type(both), both["mass"], type(other), other["status"], sol.mass]


def to_a_dict(sol):
    plain = dict(sol)
    return [type(plain), plain["message"], plain["t"] is sol.t]


def unpacked(sol):
    def call(*, message, status, **rest):
        return [message, status, "y" in rest]

    return call(**sol)


def looked_up(sol):
    return [sol.get("status"), sol.get("nothing", 7), sol.setdefault("status", 9), sol.setdefault("new", 9), sol.new]


def iterated(sol):
    first = [name for name in sol if name not in ("stats", "steps", "t_end")][:3]
    return [set(first) <= {"message", "success", "status", "t", "y", "sol"}, dict(sol.items())["nfev"] == sol.nfev]


def looked_into(sol):
    return [isinstance(sol, dict), bool(sol), "t" in sol, "t" in dir(sol), getattr(sol, "nothing", None)]


def copied(sol):
    twin, deep, back = copy.copy(sol), copy.deepcopy(sol), pickle.loads(pickle.dumps(sol))
    twin["status"], deep.y[0] = 9, 0
    return [sol.status, sol.y[0, 0], type(twin) is type(deep) is type(sol) is type(back), back.message]


def printed(sol):
    return [line.partition(":")[0].strip() in sol for line in repr(sol).splitlines() if ": " in line[:14]][:4]


def emptied(sol):
    sol.clear()
    return [len(sol), repr(sol) in ("", "OdeResult()", "OptimizeResult()", "_RichResult()")]


WAYS = [
    popped,
    updated,
    assigned,
    replaced,
    deleted,
    joined,
    to_a_dict,
    unpacked,
    looked_up,
    iterated,
    looked_into,
    copied,
    printed,
    emptied,
]


class TestTheResultIsADict:
    """Each way of handling a result does the same to SciPy's and to ours."""

    @pytest.mark.parametrize("way", WAYS, ids=lambda way: way.__name__)
    def test_as_in_scipy(self, way):
        assert way(solution(iv.solve_ivp)) == way(solution(scipy.integrate.solve_ivp))

    def test_what_the_class_computes_is_no_item(self):
        sol = solution(invariants=None)
        assert "residual" not in sol
        assert sol.residual.shape == (0, len(sol.t))
        assert "residual" not in sol
        with pytest.raises(AttributeError, match="'Solution' object has no attribute 'nothing'"):
            _ = sol.nothing

    def test_items_that_were_added_stay_with_it(self):
        sol = iv.solve_ivp(
            lambda t, y: [y[1], -y[0]], (0, 1), [1.0, 0.0], invariants=lambda t, y: y[0] ** 2 + y[1] ** 2
        )
        sol["label"] = "circle"
        assert sol.impose().label == "circle"


@pytest.mark.parametrize("name", ["RK23", "RK45", "DOP853"])
def test_classes_take_their_arguments_by_position_as_scipy_does(name):
    def columns(t, y):
        assert y.ndim == 2
        return -y

    given = (columns, 0.0, [1.0, 2.0], 1.0, np.inf, 1e-6, 1e-8, True, 0.01)
    for solver in (getattr(scipy.integrate, name)(*given), getattr(invariode.scipy, name)(*given)):
        solver.step()
        assert solver.t == pytest.approx(0.01)


def rotation(t, y, a):
    return [a * y[1], -a * y[0]]


def radius(t, y):
    return y[0] ** 2 + y[1] ** 2


def g(t, y):
    return y[0]


def jac(t, y):
    return [[0, 1], [-1, 0]]


OTHERS = {
    "invariant radius": {"invariants": radius},
    "event g": {"events": g},
    "invariant radius and event g": {"invariants": radius, "events": g},
    "jac": {"method": "ode15s", "jac": jac},
}


class TestArguments:
    """The arguments in `args` reach invariants and events too; a function that does not take them is named."""

    @pytest.mark.parametrize("name", OTHERS)
    def test_it_is_said_which(self, name):
        with pytest.raises(TypeError, match="positional argument") as raised:
            iv.solve_ivp(rotation, (0, 1), [1.0, 0.0], args=(2.0,), **OTHERS[name])
        (note,) = raised.value.__notes__
        assert note.startswith(
            "args = (2.0,) are passed to all functions of the problem, also to invariants and events"
        )
        assert f"and {name} do" in note
        assert note.endswith("with (t, y, *args)")

    def test_errors_of_another_kind_are_left_alone(self):
        def broken(t, y, a):
            raise TypeError("mine")

        with pytest.raises(TypeError, match=r"^mine$") as raised:
            iv.solve_ivp(broken, (0, 1), [1.0], args=(2.0,))
        assert not hasattr(raised.value, "__notes__")


class TestLambdify:
    sympy = pytest.importorskip("sympy")
    t, a, b = sympy.symbols("t a b")

    def made(self, expression, **options):
        return self.sympy.lambdify((self.t, (self.a, self.b)), expression, **options)

    @pytest.mark.parametrize("modules", ["numpy", "sympy"])
    def test_columns_are_vectors(self, modules):
        f = self.made(self.sympy.Matrix([self.b, -self.a]), modules=modules)
        g = self.made(self.sympy.Matrix([self.a**2 + self.b**2]), modules=modules)
        sol = iv.solve_ivp(f, (0, 1), [1.0, 0.0], invariants=g)
        expected = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 1), [1.0, 0.0], invariants=radius)
        np.testing.assert_allclose(sol.y, expected.y, atol=1e-14)

    def test_they_are_called_what_they_compute(self):
        g = self.made(self.a**2 + self.b**2)
        sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 1), [1.0, 0.0], invariants=g)
        assert sol.drift().names == ["a**2 + b**2"]
        assert repr(iv.Problem(self.made([self.b, -self.a]), (0, 1), [1, 0])) == (
            "Problem('[b, -a]', t_span=(0.0, 1.0), n=2)"
        )
        assert repr(iv.Event(self.made(self.a))).startswith("Event(a, ")
        assert iv.Problem(self.made(self.sympy.Matrix([self.b, -self.a])), (0, 1), [1, 0]).name

    def test_a_column_of_another_function_is_refused_with_what_to_return(self):
        with pytest.raises(ValueError, match=r"returned shape \(2, 1\)") as raised:
            iv.solve_ivp(lambda t, y: self.sympy.Matrix([y[1], -y[0]]), (0, 1), [1.0, 0.0])
        assert raised.value.__notes__ == ["a column is a matrix of one column: return a list, or numpy.ravel(column)"]
