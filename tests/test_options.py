"""The options: what is documented, what is typed and what is accepted are the same, at every way into a solve."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import re
import textwrap
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import numpy as np
import pytest

import invariode as iv
import invariode.scipy as plugin
from invariode._plan import planning
from invariode._problem import options
from invariode._problem.methods import METHODS
from invariode._problem.options import TABLE

#: The way in, and what its signature has beside the rows of the table.
ENTRIES = {
    "solve_ivp": (iv.solve_ivp, {"fun", "t_span", "y0", "method"}),
    "Problem.solve": (iv.Problem.solve, {"self", "method"}),
    "Problem.solve_ensemble": (iv.Problem.solve_ensemble, {"self", "y0", "method", "store"}),
    "solve_ensemble": (iv.solve_ensemble, {"fun", "t_span", "y0", "method", "store"}),
    **{name: (getattr(iv, name), {"fun", "t_span", "y0"}) for name in METHODS},
    **{name.upper(): (getattr(plugin, name.upper()), {"fun", "t0", "y0", "t_bound"}) for name in METHODS},
}

#: Harmless values of options that have no harmless default.
VALUES = {"args": (), "min_step": None}


def decay(t, y):
    return -y


def function_of(entry):
    """Return the function that Python calls: the constructor of a class."""
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
    hint = function.__annotations__.get("options")
    return names | set(get_args(eval(hint, function.__globals__))[0].__annotations__ if hint is not None else ())


def test_documented_is_typed_is_in_the_signature():
    wrong = {}
    for way, (entry, others) in ENTRIES.items():
        shown = names_of(entry, others)
        wrong[way, "no row of the table"] = shown - set(TABLE)
        wrong[way, "typed otherwise"] = (typed(entry) - others - {"self"}) ^ shown
        wrong[way, "not documented"] = shown - documented(entry)
        wrong[way, "documented, and not an option"] = (documented(entry) & set(TABLE)) - shown
    assert not {what: names for what, names in wrong.items() if names}


def call(way, **options):
    entry = ENTRIES[way][0]
    if way.startswith("Problem."):
        extra = {"workers": 1} if way == "Problem.solve_ensemble" else {}
        return getattr(iv.Problem(decay, (0, 1), [1.0]), way.removeprefix("Problem."))(**{**extra, **options})
    fun, y0 = decay, [1.0]
    if way.lower() in METHODS and METHODS[way.lower()].equations == "second-order":
        fun, y0 = iv.SecondOrder(decay), [1.0, 0.0]
    if way in {name.upper() for name in METHODS}:
        return entry(fun, 0, y0, 1, **options)
    extra = {"workers": 1} if way == "solve_ensemble" else {}
    return entry(fun, (0, 1), y0, **{**extra, **options})


@pytest.mark.parametrize("way", ENTRIES)
def test_all_that_is_shown_is_accepted_and_nothing_else(way):
    entry, others = ENTRIES[way]
    shown = names_of(entry, others)
    for name in shown:
        call(way, **{name: VALUES.get(name, TABLE[name].default)})
    for name in set(TABLE) - shown - others - {"dense_output", "adjoint", "refine", "on_interrupt", "checkpoint"}:
        with pytest.raises(TypeError, match=name):
            call(way, **{name: VALUES.get(name, TABLE[name].default)})
    with pytest.raises(TypeError, match="unknown option 'rtoll'; did you mean 'rtol'"):
        call(way, rtoll=1e-3)


def test_defaults_of_the_signature_are_those_of_the_table():
    wrong = {}
    for way, (entry, others) in ENTRIES.items():
        for name in names_of(entry, others) & set(TABLE):
            own = TABLE[name].default
            if name in ("refine", "max_step") and way in METHODS:
                own = getattr(METHODS[way], name)
            if way.endswith("solve_ensemble") and name == "on_failure":
                own = "warn"  # it fails in some trajectories of many
            default = inspect.signature(entry).parameters[name].default
            if default != own:
                wrong[way, name] = default, own
    assert not wrong, "change the row of options.py"


def test_default_tolerances_are_the_same_at_every_way_in():
    functions = {name: getattr(iv, name) for name in iv.__all__ if callable(getattr(iv, name))}
    methods = {f"Problem.{name}": one for name, one in vars(iv.Problem).items() if inspect.isfunction(one)}
    found = set()
    for way, function in {**functions, **methods}.items():
        for name, parameter in inspect.signature(function_of(function)).parameters.items():
            if name in ("rtol", "atol") and isinstance(parameter.default, float):
                assert parameter.default == TABLE[name].default, f"{name} of {way}"
                found.add(way)
    assert {"impose", "check_invariants", "solve_ivp"} <= found


def test_a_wrong_value_of_each_checked_option_is_refused():
    wrong = object()
    for name, row in options.table_of(options.Options).items():
        if row.check is not options.as_given:
            with pytest.raises((TypeError, ValueError), match=f"^{name} must be"):
                iv.Problem(decay, (0, 1), [1.0]).solve("ode15s", **{name: wrong})


def test_no_option_is_accepted_and_ignored():
    """The plan reads each option of a run, except for `min_step`, which draws a warning."""
    tree = ast.parse(inspect.getsource(planning))
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
    known = options.table_of(options.AllOptions).keys() - {"progress"}
    assert {name for name in flags if name in known} == of_the_command
    assert flags["checkpoint_every"].default == iv.Checkpoint.every
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


class TestOptionsOfSeveralFields:
    """GMRES, Banded, Checkpoint and Limits: values that cannot change, each checked when it is made."""

    @pytest.mark.parametrize(
        ("make", "error", "message"),
        [
            (lambda: iv.GMRES(dimension=0), ValueError, "dimension of GMRES must be a positive integer, got 0"),
            (lambda: iv.GMRES(preconditioner=3), TypeError, "preconditioner of GMRES must be a function"),
            (lambda: iv.Banded(-1, 1), ValueError, "lower of Banded must be a bandwidth, an integer from 0"),
            (lambda: iv.Banded(1, 1.5), TypeError, "upper of Banded must be a bandwidth"),
            (
                lambda: iv.Banded(1, 1, "sparse"),
                ValueError,
                "fun of Banded must be a function, the bands, 'trace', 'complex",
            ),
            (lambda: iv.Checkpoint(3), TypeError, "path of Checkpoint must be a str or path-like, got 3"),
            (lambda: iv.Checkpoint("run", every=0), ValueError, "every of Checkpoint must be positive, got 0"),
            (lambda: iv.Limits(steps=1.5), TypeError, "steps of Limits must be a positive integer, got 1.5"),
            (lambda: iv.Limits(time=0), ValueError, "time of Limits must be positive, got 0"),
            (lambda: iv.Limits(points=2**63), ValueError, "points of Limits must be at most 9223372036854775807"),
            (lambda: iv.Limits(bytes=-1), ValueError, "bytes of Limits must be a positive integer, got -1"),
        ],
    )
    def test_a_wrong_field_is_named(self, make, error, message):
        with pytest.raises(error, match=message):
            make()

    def test_they_cannot_change(self):
        for one in (iv.GMRES(), iv.Banded(1, 1), iv.Checkpoint("run"), iv.Limits()):
            for field in dataclasses.fields(one):
                with pytest.raises(dataclasses.FrozenInstanceError):
                    setattr(one, field.name, None)

    def test_short_forms_are_the_same_options(self, tmp_path):
        """The runs and their ends are equal, bit for bit."""
        x = np.linspace(0, 1, 12)[1:-1]

        def heat(t, u):
            return np.diff(u, n=2, prepend=0, append=0) / (x[1] - x[0]) ** 2

        bands = np.array([[1.0], [-2.0], [1.0]]) * np.ones(len(x)) / (x[1] - x[0]) ** 2
        pairs = [
            ({"linear_solver": "gmres"}, {"linear_solver": iv.GMRES()}),
            ({"lband": 1, "uband": 1}, {"jac": iv.Banded(1, 1)}),
            ({"lband": 1, "uband": 1, "jac": bands}, {"jac": iv.Banded(1, 1, bands)}),
            ({"lband": 1, "uband": 1, "jac": lambda t, u: bands}, {"jac": iv.Banded(1, 1, lambda t, u: bands)}),
            ({"max_steps": 7}, {"limits": iv.Limits(steps=7)}),
            ({"checkpoint": tmp_path / "a"}, {"checkpoint": iv.Checkpoint(tmp_path / "b")}),
            ({"nonnegative": True}, {"bounds": (0, None)}),
        ]
        for short, whole in pairs:
            one, other = (iv.ode15s(heat, (0, 0.1), np.sin(np.pi * x), **form) for form in (short, whole))
            np.testing.assert_array_equal(one.y, other.y)
            assert (one.status, one.stats.nfev, one.stats.njev) == (other.status, other.stats.nfev, other.stats.njev)

    def test_two_forms_of_one_thing_are_one_too_many(self):
        with pytest.raises(ValueError, match=r"give either jac=Banded\(lower, upper\) or lband and uband, not both"):
            iv.Problem(decay, (0, 1), [1.0], jac=iv.Banded(0, 0), lband=0)
        with pytest.raises(ValueError, match="lower of Banded must be a bandwidth, an integer from 0 to 0, got 1"):
            iv.Problem(decay, (0, 1), [1.0], jac=iv.Banded(1, 0))

    def test_an_extension_replaces_the_limits_of_its_run_in_either_form(self):
        for limited in ({"max_steps": 3}, {"limits": iv.Limits(steps=3)}):
            sol = iv.solve_ivp(decay, (0, 10), [1.0], **limited)
            assert sol.extend(10).stats.steps == 6
            assert sol.extend(10, max_steps=2).stats.steps == 5
            assert sol.extend(10, limits=iv.Limits(steps=4)).stats.steps == 7
            assert sol.extend(10, limits=iv.Limits(time=60)).success

    def test_bytes_alone_limit_what_is_kept(self):
        sol = iv.solve_ivp(decay, (0, 10), [1.0], max_step=1e-3, limits=iv.Limits(bytes=4096))
        assert sol.status == -3
        assert 4096 <= sol.t.nbytes + sol.y.nbytes + sol.steps._rows.nbytes < 4096 + 2 * 64


def test_an_argument_of_a_value_of_several_fields_names_the_value():
    new = {
        "time_limit": "limits=invariode.Limits(time=)",
        "max_points": "limits=invariode.Limits(points=)",
        "krylov_dimension": "linear_solver=invariode.GMRES(dimension=)",
        "preconditioner": "linear_solver=invariode.GMRES(preconditioner=)",
        "jac_product": "linear_solver=invariode.GMRES(jac_product=)",
    }
    for name, form in new.items():
        for way in ENTRIES:
            with pytest.raises(TypeError, match=re.escape(f"unknown option {name!r}: pass {form}")):
                call(way, **{name: 1})
        with pytest.raises(TypeError, match=re.escape(f"Problem has no argument {name!r}: pass {form}")):
            iv.Problem(decay, (0, 1), [1.0], **{name: 1})


class TestPublicNames:
    def test_each_option_has_one_topic(self):
        """The documentation is in the order of the topics."""
        listed = [name for names in options.TOPICS.values() for name in names]
        rows = options.table_of(options.AllOptions) | options.table_of(options.ManyOptions)
        assert sorted(listed) == sorted(rows)
        for text in (iv.solve_ivp.__doc__.partition("Other Parameters")[2], iv.ode15s.__doc__):
            places = {name: re.search(rf"^.*\b{name}\b.* : ", inspect.cleandoc(text), re.M) for name in listed}
            found = [place.start() for place in places.values() if place]
            assert len(found) > 20
            assert found == sorted(found)

    def test_a_signature_fits_on_a_screen(self):
        for entry, _ in ENTRIES.values():
            assert len(textwrap.wrap(f"{entry.__name__}{inspect.signature(entry)}", 80)) <= 24

    def test_the_reference_lists_each_public_name_once(self):
        page = Path(__file__).parents[1] / "docs" / "reference.md"
        listed = re.findall(r"^   (\w+)$", page.read_text(encoding="utf-8"), re.M)
        assert sorted(listed) == sorted(iv.__all__)

    def test_the_package_completes_public_names_only(self):
        shown = {name for name in dir(iv) if not name.startswith("_")}
        assert set(iv.__all__) <= shown
        assert shown - set(iv.__all__) <= MODULES

    def test_editors_complete_names_and_options(self):
        """Without running the code: jedi's completion, which is IPython's and that of many editors."""
        jedi = pytest.importorskip("jedi")
        source = Path(iv.__file__).parents[1]
        project = jedi.Project(source, added_sys_path=[str(source)], smart_sys_path=False)

        def completed(code):
            found = jedi.Script(f"import invariode as iv\nq = iv.Problem(f, s, y)\n{code}", project=project).complete()
            return {one.name for one in found}

        assert {name for name in completed("iv.") if not name.startswith("_")} == {*iv.__all__} | MODULES
        ways = {
            "iv.solve_ivp(f, s, y, ": options.SolveOptions,
            "iv.ode45(f, s, y, ": options.AllOptions,
            "iv.solve_ensemble(f, s, y, ": options.EnsembleOptions,
            "q.solve('ode45', ": options.Options,
            "q.prepare('ode45', ": options.Options,
            "q.solve_ensemble(y, ": options.ProblemEnsembleOptions,
            "q.solve().extend(2, ": options.ExtensionOptions,
        }
        for way, kind in ways.items():
            assert {f"{name}=" for name in kind.__annotations__} <= completed(way), way


#: What users import besides the names of the package.
MODULES = {"cli", "jax", "petab", "problems", "sbml", "scipy", "symbolic", "torch"}
