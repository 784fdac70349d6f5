"""The guide: pages of the documentation as plain Markdown with their outputs and pictures, for places that show
Markdown only, such as code hosts. `make docs` writes them to the folder `guide`; a test finds old ones.

`python docs/portable.py` brings the guide up to date with the text of the pages without a build; pages whose code has
changed are executed.

Pages without code, roles and directives are plain already: links lead to them where they are.
"""

from __future__ import annotations

import ast
import base64
import hashlib
import inspect
import io
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from itertools import groupby
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

DOCS = Path(__file__).parent
ROOT = DOCS.parent
GUIDE = ROOT / "guide"

sys.path.insert(0, str(DOCS))

import tables  # noqa: E402 - a neighbour

#: Pages that are no part of the guide: the front page, whose place the README takes, and one that another includes.
LEFT_OUT = ("index.md", "howto/sbml-conformance.md")

#: What a page has that is not plain Markdown.
_SPECIAL = re.compile(r"^ *(```|:::+)\{|^---\nfile_format|^% (?:options|methods)$|\{[a-z:]+\}`", re.MULTILINE)

_ROLE = re.compile(r"\{([a-z:]+)\}`([^`]*)`")
_LINK = re.compile(r"(!?\[[^\]]*\]\()((?!https?://|#|mailto:)[^)\s]+)(\))")
_CELL = re.compile(r"```\{code-cell\} python\n(.*?)```", re.DOTALL)
_OPTIONS = re.compile(r"\A(?:---\n(.*?)\n---\n|((?::\S+:.*\n)+))", re.DOTALL)

#: Pictures are at most so wide, in pixels, and have so many colours.
_WIDTH, _COLOURS = 640, 64

#: HTML of this many characters is a film.
_FILM = 20_000

#: No page of the site is larger, in bytes.
LARGEST = 1_500_000


@lru_cache
def pages() -> tuple[Path, ...]:
    """Return the pages that need to be made, relative to the documentation."""
    every = (path.relative_to(DOCS) for path in sorted(DOCS.rglob("*.md")))
    return tuple(
        page
        for page in every
        if page.parts[0] not in ("gallery", "generated", "_templates")
        and page.as_posix() not in LEFT_OUT
        and _SPECIAL.search((DOCS / page).read_text(encoding="utf-8"))
    )


def source(page: Path) -> str:
    """Return the text of a page with what the package and other files contribute to it, without its front matter."""
    text = (DOCS / page).read_text(encoding="utf-8")
    text = re.sub(r"\A---\n.*?\n---\n+", "", text, flags=re.DOTALL)
    text = "\n".join("\n".join(tables.MADE[line]()) if line in tables.MADE else line for line in text.split("\n"))
    included = r"```\{include\} (\S+)\n```"
    return re.sub(included, lambda found: (DOCS / page.parent / found[1]).read_text(encoding="utf-8"), text)


def digest(page: Path) -> str:
    return hashlib.sha256(source(page).encode()).hexdigest()[:16]


def head(page: Path) -> str:
    """Return the comment at the beginning of a page of the guide."""
    return f"<!-- Made by `make docs` from docs/{page.as_posix()}, whose digest is {digest(page)}: edit that. -->\n\n"


# ----------------------------------------------------------------------------------------------------------------------
# Text


