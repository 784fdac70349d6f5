"""Tables that stack on telephones: each cell of a wide table knows the heading of its column, for the style sheet to
write before it where columns do not fit beside each other."""

from __future__ import annotations

import html
import re
from typing import Any

#: Tables of fewer columns fit a telephone.
_WIDE = 3

_TABLE = re.compile(r'<table class="([^"]*)"([^>]*)>(.*?)</table>', re.DOTALL)
_ROW = re.compile(r"<tr[^>]*>.*?</tr>", re.DOTALL)
_HEADING = re.compile(r"<th[^>]*>(.*?)</th>", re.DOTALL)
_CELL = re.compile(r"<td(?=[ >])")


def stacked(body: str) -> str:
    """Return the HTML of a page with the class `stacks` on wide tables of words, and labels on their cells."""
    return _TABLE.sub(_table, body)


def _table(found: re.Match[str]) -> str:
    classes, attributes, inside = found.groups()
    head, _, rows = inside.partition("<tbody")
    headings = [re.sub(r"<[^>]*>", "", heading).strip() for heading in _HEADING.findall(head)]
    if len(headings) < _WIDE or 'class="text-right"' in inside:  # columns of numbers scroll: they are to be compared
        return found[0]
    labelled = _ROW.sub(lambda row: _labelled(row[0], headings), rows)
    return f'<table class="{classes} stacks"{attributes}>{head}<tbody{labelled}</table>'


def _labelled(row: str, headings: list[str]) -> str:
    """Return a row whose cells have the headings of their columns as labels."""
    labels = iter(headings)
    return _CELL.sub(lambda cell: f'<td data-label="{html.escape(html.unescape(next(labels, "")))}"', row)


def on_page(app: Any, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    if "body" in context:
        context["body"] = stacked(context["body"])


def setup(app: Any) -> dict[str, Any]:
    app.connect("html-page-context", on_page)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
