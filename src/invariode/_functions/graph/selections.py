"""Branches that only assign or return, as selections: found in the syntax tree of a function that is traced.

``if c: a = 1 else: a = 2`` becomes two functions of what they assign. If c is a condition on traced values, both are
called and their results are selected; if not, or if they cannot be merged, the statement itself runs.
"""

from __future__ import annotations

import ast
import copy
import functools
import inspect
import itertools
import textwrap
import types
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from .nodes import Node, TraceError
from .traced import JOURNALS, TracedArray, cells_of, has_traced, wrapped
from .universal import number, truth

#: Names in the rewritten function begin with this.
_OURS = "_invariode_"
#: Number of codes for which the results of their analysis are kept.
MOST_CODES = 256


class _Unbound:
    """Placeholder for a variable that is not bound."""


_UNBOUND = _Unbound()


_Written: TypeAlias = dict[int, tuple[Any, Any, Any]]


class _DifferError(Exception):
    """Results of two branches that are no selection."""


def selecting(function: types.FunctionType) -> types.CodeType | None:
    """The code of the function with selections; None: it has no branches that can be, or no source."""
    return _rewritten(function.__code__, function.__code__.co_filename)


@functools.lru_cache(MOST_CODES)
def _rewritten(code: types.CodeType, file: str) -> types.CodeType | None:
    """The code with selections, or None; equal codes of two files are rewritten apart, since errors name the file."""
    try:
        source = textwrap.dedent(inspect.getsource(code))
        tree = ast.parse(source)
    except (OSError, TypeError, SyntaxError, ValueError):
        return None
    wanted = (ast.Lambda,) if code.co_name == "<lambda>" else (ast.FunctionDef,)
    found: list[Any] = [one for one in ast.walk(tree) if isinstance(one, wanted) and _arguments(one) == _own(code)]
    if wanted == (ast.FunctionDef,):
        found = [one for one in found if one.name == code.co_name][:1]
    if len(found) != 1 or _has_private_names(found[0]):
        return None
    writer = _Rewriter()
    made = writer.function(found[0])
    if not writer.count:
        return None
    outer = _module(made, code)
    compiled = compile(outer, file, "exec")
    return next((one for one in _codes(compiled) if one.co_name == code.co_name), None)


def _module(made: Any, code: types.CodeType) -> ast.Module:
    """Return a module with the function inside another one that binds its free variables, at its original line."""
    outer: Any = ast.parse(f"def {_OURS}outer({', '.join(code.co_freevars)}): pass")
    outer.body[0].body = [made if isinstance(made, ast.FunctionDef) else ast.Expr(made)]
    ast.fix_missing_locations(outer)
    first = min((one.lineno for one in getattr(made, "decorator_list", [])), default=made.lineno)
    if isinstance(made, ast.FunctionDef):
        made.decorator_list = []
        ast.increment_lineno(outer, code.co_firstlineno - first)
    else:
        ast.increment_lineno(outer, code.co_firstlineno - made.lineno)
    module: ast.Module = outer
    return module


def _codes(code: types.CodeType) -> Iterable[types.CodeType]:
    for one in code.co_consts:
        if isinstance(one, types.CodeType):
            yield one
            yield from _codes(one)


def _arguments(node: Any) -> tuple[str, ...]:
    given = node.args
    return tuple(one.arg for one in (*given.posonlyargs, *given.args, *given.kwonlyargs))


def _own(code: types.CodeType) -> tuple[str, ...]:
    return code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]


def _has_private_names(tree: ast.AST) -> bool:
    names = (getattr(one, "attr", getattr(one, "id", "")) for one in ast.walk(tree))
    return any(name.startswith("__") and not name.endswith("__") for name in names)


# ----------------------------------------------------------------------------------------------------------------------
# The rewriting


