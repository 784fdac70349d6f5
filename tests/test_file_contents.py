"""Files are checked against what reads them, and what is given to go on with against the run."""

from __future__ import annotations

import functools
import json
import os
import pickle
import struct
from typing import NamedTuple

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import invariode as iv
from interrupted import differences


def rates(t, y):
    return [-2 * y[0] + y[1] * y[2], 2 * y[0] - y[1] * y[2] - 5 * y[1] ** 2, 5 * y[1] ** 2]


def problem(fun=rates, **changes):
    return iv.Problem(fun, (0, 3), [1.0, 0.0, 0.0], **changes)


def rewritten(path, change):
    """The file with changed arrays, and what it says of itself changed in place."""
    with np.load(path) as archive:
        arrays = dict(archive)
    about = json.loads(str(arrays["about"]))
    change(arrays, about)
    with open(path, "wb") as file:
        np.savez(file, **arrays | {"about": np.array(json.dumps(about))})


# ----------------------------------------------------------------------------------------------------------------------
# Sizes


def test_a_segment_is_of_the_size_that_its_extension_reads(method, tmp_path):
    sol = problem().solve(method, dense_output=True)
    sol.save(tmp_path / "a")
    own = sol.sol._dense.parts()["extension"]

    def claim(arrays, about):
        about["dense"]["extension"] = "numbered" if own == "TR-BDF2" else "TR-BDF2"

    rewritten(tmp_path / "a", claim)
    with pytest.raises(ValueError, match=r"a is damaged: ValueError: segments do not match"):
        iv.load(tmp_path / "a")
    rewritten(tmp_path / "a", lambda arrays, about: about["dense"].update(parameters=2**64 - 1))
    with pytest.raises(ValueError, match="a is damaged: ValueError: a point is not a state with its sensitivities"):
        iv.load(tmp_path / "a")
    t = sol.sol._dense.knots()
    for times in (
        0 * t,
        t[::-1],
        t + 10,
        t * np.nan,
        np.where(t == t[1], np.nan, t),
        np.sort(t)[[0, 2, 1, *range(3, len(t))]],
    ):
        sol.save(tmp_path / "a")
        rewritten(tmp_path / "a", lambda arrays, about, times=times: arrays.update({"dense.t": times}))
        with pytest.raises(ValueError, match=r"a is damaged: ValueError: (times|jumps|the continuous solution)"):
            iv.load(tmp_path / "a", problem()).extend(4).sol(2.9)


@pytest.mark.parametrize("method", ["ode15s", "ode23t", "ode23tb", "radau"])
def test_factors_need_a_jacobian(method, tmp_path):
    """(ode23s takes one in each step.)"""
    problem().solve(method, max_steps=7).save(tmp_path / "a")

    def empty(arrays, about):
        memory = arrays["memory"].tobytes()
        nine = struct.pack("<Q", 9)
        at = [i for i in range(len(memory) - 80) if memory[i : i + 8] == nine and memory[i - 1] == 1]
        assert at  # J, after the flag that it is kept
        arrays["memory"] = np.frombuffer(memory[: at[0]] + struct.pack("<Q", 0) + memory[at[0] + 80 :], dtype=np.uint8)

    rewritten(tmp_path / "a", empty)
    with pytest.raises(ValueError, match="the memory of the run is damaged"):
        iv.load(tmp_path / "a", problem()).extend(4, max_steps=None)


def test_no_byte_of_a_memory_does_more_than_spoil_the_solution(tmp_path):
    """Each 13th byte in turn is 2, which is no truth: the memory is refused, or the run goes on."""
    law = iv.Invariants(lambda t, y: y[0] + y[1] + y[2], when="needed")
    sol = problem(invariants=law).solve("ode45", max_steps=3)
    sol.save(tmp_path / "a")
    refused = 0
    size = len(sol._origin.memory)
    for at in range(0, size, 13):

        def change(arrays, about, at=at):
            arrays["memory"] = np.frombuffer(sol._origin.memory, np.uint8).copy()
            arrays["memory"][at] = 2

        rewritten(tmp_path / "a", change)
        try:
            iv.load(tmp_path / "a", problem(invariants=law)).extend(4, max_steps=2)
        except ValueError:
            refused += 1
    assert refused > size / 100


