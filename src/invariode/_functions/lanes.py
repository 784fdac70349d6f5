"""Trajectories side by side: the form of a compiled function, f or what comes with it, that works in all lanes of
vector registers at once.

    void code(void* unused, const double* t, const double* y, double* out, const double* p)

with t (lanes,), y (n, lanes), out (its values, lanes), p (k, lanes). It is written from the graph of the function, each
operation on a vector. A function that has no graph has no such form.

The Taylor coefficients of a solution, for methods by series, have one too (`graph.codes`).

What a kernel for graphics cards would take is in docs/howto/ensembles.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import _core
from .._base.forks import compiling
from .compiled import Compiled, made_by_compile
from .graph.function import OnGraph
from .layout import Shape

if TYPE_CHECKING:
    from .graph.objects import MachineCode

#: With fewer trajectories the form, which takes ten to a hundred milliseconds to compile, is not made.
FEWEST = 1000
#: That of Taylor coefficients takes this many times as long.
FEWEST_BY_SERIES = 4
#: The name of the instruction set to use; None: the best that this processor has.
FORCED: str | None = None

#: Why the core left trajectories, in its order.
_LEFT = (
    "where something was not finite or a step too short",
    "that may be stiff",
    "whose invariant asked for a closer look",
    "where an event or an output did",
    "where f jumps",
    "that reached max_steps",
    "after too many of these",
)


class Lanes(NamedTuple):
    """Way in which an ensemble is solved: in the lanes of `instructions`, or one trajectory at a time, for a
    `reason`."""

    instructions: str = ""
    width: int = 1
    codes: tuple[MachineCode, ...] = ()
    reason: str = ""

    def for_core(self) -> tuple[str, list[int]] | None:
        """Return the argument of the core's `integrate_all`: the instruction set and the addresses of the codes, or
        None."""
        return (self.instructions, [code.address for code in self.codes]) if self.codes else None

    def described(self, alone: Sequence[int] = ()) -> str:
        """Return a description in words; `alone`: the numbers of trajectories that were solved one at a time, by
        reason."""
        if not self.codes:
            return f"one at a time: {self.reason}"
        reasons = ", ".join(f"{count} {why}" for count, why in zip(alone, _LEFT, strict=False) if count)
        left = f"; {sum(alone)} trajectories one at a time: {reasons}" if reasons else ""
        return f"{self.width} lanes, {self.instructions}{left}"


def choose_lanes(
    solver: _core.Solver,
    functions: Mapping[str, Any],
    series: Callable[[int, bool], MachineCode | str] | None,
    size: int,
) -> Lanes:
    """Choose how `size` trajectories of this solver are solved. `functions` are those of its problem, as the core calls
    them, by their names in reasons (`Plan.in_lanes`). `series` returns the code of the Taylor coefficients for a number
    of lanes, if the method needs it, and compiles it if that is requested."""
    obstacle = solver.obstacle_to_lanes
    if obstacle is not None:
        return Lanes(reason=obstacle)
    made = {called: made_by_compile(fun) for called, fun in functions.items()}
    for called, one in made.items():
        if one is None:
            return Lanes(reason=f"{called} is not made by invariode.compile, or has inputs")
    name = next(name for name, _ in _core.instruction_sets() if FORCED in (None, name))
    width = solver.lanes(name)
    expansion: list[MachineCode] = []
    if series is not None:
        with compiling:
            found = series(width, size >= FEWEST * FEWEST_BY_SERIES)
        if isinstance(found, str):
            return Lanes(reason=found.format(f="f", most=FEWEST * FEWEST_BY_SERIES))
        expansion = [found]
    codes = []
    for called, one in made.items():
        assert one is not None
        forms, key = one.function.lane_forms, (*one[1:], width)
        if size < FEWEST and key not in forms:
            return Lanes(reason=f"fewer than {FEWEST} trajectories do not pay for compiling {called} once more")
        with compiling:
            if key not in forms:
                forms[key] = _lane_code(one, width)
            code = forms[key]
        if isinstance(code, str):
            return Lanes(reason=code.format(f=called))
        codes.append(code)
    return Lanes(name, width, (codes[0], *expansion, *codes[1:]))


def _lane_code(made: Compiled, width: int) -> MachineCode | str:
    """The form, or the reason why the function {f} has no form for lanes."""
    function = made.function
    code = function.lane_code(Shape(*made[1:]), width) if isinstance(function, OnGraph) else None
    if code is None:
        how = function.how.replace("{", "{{").replace("}", "}}")  # a reason in which the name of the function is put
        return f"{{f}} has no graph, which lanes are made from; it was compiled by {how}"
    found: MachineCode | str = code
    return found