class _Rewriter(ast.NodeTransformer):
    """Rewrites one function."""

    def __init__(self) -> None:
        self.count = 0
        self._numbers = itertools.count()

    def function(self, node: Any) -> Any:
        if isinstance(node, ast.Lambda):
            node.body = self.visit(node.body)
        else:
            node.body = self._block(node.body, returns=True)
        return node

    def visit_FunctionDef(self, node: ast.FunctionDef) -> Any:
        return self.function(node)

    def visit_IfExp(self, node: ast.IfExp) -> Any:
        if _assigns(node):
            return node
        self.count += 1
        parts = [self._condition(node.test), _lazy(self.visit(node.body)), _lazy(self.visit(node.orelse))]
        return ast.copy_location(ast.Call(_name("choose"), parts, []), node)

    def visit_Compare(self, node: ast.Compare) -> Any:
        if len(node.ops) == 1 or _assigns(node):
            return self.generic_visit(node)
        self.count += 1
        return self._condition(node)

    def visit_Call(self, node: ast.Call) -> Any:
        """``any`` and ``all`` of what a comprehension makes: conditions, joined in one node."""
        of = node.args[0] if len(node.args) == 1 else None
        named = isinstance(node.func, ast.Name) and node.func.id in ("any", "all")
        if not named or node.keywords or not isinstance(of, (ast.GeneratorExp, ast.ListComp)) or _assigns(of):
            return self.generic_visit(node)
        self.count += 1
        of.elt, of.generators = self._condition(of.elt), [self.visit(one) for one in of.generators]
        return ast.copy_location(ast.Call(_name("over"), [node.func, of], []), node)

    def visit_If(self, node: ast.If) -> Any:
        return self._block([node], returns=False)

    def _condition(self, test: ast.expr) -> ast.expr:
        """A condition whose ``and``, ``or``, ``not`` and chains are nodes."""
        if _assigns(test):
            return test
        if isinstance(test, ast.BoolOp):
            which = "both" if isinstance(test.op, ast.And) else "either"
            parts: list[ast.expr] = [_lazy(self._condition(one)) for one in test.values]
        elif isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
            which, parts = "negated", [self._condition(test.operand)]
        elif isinstance(test, ast.Compare) and len(test.ops) > 1:
            sides = [test.left, *test.comparators]
            pairs = zip(sides, test.ops, sides[1:], strict=False)
            which, parts = "both", [_lazy(ast.Compare(a, [op], [b])) for a, op, b in pairs]
        else:
            return self.visit(test)  # type: ignore[no-any-return]  # ast: what a visitor returns
        return ast.copy_location(ast.Call(_name(which), parts, []), test)

    def _block(self, body: Sequence[ast.stmt], returns: bool) -> list[ast.stmt]:
        """Return the statements with selections in place of branches. `returns`: they end the function, so that a
        return in them can be selected."""
        done: list[ast.stmt] = []
        for i, one in enumerate(body):
            rest = list(body[i + 1 :])
            if isinstance(one, ast.If) and _is_simple([one]):
                done += self._assigning(one)
            elif isinstance(one, ast.If) and returns and (_returns(one.body) or _returns(one.orelse)):
                if _can_be_function(one.body) and _can_be_function([*one.orelse, *rest]):
                    return [*done, *self._returning(one, rest)]
                done.append(self.generic_visit(one))  # type: ignore[arg-type]  # a statement again
            elif isinstance(one, ast.If):
                one.test = self.visit(one.test)
                one.body, one.orelse = (self._block(part, returns=False) for part in (one.body, one.orelse))
                done.append(one)
            else:
                found = self.visit(one)
                done += found if isinstance(found, list) else [found]
        return done

    def _assigning(self, node: ast.If) -> list[ast.stmt]:
        self.count += 1
        place = f"{_OURS}{next(self._numbers)}"
        stored = _stored([node])
        given, values = stored.given(), ", ".join(stored)
        text = [f"def {place}_yes({given}):", f"    return [{values}]", f"def {place}_no({given}):"]
        text += [f"    return [{values}]", f"{place}_if = 0"]
        text += [f"{place} = {_OURS}merged({place}_if, {place}_yes, {place}_no)"]
        stores = [f"    {how.format(one, f'{place}[{i}]')}" for i, (one, how) in enumerate(stored.items())]
        text += [f"if {place} is not None:", *stores, f"elif {place}_if:", "    pass", "else:", "    pass"]
        found = _template(text, node)
        yes, no, condition, _, chosen = found
        chosen.orelse[0].body, chosen.orelse[0].orelse = _copied(node.body), _copied(node.orelse) or [ast.Pass()]
        yes.body = [*self._block(_copied(node.body), returns=False), *yes.body]
        no.body = [*self._block(_copied(node.orelse), returns=False), *no.body]
        condition.value = self._condition(node.test)
        return list(found)

    def _returning(self, node: ast.If, rest: list[ast.stmt]) -> list[ast.stmt]:
        """Return the statements for a branch that returns and for the rest that follows where it does not."""
        self.count += 1
        place = f"{_OURS}{next(self._numbers)}"
        text, bodies = [], []
        for which, body in (("yes", node.body), ("no", node.orelse)):
            whole = [*body, *([] if _returns(body) else rest)]
            text += [f"def {place}_{which}({_stored(whole).given()}):", "    pass"]
            bodies.append(whole)
        text += [f"{place}_if = 0", f"{place} = {_OURS}merged({place}_if, {place}_yes, {place}_no)"]
        text += [f"if {place} is not None:", f"    return {place}", f"if {place}_if:", "    pass", "else:", "    pass"]
        found = _template(text, node)
        yes, no, condition, _, _, otherwise = found
        yes.body, no.body = (self._block(_copied(body), returns=True) or [ast.Pass()] for body in bodies)
        otherwise.body, otherwise.orelse = _copied(node.body), _copied(node.orelse) or [ast.Pass()]
        condition.value = self._condition(node.test)
        return [*found, *_copied(rest)]


