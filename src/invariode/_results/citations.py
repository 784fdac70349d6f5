"""The publications that a run is based on, as BibTeX."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from .._base.arguments import shown
from .._base.package import version
from .._problem.methods import METHODS, find_method
from .solution import Solution

#: Publications of what is not a method, in the form of `Method.source`.
PROJECTION = (
    "L. F. Shampine, Conservation laws and the numerical solution of ODEs, II, Comput. Math. Appl. 38 (1999) 61-72"
)
BOUNDS = (
    "L. F. Shampine, S. Thompson, J. A. Kierzenka, G. D. Byrne, Non-negative solutions of ODEs, Appl. Math. Comput. "
    "170 (2005) 556-569"
)
SENSITIVITIES = (
    "T. Maly, L. R. Petzold, Numerical methods and software for sensitivity analysis of differential-algebraic "
    "systems, Appl. Numer. Math. 20 (1996) 57-79"
)
ADJOINT = (
    "Y. Cao, S. Li, L. Petzold, R. Serban, Adjoint sensitivity analysis for differential-algebraic equations: the "
    "adjoint DAE system and its numerical solution, SIAM J. Sci. Comput. 24 (2003) 1076-1089"
)
GMRES = (
    "Y. Saad, M. H. Schultz, GMRES: a generalized minimal residual algorithm for solving nonsymmetric linear systems, "
    "SIAM J. Sci. Stat. Comput. 7 (1986) 856-869"
)
STRUCTURE = "J. D. Pryce, A simple structural analysis method for DAEs, BIT 41 (2001) 364-394"

_DOI = {PROJECTION: "10.1016/S0898-1221(99)00183-2"}

_AUTHOR = r"(?:[A-Z]\. )+[A-Z][\w-]+"
_ARTICLE = re.compile(
    rf"(?P<authors>{_AUTHOR}(?:, {_AUTHOR})*), (?P<title>.+?), (?P<journal>[A-Z][\w. ]*?) (?P<volume>\d+) "
    r"\((?P<year>\d{4})\) (?P<pages>\d+-\d+)(?:(?:, |: )(?P<note>.+))?"
)
_BOOK = re.compile(
    rf"(?P<authors>{_AUTHOR}(?:, {_AUTHOR})*), (?P<title>.+?)(?:, (?P<edition>\d\w\w) ed\.)?, (?P<publisher>\w+), "
    r"(?P<address>[\w ]+), (?P<year>\d{4})(?:, (?P<note>.+))?"
)
#: Letters that the sources leave out, and words of titles whose capitals BibTeX would lose.
_LETTERS = {"Norsett": r"N{\o}rsett", "Nystrom": r"Nystr{\"o}m"}
_CAPITALS = re.compile(r"\bTR-BDF2\b|\b(?:[A-Z]{2,}\w*|Runge|Kutta|Nystrom|Taylor|Radau|Simulink)\b")


class Publication(NamedTuple):
    """A publication with its BibTeX entry."""

    key: str
    entry: str


def publications(source: str) -> list[Publication]:
    """Return the publications in a text such as `Method.source`, in their order; remarks between them are left out."""
    found = []
    for part in source.split("; "):
        text = re.sub(r"^[a-z]+: ", "", part)
        if match := _ARTICLE.fullmatch(text):
            found.append(_entry("article", match.groupdict(), _DOI.get(source)))
        elif match := _BOOK.fullmatch(text):
            found.append(_entry("book", match.groupdict(), None))
    return found


def _entry(kind: str, parts: dict[str, str | None], doi: str | None) -> Publication:
    authors = re.findall(_AUTHOR, parts.pop("authors") or "")
    title = parts["title"] or ""
    fields = {"author": " and ".join(authors), **parts, "doi": doi}
    fields["title"] = _CAPITALS.sub(lambda word: f"{{{word[0]}}}", title)
    if pages := parts.get("pages"):
        fields["pages"] = pages.replace("-", "--")
    first = re.sub(r"\W", "", authors[0].rpartition(" ")[2]).lower()
    word = next(word for word in re.findall(r"[a-z]+", title.lower()) if word not in ("a", "the", "on"))
    return Publication(key := f"{first}{parts['year']}{word}", _bibtex(kind, key, fields))


def _bibtex(kind: str, key: str, fields: dict[str, str | None]) -> str:
    lines = [f"  {name} = {{{value}}}," for name, value in fields.items() if value is not None]
    text = "\n".join([f"@{kind}{{{key},", *lines, "}"])
    for plain, written in _LETTERS.items():
        text = text.replace(plain, written)
    return text


def cite(sol: Solution | str) -> str:
    """Return the publications that a run is based on, as BibTeX entries.

    Parameters
    ----------
    sol : Solution or str
        A solution, also one that was loaded; or the name of a method.

    Returns
    -------
    str
        An entry for this software and one for each publication of the method; for `auto`, also of the methods that
        took steps, if `steps` were kept. Entries follow for what the run used: projection onto invariants, `bounds` or
        `nonnegative`, `sensitivities`, `adjoint`, `GMRES`, and the index reduction of a `Dae`.

    Raises
    ------
    TypeError
        `sol` is neither a Solution nor a str.
    ValueError
        There is no such method; or the solution comes from a pickle, which does not hold the method.

    Examples
    --------
    >>> import invariode as iv
    >>> sol = iv.ode23(lambda t, y: [y[1], -y[0]], (0, 1), [1.0, 0.0], invariants=lambda t, y: y @ y)
    >>> print(*[line for line in iv.cite(sol).splitlines() if line.startswith("@")], sep="\\n")
    @software{invariode,
    @article{bogacki1989pair,
    @article{shampine1999conservation,
    """
    software = {
        "author": "{The invariode developers}",
        "title": "invariode: {ODE} solvers that conserve what your equations conserve",
        "version": version(),
    }
    entries = {"invariode": _bibtex("software", "invariode", {**software})}
    for source in _sources(sol):
        entries.update(publications(source))
    return "\n\n".join(entries.values()) + "\n"


def _sources(sol: object) -> Iterator[str]:
    """Return the sources of what the run used, as texts in the form of `Method.source`."""
    if isinstance(sol, str):
        yield find_method(sol)[0].source
        return
    if not isinstance(sol, Solution):
        raise TypeError(f"cite takes a Solution or the name of a method, got {shown(sol)}")
    method, options, bounded = _run_of(sol)
    yield find_method(method)[0].source
    if sol.steps is not None:
        yield from (METHODS[name].source for name in METHODS if name in {*sol.steps.method})
    if len(sol._invariants):
        yield PROJECTION
    if bounded or options.get("nonnegative") is not None:
        yield BOUNDS
    if sol._sensitivities is not None:
        yield SENSITIVITIES
    if options.get("adjoint"):
        yield ADJOINT
    if options.get("linear_solver") is not None:
        yield GMRES
    if hasattr(sol, "yp"):
        yield STRUCTURE


def _run_of(sol: Solution) -> tuple[Any, dict[str, Any], bool]:
    """The method of a solution, its options, and the presence of bounds."""
    if sol._origin is None:
        raise ValueError("this solution comes from a pickle, which does not hold its method: cite the method by name")
    source = sol._origin.source
    if source is None:  # it comes from a file
        about = sol._origin.identity().about
        return about["method"], about["options"], about["problem"]["bounds"] is not None
    return source.method, {**source.options}, source.problem.bounds is not None