def title_of(path: Path) -> str:
    """Return the title of a page or of an example."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return (ast.get_docstring(ast.parse(text)) or path.stem).splitlines()[0]
    found = re.search(r"^# (.+)$", text, re.MULTILINE)
    return found[1] if found else path.stem


def _target(page: Path, target: str) -> Path:
    """Return the file that a link or a role of a page leads to."""
    name = target.strip("/") if target.startswith("/") else (page.parent / target).as_posix()
    name = os.path.normpath(name)
    if name.startswith("gallery/"):
        return (
            ROOT / "examples" / f"{name.removeprefix('gallery/')}.py" if name != "gallery/index" else ROOT / "examples"
        )
    path = DOCS / name
    return path if path.suffix else path.with_suffix(".md")


def _relative(page: Path, path: Path) -> str:
    """Return a link from a page of the guide to a file: to its page of the guide if it has one."""
    inside = path.relative_to(DOCS) if path.is_relative_to(DOCS) else None
    if inside in pages():
        path = GUIDE / inside
    return Path(os.path.relpath(path, (GUIDE / page).parent)).as_posix()


def _role(page: Path, kind: str, content: str) -> str:
    """Return a role as a link or as code."""
    if kind != "doc":
        return f"`{content.strip('~.').removeprefix('invariode.')}`"
    text, target = re.fullmatch(r"(?:(.*?)\s*<)?([^<>]+)>?", content).groups()  # type: ignore[union-attr]
    path = _target(page, target)
    if path.is_dir():
        return f"[{text or 'gallery'}]({_relative(page, path)})"
    return f"[{text or title_of(path)}]({_relative(page, path)})"


def _summary(name: str) -> str:
    """Return the first line of the documentation of an object of the package."""
    text = "all methods by name" if name == "METHODS" else inspect.getdoc(resolve_name(f"invariode.{name}")) or ""
    return text.partition("\n\n")[0].replace("\n", " ").replace("|", "\\|").replace("``", "`")


def _names(block: str) -> str:
    """Return the names of a block of the reference as a table: public ones, and those of modules with their classes."""
    names = re.findall(r"^   (\w+)$", block, re.MULTILINE)
    made = r"^\.\. auto(module|class):: invariode\.(\S+)(?:\n   :members:(.*))?"
    for kind, name, listed in re.findall(made, block, re.MULTILINE):
        members = listed.replace(",", " ").split()
        if kind == "class":
            names.append(name)
        elif not members:
            members = resolve_name(f"invariode.{name}").__all__
        names += [f"{name}.{one}" for one in members]
    rows = [f"| `{name}` | {_summary(name)} |" for name in names]
    return "\n".join(["| name | is |", "|---|---|", *rows]) if rows else ""


def plain(page: Path, text: str) -> str:
    """Return Markdown of a page, outside its cells, without roles and directives."""
    text = re.sub(r"```\{toctree\}.*?```\n?", "", text, flags=re.DOTALL)
    text = re.sub(r"```\{eval-rst\}\n(.*?)```", lambda found: _names(found[1]), text, flags=re.DOTALL)
    text = re.sub(r"```\{code-block\} (\w+)", r"```\1", text)
    text = re.sub(r"^\([\w-]+\)=\n", "", text, flags=re.MULTILINE)
    blocks = re.split(r"(```.*?```)", text, flags=re.DOTALL)
    for k in range(0, len(blocks), 2):
        blocks[k] = _ROLE.sub(lambda found: _role(page, found[1], found[2]), blocks[k])
        blocks[k] = _LINK.sub(lambda found: found[1] + _moved(page, found[2]) + found[3], blocks[k])
        blocks[k] = re.sub(r"\n{3,}", "\n\n", blocks[k])
    return "".join(blocks)


def _moved(page: Path, link: str) -> str:
    """Return a link of a page as one of its page in the guide; what roles became is right already."""
    target, hash_, anchor = link.partition("#")
    path = DOCS / page.parent / target
    if not path.exists():
        return link
    return _relative(page, path.resolve()) + hash_ + anchor


# ----------------------------------------------------------------------------------------------------------------------
# Cells


def _options(code: str) -> tuple[str, str, str]:
    """Return the code of a cell, its tags and the text that describes its picture."""
    found = _OPTIONS.match(code)
    if found is None:
        return code, "", ""
    about = found[1] or found[2]
    alt = re.search(r"alt: (.+)", about)
    return code[found.end() :], "".join(re.findall(r"tags: \[(.*?)\]", about)), alt[1].strip() if alt else ""


def _picture(data: str, path: Path) -> None:
    """Write a picture with few bytes, unless it is there with the same ones."""
    from PIL import Image

    with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
        picture = picture.convert("RGB")
        picture.thumbnail((_WIDTH, 10 * _WIDTH))
        path.parent.mkdir(parents=True, exist_ok=True)
        picture.quantize(_COLOURS).save(path, optimize=True)


def _outputs(page: Path, cell: Any, alt: str, number: Iterator[int]) -> Iterator[str]:
    """Yield the outputs of an executed cell as Markdown, and write its pictures."""
    for streams, group in groupby(cell.outputs, lambda one: one.output_type == "stream"):
        if streams:  # what one cell prints comes in parts
            printed = "".join(one.text for one in group if one.name == "stdout").rstrip()
            if printed:
                yield f"```text\n{printed}\n```"
            continue
        yield from _shown(page, group, alt, number)


def _shown(page: Path, outputs: Iterable[Any], alt: str, number: Iterator[int]) -> Iterator[str]:
    """Yield values and pictures as Markdown."""
    for one in outputs:
        data = one.get("data", {})
        if "image/png" in data:
            name = "-".join([*page.parent.parts, page.stem, str(next(number))])
            path = GUIDE / "images" / f"{name}.png"
            _picture(data["image/png"], path)
            yield f"![{alt or 'Picture'}]({Path(os.path.relpath(path, (GUIDE / page).parent)).as_posix()})"
        elif len(str(data.get("text/html", ""))) > _FILM:
            yield "*(Here the page shows a film.)*"
        elif "text/plain" in data:
            yield f"```text\n{data['text/plain'].rstrip()}\n```"


def _code(part: str) -> str:
    """Return the digest of a cell's code."""
    return hashlib.sha256(part.encode()).hexdigest()[:8]


