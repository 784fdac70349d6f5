"""The documentation shows what one gets: code blocks and docstring examples are executed."""

from __future__ import annotations

import ast
import contextlib
import doctest
import importlib
import inspect
import io
import re
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import invariode

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


BLOCK = r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?"
LINK = r"\]\((?!https?://|#)([^)]+)\)"


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if re.search(BLOCK, page.read_text(encoding="utf-8"), re.DOTALL)],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_code_blocks_print_what_the_page_says(page, tmp_path, monkeypatch):
    """Python blocks run one after the other in one namespace; a text block that follows is their output."""
    monkeypatch.chdir(tmp_path)  # for the files that they write
    namespace: dict[str, object] = {}
    for code, shown in re.findall(BLOCK, page.read_text(encoding="utf-8"), re.DOTALL):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, page.name, "exec"), namespace)
        assert printed.getvalue() == shown


SHOWN = r"```(?:py|\{code-block\} python)\n(.*?)```"
#: Code that is shown without being executed where it stands, and why.
NOT_EXECUTED = {
    "docs/index.md": "a line of the README's example",
    "docs/howto/jax_torch.md": "tests/test_jax.py and test_torch.py execute it, where JAX and PyTorch are",
    "docs/howto/many.md": "millions of runs, and clusters",
    "docs/howto/mechanics.md": "PyDy; tests/test_symbolic.py solves its systems",
    "docs/howto/petab.md": "a problem of the collection of benchmarks, which has no place here",
    "docs/howto/production.md": "a store of a long run",
    "docs/howto/units.md": "Pint; executed here, where it is installed",
}


def test_code_that_is_not_executed_has_a_reason_and_names_that_exist(tmp_path, monkeypatch):
    """Names of the package and of options; what can be executed is."""
    shown = {str(page.relative_to(ROOT)): re.findall(SHOWN, page.read_text("utf-8"), re.DOTALL) for page in PAGES}
    assert {page for page, blocks in shown.items() if blocks} == NOT_EXECUTED.keys()
    options = importlib.import_module("invariode._problem.options")
    known = {*options.TABLE, *options.ManyOptions.__annotations__}
    for page, blocks in shown.items():
        for call in (node for code in blocks for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Call)):
            if isinstance(call.func, ast.Attribute) and ast.unparse(call.func.value) == "iv":
                own = inspect.signature(getattr(invariode, call.func.attr)).parameters
                assert {one.arg for one in call.keywords} <= known | own.keys(), (page, ast.unparse(call))
    monkeypatch.chdir(tmp_path)
    readme = re.findall(BLOCK, (ROOT / "README.md").read_text("utf-8"), re.DOTALL)[0][0]
    with contextlib.redirect_stdout(io.StringIO()):
        exec(readme + shown["docs/index.md"][0], {})
    if importlib.util.find_spec("pint"):
        exec(shown["docs/howto/units.md"][0], {})


def test_commands_of_the_readme_exist():
    """Targets of make; pip's lines are those of 'pages install alike', the command's are tests/test_cli.py's."""
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = re.findall(r"^\$ (.*)", "".join(re.findall(r"```console\n(.*?)```", text, re.DOTALL)), re.MULTILINE)
    assert len(lines) > 3
    for line in lines:
        command, first, *_ = line.split()
        assert command in ("pip", "cd") or (command == "make" and first in targets), line


