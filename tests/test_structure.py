"""How the package is put together: imports go one way, generated names are there."""

from __future__ import annotations

import ast
import copy
import functools
import importlib
import inspect
import pickle
import re
import subprocess
import sys
from collections import Counter
from graphlib import CycleError, TopologicalSorter
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse

import invariode as iv
from cases import explicit_and_implicit

PACKAGE = Path(iv.__file__).parent
ROOT = Path(__file__).resolve().parents[1]


def module_name(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


SOURCES = [(module_name(path), path) for path in PACKAGE.rglob("*.py*") if path.suffix in (".py", ".pyi")]
MODULES = {name for name, _ in SOURCES}


@functools.cache
def tree(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def statements(node):
    """The node and the statements in it, without expressions, which are most of a tree."""
    yield node
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, (ast.stmt, ast.excepthandler, ast.match_case)):
            yield from statements(inner)


@functools.cache
def imported(name, path):
    """All modules of the package that a module names in an import, in functions and for type checkers too."""
    return list(_imported(name, path))


def _imported(name, path):
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in statements(tree(path)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in MODULES)
        elif isinstance(node, ast.ImportFrom):
            base = package.rsplit(".", node.level - 1)[0] if node.level else None
            source = ".".join(filter(None, (base, node.module)))
            inside = [f"{source}.{alias.name}" for alias in node.names]
            yield from (one for one in inside if one in MODULES)
            if source in MODULES and not all(one in MODULES for one in inside):
                yield source


#: The one class that leads upwards: the methods of `Problem` import those who solve it when they are called.
FACE = "invariode._problem.problem"
LED_TO = {
    "_run.run",
    "_solve.prepared_solver",
    "_ensemble.ensemble",
    "_ensemble.ensemble_solution",
    "_ensemble.store",
    "_results.solution",
}


def upwards(name, path):
    """The modules that a module names in an import, except those to which `Problem` leads."""
    return {used for used in imported(name, path) if name != FACE or used.removeprefix("invariode.") not in LED_TO}


@pytest.mark.slow
def test_no_module_imports_itself_by_a_detour():
    graph = {name: set() for name in MODULES}
    for name, path in SOURCES:
        graph[name] |= upwards(name, path) - {name}
    assert "invariode._run.run" in graph["invariode._solve.ivp"]  # imports are seen at all
    at_once = [node for node in tree(PACKAGE / "_problem/problem.py").body if isinstance(node, ast.ImportFrom)]
    assert not {f"{node.module}" for node in at_once} & LED_TO
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as circle:
        pytest.fail(f"a circle of imports: {' <- '.join(circle.args[1])}")


#: The rooms from top to bottom: each imports only those below it. What stands at the top of the package is above all.
ROOMS = [
    "cli",
    "symbolic",
    "petab",
    "sbml",
    "_studies",
    "_mechanics",
    "_dae",
    "_solve",
    "_ensemble",
    "_run",
    "_adjoint",
    "_plan",
    "_taylor",
    "_sensitivity",
    "_files",
    "_results",
    "_linear",
    "_laws",
    "_problem",
    "_functions",
    "_base",
    "_core",
]


def room_of(name):
    """0 for the top of the package, then the floors downwards."""
    parts = name.split(".")
    return 1 + ROOMS.index(parts[1]) if len(parts) > 1 and parts[1] in ROOMS else 0


def words_of_the_map():
    """The words of each entry of CONTRIBUTING's map: of folders, and of the files beside them under "."."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").partition("## Where things are")[2].split("\n## ")[0]
    words = {}
    for line in text.strip().splitlines():
        if top := re.match(r"\*\*`(\S+/)`\*\*", line):
            base, entry = top[1], "."
        elif inner := re.match(r"- `([^`]+)`", line):
            entry = inner[1] if re.fullmatch(r"\S+/", inner[1]) else "."
        else:
            continue
        words.setdefault((base, entry), set()).update(re.findall(r"\w+", line))
    return words


def not_in_the_map():
    """The files of the package, of the core and of the binding whose names their entries lack."""
    words = words_of_the_map()
    for base, ending in (("core/", ".?pp"), ("binding/", ".?pp"), ("src/invariode/", ".py")):
        for path in sorted((ROOT / base).rglob(f"*{ending}")):
            entry, *inside = path.relative_to(ROOT / base).parts
            known = words.get((base, f"{entry}/" if inside else "."), set())
            if path.stem not in known | {"__init__", "__main__"}:
                yield str(path.relative_to(ROOT))


def test_rooms_import_downwards_only_and_the_map_has_their_files():
    climbs = {(name, used) for name, path in SOURCES for used in upwards(name, path) if room_of(used) < room_of(name)}
    assert climbs == set()
    assert {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()} == {*ROOMS} - {"_core"}
    assert all(ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text())) for room in ROOMS[:-1])
    assert [*not_in_the_map()] == []


#: Names of `invariode.petab`, which are PEtab's, beside those of the package.
NAMES_OF_TWO_CLASSES = {"Problem", "Objective"}


def test_a_class_name_means_one_thing():
    """Names are compared without the underscore that makes it private"""
    places = {}
    for _, path in SOURCES:
        if path.suffix == ".py":
            for node in ast.walk(tree(path)):
                if isinstance(node, ast.ClassDef):
                    places.setdefault(node.name.lstrip("_"), []).append(path.name)
    assert {name for name, files in places.items() if len(files) > 1} == NAMES_OF_TWO_CLASSES


def test_a_file_name_means_one_thing():
    """Except those of `cli`, whose modules have the names of the commands."""
    stems = [path.stem for path in PACKAGE.rglob("*.py") if path.stem[0] != "_" and path.parent.name != "cli"]
    assert {name for name, count in Counter(stems).items() if count > 1} == set()


def test_a_solve_of_a_known_kind_reaches_the_core_in_twelve_frames_four_of_them_one_in_another():
    """No function only forwards. `_solve` and `_problem` are not entered again once the run's plan is looked for."""
    entered, hops = [], []

    def fun(t, y):
        return -y

    def follow(frame, event, _):
        if event == "call" and not hops:
            entered.append(frame.f_code)
            while frame is not None and entered[-1] is fun.__code__:
                hops.insert(0, frame.f_code.co_name)
                frame = frame.f_back

    iv.solve_ivp(fun, (0, 1), [1.0], "ode23", rtol=1e-5)  # makes the plan of the kind
    before = sys.getprofile()
    sys.setprofile(follow)
    try:
        iv.solve_ivp(fun, (0, 1), [1.0], "ode23", rtol=1e-5)
    finally:
        sys.setprofile(before)
    assert hops[-5:] == ["solve_ivp", "solve", "run_or_plan", "run", "fun"]
    names = [code.co_name for code in entered[:-1]]
    assert len(names) <= 12, names
    files = [code.co_filename.removeprefix(str(PACKAGE)) for code in entered]
    after = files[names.index("run_or_plan") :]
    assert not any(file.startswith(("/_solve", "/_problem", "/_results")) for file in after)


def test_the_package_imports_numpy_alone():
    """SciPy, whose sparse matrices take longer than everything else, and the extras are imported when they are used."""
    code = "import sys, invariode; print(*{name.partition('.')[0] for name in sys.modules})"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    needed = {re.match(r"\w+", name)[0] for name in metadata.requires("invariode")} - {"invariode"}
    assert needed > {"numpy", "scipy", "matplotlib"}
    assert needed.intersection(loaded) == {"numpy"}


def test_a_dense_solve_and_a_fit_import_nothing_slow():
    code = """import sys, invariode as iv
iv.solve_ivp(lambda t, y: [-y[0]], (0, 1), [1.0], "radau", atol=[1e-6], bounds=[0.0, [2.0]])
iv.fit(iv.Problem(lambda t, y, k: [-k * y[0]], (0, 2), [1.0], args=(1.0,)), [1, 2], [[0.4, 0.1]], {"k": (0.1, 5)})
print(*{"scipy", "numpy.ma", "multiprocessing", "concurrent.futures"}.intersection(sys.modules))"""
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split() == []


#: Words that begin a fragment: a docstring that starts with one cannot be understood without the text above it.
HEADLESS = "The same|What|Those|That|These|Whether|Of|How|Where|When|Why|Which|Who|As|Its?|They|Their|Likewise"


def docstrings(path):
    """The documented modules, classes and functions of a file, with the first line of each."""
    for node in statements(tree(path)):
        documented = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        if documented and (text := ast.get_docstring(node)):
            yield getattr(node, "name", "module"), text.partition("\n")[0]


def test_every_docstring_stands_alone():
    """A docstring begins with what the function returns or does, or with the name of a thing."""
    fragment = re.compile(rf"({HEADLESS})\b")
    seen = [(f"{path.relative_to(PACKAGE)}:{name}", first) for _, path in SOURCES for name, first in docstrings(path)]
    assert [f"{place}: {first}" for place, first in seen if fragment.match(first)] == []
    assert len(seen) > 1000
    # A test's may go on from the test's name, which says what "they" are.
    tests = [(path.name, first) for path in (ROOT / "tests").glob("*.py") for _, first in docstrings(path)]
    assert [one for one in tests if re.match(r"(The same|What|Those|Of|Whether)\b", one[1])] == []
    assert len(tests) > 1000
    assert fragment.match("The same, of a run.")
    assert not fragment.match("Offsets of the columns.")


LONGEST = 60  # lines of a function, without its signature and docstring


def test_no_function_is_longer_than_a_screen():
    """Python's by their syntax; those of the core and the binding from the line at the margin that opens them."""
    found = {}
    for path in sorted([*(ROOT / "src").rglob("*.py"), *(ROOT / "paper").glob("*.py")]):
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef):
                first = node.body[1] if ast.get_docstring(node) and len(node.body) > 1 else node.body[0]
                found[f"{path.name}:{node.name}:{node.lineno}"] = node.end_lineno - first.lineno + 1
    for path in sorted(p for room in ("core", "binding") for p in (ROOT / room).rglob("*.?pp")):
        start = None
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if line.endswith("{") and re.match(r"(?!namespace|class|struct|enum|union|template|extern|\})[\w:~]", line):
                start = None if " = {" in line or re.match(r"(inline |static )?const", line) else number
            elif line == "}" and start is not None:
                found[f"{path.name}:{start}"] = number - start + 1
                start = None
    assert {name: lines for name, lines in found.items() if lines > LONGEST} == {}
    assert len(found) > 500