def outputs_of(page: Path, cells: list[Any]) -> list[str]:
    """Return the outputs of the executed code cells of a page as Markdown, and write their pictures."""
    number = iter(range(1, 1000))
    parts = _CELL.split(source(page))[1::2]
    return [
        "" if "remove-cell" in _options(part)[1] else "\n\n".join(_outputs(page, cell, _options(part)[2], number))
        for part, cell in zip(parts, cells, strict=True)
    ]


def known_outputs(page: Path) -> list[str] | None:
    """Return the outputs that a page of the guide has, or None if the code of the page has changed since."""
    path = GUIDE / page
    parts = _CELL.split(source(page))[1::2]
    if not path.exists():
        return [] if not parts else None
    there = re.findall(
        r"<!-- cell (\w+) -->\n(?:\n```python\n.*?\n```\n)?(.*?)\n<!-- /cell -->",
        path.read_text(encoding="utf-8"),
        re.DOTALL,
    )
    shown = [_code(part) for part in parts if "remove-cell" not in _options(part)[1]]
    if [code for code, _ in there] != shown:
        return None
    left = iter(outputs.strip("\n") for _, outputs in there)
    return ["" if "remove-cell" in _options(part)[1] else next(left) for part in parts]


def page_of(page: Path, outputs: list[str]) -> str:
    """Return the text of a page of the guide; `outputs`: of its code cells, as Markdown."""
    found = []
    for k, part in enumerate(_CELL.split(source(page))):
        if k % 2 == 0:
            found.append(plain(page, part).strip("\n"))
            continue
        code, tags, _ = _options(part)
        if "remove-cell" in tags:
            continue
        found.append(f"<!-- cell {_code(part)} -->")
        if "remove-input" not in tags:
            found.append(f"```python\n{code.rstrip()}\n```")
        found += [outputs[k // 2], "<!-- /cell -->"]
    text = "\n\n".join(one for one in found if one)
    return head(page) + text.rstrip() + "\n"


def _notebook(page: Path) -> Any:
    from myst_nb.core.read import read_myst_markdown_notebook

    return read_myst_markdown_notebook((DOCS / page).read_text(encoding="utf-8"), path=str(DOCS / page))


def from_cache(page: Path, cache: Any) -> list[str]:
    """Return the outputs of a page from the cache of a build."""
    try:
        _, found = cache.merge_match_into_notebook(_notebook(page))
    except KeyError:
        raise ValueError(f"{page} was not executed: remove build/docs, and build it again") from None
    return outputs_of(page, [cell for cell in found.cells if cell.cell_type == "code"])


def from_run(page: Path) -> list[str]:
    """Return the outputs of a page by executing it."""
    from nbclient import NotebookClient

    notebook = _notebook(page)
    NotebookClient(
        notebook, kernel_name="python3", resources={"metadata": {"path": str((DOCS / page).parent)}}
    ).execute()
    return outputs_of(page, [cell for cell in notebook.cells if cell.cell_type == "code"])


def write(outputs: Callable[[Path], list[str]]) -> None:
    """Write all pages with the outputs of their code, and remove files that no page has any more."""
    before = {path for path in GUIDE.rglob("*") if path.is_file()}
    for page in pages():
        text = page_of(page, outputs(page) if _CELL.search(source(page)) else [])
        path = GUIDE / page
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        before -= {path, *((path.parent / image).resolve() for image in re.findall(r"\]\((\S+\.png)\)", text))}
    for path in before:
        path.unlink()


def as_known(page: Path) -> list[str]:
    """Return the outputs of a page as the guide has them; if its code has changed, execute it."""
    found = known_outputs(page)
    return from_run(page) if found is None else found


def after_the_build(app: Any, failure: Exception | None) -> None:
    """Write the guide, and require that no page of the site is too large for a telephone."""
    if failure is None and app.builder.name == "html":
        large = [path for path in Path(app.outdir).rglob("*.html") if path.stat().st_size > LARGEST]
        if large:
            raise ValueError(f"pages above {LARGEST} bytes: {', '.join(map(str, large))}")
        from jupyter_cache import get_cache

        cache = get_cache(Path(app.outdir).parent / ".jupyter_cache")
        write(lambda page: from_cache(page, cache))


def setup(app: Any) -> dict[str, Any]:
    app.connect("build-finished", after_the_build)
    return {"parallel_read_safe": True}


if __name__ == "__main__":
    write(as_known)
