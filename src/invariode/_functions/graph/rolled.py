"""Large graphs as loops: values that are computed alike, of other components, are one group.

The graph is cut into trees: a node that several trees need is the root of its own, and kept in `work`. Trees of one
form that do not need each other are a group. In each place of the form, the indices of y, p and `work` follow one
another by a constant difference, so that loops are vectorised, or stand in a table; numbers that differ stand in one.
Neighbours on a line, on a ring or on a grid have such differences but at their ends, which are groups of their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, chain, pairwise
from typing import Any, NamedTuple

from .nodes import Node, in_order

#: Groups of fewer trees are written out.
FEWEST = 8


class Leaf(NamedTuple):
    """A place in the form: what is loaded there, or the number, for each tree."""

    kind: str
    values: list[Any]


class Group(NamedTuple):
    """Trees of one form."""

    nodes: list[Node]  # nodes of the first tree, in order
    leaves: dict[Node, Leaf]  # its nodes that have a place
    target: str  # "out" or "work": where the values go, to `places`
    places: list[int]
    #: Trees in succession along which each index grows by a constant difference, the same in all runs; none: tables
    runs: list[range]

    @property
    def is_loop(self) -> bool:
        return len(self.places) >= FEWEST

    @property
    def size(self) -> int:
        """Number of operations in the group's code."""
        return len(self.nodes) * (1 if self.is_loop else len(self.places))


class _Tree(NamedTuple):
    nodes: list[Node]
    places: list[Node]  # its leaves, in order
    needs: list[Node]  # those that are in `work`


def rolled(outputs: Sequence[Node]) -> tuple[list[Group], int] | None:
    """Return the groups of a graph, each after those it needs, and the size of `work`; None if the code would hardly be
    shorter than the graph, or if there are linear systems."""
    nodes = [*in_order(outputs)]
    if any(node.op == "solve" for node in nodes):
        return None
    shared = _shared(nodes, outputs)
    levels: dict[Node, int] = {}
    forms: dict[tuple[Any, ...], list[tuple[_Tree, Any]]] = {}
    tasks: list[tuple[Node, str, Any]] = [(node, "work", node) for node in nodes if node in shared]
    tasks += [(node, "out", i) for i, node in enumerate(outputs)]
    for node, target, place in tasks:
        tree, form = _tree(node, shared, whole=target == "work")
        level = 1 + max((levels[one] for one in tree.needs), default=0)
        if target == "work":
            levels[node] = level
        forms.setdefault((level if target == "work" else len(nodes), target, form), []).append((tree, place))
    offsets: dict[Node, int] = {}
    groups: list[Group] = []
    for key in sorted(forms, key=lambda one: one[0]):
        groups += _groups(forms[key], key[1], shared, offsets)
    shorter = sum(one.size for one in groups) < (len(nodes) + len(outputs)) / 2
    return (groups, len(offsets)) if shorter else None


def _groups(tasks: list[tuple[_Tree, Any]], target: str, shared: set[Node], offsets: dict[Node, int]) -> list[Group]:
    """Return the groups of trees of one form with their places; places in `work` are nodes, whose `offsets` are added.

    Loops over trees whose indices have constant differences are vectorised; runs with the same differences are a group,
    and all short ones are another."""
    model = tasks[0][0]
    kinds = ["work" if one in shared and one in model.needs else one.op for one in model.places]
    values, rows = [], []
    for tree, place in tasks:
        nodes = zip(kinds, tree.places, strict=True)
        values.append([offsets[one] if kind == "work" else one.value for kind, one in nodes])
        indices = [one for kind, one in zip(kinds, values[-1], strict=True) if kind != "number"]
        rows.append([place, *indices] if target == "out" else indices)
    orders = [sorted(range(len(rows)), key=key) for key in (rows.__getitem__, lambda i: _distances(rows[i]))]
    cut = [(order, _runs([rows[i] for i in order])) for order in orders]
    order, runs = min(cut, key=lambda one: sum(len(run) for run in one[1] if len(run) < FEWEST))
    if target == "work":
        offsets |= {tasks[one][1]: len(offsets) + i for i, one in enumerate(order)}
    chosen: dict[tuple[int, ...] | None, list[range]] = {}  # by the differences; None: short runs
    for run in runs:
        pair = (rows[order[i]] for i in run[:2])
        steps = tuple(b - a for a, b in zip(*pair, strict=True)) if len(run) >= FEWEST else None
        chosen.setdefault(steps, []).append(run)
    found = []
    for alike, parts in chosen.items():
        members = [order[i] for i in chain(*parts)]
        listed = zip(*(values[i] for i in members), strict=True)
        leaves = {one: Leaf(kind, [*each]) for one, kind, each in zip(model.places, kinds, listed, strict=True)}
        places = [offsets[tasks[i][1]] if target == "work" else tasks[i][1] for i in members]
        ends = [0, *accumulate(map(len, parts))] if alike is not None else []
        found.append(Group(model.nodes, leaves, target, places, [range(*pair) for pair in pairwise(ends)]))
    return found


def _distances(row: list[int]) -> tuple[list[int], list[int]]:
    """Return the distances of indices from the first, and that: it tells neighbours along different axes apart."""
    return [one - row[0] for one in row], row[:1]


def _runs(rows: Sequence[list[int]]) -> list[range]:
    """Cut rows of indices, each of which differs from the one before by the same row of differences, apart."""
    steps = [[b - a for a, b in zip(*pair, strict=True)] for pair in pairwise(rows)]
    found, start = [], 0
    for i in range(1, len(rows)):
        if i - start > 1 and steps[i - 1] != steps[start]:
            end = i if i - start > 2 else i - 1  # the second of a pair may begin the next run
            found.append(range(start, end))
            start = end
    return [*found, range(start, len(rows))]


def _shared(nodes: Sequence[Node], outputs: Sequence[Node]) -> set[Node]:
    """The nodes that several trees need. Truths are not kept: each tree has its own."""
    owners: dict[Node, Any] = {}  # the root or the place of the output that needs it; None: several
    for node in outputs:
        owners[node] = None if node in owners else node
    shared = set()
    for node in reversed(nodes):
        if not node.arguments:
            continue
        owner = owners[node]
        if owner is None and not node.is_truth:
            shared.add(node)
            owner = node
        for one in node.arguments:
            if owners.setdefault(one, owner) is not owner:
                owners[one] = None
    return shared


def _tree(root: Node, shared: set[Node], *, whole: bool) -> tuple[_Tree, tuple[Any, ...]]:
    """Return the tree of a root down to shared nodes, and its form. `whole`: the root itself is shared, and not a
    leaf."""
    numbers: dict[Node, int] = {}
    nodes: list[Node] = []
    places: list[Node] = []
    needs: list[Node] = []
    form: list[Any] = []
    waiting = [(root, False)]
    while waiting:
        node, ready = waiting.pop()
        if node in numbers:
            continue
        is_leaf = not node.arguments or (node in shared and not (whole and node is root))
        if not is_leaf and not ready:
            waiting.append((node, True))
            waiting.extend((one, False) for one in node.arguments[::-1])
            continue
        numbers[node] = len(nodes)
        nodes.append(node)
        if not is_leaf:
            exponent = node.arguments[-1].value if node.op == "power" else node.value
            form.append((node.op, exponent, *(numbers[one] for one in node.arguments)))
        elif node.op == "t":
            form.append("t")
        else:
            in_work = bool(node.arguments)
            needs += [node] if in_work else []
            places.append(node)
            form.append("work" if in_work else node.op)
    return _Tree(nodes, places, needs), tuple(form)