def _name(which: str) -> ast.expr:
    return ast.Name(_OURS + which, ast.Load())


def _lazy(value: ast.expr) -> ast.expr:
    none = ast.arguments(posonlyargs=[], args=[], kwonlyargs=[], kw_defaults=[], defaults=[])
    return ast.copy_location(ast.Lambda(none, value), value)


def _copied(body: Sequence[ast.stmt]) -> list[ast.stmt]:
    return copy.deepcopy(list(body))


def _template(lines: Sequence[str], node: ast.stmt) -> Any:
    """Statements at the line of a branch."""
    found = ast.parse("\n".join(lines)).body
    for one in found:
        for part in ast.walk(one):
            ast.copy_location(part, node)
    return found


def _assigns(tree: ast.AST) -> bool:
    return any(isinstance(one, (ast.NamedExpr, ast.Await, ast.Yield, ast.YieldFrom)) for one in ast.walk(tree))


def _is_simple(body: Iterable[ast.stmt]) -> bool:
    """Return whether statements only assign, to variables and to elements of variables."""
    for one in body:
        if isinstance(one, ast.If):
            if not (_is_simple(one.body) and _is_simple(one.orelse)) or _assigns(one.test):
                return False
        elif isinstance(one, (ast.Assign, ast.AugAssign)):
            targets = one.targets if isinstance(one, ast.Assign) else [one.target]
            if not all(map(_is_target, targets)) or _assigns(one):
                return False
        elif not isinstance(one, ast.Pass) and not (isinstance(one, ast.Expr) and isinstance(one.value, ast.Constant)):
            return False
    return True


def _is_target(target: ast.expr) -> bool:
    if isinstance(target, ast.Tuple):
        return all(map(_is_target, target.elts))
    return isinstance(target, ast.Name) or (isinstance(target, ast.Subscript) and isinstance(target.value, ast.Name))


#: How the results of branches are stored: in variables, in what they hold if that is an array, in elements.
_REBOUND, _AUGMENTED, _FILLED = "{0} = {1}", "{0} = " + _OURS + "fill({0}, {1})", _OURS + "fill({0}, {1})"


class _Assigned(dict[str, str]):
    """The variables that statements assign to, or to whose elements, and how."""

    changed: set[str]  # in place

    def given(self) -> str:
        """Arguments of a function that does the same to values and copies of its own."""
        how = {one: "copy" if one in self.changed else "value" for one in self}
        return ", ".join(f"{one}={_OURS}{way}(lambda: {one})" for one, way in how.items())


def _stored(body: Iterable[ast.stmt]) -> _Assigned:
    nodes = [one for tree in body for one in ast.walk(tree)]
    augmented = {one.target.id for one in nodes if isinstance(one, ast.AugAssign) and isinstance(one.target, ast.Name)}
    elements = [one.value for one in nodes if isinstance(one, ast.Subscript) and isinstance(one.ctx, ast.Store)]
    filled = {one.id for one in elements if isinstance(one, ast.Name)}
    names = [one for one in nodes if isinstance(one, ast.Name) and isinstance(one.ctx, ast.Store)]
    targets = {id(one.target) for one in nodes if isinstance(one, ast.AugAssign)}
    rebound = {one.id for one in names if id(one) not in targets}
    rebound |= {one.name for one in nodes if isinstance(one, ast.FunctionDef)}
    kinds = dict.fromkeys(filled, _FILLED) | dict.fromkeys(augmented, _AUGMENTED) | dict.fromkeys(rebound, _REBOUND)
    stored = _Assigned(sorted(kinds.items()))
    stored.changed = augmented | filled
    return stored


