"""The options: what is documented, what is typed and what is accepted are the same, at every way into a solve."""

from __future__ import annotations

import ast
import inspect
import re
from typing import Annotated, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import invariode as iv
import invariode.scipy as plugin
from invariode._problem import options
from invariode._problem.methods import METHODS
from invariode._problem.options import TABLE
from invariode._run import plan

#: Who solves an ensemble, and where its results go.
OF_PARTS = ("executor", "store", "resume", "retry", "chunk", "seed")

#: The way in, and what its signature has beside the rows of the table.
ENTRIES = {
    "solve_ivp": (iv.solve_ivp, {"fun", "t_span", "y0", "method"}),
    "Problem.solve": (iv.Problem.solve, {"self", "method"}),
    "solve_ensemble": (iv.solve_ensemble, {"fun", "t_span", "y0", "method", "workers", "lanes", *OF_PARTS}),
    **{name: (getattr(iv, name), {"fun", "t_span", "y0"}) for name in METHODS},
    **{name.upper(): (getattr(plugin, name.upper()), {"fun", "t0", "y0", "t_bound"}) for name in METHODS},
}

#: Harmless values of options that have no harmless default.
VALUES = {"args": (), "min_step": None}


def decay(t, y):
    return -y


def function_of(entry):
    """What Python calls: the constructor of a class."""
    return entry.__init__ if isinstance(entry, type) else entry


def names_of(entry, others):
    return set(inspect.signature(entry).parameters) - others


def documented(entry):
    """The names that stand in its docstring before a colon."""
    entries = re.findall(
        r"^    (\w+(?:, \w+)*)(?: :.*)?$", inspect.cleandoc(entry.__doc__).replace("\n", "\n    "), re.M
    )
    return {name for line in entries for name in line.split(", ")}


def typed(entry):
    """The names that type checkers let through: those spelled out, and those of the TypedDict behind `options`."""
    function = inspect.unwrap(function_of(entry))
    names = set(inspect.getfullargspec(function).args) | set(inspect.getfullargspec(function).kwonlyargs)
    hint = get_type_hints(function).get("options")
    return names | set(get_args(hint)[0].__annotations__ if hint is not None else ())


@pytest.mark.parametrize("way", ENTRIES)
def test_documented_is_typed_is_in_the_signature(way):
    entry, others = ENTRIES[way]
    shown = names_of(entry, others)
    assert shown <= set(TABLE) | {"progress", "workers"}
    assert typed(entry) - others - {"self"} == shown
    assert shown <= documented(entry), "not documented"
    assert {name for name in documented(entry) if name in TABLE} <= shown, "documented, and not an option"


def call(way, **options):
    entry = ENTRIES[way][0]
    if way == "Problem.solve":
        return iv.Problem(decay, (0, 1), [1.0]).solve(**options)
    if way in {name.upper() for name in METHODS}:
        return entry(decay, 0, [1.0], 1, **options)
    extra = {"workers": 1} if way == "solve_ensemble" else {}
    return entry(decay, (0, 1), [1.0], **extra, **options)


@pytest.mark.parametrize("way", ENTRIES)
def test_all_that_is_shown_is_accepted_and_nothing_else(way):
    entry, others = ENTRIES[way]
    shown = names_of(entry, others)
    for name in shown:
        call(way, **{name: VALUES.get(name, TABLE[name].default)})
    for name in set(TABLE) - shown - others - {"dense_output", "refine", "on_interrupt", "checkpoint"}:
        with pytest.raises(TypeError, match=name):
            call(way, **{name: VALUES.get(name, TABLE[name].default)})
    with pytest.raises(TypeError, match="unknown option 'rtoll'; did you mean 'rtol'"):
        call(way, rtoll=1e-3)


@pytest.mark.parametrize("way", ENTRIES)
def test_defaults_of_the_signature_are_those_of_the_table(way):
    entry, others = ENTRIES[way]
    for name, parameter in inspect.signature(entry).parameters.items():
        if name in TABLE and name not in others:
            own = METHODS[way].refine if name == "refine" and way in METHODS else TABLE[name].default
            if (way, name) == ("solve_ensemble", "on_failure"):
                own = "warn"  # it fails in some trajectories of many
            assert parameter.default == own, f"default of {name}: change the row of options.py"


def test_a_wrong_value_of_each_checked_option_is_refused():
    wrong = object()
    for name, row in options.table_of(options.Options).items():
        if row.check is not options.as_given:
            with pytest.raises((TypeError, ValueError), match=f"^{name} must be"):
                iv.Problem(decay, (0, 1), [1.0]).solve("ode15s", **{name: wrong})


def test_no_option_is_accepted_and_ignored():
    """The plan reads each option of a run, except for `min_step`, which draws a warning."""
    tree = ast.parse(inspect.getsource(plan))
    read = {
        node.slice.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name) and node.value.id == "options"
    }
    assert read == set(options.table_of(options.Options)) - {"min_step"}, "unused rows of options.py"
    with pytest.warns(UserWarning, match="option 'min_step' has no effect"):
        iv.ode45(decay, (0, 1), [1.0], min_step=0.1)


def test_methods_name_options_that_the_table_knows():
    named = {name for method in METHODS.values() for name in method.options}
    of_some = {name for name, row in TABLE.items() if not row.every_method}
    assert of_some == named | {"min_step"}, "every_method of these rows in options.py"


def test_every_class_of_options_says_the_same_of_a_name():
    """The classes that no row stands in repeat types: they are compared with the rows."""
    for name, hint in get_type_hints(options.ExtensionOptions).items():
        assert hint == TABLE[name].type, f"type of {name} in ExtensionOptions: that of its row in options.py"
    for name, hint in get_type_hints(options.ProblemArguments, include_extras=True).items():
        assert (get_origin(hint) is Annotated) == (name in TABLE)
    constructor = set(inspect.signature(iv.Problem).parameters)
    assert set(options.ProblemArguments.__annotations__) == constructor, "arguments of Problem in options.py"


def test_the_command_has_the_flags_of_the_table():
    pytest.importorskip("typer")
    from invariode.cli.solve import solve

    flags = inspect.signature(solve).parameters
    of_the_command = {name for name, row in TABLE.items() if row.command}
    assert {name for name in flags if name in TABLE and name != "progress"} == of_the_command
    for name in of_the_command:
        assert flags[name].default == TABLE[name].default


class TestKeep:
    def test_in_an_ensemble(self):
        one = iv.solve_ensemble(decay, (0, 1), [[1.0]], workers=1, keep="end")
        np.testing.assert_array_equal(one.y_end, iv.solve_ensemble(decay, (0, 1), [[1.0]], workers=1).y_end)
        with pytest.raises(ValueError, match="keep='all' of an ensemble needs t_eval"):
            iv.solve_ensemble(decay, (0, 1), [[1.0]], workers=1, keep="all")

    def test_an_extension_keeps_what_the_run_kept(self):
        assert iv.solve_ivp(decay, (0, 1), [1.0], keep="end").extend(2).t.tolist() == [2]
