"""Additions of `compile` to numba: arrays that may only be read, and powers of complex numbers whose imaginary parts
are derivatives. This module is imported with numba only."""

from __future__ import annotations

import operator
from importlib import import_module
from typing import Any

# numba has no types.
_core: Any = import_module("numba.core")
_compiler: Any = import_module("numba.core.compiler")
_machinery: Any = import_module("numba.core.compiler_machinery")
_passes: Any = import_module("numba.core.untyped_passes")
_extending: Any = import_module("numba.extending")
_imputils: Any = import_module("numba.core.imputils")
_ir, _ir_utils, _types = _core.ir, import_module("numba.core.ir_utils"), _core.types


@_extending.intrinsic  # type: ignore[untyped-decorator]  # numba has no types
def read_only(context: Any, array: Any) -> Any:
    """Return an array in the same memory to which numba compiles no assignment."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _imputils.impl_ret_borrowed(context, builder, signature.return_type, arguments[0])

    return array.copy(readonly=True)(array), generate


def condition(value: Any) -> Any:
    """The value of an event: a truth value is 1 or -1."""
    raise NotImplementedError  # for numba only


@_extending.overload(condition, strict=False)  # type: ignore[untyped-decorator]  # numba has no types
def _condition(value: Any) -> Any:
    if isinstance(value, _types.Boolean):
        return lambda value: 1.0 if value else -1.0
    return lambda value: value


@_extending.register_jitable  # type: ignore[untyped-decorator]  # numba has no types
def copied(array: Any) -> Any:
    """New memory with the same numbers."""
    return array.copy()


# numba compares the signatures below, with their annotations.


def _power(base: Any, exponent: Any) -> Any:
    """base ** exponent. The polar form, which numba has for complex numbers, loses a tiny imaginary part if the real
    part is negative: its angle is π, to the last digit. Integer powers are products, which keep it."""
    return base**exponent


@_extending.register_jitable  # type: ignore[untyped-decorator]  # numba has no types
def _whole_power(base: Any, exponent: Any) -> Any:
    power, square, left = 1.0 + 0j, base, abs(exponent)
    while left > 0:
        if left & 1:
            power *= square
        left >>= 1
        if left > 0:
            square *= square
    return 1 / power if exponent < 0 else power


def _float_power(base: Any, exponent: Any) -> Any:
    whole = int(exponent)
    return _whole_power(base, whole) if whole == exponent else base**exponent


@_extending.overload(_power)  # type: ignore[untyped-decorator]  # numba has no types
def _power_code(base: Any, exponent: Any) -> Any:
    if isinstance(base, _types.Complex) and isinstance(exponent, _types.Integer):
        return _whole_power
    return _float_power if isinstance(base, _types.Complex) and isinstance(exponent, _types.Float) else _power


@_machinery.register_pass(mutates_CFG=False, analysis_only=False)
class _Powers(_machinery.FunctionPass):  # type: ignore[misc]  # numba has no types
    """Compiler pass that replaces every ** by a call of `_power`."""

    _name = "invariode_powers"

    def __init__(self) -> None:  # the base's is abstract
        _machinery.FunctionPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        changed = False
        for block in state.func_ir.blocks.values():
            body: list[Any] = []
            for statement in block.body:
                value: Any = getattr(statement, "value", None)
                two = isinstance(value, _ir.Expr) and value.op in ("binop", "inplace_binop")
                if two and value.fn in (operator.pow, operator.ipow):
                    loc = statement.loc
                    power = block.scope.redefine("$power", loc)
                    body.append(_ir.Assign(_ir.Global("_power", _power, loc), power, loc))
                    call = _ir.Expr.call(power, [value.lhs, value.rhs], (), loc)
                    statement = _ir.Assign(call, statement.target, loc)
                    changed = True
                body.append(statement)
            block.body = body
        if changed:
            state.func_ir._definitions = _ir_utils.build_definitions(state.func_ir.blocks)
        return changed


class ComplexCompiler(_compiler.CompilerBase):  # type: ignore[misc]  # numba has no types
    """numba's pipeline, with powers that keep derivatives."""

    def define_pipelines(self) -> list[Any]:
        pipeline = _compiler.DefaultPassBuilder.define_nopython_pipeline(self.state)
        pipeline.add_pass_after(_Powers, _passes.IRProcessing)
        pipeline.finalize()
        return [pipeline]