def _returns(body: Sequence[ast.stmt]) -> bool:
    """Return whether statements always end in a return."""
    if not body:
        return False
    last = body[-1]
    return isinstance(last, ast.Return) or (isinstance(last, ast.If) and _returns(last.body) and _returns(last.orelse))


def _can_be_function(body: Iterable[ast.stmt]) -> bool:
    """Return whether statements keep their meaning in a function of their own."""
    kinds = (ast.Global, ast.Nonlocal, ast.Raise, ast.Try, ast.With, ast.Import, ast.ImportFrom, ast.Delete, ast.Yield)
    body = list(body)
    names = {*_stored(body)}
    return not any(
        isinstance(one, kinds) or (isinstance(one, ast.Expr) and _changes(one.value, names))
        for tree in body
        for one in ast.walk(tree)
    )


def _changes(value: ast.expr, own: set[str]) -> bool:
    """Return whether a call for its effect may change an object made before."""
    if not isinstance(value, ast.Call):
        return False
    owner = value.func.value if isinstance(value.func, ast.Attribute) else None
    return not (isinstance(owner, ast.Name) and owner.id in own)


# ----------------------------------------------------------------------------------------------------------------------
# What the rewritten function calls


def helpers(decide: Callable[[Node], bool]) -> dict[str, Any]:
    """The functions that rewritten code calls, by name."""

    def merged(condition: Any, yes: Callable[[], Any], no: Callable[[], Any]) -> Any:
        node = _as_condition(condition)
        if node is None:
            return None
        try:
            found = [_tried(branch) for branch in (yes, no)]
        except (TraceError, RecursionError):  # both branches of a recursion are called without end, at each level
            raise
        except Exception:  # whatever a branch raises that is not taken: then they are followed one by one
            return None
        before = _merge_arrays(node, found[0].written, found[1].written)
        try:
            return _selected(node, found[0].value, found[1].value, decide)
        except _DifferError:
            for whole, cells in before:
                whole[...] = cells
            return None

    def choose(condition: Any, yes: Callable[[], Any], no: Callable[[], Any]) -> Any:
        found = merged(condition, yes, no)
        if found is None:
            return yes() if condition else no()
        return found

    def negated(value: Any) -> Any:
        node = _as_condition(value)
        return not value if node is None else wrapped(node.graph.make("not", node), decide)

    def value(get: Callable[[], Any]) -> Any:
        try:
            return get()
        except NameError:
            return _UNBOUND

    def copied(get: Callable[[], Any]) -> Any:
        return _own_copy(value(get))

    def filled(target: Any, merged: Any) -> Any:
        if isinstance(target, list):
            target[:] = merged
        elif isinstance(target, TracedArray) and target.ndim:
            target[...] = merged
        else:
            return merged
        return target

    found: dict[str, Any] = {
        "merged": merged,
        "choose": choose,
        "both": _joined("and", False, decide),
        "either": _joined("or", True, decide),
    }
    found |= {"negated": negated, "over": _over(decide), "value": value, "copy": copied, "fill": filled}
    return {_OURS + name: one for name, one in found.items()}


def _joined(op: str, last: bool, decide: Callable[[Node], bool]) -> Callable[..., Any]:
    """``and`` or ``or`` of conditions, the further ones as functions; `last`: the truth that ends it."""

    def of(*parts: Callable[[], Any]) -> Any:
        value = parts[0]()
        for part in parts[1:]:
            node = _as_condition(value)
            if node is None:
                if bool(value) is last:
                    return value
                value = part()
                continue
            try:
                tried = _tried(part)
                if tried.written:
                    raise _DifferError
                other = tried.value
                further = _as_condition(other)
                if further is None:
                    further = node.graph.node(float(bool(other)))
            except TraceError:
                raise
            except Exception:  # it may be defined only where the first part allows it
                if bool(value) is last:
                    return value
                value = part()
                continue
            value = wrapped(node.graph.make(op, node, truth(further)), decide)
        return value

    return of


