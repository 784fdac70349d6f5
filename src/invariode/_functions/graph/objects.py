"""Machine code of graphs: made once in a process, and kept between processes (`stored_code`)."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import llvmlite.binding as llvm

from ... import _core
from ..._base.forks import compiling, short_lock
from . import stored_code

#: The function of a module, and those of the core that it may call.
NAME, SOLVE, SOLVE_SPARSE = "graph", "invariode_solve", "invariode_solve_sparse"
#: Bytes that LLVM holds for a compiled function, and for each line of its code: measured as the growth of the process
#: by functions of 4 to 3000 operations.
_OF_EACH, _OF_LINE = 1_000_000, 1_000
#: Bytes of the codes that are kept for equal graphs, and those, in the order of their last use.
_MOST_BYTES = 256_000_000
_kept: OrderedDict[bytes, MachineCode] = OrderedDict()
_keeping = short_lock()


class MachineCode(NamedTuple):
    """An address, what keeps the code there alive, and about how many bytes that takes."""

    address: int
    owner: Any
    size: int


class CodeForm(NamedTuple):
    """Form of machine code: its arguments and its results."""

    returns: bool = False  # the code returns its one value, as events do; otherwise it stores its values
    #: So many numbers side by side: ``code(unused, t, y, out, p)`` with t (lanes,), y (n, lanes) and so on
    lanes: int = 1
    own: bool = True  # invariode's elementary functions are called, not the mathematical library's


class SeriesForm(NamedTuple):
    """Form of the code of Taylor coefficients: its arguments and its results."""

    n: int  # components of y
    order: int  # order of the last coefficients
    #: y are the coefficients of a polynomial along which a function is expanded; otherwise its values are y'
    along: bool = False
    lanes: int = 1  # so many numbers side by side
    own: bool = True  # invariode's elementary functions are called, not the mathematical library's


def is_kept(key: Any) -> bool:
    """Return whether `once` has made code with an equal key."""
    return hashlib.sha256(repr(key).encode()).digest() in _kept


def made_of(key: Any, write: Callable[[], bytes]) -> MachineCode:
    """Return the machine code of an object file that was loaded with an equal key in this process, or load it now: it
    may be kept; otherwise `write` returns it."""

    def make(digest: bytes) -> MachineCode:
        name = stored_code.name_of(digest, processor())
        code = stored_code.read(name)
        if code is None:
            code = write()
            stored_code.keep(name, code)
        with compiling:
            return _loaded(code)

    return once(key, make)


def once(key: Any, make: Callable[[bytes], MachineCode]) -> MachineCode:
    """Return the machine code made with an equal key in this process, or make it now, given the digest of the key."""
    digest = hashlib.sha256(repr(key).encode()).digest()
    with _keeping:
        if digest in _kept:
            _kept.move_to_end(digest)
            return _kept[digest]
    made = make(digest)
    with _keeping:
        _kept[digest] = made
        left = sum(code.size for code in _kept.values())
        while left > _MOST_BYTES and len(_kept) > 1:  # those in use live on with their functions
            _, oldest = _kept.popitem(last=False)
            left -= oldest.size
    return made


def object_file(code: bytes, lines: int) -> bytes:
    """An object file after the number of lines of LLVM's language that it was made of."""
    return lines.to_bytes(8, "little") + code


def _loaded(file: bytes) -> MachineCode:
    """Load the function of an `object_file`."""
    empty = llvm.parse_assembly(f'target triple = "{llvm.get_process_triple()}"')
    for name, address in zip((SOLVE, SOLVE_SPARSE), _core.solve_addresses(), strict=True):
        llvm.add_symbol(name, address)
    engine = llvm.create_mcjit_compiler(empty, target_machine())
    engine.add_object_file(llvm.object_file.ObjectFileRef.from_data(file[8:]))
    engine.finalize_object()
    size = _OF_EACH + _OF_LINE * int.from_bytes(file[:8], "little")
    return MachineCode(engine.get_function_address(NAME), engine, size)


def target_machine() -> Any:
    """Return LLVM's description of this processor, a new one."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_triple(llvm.get_process_triple())
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=_features(), opt=3, jit=True)


@cache
def processor() -> str:
    """All of this processor and of LLVM that code depends on."""
    return repr((llvm.llvm_version_info, llvm.get_process_triple(), llvm.get_host_cpu_name(), _features()))


@cache
def _features() -> str:
    found: str = llvm.get_host_cpu_features().flatten()
    return found
