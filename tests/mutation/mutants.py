"""Mutants of Python source: each is one change that a test should see."""

from __future__ import annotations

import ast
import copy
import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
COMPUTED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.MatMult: ast.Mult,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    file: str
    """Below the package."""
    kind: str
    site: int
    """Of those of this kind in the file."""
    line: int


def operator(node: ast.AST) -> ast.AST | None:
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in COMPUTED:
        node.op = COMPUTED[type(node.op)]()
        return node
    if isinstance(node, ast.BoolOp):
        node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        return node
    if isinstance(node, ast.Compare):
        node.ops = [COMPARED[type(node.ops[0])](), *node.ops[1:]]
        return node
    return None


def constant(node: ast.AST) -> ast.AST | None:
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        value = node.value
        node.value = (
            (not value) if isinstance(value, bool) else value + 1 if isinstance(value, int) else value * 1.5 + 1
        )
        return node
    return None


def condition(node: ast.AST) -> ast.AST | None:
    if isinstance(node, ast.If | ast.IfExp):
        node.test = ast.UnaryOp(ast.Not(), node.test)
        return node
    return None


def deletion(node: ast.AST) -> ast.AST | None:
    called = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
    kept = isinstance(node, ast.Assign) and not isinstance(node.targets[0], ast.Name | ast.Tuple)
    return ast.Pass() if called or kept or isinstance(node, ast.Raise | ast.AugAssign) else None


def arguments(node: ast.AST) -> ast.AST | None:
    if (
        isinstance(node, ast.Call)
        and len(node.args) >= 2
        and not any(isinstance(a, ast.Starred) for a in node.args[:2])
    ):
        node.args = [node.args[1], node.args[0], *node.args[2:]]
        return node
    return None


KINDS: dict[str, Callable[[ast.AST], ast.AST | None]] = {
    one.__name__: one for one in (operator, constant, condition, deletion, arguments)
}


class _Replace(ast.NodeTransformer):
    """Applies one kind of change to its `site`-th node inside of functions, or counts them."""

    def __init__(self, kind: str, site: int | None) -> None:
        self.change, self.site, self.lines, self.inside = KINDS[kind], site, list[int](), 0

    def visit(self, node: ast.AST) -> ast.AST:
        function = isinstance(node, ast.FunctionDef | ast.Lambda)
        if self.inside and hasattr(node, "lineno") and self._here(node):
            return ast.copy_location(self.change(node) or node, node)
        self.inside += function
        for name in node._fields:
            if name not in ("annotation", "returns", "decorator_list", "type_params"):
                self._visit_field(node, name)
        self.inside -= function
        return node

    def _here(self, node: ast.AST) -> bool:
        if self.change(copy.copy(node)) is None:
            return False
        self.lines.append(node.lineno)  # type: ignore[attr-defined]  # statements have one
        return self.site == len(self.lines) - 1

    def _visit_field(self, node: ast.AST, name: str) -> None:
        value = getattr(node, name, None)
        if isinstance(value, ast.AST):
            setattr(node, name, self.visit(value))
        elif isinstance(value, list):
            value[:] = [self.visit(one) if isinstance(one, ast.AST) else one for one in value]


def sites(source: str, kind: str) -> list[int]:
    """The lines of the nodes that a kind of change applies to."""
    visitor = _Replace(kind, None)
    visitor.visit(ast.parse(source))
    return visitor.lines


def mutated(source: str, mutant: Mutant) -> str:
    tree = _Replace(mutant.kind, mutant.site).visit(ast.parse(source))
    return ast.unparse(ast.fix_missing_locations(tree))


def all_mutants(package: Path) -> Iterator[Mutant]:
    for path in sorted(package.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        for kind in KINDS:
            for site, line in enumerate(sites(source, kind)):
                yield Mutant(str(path.relative_to(package)), kind, site, line)


def sample(package: Path, count: int, seed: int) -> list[Mutant]:
    """As many of each kind."""
    chooser = random.Random(seed)
    by_kind: dict[str, list[Mutant]] = {kind: [] for kind in KINDS}
    for mutant in all_mutants(package):
        by_kind[mutant.kind].append(mutant)
    return [one for some in by_kind.values() for one in chooser.sample(some, count // len(KINDS))]
