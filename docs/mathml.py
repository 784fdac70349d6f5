"""Formulas as MathML, which browsers show without a script and without a network."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.util.math import get_node_equation_number


def formula(latex: str, display: str = "inline") -> str:
    """What a page holds in place of a formula."""
    return convert(latex, display=display)


def visit_math(page: Any, node: Any) -> None:
    page.body.append(formula(node.astext()))
    raise nodes.SkipNode


def visit_displayed(page: Any, node: Any) -> None:
    page.body.append(page.starttag(node, "div", CLASS="math"))
    if node["number"]:
        page.body.append(f'<span class="eqno">({get_node_equation_number(page, node)})')
        page.add_permalink_ref(node, "Link to this equation")
        page.body.append("</span>")
    page.body.append(formula(node.astext(), "block") + "</div>")
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", (visit_math, None), (visit_displayed, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