ABSENT = {
    "quad": "scipy.integrate.quad. Of SciPy's functions invariode has complex_ode, ode, odeint, solve_ivp",
    "RK45": "scipy.integrate.RK45; SciPy's classes with our methods are in invariode.scipy",
    "solve_ipv": "did you mean 'solve_ivp'?",
    "nothing_like_it": "no attribute 'nothing_like_it'",
}


@pytest.mark.parametrize("name", ABSENT)
def test_the_message_for_a_missing_name_says_where_it_is(name):
    with pytest.raises(AttributeError, match=re.escape(ABSENT[name])):
        getattr(iv, name)
    assert not hasattr(iv, name)


def test_a_module_that_is_not_imported_yet_is_named():
    code = "import invariode; invariode.symbolic"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False).stderr
    assert "has no attribute 'symbolic' yet: import invariode.symbolic" in told


class TestFunctionsOfTheMethods:
    def test_each_method_has_one(self):
        for name in iv.METHODS:
            function = getattr(iv, name)
            assert name in iv.__all__
            assert function.__name__ == name
            assert pickle.loads(pickle.dumps(function)) is function
            assert {"rtol", "atol", "max_step"} <= set(inspect.signature(function).parameters)
            assert iv.METHODS[name].summary in function.__doc__

    def test_and_a_class_for_scipy(self):
        module = importlib.import_module("invariode.scipy")
        names = [*(name.upper() for name in iv.METHODS), *(m.scipy_name for m in iv.METHODS.values() if m.scipy_name)]
        assert module.__all__ == [*dict.fromkeys(names)]
        for name in module.__all__:
            assert pickle.loads(pickle.dumps(getattr(module, name))) is getattr(module, name)


