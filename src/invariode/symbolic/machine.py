"""Straight-line code as machine code, through numba's LLVM without numba's analysis of Python.

numba infers types and control flow, which takes milliseconds for each line. Code that only assigns real numbers has
neither: its syntax tree is translated instruction by instruction, with the elementary functions of C.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.extending import intrinsic, overload

__all__ = ["translated"]

_DOUBLE, _BIT, _INDEX = ir.DoubleType(), ir.IntType(1), ir.IntType(64)

#: Functions of `math` that C has under the same names.
_ELEMENTARY = {
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
    *("exp", "expm1", "log", "log10", "log1p", "pow", "erf", "erfc"),
}
#: Functions of Python and `math` that are instructions.
_BUILT_IN = {"abs", "fabs", "float", "max", "min", "sqrt"}
_CONSTANTS = {name: getattr(math, name) for name in ("pi", "e", "inf", "nan", "tau")}

#: Powers up to this one become products.
_MOST_FACTORS = 16

#: LLVM takes more than linear time for long blocks, and for long code with optimisation: measured on chains
#: of 10 and 20 links.
_BLOCK, _OPTIMISED = 100, 3000

_SIGNS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}


def translated(name: str, lines: Callable[[], list[str]]) -> Callable[..., Any]:
    """A function ``name(t, y, a, out, p)`` for numba's compiled functions to call, of `lines`, which assign numbers.

    The lines are requested when the function is first compiled or called. If they contain anything that is not
    translated, numba compiles them in its own way.
    """
    executed: list[Callable[..., Any]] = []

    def python() -> Callable[..., Any]:
        if not executed:
            namespace: dict[str, Any] = dict(vars(math))
            exec("\n    ".join([f"def {name}(t, y, a, out, p):", *(lines() or ["pass"])]), namespace)
            executed.append(namespace[name])
        return executed[0]

    def evaluate(t: float, y: Any, a: Any, out: Any, p: Any) -> Any:
        return python()(t, y, a, out, p)

    def chosen(t: Any, y: Any, a: Any, out: Any, p: Any) -> Callable[..., Any]:
        assignments = ast.parse("\n".join(lines())).body
        if not all(_is_translated(one) for one in assignments):
            return python()
        run = _instructions(assignments)

        def code(t: float, y: Any, a: Any, out: Any, p: Any) -> None:
            run(t, y, a, out, p)

        return code

    overload(evaluate, jit_options={"error_model": "numpy"}, strict=False)(chosen)
    return evaluate


def _is_translated(assignment: ast.AST) -> bool:
    for node in ast.walk(assignment):
        match node:
            case ast.Call(func=ast.Name(id=name)):
                known = name in _ELEMENTARY | _BUILT_IN
            case ast.Constant(value=value):
                known = isinstance(value, (int, float))
            case _:
                known = isinstance(node, _NODES)
        if not known:
            return False
    return True


_NODES = (
    ast.Assign,
    ast.BinOp,
    ast.BoolOp,
    ast.Compare,
    ast.IfExp,
    ast.Name,
    ast.Subscript,
    ast.UnaryOp,
    ast.expr_context,
    ast.boolop,
    ast.Add,
    ast.Sub,
    ast.Mult,
    ast.Div,
    ast.Pow,
    ast.UAdd,
    ast.USub,
    ast.Not,
    *_SIGNS,
)


def _instructions(assignments: list[ast.stmt]) -> Any:
    """An intrinsic of numba's that calls a function of these assignments."""

    @intrinsic
    def run(context: Any, t: Any, y: Any, a: Any, out: Any, p: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            double = _DOUBLE.as_pointer()
            kind = ir.FunctionType(ir.VoidType(), [_DOUBLE, double, double, double, double])
            function = ir.Function(builder.module, kind, builder.module.get_unique_name("formulas"))
            function.linkage = "internal"
            for attribute in ("noinline", *(("optnone",) if len(assignments) > _OPTIMISED else ())):
                function.attributes.add(attribute)
            function.args[3].add_attribute("noalias")  # out
            _Translation(function).write(assignments)
            arrays = zip(signature.args[1:], given[1:], strict=True)
            data = [context.make_array(kind)(context, builder, value).data for kind, value in arrays]
            builder.call(function, [given[0], *data])
            return context.get_dummy_value()

        return types.void(t, y, a, out, p), generate

    return run


class _Translation:
    """Writes assignments of real numbers into a function of LLVM's."""

    def __init__(self, function: Any) -> None:
        self._function, self._module = function, function.module
        self._builder = ir.IRBuilder(function.append_basic_block())
        t, *arrays = function.args
        self._arrays = dict(zip(("y", "a", "out", "p"), arrays, strict=True))
        self._names: dict[str, Any] = {"t": t, **{name: _DOUBLE(value) for name, value in _CONSTANTS.items()}}
        self._loaded: dict[tuple[str, int], Any] = {}

    def write(self, assignments: list[ast.stmt]) -> None:
        for number, one in enumerate(assignments, 1):
            assert isinstance(one, ast.Assign)  # see _is_translated
            value = self._number(one.value)
            target: Any = one.targets[0]
            if isinstance(target, ast.Subscript):
                self._builder.store(value, self._place(*_entry(target)))
            else:
                self._names[target.id] = value
            if number % _BLOCK == 0:
                following = self._function.append_basic_block()
                self._builder.branch(following)
                self._builder.position_at_end(following)
        self._builder.ret_void()

    def _place(self, array: str, index: int) -> Any:
        return self._builder.gep(self._arrays[array], [_INDEX(index)])

    def _number(self, node: Any) -> Any:
        value = self._value(node)
        return self._builder.uitofp(value, _DOUBLE) if value.type == _BIT else value

    def _truth(self, node: Any) -> Any:
        value = self._value(node)
        return value if value.type == _BIT else self._builder.fcmp_unordered("!=", value, _DOUBLE(0.0))

    def _value(self, node: Any) -> Any:
        build = self._builder
        match node:
            case ast.Constant(value=bool() as value):
                return _BIT(value)
            case ast.Constant(value=int() | float() as value):
                return _DOUBLE(float(value))
            case ast.Name(id=name):
                return self._names[name]
            case ast.Subscript():
                entry = _entry(node)
                if entry not in self._loaded:
                    self._loaded[entry] = build.load(self._place(*entry))
                return self._loaded[entry]
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return build.not_(self._truth(operand))
            case ast.UnaryOp(op=op, operand=operand):
                return build.fneg(self._number(operand)) if isinstance(op, ast.USub) else self._number(operand)
            case ast.BinOp(left=base, op=ast.Pow(), right=exponent):
                return self._power(self._number(base), exponent)
            case ast.BinOp(left=left, op=op, right=right):
                make = {ast.Add: build.fadd, ast.Sub: build.fsub, ast.Mult: build.fmul, ast.Div: build.fdiv}[type(op)]
                return make(self._number(left), self._number(right))
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return build.select(self._truth(test), self._number(body), self._number(orelse))
            case ast.Call(func=ast.Name(id=name), args=given):
                return self._called(name, [self._number(one) for one in given])
        return self._condition(node)

    def _condition(self, node: Any) -> Any:
        build = self._builder
        if isinstance(node, ast.BoolOp):
            parts, join = [self._truth(one) for one in node.values], isinstance(node.op, ast.And)
        else:
            sides = [self._number(one) for one in (node.left, *node.comparators)]
            signs = [_SIGNS[type(op)] for op in node.ops]
            compare = dict.fromkeys(signs, build.fcmp_ordered) | {"!=": build.fcmp_unordered}
            parts = [compare[sign](sign, *sides[i : i + 2]) for i, sign in enumerate(signs)]
            join = True
        whole = parts[0]
        for part in parts[1:]:
            whole = build.and_(whole, part) if join else build.or_(whole, part)
        return whole

    def _called(self, name: str, values: list[Any]) -> Any:
        if name == "float":
            return values[0]
        if name in ("max", "min"):
            found = values[0]
            for one in values[1:]:  # as Python's: the first of equal ones
                better = self._builder.fcmp_ordered(">" if name == "max" else "<", one, found)
                found = self._builder.select(better, one, found)
            return found
        if name in ("abs", "fabs", "sqrt"):
            function = self._module.declare_intrinsic(f"llvm.{'sqrt' if name == 'sqrt' else 'fabs'}", [_DOUBLE])
        elif name in self._module.globals:
            function = self._module.globals[name]
        else:
            function = ir.Function(self._module, ir.FunctionType(_DOUBLE, [_DOUBLE] * len(values)), name)
        return self._builder.call(function, values)

    def _power(self, base: Any, exponent: Any) -> Any:
        """Small integers as products, as numba does."""
        inverse = isinstance(exponent, ast.UnaryOp) and isinstance(exponent.op, ast.USub)
        size = exponent.operand if inverse else exponent
        if not (isinstance(size, ast.Constant) and isinstance(size.value, int) and 0 < size.value <= _MOST_FACTORS):
            return self._called("pow", [base, self._number(exponent)])
        product, factor, left = None, base, size.value
        while left:
            if left % 2:
                product = factor if product is None else self._builder.fmul(product, factor)
            left //= 2
            factor = self._builder.fmul(factor, factor) if left else factor
        return self._builder.fdiv(_DOUBLE(1.0), product) if inverse else product


def _entry(node: Any) -> tuple[str, int]:
    """Array and index of y[3]."""
    return node.value.id, node.slice.value