def _over(decide: Callable[[Node], bool]) -> Callable[..., Any]:
    """``any`` or ``all`` of conditions."""

    def of(function: Any, items: Iterable[Any]) -> Any:
        if function not in (any, all):  # the user's own
            return function(items)
        op, joined = "or" if function is any else "and", None
        try:
            for one in items:
                node = _as_condition(one)
                if node is not None:
                    joined = node if joined is None else node.graph.make(op, joined, node)
                elif bool(one) is (function is any):
                    return function is any
        except (ArithmeticError, ValueError) as error:  # of one that need not be asked: the paths end before it
            raise TraceError(str(error)) from error
        return function is all if joined is None else wrapped(joined, decide)

    return of


class _Tried(NamedTuple):
    """Result of a branch, and the arrays that it writes to: themselves, their cells before and after."""

    value: Any
    written: _Written


def _tried(branch: Callable[[], Any]) -> _Tried:
    """A branch, whose writes to arrays are taken back: so other names and views of the same arrays see what they would
    see."""
    journal: dict[int, tuple[Any, Any]] = {}
    token = JOURNALS.set((*JOURNALS.get(), journal))
    try:
        value = branch()
        return _Tried(value, {key: (whole, cells, whole.copy()) for key, (whole, cells) in journal.items()})
    finally:
        JOURNALS.reset(token)
        for whole, cells in journal.values():
            whole[...] = cells


def _merge_arrays(condition: Node, yes: _Written, no: _Written) -> list[tuple[Any, Any]]:
    """Return the arrays as one or the other branch leaves them, each with its cells before."""
    graph = condition.graph

    def either(a: Node, b: Node) -> Node:
        return a if a is b else graph.select(condition, number(a), number(b))

    saved = []
    for key in {**yes, **no}:
        whole, before, _ = yes.get(key) or no.get(key)  # type: ignore[misc]  # one has it
        after = [found[key][2] if key in found else before for found in (yes, no)]
        whole[...] = np.frompyfunc(either, 2, 1)(*after)
        saved.append((whole, before))
    return saved


def _own_copy(value: Any) -> Any:
    """Return a copy of a value that a branch may change in place. Writes to traced arrays are taken back, so these are
    not copied; a value that cannot be copied counts as unbound."""
    if isinstance(value, list):
        return [_own_copy(one) if isinstance(one, list) else one for one in value]
    if isinstance(value, np.ndarray):
        return value.copy()
    known = (TracedArray, int, float, complex, str, tuple, np.generic, _Unbound)
    return value if value is None or isinstance(value, known) else _UNBOUND


def _as_condition(value: Any) -> Node | None:
    """The node of a condition on traced values. None: it is decided."""
    if not isinstance(value, TracedArray) or value.size != 1:
        return None
    node: Node = truth(value.cells.flat[0])
    return None if value.cells.flat[0].op == "number" else node


def _selected(condition: Node, yes: Any, no: Any, decide: Callable[[Node], bool]) -> Any:
    """Select one of two results by a condition."""
    if yes is no:
        return yes
    if isinstance(yes, (list, tuple)) and type(yes) is type(no) and len(yes) == len(no):
        return type(yes)(_selected(condition, a, b, decide) for a, b in zip(yes, no, strict=True))
    if isinstance(yes, _Unbound):
        return _selected(condition, _undefined(no), no, decide)
    if isinstance(no, _Unbound):
        return _selected(condition, yes, _undefined(yes), decide)
    if not has_traced(yes) and not has_traced(no) and type(yes) is type(no) and bool(yes == no):
        return yes
    if isinstance(yes, bool) and isinstance(no, bool):  # which differ: the condition, or its opposite
        answer = condition if yes else condition.graph.make("not", condition)
        return TracedArray(np.array(answer, dtype=object), decide)
    try:
        a, b = cells_of(yes, condition.graph), cells_of(no, condition.graph)
    except TraceError:
        raise _DifferError from None
    if a.shape != b.shape:
        raise _DifferError
    made = np.empty(a.shape, dtype=object)
    for place in np.ndindex(a.shape):
        made[place] = condition.graph.select(condition, number(a[place]), number(b[place]))
    return TracedArray(made, decide)


def _undefined(like: Any) -> Any:
    """NaN, of the shape of a number or array; else the same."""
    if isinstance(like, (TracedArray, np.ndarray, int, float)):
        return np.full(np.shape(like), np.nan)
    return like