def test_matrices_that_change_later_do_not_change_a_problem():
    """Whatever holds them: an array, a list of rows, a sparse matrix."""
    for kind in (np.array, lambda rows: [*map(list, rows)], scipy.sparse.lil_array):
        jac, mass = kind([[-1.0, 0.0], [0.0, -2.0]]), kind([[1.0, 0.0], [0.0, 1.0]])
        problem = iv.Problem(lambda t, y: [-y[0], -2 * y[1]], (0, 1), [1.0, 1.0], jac=jac, mass=mass)
        expected = problem.solve("ode15s").y
        for matrix in (jac, mass):
            if isinstance(matrix, list):
                matrix[0][0] = 7.0
            else:
                matrix[0, 0] = 7.0
        np.testing.assert_array_equal(problem.solve("ode15s").y, expected)
        np.testing.assert_array_equal(problem.replace(t_span=(0, 1)).solve("ode15s").y, expected)


def test_methods_can_be_pickled_and_copied():
    for method in iv.METHODS.values():
        again = pickle.loads(pickle.dumps(method))
        assert again == copy.deepcopy(method) == method
        with pytest.raises(TypeError):
            again.scipy_options["bdf"] = True


def test_the_package_can_be_imported_again():
    """Reloaded, and after its modules were deleted; what the first import made works on. Nothing warns."""
    code = """
import importlib, sys
import invariode as first
importlib.reload(first)
decay = lambda t, y: [-y[0]]
expected = first.solve_ivp(decay, (0, 1), [1.0]).y
for name in [name for name in sys.modules if name.partition(".")[0] == "invariode"]:
    del sys.modules[name]
import invariode as second
assert second is not first
for one in (first, second):
    for method in ("ode45", "radau"):
        assert one.solve_ivp(decay, (0, 1), [1.0], method, events=lambda t, y: y[0] - 0.5).t_events[0].size == 1
    assert (one.solve_ivp(decay, (0, 1), [1.0]).y == expected).all()
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr


class TestReplace:
    def problem(self, **arguments):
        return iv.Problem(lambda t, y, a: -a * y, (0, 1), [1.0, 2.0], args=(3.0,), **arguments)

    def test_any_argument_by_name(self):
        """Each argument replaced is that of a problem made with it; the others stay; the old problem stays too."""
        old = self.problem(
            name="old", labels=["a", "b"], events=lambda t, y, a: y[0] - 0.5, jac=np.eye(2), mass=np.eye(2)
        )
        other = {
            "fun": lambda t, y, a: -y,
            "t_span": (0.0, 2.0),
            "y0": [3.0, 4.0],
            "args": (5.0,),
            "invariants": lambda t, y, a: y[0],
            "events": [],
            "jac": 2 * np.eye(2),
            "jac_sparsity": np.eye(2),
            "lband": 0,
            "uband": 0,
            "mass": None,
            "nonnegative": [0],
            "bounds": (None, 10.0),
            "sensitivities": "y0",
            "second_order": True,
            "inplace": True,
            "inputs": [iv.Input([0], [1.0])],
            "breakpoints": [0.5],
            "name": "new",
            "labels": ["c", "d"],
        }
        in_place_of_args = {"parameters"}  # see test_parameters.py
        together = {"delays", "history"}  # see test_delays.py
        assert set(other) == set(inspect.signature(iv.Problem).parameters) - in_place_of_args - together
        before = self.seen(old)
        for name, value in other.items():
            now = self.seen(old.replace(**{name: value}))
            changed = {key for key in now if not self.same(now[key], before[key])}
            assert changed == {name}, name
            assert self.seen(old) == before

    @staticmethod
    def seen(problem):
        return {
            "fun": getattr(problem.fun, "__wrapped__", problem.fun),
            "inplace": problem.inplace,
            "t_span": problem.t_span,
            "y0": problem.y0.tolist(),
            "args": problem.args,
            "inputs": problem.inputs,
            "breakpoints": problem.breakpoints,
            "invariants": [one.fun for one in problem.invariants],
            "events": [one.fun for one in problem.events],
            "sensitivities": problem.sensitivities and problem.sensitivities.args,
            **{name: None if m is None else np.asarray(m).tolist() for name, m in problem._as_given.items()},
            "name": problem.name,
            "labels": problem.labels,
            "second_order": problem.second_order,
        }

    @staticmethod
    def same(a, b):
        return a == b

    def test_it_is_checked_as_a_new_problem_is(self):
        with pytest.raises(ValueError, match="labels must name the 3 components"):
            self.problem(labels=["a", "b"]).replace(y0=[1, 2, 3])
        with pytest.raises(TypeError, match="Problem has no argument 'tspan'; did you mean 't_span'"):
            self.problem().replace(tspan=(0, 2))
        with pytest.raises(TypeError, match="Problem has no argument 'zzz'"):
            self.problem().replace(zzz=1)

    def test_it_solves_as_the_problem_made_so(self):
        replaced = self.problem().replace(y0=[5.0], args=(1.0,)).solve(rtol=1e-6)
        np.testing.assert_array_equal(
            replaced.y, iv.solve_ivp(lambda t, y, a: -a * y, (0, 1), [5.0], args=(1.0,), rtol=1e-6).y
        )


@explicit_and_implicit
def test_t_end_is_where_the_run_ended(method, tmp_path):
    """At the end of the interval, at a terminal event, after the last output; also from a file."""

    def fall(t, y):
        return [-1.0]

    hit = iv.Event(lambda t, y: y[0], terminal=True)
    assert iv.solve_ivp(fall, (0, 3), [1.0], method).t_end == 3
    ended = iv.solve_ivp(fall, (0, 3), [1.0], method, events=hit, t_eval=[0.25])
    assert ended["t_end"] == ended.t_end == ended.t_events[0][-1] == pytest.approx(1)
    assert ended.t[-1] == 0.25
    ended.save(tmp_path / "ended.npz")
    assert iv.load(tmp_path / "ended.npz").t_end == ended.t_end
    assert iv.solve_ivp(fall, (0, 1), [1.0], method).extend(2).t_end == 2