DAMAGE = {
    "no memory": lambda arrays, about: arrays.pop("memory"),
    "a length": lambda arrays, about: about.update(length=2**62),
    "a negative interval": lambda arrays, about: about.update(every=-1.0),
    "no token": lambda arrays, about: about.pop("token"),
    "a token elsewhere": lambda arrays, about: about.update(token="../../x/../0000000"),
    "the end": lambda arrays, about: arrays.update(y_end=np.zeros(7)),
    "the status": lambda arrays, about: about.update(status="0"),
    "the statistics": lambda arrays, about: about["stats"].pop("steps"),
    "values": lambda arrays, about: arrays.update({"invariants.value": np.zeros(3)}),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_what_a_checkpoint_says_is_seen_to_be_possible(what, tmp_path):
    problem().solve(checkpoint=tmp_path / "run")
    rewritten(tmp_path / "run", DAMAGE[what])
    with pytest.raises(ValueError, match=r"the file .*run.* is (damaged|shorter)"):
        iv.load(tmp_path / "run", problem())
    if what == "a length":
        rewritten(tmp_path / "run", lambda arrays, about: about.update(length=-1))
        with pytest.raises(ValueError, match="is damaged"):
            iv.load(tmp_path / "run", problem())


# ----------------------------------------------------------------------------------------------------------------------
# The code of the functions


GRID = np.linspace(0.0, 2.0, 9)


def twin(t, y):
    return [-2 * y[0] + y[1] * y[2], 2 * y[0] - y[1] * y[2] - 5 * y[1] ** 3, 5 * y[1] ** 3]


def crossing(level):
    return lambda t, y: y[0] - level


class Reactions:
    """`rates` with a power that shows where y₁ is neither 0 nor 1."""

    order = 2

    def __init__(self, power, calls=0):
        self.power, self.calls, self.out = power, calls, np.zeros(3)

    def __call__(self, t, y):
        self.count()
        self.out[:] = rates(t, [y[0], y[1] ** self.power, y[2]])
        return self.out

    def count(self):
        self.calls += 1

    @property
    def level(self):
        return 0.1 * self.power

    def event(self, t, y):
        return y[0] - self.level

    def action(self, t, y):
        return self.power * y

    def by_class(self, t, y):
        return y[0] - 0.1 * self.order


class Others(Reactions):
    order = 3


def powered(values):
    """Lists, dicts and objects that hold the power."""
    if isinstance(values, Reactions):
        return lambda t, y: rates(t, [y[0], y[1] ** values.power, y[2]])
    return lambda t, y: rates(t, [y[0], y[1] ** values[0], y[2]])


def through(function):
    """Functions of y₁ that are 0 at 0."""
    return lambda t, y: rates(t, [y[0], function(y[1]), y[2]])


class Power(NamedTuple):
    value: int


CODES = {
    "fun": (dict(fun=twin), {}, "fun"),
    "jac": (dict(jac=lambda t, y: np.zeros((3, 3))), {}, "jac"),
    "event": (dict(events=lambda t, y: y[0] - 0.5), {}, "event 0"),
    "what an event keeps": (dict(events=crossing(0.5)), {}, "event 0"),
    "action": (dict(events=iv.Event(lambda t, y: y[0], action=lambda t, y: 2 * y)), {}, "the action of event 0"),
    "invariant": (dict(invariants=lambda t, y: y[0] + y[1] + y[2] + 0 * t), {}, r"invariant 0 \(fun\)"),
    "breakpoint": ({}, {"breakpoints": [(1, lambda t, y: 3 * y)]}, r"the action at t = 1\.0"),
    "callable object": (dict(fun=Reactions(2)), {}, "fun"),
    "compiled method": (dict(fun=iv.compile(powered((2,)))), {}, "fun"),
    "object": (dict(fun=powered(Reactions(2))), {}, "fun"),
    "list": (dict(fun=powered([2])), {}, "fun"),
    "dict": (dict(fun=powered({0: 2})), {}, "fun"),
    "named tuple": (dict(fun=powered(Power(2))), {}, "fun"),
    "function of NumPy": (dict(fun=through(np.sin)), {}, "fun"),
    "interpolator": (dict(fun=through(CubicSpline(GRID, GRID**2))), {}, "fun"),
    "wrapped function": (dict(fun=through(np.vectorize(lambda x: x**2))), {}, "fun"),
    "method": (dict(events=Reactions(2).event), {}, "event 0"),
    "class": (dict(events=Others(1).by_class), {}, "event 0"),
    "action that is a method": (
        dict(events=iv.Event(crossing(0.5), action=Reactions(2).action)),
        {},
        "the action of event 0",
    ),
}
FIRST = {
    "jac": dict(jac=lambda t, y: 0 * np.ones((3, 3))),
    "event": dict(events=lambda t, y: y[0] - 0.6),
    "what an event keeps": dict(events=crossing(0.6)),
    "action": dict(events=iv.Event(lambda t, y: y[0], action=lambda t, y: y)),
    "invariant": dict(invariants=lambda t, y: y[0] + y[1] + y[2]),
    "callable object": dict(fun=Reactions(1)),
    "compiled method": dict(fun=iv.compile(powered((1,)))),
    "object": dict(fun=powered(Reactions(1))),
    "list": dict(fun=powered([1])),
    "dict": dict(fun=powered({0: 1})),
    "named tuple": dict(fun=powered(Power(1))),
    "function of NumPy": dict(fun=through(np.tan)),
    "interpolator": dict(fun=through(CubicSpline(GRID, GRID))),
    "wrapped function": dict(fun=through(np.vectorize(lambda x: 2 * x))),
    "method": dict(events=Reactions(1).event),
    "class": dict(events=Reactions(1).by_class),
    "action that is a method": dict(events=iv.Event(crossing(0.5), action=Reactions(1).action)),
}


@pytest.mark.parametrize("what", CODES)
def test_other_code_is_refused_by_the_function_unless_it_is_trusted(what, tmp_path):
    """f and g agree at the start, where they are compared."""
    now, functions, name = CODES[what]
    before = {one: [(1, lambda t, y: 2 * y)] for one in functions}
    problem(**FIRST.get(what, {})).solve("ode15s", max_steps=2, **before).save(tmp_path / "a")
    with pytest.raises(ValueError, match=rf"the code of {name} is not that of the run\..*trust=.code"):
        iv.load(tmp_path / "a", problem(**now), **functions)
    iv.load(tmp_path / "a", problem(**now), **functions, trust="code")
    with pytest.raises(ValueError, match="trust must be one of 'code', got 'all'"):
        iv.load(tmp_path / "a", problem(**now), **functions, trust="all")


CALLS = 0


def counting(t, y):
    global CALLS
    CALLS += 1
    return rates(t, y) if t not in {1e9, 2e9} else [0, 0, 0]


def filling():
    out = np.zeros(3)

    def f(t, y):
        out[:] = rates(t, y)
        return out

    return f


def logging():
    log, parts = [], (lambda t, y: rates(t, y), None)

    def f(t, y):
        log.append(t)
        return parts[0](t, y)

    return f


@pytest.mark.parametrize("make", [lambda: counting, filling, logging, lambda: Reactions(2)])
def test_what_a_function_changes_itself_is_not_its_code(make, tmp_path):
    """Nor is where in memory it and the functions that it calls are."""
    sol = problem(make()).solve(max_steps=5)
    sol.save(tmp_path / "a")
    again = iv.load(tmp_path / "a", problem(make()))
    assert not differences(sol.extend(3, max_steps=None), again.extend(3, max_steps=None))


def filled_jacobian():
    J, kept = np.zeros((3, 3)), {"last": 0.0, "row": [0.0]}

    def jac(t, y):
        kept["last"] = kept["row"][0] = t
        J[0] = [-2, y[2], y[1]]
        J[1] = [2, -y[2] - 10 * y[1], -y[1]]
        J[2, 1] = 10 * y[1]
        return J

    return jac


def test_arrays_that_a_jacobian_fills_are_not_its_code(tmp_path):
    sol = problem(jac=filled_jacobian()).solve("ode15s", max_steps=5)
    sol.save(tmp_path / "a")
    again = iv.load(tmp_path / "a", problem(jac=filled_jacobian()))
    assert not differences(sol.extend(3, max_steps=None), again.extend(3, max_steps=None))


# ----------------------------------------------------------------------------------------------------------------------
# What can be written and read


@pytest.mark.parametrize("path", [3, None, True, b"a"])
def test_a_path_is_text(path, tmp_path):
    sol = problem().solve()
    for use in (sol.save, iv.load, iv.EnsembleSolution.load):
        with pytest.raises(TypeError, match="path must be a str or path-like, got "):
            use(path)
        for name, why in (("", "it is empty"), ("a\ud800.npz", "a lone surrogate"), ("a\0", "a null character")):
            with pytest.raises(ValueError, match=f"path = .* is not a name of a file: .*{why}"):
                use(name)
    for name, value in (("t", [1.0, 2.0]), ("y", None)):
        with pytest.raises(ValueError, match=r"save: t is .* arrays of shapes \(k,\) and \(3, k\)"):
            sol.changed(**{name: value}).save(tmp_path / "a")
    del sol["t"]
    with pytest.raises(ValueError, match="save: the solution has no t any more"):
        sol.save(tmp_path / "a")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names")
def test_reading_does_not_wait_for_a_pipe(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe is not a regular file"):
        iv.load(tmp_path / "pipe")


def test_fields_that_the_user_has_added_are_kept(tmp_path):
    sol = problem().solve()
    sol.author, sol.notes, sol.mask = "E. Hairer", {"seed": [1, 2.5, None]}, np.array([[True], [False]])
    sol.check, sol["7"] = (lambda: None), np.float64(7)
    with pytest.warns(UserWarning, match=r"save keeps numbers, .* leaves out the fields 'check'"):
        sol.save(tmp_path / "a")
    again = iv.load(tmp_path / "a", problem())
    assert (again.author, again.notes, float(again["7"])) == (sol.author, sol.notes, 7.0)
    np.testing.assert_array_equal(again.mask, sol.mask)
    assert "check" not in again
    again.save(tmp_path / "b")
    assert iv.load(tmp_path / "b").notes == sol.notes
    many = iv.solve_ensemble(
        lambda t, y: [y[1], -y[0]],
        (0, 1),
        [[1.0, 0.0]],
        workers=1,
        invariants=iv.Invariants(lambda t, y: y @ y, names="energy"),
        events=iv.Event(lambda t, y: y[0] - 0.9, name="down"),
    )
    many.author, many.mask, many.check, many.large = "E. Hairer", sol.mask, sol.check, 10**5000
    with pytest.warns(UserWarning, match=r"save keeps numbers, .* leaves out the fields 'check', 'large'"):
        many.save(tmp_path / "m")
    again = iv.EnsembleSolution.load(tmp_path / "m")
    assert again.author == "E. Hairer"
    np.testing.assert_array_equal(again.mask, sol.mask)
    assert again[0].drift().names == many[0].drift().names == ["energy"]
    assert again[0]._names == many[0]._names


def test_arguments_of_other_precisions_are_told_apart(tmp_path):
    def scaled(t, y, a, b):
        return [-float(a) * y[0], -float(b[0]) * y[1], 0.0]

    def given(a):
        return problem(scaled, args=(np.longdouble(a), np.full(2, a, np.longdouble)))

    given(0.5).solve().save(tmp_path / "a")
    assert iv.load(tmp_path / "a", given(0.5)).extend(4).success
    with pytest.raises(ValueError, match="args"):
        iv.load(tmp_path / "a", given(np.longdouble(0.5) + np.finfo(np.longdouble).eps))

    def unused(t, y, a):
        return [-y[0], -y[1], 0.0]

    problem(unused, args=(10**5000,)).solve().save(tmp_path / "b")
    assert iv.load(tmp_path / "b", problem(unused, args=(10**5000,))).extend(4).success
    with pytest.raises(ValueError, match=r"args: .*an integer of 16610 bits"):
        iv.load(tmp_path / "b", problem(unused, args=(10**5000 + 1,)))
    inside: list = []
    inside.append(inside)
    for wrong in (inside, functools.reduce(lambda one, _: [one], range(1000), 0)):
        with pytest.raises(ValueError, match=r"nested in more than 50 levels, or contains itself: .* Flatten it"):
            problem(unused, args=(wrong,)).solve().save(tmp_path / "c")
        with pytest.raises(ValueError, match="nested in more than 50 levels"):
            problem(unused, args=(wrong,)).solve(checkpoint=tmp_path / "c")
    assert [one.name for one in tmp_path.iterdir() if one.name.startswith("c.output")] == []


def test_labels_of_any_text_come_back(tmp_path):
    sol = problem(labels=["\ud800", "ü", "c"], name="a\ud800").solve()
    sol.save(tmp_path / "a")
    assert iv.load(tmp_path / "a")._names.components == ["?", "ü", "c"]
    sol.to_dataframe().to_csv(tmp_path / "a.csv")
    sol.plot().figure.savefig(tmp_path / "a.svg")
    with pytest.raises(ValueError, match="labels must differ"):
        problem(labels=["\ud800", "\ud801", "c"])


def test_names_without_an_encoding_are_readable(tmp_path):
    """Lone surrogates, as `os.fsdecode` makes them of bytes, reached the core, whose text they cannot be."""

    def height(t, y):
        return y[0] - 0.5

    height.__name__ = "height\udcff"
    laws = [
        iv.Invariants(lambda t, y: y[0] + y[1] + y[2], names=["sum\udcff"]),
        iv.UnitVector([3, 4], name="axis\udcff"),
    ]
    events = [height, iv.Event(lambda t, y: y[0] - 0.1, name="low\udcff")]
    turning = iv.Problem(
        lambda t, y: [*rates(t, y), -y[4], y[3]], (0, 3), [1.0, 0, 0, 1, 0], invariants=laws, events=events
    )
    sol = turning.solve()
    sol.save(tmp_path / "a")
    assert iv.load(tmp_path / "a", turning).extend(4).success
    assert sol.drift().names == ["sum?", "|axis?|²"]


def test_a_wrong_f_is_told_alike_with_a_checkpoint(tmp_path):
    with pytest.raises(ValueError, match=r"returned shape \(1,\), expected shape \(3,\)"):
        problem(lambda t, y: [1.0]).solve(checkpoint=tmp_path / "a")
    assert os.listdir(tmp_path) == []


def test_a_prepared_solver_and_an_input_travel():
    level = iv.Input([0.0, 1.0, 2.0], [1.0, 2.0, 3.0], kind="linear")
    solver = iv.Problem(rates, (0, 3), [1.0, 0.0, 0.0]).prepare("ode45", rtol=1e-6)
    assert not differences(solver(), pickle.loads(pickle.dumps(solver))())
    with pytest.raises(ValueError, match="read-only"):
        level.values[0] = 5
    with pytest.raises(AttributeError, match="an Input cannot be changed: make another one, with values="):
        level.values = np.zeros(3)
    assert pickle.loads(pickle.dumps(level))(0.5) == level(0.5) == 1.5


# ----------------------------------------------------------------------------------------------------------------------
# The tables of fields


def full(path):
    """A file that has every field but those of former runs."""
    total = iv.Invariants(lambda t, y: y[0] + y[1] + y[2], names="total")
    sol = problem(invariants=total, events=lambda t, y: y[0] - 0.5).solve("ode15s", dense_output=True)
    sol.mask = np.array([1.0])
    sol.save(path)


def test_every_field_of_a_file_is_of_its_type_and_shape_or_is_named(tmp_path):
    full(tmp_path / "a")
    with np.load(tmp_path / "a") as archive:
        arrays = {name: one for name, one in archive.items() if name != "about"}
        values = json.loads(str(archive["about"])).keys() - {"format", "version", "invariode"}
    others = ("dense.", "identity.", "added.")  # which those check that use them

    def wrong(name):
        def put(arrays, about):
            if name in about:
                about[name] = [about[name]] * 2
            else:
                arrays[name] = np.array([[[[1.5j]]]])

        return put

    def left_out(name):
        return lambda arrays, about: (arrays.pop(name, None), about.pop(name, None))

    def added(arrays, about):
        arrays["more"] = np.zeros(1)

    full(tmp_path / "b")
    for name in [*values, *(name for name in arrays if not name.startswith(others))]:
        rewritten(tmp_path / "b", wrong(name))
        with pytest.raises(ValueError, match=rf"b is damaged: ValueError: {name}, .* does not fit"):
            iv.load(tmp_path / "b")
        (tmp_path / "b").write_bytes((tmp_path / "a").read_bytes())
        if name not in ("steps", "y_end", "memory"):
            rewritten(tmp_path / "b", left_out(name))
            with pytest.raises(ValueError, match=rf"b is damaged: it has no '{name}'"):
                iv.load(tmp_path / "b")
            (tmp_path / "b").write_bytes((tmp_path / "a").read_bytes())
    rewritten(tmp_path / "b", added)
    with pytest.raises(ValueError, match="b is damaged: ValueError: 'more' should not be there"):
        iv.load(tmp_path / "b")


@pytest.mark.parametrize("name", ["format", "version"])
@pytest.mark.parametrize(
    "value",
    [{}, {"a": 1}, [], [1], None, True, 1, 1.5, np.inf, "", "x" * 5000, 10**4000],
    ids=lambda value: str(value)[:9],
)
def test_whatever_a_header_says_is_told_in_a_few_words(name, value, tmp_path):
    problem().solve().save(tmp_path / "a")
    rewritten(tmp_path / "a", lambda arrays, about: about.update({name: value, "invariode": value}))
    with pytest.raises(ValueError, match=r"a (was not written by|is of kind 'solution' in version )") as told:
        iv.load(tmp_path / "a")
    assert len(str(told.value)) < 1000


@pytest.mark.parametrize(("name", "value"), [("status", "0"), ("t_end", None), ("nfev", True)])
def test_what_could_not_be_read_is_not_written(name, value, tmp_path):
    sol = problem().solve()
    sol.save(tmp_path / "a")
    before = (tmp_path / "a").read_bytes()
    sol[name] = value
    with pytest.raises(ValueError, match=f"{name}, {value!r}, does not fit"):
        sol.save(tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == before


@pytest.mark.parametrize("name", ["y", "t", "status", "stats"])
def test_added_fields_replace_none_of_the_solution(name, tmp_path):
    sol = problem().solve("ode45")
    sol["mine"] = 3.0
    sol.save(tmp_path / "a")
    assert iv.load(tmp_path / "a")["mine"] == 3.0
    rewritten(tmp_path / "a", lambda arrays, about: about["added"].update({name: about["added"]["mine"]}))
    with pytest.raises(ValueError, match=rf"a is damaged: .*names of others: {name}"):
        iv.load(tmp_path / "a")


@pytest.mark.parametrize("method", ["ode45", "ode15s", "radau"])
def test_edited_breakpoints_end_or_are_refused(method, tmp_path):
    """A run that stands before t = 1 and whose next breakpoint is said to be after it has no way to go."""
    for points in ([0.1, 0.2], [0.5, 2.0], [1.0, 0.3], [1.5, 2.0], [-1.0, 5.0], [1.0, 2.0, 2.5]):
        problem().solve(method, breakpoints=[1.0, 2.0], max_steps=9).save(tmp_path / "a")
        rewritten(tmp_path / "a", lambda arrays, about, points=points: arrays.update({
            "identity.breakpoints": np.array(points)
        }))  # fmt: skip
        loaded = iv.load(tmp_path / "a", problem())
        try:
            assert loaded.extend(8, max_steps=2000).t_end == 8
        except ValueError as error:
            assert "memory of the run is damaged" in str(error)