PACKAGE = Path(invariode.__file__).parent
#: The modules whose docstrings have examples; those of the public names belong to the package.
MODULES = ["invariode"] + [
    ".".join(["invariode", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>>" in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name):
    """Examples import what they use, so that they run where they are pasted."""
    module = importlib.import_module(name)
    assert doctest.testmod(module, globs={}).failed == 0


def found_on_pages(pattern: str) -> list[tuple[Path, str]]:
    return [(page, found) for page in PAGES for found in re.findall(pattern, page.read_text(encoding="utf-8"))]


def test_pages_install_alike():
    """From a clone, with the extras that there are."""
    extras = "|".join(metadata.metadata("invariode").get_all("Provides-Extra"))
    alike = rf'pip install "\.\[({extras})(,({extras}))*\]"'
    lines = found_on_pages(r"pip install [^`\n]*")
    assert lines
    assert [(page, line) for page, line in lines if not re.fullmatch(alike, line)] == []


def test_links_to_files_lead_somewhere():
    links = found_on_pages(LINK)
    assert len(links) > 100
    assert [(page, to) for page, to in links if not (page.parent / to.partition("#")[0]).exists()] == []


def spoken() -> list[str]:
    """Every text in the package and the binding, with ... for what is filled in."""
    texts = []
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                texts.append("".join(part.value if isinstance(part, ast.Constant) else "..." for part in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                texts.append(node.value)
    for path in (ROOT / "binding").glob("*.cpp"):
        code = re.sub(r'"\s*\n\s*"', "", path.read_text(encoding="utf-8"))
        texts += [re.sub(r"%\w", "...", text) for text in re.findall(r'"([^"\n]*)"', code)]
    return texts


def test_messages_are_found_by_their_text():
    """The headings of 'Troubleshooting' quote what the package says."""
    page = (ROOT / "docs/troubleshooting.md").read_text(encoding="utf-8")
    headings = re.findall(r"^### `+ ?(.*?) ?`+$", page, re.MULTILINE)
    texts = spoken()
    assert len(headings) > 30
    for heading in headings:
        assert any(heading in text for text in texts), heading


def test_every_option_and_method_has_its_place(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    tables = importlib.import_module("tables")
    options, methods = "\n".join(tables.options()), "\n".join(tables.methods())
    for name in tables.TABLE:
        assert re.search(rf"^### .*`{name}`", options, re.MULTILINE), name
    for name in invariode.METHODS:
        assert f"## {name}\n" in methods


def test_every_formula_can_be_shown_without_a_network(monkeypatch):
    pytest.importorskip("latex2mathml")
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    formula = importlib.import_module("mathml").formula
    found = 0
    for page in (ROOT / "docs").rglob("*.md"):
        text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for latex in re.findall(r"\$\$(.+?)\$\$|(?<!\$)\$([^$\n]+)\$(?!\$)", text, re.DOTALL):
            shown = formula("".join(latex))
            assert "<math" in shown
            assert not re.search(r"<m[io]>\\", shown), latex  # a command that it does not know
            found += 1
    assert found > 100


def test_the_picture_on_the_front_page_is_that_of_todays_solver(monkeypatch):
    """The picture says in numbers what it shows; `python docs/picture.py` draws it again."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    picture = importlib.import_module("picture")
    assert f"<dc:description>{picture.summary()}</dc:description>" in picture.FILE.read_text(encoding="utf-8")


def test_indices_and_exponents_written_as_text_are_small_in_print(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    formulas = importlib.import_module("formulas")
    kept = "not `max_i`, $x_i^{2}$, hmax_old or [a](b_c)"
    shown = formulas.in_print(r"|y\*_i| ≤ rtol_i h^{1/(k+1)} D_{j≤k} R_ij, " + kept)
    small = r"|y\*<sub>i</sub>| ≤ rtol<sub>i</sub> h<sup>1/(k+1)</sup> D<sub>j≤k</sub> R<sub>ij</sub>, "
    assert shown == small + kept
    for page in formulas.PAGES:  # no formula is left as it was typed
        text = formulas.in_print((ROOT / "docs" / f"{page}.md").read_text(encoding="utf-8"))
        assert not re.search(r"[\^_]\{", re.sub(r"```.*?```|`[^`]*`", "", text, flags=re.DOTALL))


def test_every_public_name_is_documented():
    for name in invariode.__all__:
        assert name == "METHODS" or getattr(invariode, name).__doc__, name


def test_pages_of_benchmarks_say_when_their_figures_are_older_than_the_package():
    """Pages that are not older say nothing. The version stands beside the machine, under the figures."""
    remark, now = "**Measured with an earlier version**", metadata.version("invariode")
    for page in sorted((ROOT / "docs/benchmarks").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        older = {*re.findall(r"; Python [\d.]+, invariode ([\d.]+)", text)} - {now}
        assert (remark in text) == bool(older), (page.name, older)


#: Lists of what a standard asks for, or of guides, which are no how-tos.
NO_HOWTO = {"index", "sbml-conformance"}


def test_howtos_say_first_what_one_has_at_the_end_and_have_at_most_900_words():
    """Code does not count."""
    for page in sorted((ROOT / "docs/howto").glob("*.md")):
        if page.stem in NO_HOWTO:
            continue
        text = re.sub(r"\A---\n.*?\n---\n", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        first = re.search(r"^# .+\n\n(.+)", text, re.MULTILINE)
        assert first, page.name
        assert first[1].startswith("At the end of this page you have "), page.name
        words = len(re.sub(r"```.*?```", "", text, flags=re.DOTALL).split())
        assert words <= 900, (page.name, words)


class TestGuide:
    """The folder `guide` has the pages that are not plain Markdown, with their outputs, as `make docs` writes them."""

    @pytest.fixture(autouse=True)
    def _portable(self, monkeypatch):
        monkeypatch.syspath_prepend(str(ROOT / "docs"))
        self.portable = importlib.import_module("portable")

    def test_its_pages_are_those_of_the_documentation_as_it_is(self):
        """Each page is made again, with the outputs that it has for the same code, and compared."""
        there = {path.relative_to(ROOT / "guide") for path in (ROOT / "guide").rglob("*.md")}
        assert there == {*self.portable.pages()}
        for page in self.portable.pages():
            text = (ROOT / "guide" / page).read_text(encoding="utf-8")
            known = self.portable.known_outputs(page)
            assert known is not None, f"docs/{page.as_posix()} has other code: python docs/portable.py"
            assert text == self.portable.page_of(page, known), f"docs/{page.as_posix()}: python docs/portable.py"

    def test_its_pages_are_plain_have_their_outputs_and_lead_somewhere(self):
        pictures = set()
        for path in (ROOT / "guide").rglob("*.md"):
            text = path.read_text(encoding="utf-8")
            outside = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
            assert not re.search(r"\{[a-z:]+\}`|^:::|^% |\{code-cell\}|\{\{", outside, re.MULTILINE), path.name
            assert len(outside) > 300, path.name
            for to in re.findall(LINK, outside):
                target = (path.parent / to.partition("#")[0]).resolve()
                assert target.exists(), (path.name, to)
                pictures |= {target} & {*(ROOT / "guide/images").iterdir()}
        assert pictures == {*(ROOT / "guide/images").iterdir()}
        assert sum(path.stat().st_size for path in (ROOT / "guide").rglob("*.*")) < 2_000_000

    def test_the_readme_leads_to_pages_that_show_as_they_are(self):
        """To those of the guide where the documentation has code, roles or directives."""
        made = {f"docs/{page.as_posix()}" for page in self.portable.pages()}
        links = {to.partition("#")[0] for to in re.findall(LINK, (ROOT / "README.md").read_text(encoding="utf-8"))}
        assert len(links) > 20
        assert links & made == set()


def test_cells_of_wide_tables_have_the_headings_of_their_columns(monkeypatch):
    """For telephones; tables of two columns, and of numbers, stay as they are."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    stacked = importlib.import_module("stacking").stacked

    def table(columns, cell="<td>"):
        head = "".join(f'<th class="head"><p>h<em>{k}</em></p></th>' for k in range(columns))
        row = "".join(f"{cell}<p>c{k}</p></td>" for k in range(columns))
        return f'<table class="table"><thead><tr>{head}</tr></thead><tbody><tr>{row}</tr><tr>{row}</tr></tbody></table>'

    wide = stacked(f"<p>before</p>{table(3)}{table(2)}")
    assert '<table class="table stacks">' in wide
    assert wide.count('data-label="h0"') == wide.count('data-label="h2"') == 2
    assert wide.endswith(table(2))
    numbers = table(4, '<td class="text-right">')
    assert stacked(numbers) == numbers


def test_pages_that_a_telephone_cannot_show_are_found(monkeypatch, tmp_path):
    """Pages that scroll sideways, and pages that are cut off instead; not those of which a part scrolls."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    widths = importlib.import_module("widths")
    if widths.browser() is None:
        pytest.skip("there is no Chromium")
    page = '<!doctype html><body><main style="overflow-x:{}"><pre style="width:{}px">code</pre></main></body>'
    for name, overflow, width in (("fits", "visible", 300), ("scrolls", "auto", 900), ("wide", "visible", 900)):
        (tmp_path / f"{name}.html").write_text(page.format(overflow, width))
    (tmp_path / "cut.html").write_text(page.format("hidden", 900))
    assert [name for name, _ in widths.too_wide(tmp_path)] == ["cut.html", "wide.html"]


def test_benchmarks_are_of_this_version_or_say_why_not():
    """A page that an earlier version was measured for has the reason above its figures."""
    version = metadata.version("invariode")
    stamped = 0
    for page in sorted((ROOT / "docs/benchmarks").glob("*.md")):
        marked = False
        for line in page.read_text(encoding="utf-8").splitlines():
            marked = marked or line.startswith("**Measured with an earlier version**: ")
            for found in re.findall(r"invariode (\d+\.\d+\.\d+)", line):
                stamped += 1
                assert found == version or marked, f"{page.name}: measured with {found}: make bench, or say why not"
                marked = False
    assert stamped > 15


def test_figures_of_projection_are_those_of_today():
    """The row of docs/benchmarks/precision.md that the README quotes; times are the machine's."""
    from invariode.problems import kepler
    from problems import PROBLEMS

    page = (ROOT / "docs/benchmarks/precision.md").read_text(encoding="utf-8").partition("Every tolerance")[0]
    orbit = PROBLEMS["Kepler"]
    y0 = kepler(0.6).y0.tolist()
    row = re.search(r"^\| ode45 +\| +1e-06 \|(.*)", page, re.MULTILINE)[1]
    errors, counts = [], []
    for when in (None, "always", "needed"):
        given = when and invariode.Invariants(orbit.g, orbit.jac, orbit.value, when=when)
        sol = invariode.solve_ivp(
            orbit.fun, (0, 20 * np.pi), y0, "ode45", invariants=given, rtol=1e-6, atol=1e-9, keep="end"
        )
        errors.append(f"{np.hypot(*(sol.y[:2, -1] - y0[:2])):.1e}")
        counts.append(str(sol.nfev))
    assert [cell.strip() for cell in row.split("|")][:6] == [*errors, *counts]


#: Words that 'Words' in CONTRIBUTING.md replaces, as far as a search can find them.
REPLACED = (
    "round-off|outside of|right to the unit|those of the user's|(is|are) (asked for|looked at|told)|fails also|"
    r"\bgo(es)? on\b|tells? nothing|\bfor ever\b|\banew\b|\ball but\b|\bbut for\b|with the bits of|put back"
)


def test_pages_use_the_words_of_the_table():
    """Except the rules of the algorithms, whose sentences are older than the table."""
    pages = [page for page in PAGES if "algorithms" not in str(page)]
    found = [
        (str(page.relative_to(ROOT)), match[0])
        for page in pages
        for match in re.finditer(REPLACED, page.read_text(encoding="utf-8"))
    ]
    assert found == []
    assert re.search(REPLACED, "The run goes on.")


def test_rules_and_code_are_found_from_each_other():
    """Comments name sections that exist; pages of algorithms name files that exist, and every method has a page."""
    pages = [ROOT / "docs/algorithms.md", *sorted((ROOT / "docs/algorithms").glob("*.md"))]
    texts = {page: page.read_text(encoding="utf-8") for page in pages}
    headings = {name.strip("`") for text in texts.values() for name in re.findall(r"^#{2,3} (.+)$", text, re.MULTILINE)}
    named = {}
    for path in [*(ROOT / "core").rglob("*.?pp"), *PACKAGE.rglob("*.py")]:
        comments = re.sub(r"\s*\n\s*(?://+|#)?\s*", " ", path.read_text(encoding="utf-8"))
        for name in re.findall(r"docs/algorithms\.md, '([^']+)'", comments):
            named.setdefault(name.replace("Runge-Kutta", "Runge–Kutta"), path.name)
    assert len(named) > 20
    whole = "\n".join(texts.values())
    assert [
        one for one in named.items() if one[0] not in headings and not re.search(rf"\*{re.escape(one[0])}", whole)
    ] == []
    code = {file for text in texts.values() for file in re.findall(r"`((?:core|src|paper)/[^`]*)`", text)}
    assert [file for file in sorted(code) if not (ROOT / file).exists()] == []
    steps = {
        path for path in (ROOT / "core/methods").glob("*.hpp") if re.search(r"docs/algorithms\.md, '", path.read_text())
    }
    assert len(steps) > 10
    assert [path.name for path in sorted(steps) if str(path.relative_to(ROOT)) not in code] == []
