"""Large graphs as loops: values that are computed alike, of other components, are one group.

The graph is cut into trees: a node that several trees need is the root of its own, and kept in `work`. Trees of one
form that do not need each other are a group. In each place of the form, the indices of y, p and `work`, or the numbers,
follow one another by a constant difference, or stand in a table.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    groups = []
    for key in sorted(forms, key=lambda one: one[0]):
        trees = forms[key]
        first, count = trees[0][0], len(offsets)
        if key[1] == "work":
            offsets |= {place: count + i for i, (_, place) in enumerate(trees)}
        places = [offsets[place] if key[1] == "work" else place for _, place in trees]
        leaves = {}
        for i, leaf in enumerate(first.places):
            kind = "work" if leaf in shared and leaf in first.needs else leaf.op
            values = [offsets[one] if kind == "work" else one.value for one in (tree.places[i] for tree, _ in trees)]
            leaves[leaf] = Leaf(kind, values)
        groups.append(Group(first.nodes, leaves, key[1], places))
    shorter = sum(one.size for one in groups) < (len(nodes) + len(outputs)) / 2
    return (groups, len(offsets)) if shorter else None


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
