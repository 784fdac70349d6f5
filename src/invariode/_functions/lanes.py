"""Trajectories side by side: the form of a compiled function, f or what comes with it, that works in all lanes of
vector registers at once.

    void code(void* unused, const double* t, const double* y, double* out, const double* p)

with t (lanes,), y (n, lanes), out (its values, lanes), p (k, lanes). numba compiles a loop over the lanes whose number
it does not know. In its intermediate representation the number becomes a constant and the arguments are said not to
overlap; then LLVM optimises it once more, and its loop vectoriser finds a clean loop. A function that it does not
vectorise has no such form.

numba.cuda compiles the same loop body, a lane being a thread there: what is missing for that is in
docs/howto/ensembles.md.
"""

from __future__ import annotations

import importlib
import math
import re
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import _core
from .._base.arguments import warn
from .compiled import Compiled, made_by_compile
from .graph.function import GraphFunction

if TYPE_CHECKING:
    from .machine_code import MachineCode

#: With fewer trajectories the form, which takes about half a second to compile, is not made.
FEWEST = 1000
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

_ENTRY = "invariode_lanes"
#: Attribute group of the entry; numba's own groups have small numbers.
_GROUP = 9999


class Lanes(NamedTuple):
    """How an ensemble is solved: in the lanes of `instructions`, or one trajectory at a time, for a `reason`."""

    instructions: str = ""
    width: int = 1
    codes: tuple[MachineCode, ...] = ()
    reason: str = ""

    def for_core(self) -> tuple[str, list[int]] | None:
        """What `integrate_all` takes."""
        return (self.instructions, [code.address for code in self.codes]) if self.codes else None

    def described(self, alone: Sequence[int] = ()) -> str:
        """In words; `alone`: how many trajectories were left to the code for one at a time, for each reason."""
        if not self.codes:
            return f"one at a time: {self.reason}"
        reasons = ", ".join(f"{count} {why}" for count, why in zip(alone, _LEFT, strict=False) if count)
        left = f"; {sum(alone)} trajectories one at a time: {reasons}" if reasons else ""
        return f"{self.width} lanes, {self.instructions}{left}"


class _NotVectorisedError(Exception):
    """Why a function has no form for lanes."""


_making = threading.Lock()
_warned = False


def choose_lanes(solver: _core.Solver, functions: Mapping[str, Any], size: int) -> Lanes:
    """How `size` trajectories of this solver are solved; `functions` are those of its problem, as the core calls them,
    by what they are called in reasons: f, then those of an invariant that is held."""
    obstacle = solver.obstacle_to_lanes
    if obstacle is not None:
        return Lanes(reason=obstacle)
    made = {called: made_by_compile(fun) for called, fun in functions.items()}
    for called, one in made.items():
        if one is None:
            return Lanes(reason=f"{called} is not made by invariode.compile, or has inputs")
    name, width, bits = next(one for one in _core.LANES if FORCED in (None, one[0]))
    codes = []
    for called, one in made.items():
        assert one is not None
        forms, key = one.function.lane_forms, (*one[1:], name)
        if size < FEWEST and key not in forms:
            return Lanes(reason=f"fewer than {FEWEST} trajectories do not pay for compiling {called} once more")
        with _making:
            if key not in forms:
                forms[key] = _lane_code(one, width, bits)
            code = forms[key]
        if isinstance(code, str):
            return Lanes(reason=code.format(f=called))
        codes.append(code)
    return Lanes(name, width, tuple(codes))


def _lane_code(made: Compiled, width: int, bits: int) -> MachineCode | str:
    """The form, or the reason why the function {f} has no form for lanes."""
    global _warned
    if isinstance(made.function, GraphFunction):
        if made.function.solves_systems:
            return "{f} solves a linear system"
        code: MachineCode = made.function.lane_code(width)
        return code
    if made.function.works_on_copies(*made[1:]):
        return "{f} writes to y or p, or hands them to a function that may"
    reason, own = "", made.function.has_own_functions(*made[1:])
    for by_tuples in (False, True):  # loops over len(y) are unrolled for tuples only
        try:
            return _vectorised(_loop(made, width, by_tuples), width, bits, own)
        except _NotVectorisedError as error:
            reason = reason or str(error)
        except Exception as error:  # whatever internals of numba and llvmlite have changed
            if not _warned:
                warn(f"this version of numba has no lanes: {error!r}. Ensembles are solved one trajectory at a time")
                _warned = True
            return f"this version of numba is not known: {_literal(repr(error))}"
    return reason


