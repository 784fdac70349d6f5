"""Pages that are made from the package: a line ``% options`` or ``% methods`` becomes what the registry says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from invariode import METHODS, Method
from invariode._problem.options import (
    TABLE,
    TOPICS,
    AllOptions,
    EnsembleOptions,
    ExtensionOptions,
    Options,
    ProblemArguments,
    ProblemEnsembleOptions,
    StepperOptions,
)

#: The calls that take options.
TAKEN: dict[str, type] = {
    "`solve_ivp`": AllOptions,
    "`Problem`": ProblemArguments,
    "`Problem.solve` and `prepare`": Options,
    "`Problem.solve_ensemble`": ProblemEnsembleOptions,
    "`solve_ensemble`": EnsembleOptions,
    "`Solution.extend`": ExtensionOptions,
    "the classes in `invariode.scipy`": StepperOptions,
}


def options() -> Iterator[str]:
    """A section for each topic, an entry for each option; those that share a text stand together."""
    for topic, names in TOPICS.items():
        yield f"## {topic[0].upper()}{topic[1:]}\n"
        together: list[str] = []
        for name in names:
            together.append(name)
            row = TABLE[name]
            if row.text is None:
                continue
            yield f"### {', '.join(f'`{one}`' for one in together)}\n"
            default = "optional" if row.default is None else f"default `{row.default!r}`"
            only = [method.name for method in METHODS.values() if name in method.options]
            yield f"*{row.kind}*, {default}{'; of ' if only else ''}{', '.join(only)}\n"
            yield f"{row.text}\n"
            yield f"Taken by {', '.join(takers(name))}.\n"
            together = []


def takers(name: str) -> list[str]:
    return [who for who, kind in TAKEN.items() if name in kind.__annotations__]


def methods() -> Iterator[str]:
    """A table of all methods, and what is particular to each."""
    yield "| name | SciPy's name | order | for | mass matrix | delays |\n|---|---|---|---|---|---|"
    for method in METHODS.values():
        scipy = f"`{method.scipy_name}`" if method.scipy_name else ""
        delays = "yes" if method.delays else ""
        yield (
            f"| [`{method.name}`](#{method.name}) | {scipy} | {orders(method)} | {method.summary} | {method.mass} | "
            f"{delays} |"
        )
    yield ""
    for method in METHODS.values():
        yield f"## {method.name}\n"
        yield f"{method.family[0].upper()}{method.family[1:]}; {'; '.join(details(method))}.\n"
        yield f"Source: {method.source}.\n"


def orders(method: Method) -> str:
    return str(method.order) if method.fixed_order else f"{method.min_order} to {method.order}"


def details(method: Method) -> Iterator[str]:
    yield f"order {orders(method)}, continuous extension of order {method.extension_order}"
    if method.stages is not None:
        yield f"{method.stages} evaluations of f per step"
    if method.equations != "any":
        yield EQUATIONS[method.equations]
    if method.options:
        yield f"options of its own: {', '.join(f'`{one}`' for one in method.options)}"


EQUATIONS = {
    "graph": "needs an f that can be traced, as by `invariode.compile`",
    "second-order": "needs y'' = f(t, y), as `invariode.SecondOrder(f)` or with `second_order=True`",
}

MADE = {"% options": options, "% methods": methods}


def fill(app: Any, page: str, source: list[str]) -> None:
    lines = source[0].split("\n")
    source[0] = "\n".join("\n".join(MADE[line]()) if line in MADE else line for line in lines)


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", fill)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
