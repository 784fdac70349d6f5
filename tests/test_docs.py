"""What the documentation shows is what one gets: code blocks and docstring examples are executed."""

from __future__ import annotations

import ast
import contextlib
import doctest
import importlib
import io
import re
from importlib import metadata
from pathlib import Path

import pytest

import invariode

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def pages_with(pattern: str) -> pytest.MarkDecorator:
    """Parametrises over the pages that have something to test."""
    found = [page for page in PAGES if re.search(pattern, page.read_text(encoding="utf-8"), re.DOTALL)]
    return pytest.mark.parametrize("page", found, ids=lambda page: str(page.relative_to(ROOT)))


BLOCK = r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?"
LINK = r"\]\((?!https?://|#)([^)]+)\)"


@pages_with(BLOCK)
def test_code_blocks_print_what_the_page_says(page, tmp_path, monkeypatch):
    """Python blocks run one after the other in one namespace; a text block that follows is their output."""
    monkeypatch.chdir(tmp_path)  # for the files that they write
    namespace: dict[str, object] = {}
    for code, shown in re.findall(BLOCK, page.read_text(encoding="utf-8"), re.DOTALL):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(code, page.name, "exec"), namespace)
        assert printed.getvalue() == shown


PACKAGE = Path(invariode.__file__).parent
#: The modules whose docstrings have examples; those of the public names belong to the package.
MODULES = ["invariode"] + [
    ".".join(["invariode", *path.relative_to(PACKAGE).with_suffix("").parts]).removesuffix(".__init__")
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>>" in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name):
    """They import what they use, so that they run where they are pasted."""
    module = importlib.import_module(name)
    assert doctest.testmod(module, globs={}).failed == 0


@pages_with("pip install")
def test_pages_install_alike(page):
    """From a clone, with the extras that there are."""
    lines = re.findall(r"pip install [^`\n]*", page.read_text(encoding="utf-8"))
    extras = metadata.metadata("invariode").get_all("Provides-Extra")
    for line in lines:
        named = re.fullmatch(r'pip install "\.\[([\w,]+)\]"', line)
        assert named, line
        assert {*named[1].split(",")} <= {*extras}


@pages_with(LINK)
def test_links_to_files_lead_somewhere(page):
    for target in re.findall(LINK, page.read_text(encoding="utf-8")):
        assert (page.parent / target.partition("#")[0]).exists(), target


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
        assert f"### {name}\n" in methods


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
    """It says in numbers what it shows; `python docs/picture.py` draws it again."""
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