def _loop(made: Compiled, width: int, by_tuples: bool) -> Any:
    """numba's compilation of the function in a loop over a number of lanes that it does not know."""
    from .numba_additions import read_only

    compiled, n, size, parameters, event = made
    numba: Any = importlib.import_module("numba")
    config, pointer = numba.core.config, numba.types.CPointer(numba.types.double)

    def row(name: str, size: int) -> str:
        return f"({''.join(f'{name}_[{i * width} + l],' for i in range(size))})" if by_tuples else f"{name}[:, l]"

    fills = compiled.inplace and not event
    head = [f"y = read_only(carray(y_, ({n}, {width})))", f"out = carray(out_, ({size}, {width}))"]
    head += [f"p = read_only(carray(p_, ({parameters}, {width})))"] if parameters else []
    values = ["t_[l]", row("y", n), *(["out[:, l]"] if fills else [])]
    values += [row("p", parameters)] if parameters else []
    call = f"f({', '.join(values)})"
    unfilled = f"for i in range({size}): out[i, l] = nan"  # what f does not fill is not defined
    body = [unfilled, call] if fills else [f"r = {call}", *_stores(made)]
    lines = ["def code(lanes, t_, y_, out_, p_):", *head, "for l in range(lanes):", *(f"    {line}" for line in body)]
    namespace: dict[str, Any] = {
        "f": compiled.jitted, "carray": numba.carray, "read_only": read_only, "nan": math.nan
    }  # fmt: skip
    exec("\n    ".join(lines), namespace)
    signature = numba.types.void(numba.types.intp, pointer, pointer, pointer, pointer)
    kept, config.LOOP_VECTORIZE = config.LOOP_VECTORIZE, 0  # the loop is left to the second pass
    try:
        return numba.cfunc(signature, error_model="numpy")(namespace["code"])
    except numba.core.errors.NumbaError as error:
        raise _NotVectorisedError(
            f"numba does not compile {{f}} for lanes: {_literal(str(error).splitlines()[0])}"
        ) from error
    finally:
        config.LOOP_VECTORIZE = kept


def _literal(text: str) -> str:
    """For a reason, in which `format` puts the name of the function."""
    return text.replace("{", "{{").replace("}", "}}")


def _stores(made: Compiled) -> list[str]:
    """Lines that store the result r of f in lane l."""
    from numba import types

    result = made.function.result_type(made.n, made.size, made.parameters)
    if isinstance(result, types.BaseTuple):
        return [f"out[{i}, l] = r[{i}]" for i in range(made.size)]
    if isinstance(result, types.Number):
        return ["out[0, l] = r"]
    raise _NotVectorisedError("{f} returns a list or an array: return a tuple")


def _vectorised(code: Any, width: int, bits: int, own: bool) -> MachineCode:
    """numba's loop with a constant number of lanes, optimised once more."""
    import llvmlite.binding as llvm

    from . import machine_code as made

    text, calls = made.own(code._library.get_llvm_str()) if own else (code._library.get_llvm_str(), [])
    found = re.search(r"define [^@]*@(_ZN[^(]*code[^(]*)\(ptr", text)
    if found is None:
        raise RuntimeError("the compiled loop has another name or other pointers")
    entry = _entry(found[1], width, bits, known_assume="@llvm.assume(i1" in text)
    forms = made.side_by_side(calls, bits // 64)
    module = llvm.parse_assembly(text + made.declarations(calls, forms) + entry)
    made.hide(module, _ENTRY)
    module.get_function(found[1]).add_function_attribute("alwaysinline")
    machine = made.machine()
    made.optimise(module, machine, loop_vectorization=True)
    text = str(module)
    _require_vectors(text)
    if calls:
        module = made.linked(text, bits)
        made.optimise(module, machine, loop_vectorization=False)
    return made.finished(module, machine, _ENTRY, code)


def _entry(loop: str, width: int, bits: int, known_assume: bool) -> str:
    """The entry in LLVM's language: calls the loop; if that raised, which no vectorised one can, f is not defined."""
    pointers = ", ".join(f'"align"(ptr %{name}, i64 64)' for name in ("t", "y", "out", "p"))
    undefined = ", ".join(["double 0x7FF8000000000000"] * width)
    declared = "" if known_assume else "declare void @llvm.assume(i1)\n"
    return f"""
define void @{_ENTRY}(ptr %unused, ptr noalias nocapture readonly %t, ptr noalias nocapture readonly %y,
                      ptr noalias nocapture writeonly %out, ptr noalias nocapture readonly %p) #{_GROUP} {{
  %result = alloca ptr
  %raised = alloca ptr
  call void @llvm.assume(i1 true) [{pointers}]
  %status = call i32 @{loop}(ptr %result, ptr %raised, i64 {width}, ptr %t, ptr %y, ptr %out, ptr %p)
  %failed = icmp ne i32 %status, 0
  br i1 %failed, label %undefined, label %done
undefined:
  store <{width} x double> <{undefined}>, ptr %out
  br label %done
done:
  ret void
}}
{declared}attributes #{_GROUP} = {{ nounwind "prefer-vector-width"="{bits}" }}
"""


def _require_vectors(text: str) -> None:
    """That all arithmetic of the entry is done on vectors, and that there is no loop but that over the lanes: only
    innermost loops are vectorised. Calls of the mathematical library are one by one."""
    start = text.index(f"@{_ENTRY}(")
    body = text[start : text.index("\n}", start)]
    if re.search(r"= f(?:add|sub|mul|div|neg) (?:\w+ )*double", body) or _loops(body) > 1:
        raise _NotVectorisedError(
            "LLVM does not vectorise {f} over lanes: return a tuple, and leave out arrays that it makes, long loops, "
            "loops until convergence and exceptions"
        )


def _loops(body: str) -> int:
    """How many branches of LLVM's code lead back."""
    seen: set[str] = set()
    count = 0
    for line in body.splitlines():
        if label := re.match(r"([\w.$-]+):", line):
            seen.add(label[1])
        elif line.lstrip().startswith(("br ", "switch ")):
            count += len(seen.intersection(re.findall(r"label %([\w.$-]+)", line)))
    return count
