"""Checks the docstrings of all that is public by numpydoc's rules: ``python docs/docstrings.py``, or `make lint`."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import sys
from collections.abc import Iterator
from typing import Any

from numpydoc.validate import validate

#: What users import from; each lists its names in `__all__`.
MODULES = (
    "invariode",
    "invariode.petab",
    "invariode.problems",
    "invariode.sbml",
    "invariode.scipy",
    "invariode.symbolic",
)

#: Rules of numpydoc's that are not ours, and why.
NOT_OURS = {
    "ES01": "an extended summary: unnecessary if the summary says everything",
    "EX01": "examples: most are in the pages",
    "GL02": "quotes on a line of their own: one line has both",
    "GL03": "no blank lines: those around an example stay",
    "GL07": "the order of sections: Other Parameters follow Parameters",
    "GL08": "a docstring for each: properties are described by their class",
    "PR02": "only parameters of the signature: options are in **options",
    "PR03": "the order of the signature: what is as in solve_ivp is listed together",
    "PR04": "a type for each: what is as in solve_ivp has its type there",
    "PR07": "a description for each: two that are explained together share one",
    "PR08": "capital letters: names of methods begin sentences",
    "RT01": "a section Returns: unnecessary if the summary says it",
    "RT03": "a description of what is returned: a Solution is described by its class",
    "SA01": "see also: names in the text are links",
    "SS02": "capital letters: formulas begin summaries",
    "SS05": "the infinitive: summaries say what it does",
    "SS06": "a summary in one line: some sentences take two",
}


def public() -> Iterator[tuple[str, Any]]:
    """All classes, functions and public methods, with their names."""
    for module in MODULES:
        found = importlib.import_module(module)
        for name in found.__all__:
            thing = getattr(found, name)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                yield f"{module}.{name}", thing
            if inspect.isclass(thing):
                yield from ((f"{module}.{name}.{own}", getattr(thing, own)) for own in own_methods(thing))


def own_methods(thing: type[Any]) -> list[str]:
    fields = {field.name for field in dataclasses.fields(thing)} if dataclasses.is_dataclass(thing) else set()
    return [name for name in vars(thing) if not name.startswith("_") and name not in fields]


def is_ours(code: str, text: str, thing: Any) -> bool:
    """Whether that rule holds here. Parameters of functions are all documented where any are, but for **options."""
    if code != "PR01":
        return code not in NOT_OURS
    listed = inspect.isfunction(thing) and "Parameters\n" in (thing.__doc__ or "")
    return listed and "**" not in text


def main() -> int:
    """Prints what is wrong. 1 if anything is."""
    wrong = [
        f"{name}: {code} {text}"
        for name, thing in public()
        for code, text in validate(name)["errors"]
        if is_ours(code, text, thing)
    ]
    print(*wrong, sep="\n", end="\n" if wrong else "")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
