"""Signatures and docstrings, completed from the table of options."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from functools import cache
from itertools import chain
from types import MappingProxyType
from typing import Any, TypeVar

from .methods import METHODS
from .options import TABLE, TOPICS

#: Columns of a docstring, as in the source.
_WIDTH = 120

_NOTHING: Mapping[str, Any] = MappingProxyType({})

_Target = TypeVar("_Target", bound=Callable[..., Any])


def documented(own: Mapping[str, Any] = _NOTHING, /, **places: Iterable[str]) -> Callable[[_Target], _Target]:
    """Writes the options named into the signature, in place of its ``**options``, and into the docstring, where a line
    says ``{place}``, in the order of their topics; and where a line says ``{topics}``, which options there are on each.
    `own`: defaults that differ from those of the table."""
    ordered = {place: [name for name in TABLE if name in {*names}] for place, names in places.items()}

    def document(target: _Target) -> _Target:
        if target.__doc__ is not None:  # it is under python -OO
            for place, names in ordered.items():
                target.__doc__ = _filled(target.__doc__, place, _paragraphs(names, own))
            if "{topics}" in target.__doc__:
                target.__doc__ = _filled(target.__doc__, "topics", _topics({*chain(*ordered.values())}))
        signature = inspect.signature(target)
        kinds = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)  # the latter only says what is wrong
        spelled = [p for p in signature.parameters.values() if p.kind not in kinds]
        if len(spelled) < len(signature.parameters):
            there = {p.name for p in spelled}
            defaults = {name: own.get(name, TABLE[name].default) for names in ordered.values() for name in names}
            spelled += [
                inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default)
                for name, default in defaults.items()
                if name not in there
            ]
            target.__signature__ = signature.replace(parameters=spelled)  # type: ignore[attr-defined]  # inspect looks there
        return target

    return document


def _filled(text: str, place: str, paragraphs: Iterable[tuple[str, str]]) -> str:
    """A docstring with paragraphs in the place of a line, as far indented as that."""
    before, marker, after = text.partition(f"{{{place}}}\n")
    margin = before[before.rindex("\n") + 1 :]
    if not marker or margin.strip():
        raise ValueError(f"the docstring has no line {{{place}}}")
    filled = [f"{margin}{head}\n{_wrapped(body, margin + ' ' * 4)}\n" for head, body in paragraphs]
    return before.removesuffix(margin) + "".join(filled) + after


@cache  # the same options stand in many docstrings
def _wrapped(text: str, margin: str) -> str:
    return textwrap.fill(
        text,
        width=_WIDTH,
        initial_indent=margin,
        subsequent_indent=margin,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _topics(names: Container[str]) -> Iterator[tuple[str, str]]:
    """The topics, as a list of definitions."""
    for topic, of_topic in TOPICS.items():
        if there := [f"`{name}`" for name in of_topic if name in names]:
            yield topic[0].upper() + topic[1:], ", ".join(there)


def _paragraphs(names: Iterable[str], own: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The options in NumPy's style, each with its text; those that share one stand in one entry."""
    together: list[str] = []
    for name in names:
        together.append(name)
        row = TABLE[name]
        if row.text is None:
            continue
        default = own.get(name, row.default)
        optional = "optional" if default is None else f"default {default!r}"
        those = [method.name for method in METHODS.values() if name in method.options]
        listed = " and ".join(filter(None, [", ".join(those[:-1]), *those[-1:]]))
        yield f"{', '.join(together)} : {row.kind}, {optional}", (f"For {listed}. " if those else "") + row.text
        together = []
