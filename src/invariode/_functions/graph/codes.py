"""Machine code of graphs in each form: code that is kept is loaded without the modules that would write it."""

from __future__ import annotations

from collections.abc import Sequence

from .nodes import Node, as_rows
from .objects import CodeForm, MachineCode, SeriesForm, is_kept, made_of


def machine_code(outputs: Sequence[Node], form: CodeForm | SeriesForm) -> MachineCode:
    """Return the machine code of a function with these values, or of the Taylor coefficients for y' = these values, or
    for these values along a polynomial; code of an equal graph compiled in this process, or kept by another one, is
    reused."""

    def written() -> bytes:
        if isinstance(form, SeriesForm):
            from .series import written as series

            return series(outputs, form)
        from .machine import written as values

        return values(outputs, form)

    return made_of((form, as_rows(outputs)), written)


def lane_code(outputs: Sequence[Node], form: SeriesForm, *, make: bool) -> MachineCode | str:
    """The code with lanes; or why the function {f} has none. Unless it is to be made, it is that which has been made.

    Coefficients in loops have none: in one lane they fill vector registers too, and those of several lanes would not
    fit into the cache (measured in benchmarks/taylor.py: 1.1 times as fast for six bodies)."""
    if not (make or is_kept((form, as_rows(outputs)))):
        return "fewer trajectories than {most} do not pay for compiling the series of {f} once more"
    from .recurrences import program
    from .series import is_small

    found = program(outputs)
    if found.solves:
        return "{f} solves a linear system"
    if not is_small(found, form.order):
        return "the series of {f} is so large that one trajectory fills the vector registers"
    return machine_code(outputs, form)
