"""Derivatives of user functions F(t, y, *args) in directions of t, y and parameters.

They are exact from the graph of F, if it is compiled from one or can be traced; or those given; or complex steps, if
these give what differences give. Differences are the last resort.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import cached_property
from importlib.util import find_spec
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import Array, call_name
from .._base.matrices import as_matrix
from .compiled import (
    CompiledFunction,
    CoreFunction,
    NativeWithInputs,
    Shape,
    as_python,
    event_value,
    form_jacobians_by,
    is_native,
    to_native,
)
from .derivatives import INCREMENT, NOT_COMPLEX, TINY, sizes, somewhere, takes_complex
from .filling import Filling
from .graph.derivatives import singular_where
from .graph.derived import Derived, derived, native
from .graph.function import GraphFunction, OnGraph, TracedFunction
from .graph.nodes import Node, in_order, in_words
from .graph.python import Formula
from .graph.switches import Switch, conditions, evaluated, has_steps, surface, switches
from .layout import NO_ARGUMENTS, layout_of, numbers_at_places, place_of, with_numbers

#: Of an increment of a one-sided difference: a smaller one to compare with, and by how much a derivative that exists
#: may be larger there.
_PART, _GROWTH = 1 / 8, 1.01


class ParameterPlace(Protocol):
    """A number among the arguments, or an initial value, on which no function depends directly."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def index(self) -> int: ...
    @property
    def item(self) -> int | None: ...


class Given(NamedTuple):
    """Derivatives that the user gives.

    Attributes
    ----------
    jac : callable, optional
        ``jac(t, y, *args)``, ∂F/∂y of shape (m, n), which may be sparse.
    dfdp : callable or array_like, optional
        ``dfdp(t, y, *args)``, ∂F/∂p, a column for each of the parameters that are no initial values.
    """

    jac: Any = None
    dfdp: Any = None


class Point(NamedTuple):
    """Point (t, y) at which F is defined."""

    t: float
    y: Array


class Directional:
    """The derivatives of F(t, y, *args) with m values for k parameters.

    Parameters
    ----------
    fun : callable
        F: Python, or native; with inputs as `fed` gives it them.
    args : tuple
        Its further arguments, with the values of the parameters.
    names : sequence of ParameterName
        The parameters.
    n : int
        The number of components of y.
    given : Given, optional
        Derivatives that are known. `dfdp` comes before everything, `jac` after the graph.
    at : Point
        A point at which F is defined: it is called there, for m and to see whether it takes complex numbers.
    m : int, optional
        The number of its values, which a native function does not say.
    called : str
        Name of the function in messages.
    moves_t : bool, default False
        Derivatives with respect to t are needed too.
    event : bool, default False
        Machine code has the signature of events.

    Attributes
    ----------
    how : {"traced", "given", "complex step", "differences"}
        Way in which derivatives are formed; "given and traced" and so on if only some were given.
    m, k : int
        The number of values and of parameters.
    args, names
        As given.
    """

    def __init__(
        self,
        fun: Any,
        args: tuple[Any, ...],
        names: Sequence[ParameterPlace],
        n: int,
        given: Given | None = None,
        *,
        at: Point,
        m: int | None = None,
        called: str | None = None,
        moves_t: bool = False,
        event: bool = False,
    ) -> None:
        self.n, self.k, self.args, self.names = n, len(names), args, names
        self.called = call_name(fun, "fun") if called is None else called
        self._moves_t = moves_t
        self._evaluate = _Evaluation(fun, args, names, m, self.called, event)
        self.m = len(self._evaluate(at.t, at.y)) if m is None else m
        self._evaluate.m, self._at = self.m, at
        given = given or Given()
        self._dfdp = None if given.dfdp is None else self._shaped("dfdp", given.dfdp, int(self._evaluate.own.sum()))
        self._graph = self._by_graph(fun, args, names)
        if self._graph is None:
            self._require_numbers(at, names)
        self._jac = None if given.jac is None or self._graph is not None else self._shaped("jac", given.jac, n)
        self._steps: _Steps | None = None
        self._sides: _Sides | None = None
        if self._graph is None and (self._jac is None or (self._dfdp is None and self.k) or moves_t):
            self._steps = _Steps(self._evaluate, at, moves_t)
        found = "traced" if self._graph is not None else None if self._steps is None else self._steps.how
        partly = self._dfdp is not None or self._jac is not None
        #: How derivatives are formed.
        self.how: str = " and ".join(filter(None, ["given" if partly else "", found]))

    def _by_graph(self, fun: Any, args: tuple[Any, ...], names: Sequence[ParameterPlace]) -> _OfGraph | None:
        traced = with_graph(fun)
        if traced is None:
            return None
        floating = with_numbers(args, _as_floats(args, names))  # an integer may be an index, a parameter may not
        parameters = layout_of(floating)
        places = [place_of(args, one.index, one.item) if one.kind == "args" else None for one in names]
        try:
            exact = derived(traced, self.n, self.m, parameters)
        except TypeError:  # it cannot be traced
            return None
        shape = Shape(self.n, self.m, parameters, event=False)
        if exact is None or _constant(traced, shape, places):
            return None
        return _OfGraph(exact, traced, places, parameters.numbers, self.n, self.m)

    def _require_numbers(self, at: Point, names: Sequence[ParameterPlace]) -> None:
        """Raise a TypeError unless F also accepts floating-point values for integer parameters."""
        for one, number in zip(names, self._evaluate.given(names), strict=True):
            if not isinstance(number, (int, np.integer)):
                continue
            try:
                alone = _as_floats(self._evaluate.args, [one])
                self._evaluate.called(at.t, at.y, with_numbers(self._evaluate.args, alone))
            except (TypeError, IndexError) as error:
                raise TypeError(
                    f"{self.called} has no derivative with respect to {one.name} = {number}, which has to be an "
                    f"integer ({error}): name the other parameters"
                ) from error

    def _shaped(self, what: str, given: Any, columns: int) -> Callable[[float, Array], Any]:
        """Return a given matrix as a function of (t, y) that checks its shape."""
        args, shape = self._evaluate.args, (self.m, columns)

        def matrix(t: float, y: Array) -> Any:
            found = given(t, y.copy(), *args) if callable(given) else given
            return as_matrix(f"{what} of {self.called}", found, shape, at=t)

        return matrix

    def takes_complex_at(self, at: Point) -> bool:
        """Return whether F accepts complex steps at this point too; True if derivatives are not formed by complex
        steps."""
        if self._steps is None or self._steps.how != "complex step":
            return True
        try:
            return _Steps(self._evaluate, at, self._moves_t).how == "complex step"
        except NOT_COMPLEX:
            return True  # F is not defined there at all, which is not for this to say

    @cached_property
    def native(self) -> _core.Native | None:
        """`tangent` as machine code for the core, with the parameters of the problem; None: Python's."""
        if self._graph is None or self._dfdp is not None or not has_llvm():
            return None
        found: _core.Native = self._graph.native
        return found

    def tangent_nodes(self) -> list[Node] | None:
        """Return the nodes of the derivative, functions of (t, (y, S_1, S_2, ...)) and the numbers of the arguments;
        None without a graph."""
        return None if self._graph is None else self._graph.tangent_nodes()

    def for_core(self, t: float, Y: ArrayLike) -> Any:
        """`tangent` as the core calls it: machine code, unless that gives NaN at the start (t, Y), which Python mends
        with other derivatives."""
        if self.native is None:
            return self.tangent
        assert self._graph is not None
        return self.native if np.isfinite(self._graph.tangent(t, self._rows(Y))).all() else self.tangent

    def _rows(self, Y: ArrayLike) -> Array:
        return np.asarray(Y, dtype=float).reshape(1 + self.k, self.n)

    def tangent(self, t: float, Y: ArrayLike) -> Array:
        """∂F/∂y S_j + ∂F/∂p_j in row j, of shape (k, m); Y (1 + k, n) has the rows y, S_1, S_2 and so on."""
        rows = self._rows(Y)
        if self._graph is not None and self._dfdp is None:
            found = self._graph.tangent(t, rows)
            if np.isfinite(found).all():
                return found
        return self.columns(t, rows[0], np.zeros(self.k), rows[1:], np.eye(self.k))

    def along(self, t: float, y: Array, dt: float, dy: Array, dp: Array) -> Array:
        """d/ds of F(t + s dt, y + s dy, p + s dp) at s = 0, of shape (m,)."""
        found = self.columns(t, y, np.array([dt]), np.atleast_2d(dy), np.atleast_2d(dp))
        return np.ravel(found)

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives of F in c directions, dt (c,), dy (c, n) and dp (c, k), as rows: of shape (c, m)."""
        with np.errstate(all="ignore"):  # what is not finite is looked at here
            found = self._columns(t, y, dt, dy, dp)
        return found if np.isfinite(found).all() else self._mended(found, t, y, dt, dy, dp)

    def _mended(self, found: Array, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return `found` (c, m) with one-sided finite differences in place of entries that are not finite though F is,
        such as 0 · ∞ where a formula is singular and the function is not. Entries that these do not give stay: there F
        has no derivative along this direction, or is not defined."""
        if self._sides is None:
            self._sides = _Sides(self._evaluate, self.n)
        found = found.copy()
        for row, one in zip(found, zip(dt, dy, dp, strict=True), strict=True):
            gaps = ~np.isfinite(row)
            if gaps.any():
                row[gaps] = self._sides(t, y, *one)[gaps]
        return found

    def _columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        rest = dp if self._dfdp is None else np.zeros_like(dp)
        if self._graph is not None:
            found = self._graph.columns(t, y, dt, dy, rest)
        elif self._jac is None:
            assert self._steps is not None
            found = np.array([self._steps(t, y, *one) for one in zip(dt, dy, rest, strict=True)], dtype=float)
        else:
            found = np.array((self._jac(t, y) @ dy.T).T)
            if dt.any() or rest.any():
                assert self._steps is not None
                found += [self._steps(t, y, one, np.zeros(self.n), other) for one, other in zip(dt, rest, strict=True)]
        found = np.reshape(found, (len(dt), self.m))
        if self._dfdp is not None:
            found = found + (self._dfdp(t, y) @ dp[:, self._evaluate.own].T).T
        return found

    def transposed(self, t: float, y: Array, w: Array) -> Array:
        """(∂F/∂y)ᵀ w, then wᵀ ∂F/∂p_j for each parameter: of shape (n + k,)."""
        if self._graph is not None and self._dfdp is None:
            found = self._graph.transposed(t, y, w)
            if np.isfinite(found).all():
                return found
        return np.asarray(self.columns(t, y, *self._unit_directions) @ w)

    @cached_property
    def _unit_directions(self) -> tuple[Array, Array, Array]:
        """Unit directions (dt, dy, dp) of each component of y, then of each parameter."""
        both = self.n + self.k
        return np.zeros(both), np.eye(both, self.n), np.eye(both, self.k, -self.n)

    def jacobian(self, t: float, y: Array) -> Array:
        """∂F/∂y, of shape (m, n)."""
        if self._graph is not None:
            found = self._graph.jacobian(t, y)
            if np.isfinite(found).all():
                return found
        n = self.n
        return np.asarray(self.columns(t, y, np.zeros(n), np.eye(n), np.zeros((n, self.k))).T)

    def jacobian_of_args(self) -> Callable[[float, Array, Array], Array] | None:
        """Return ∂F/∂y, (m, n), as a function of t, y and the numbers of the arguments; None without a graph."""
        return None if self._graph is None else self._graph.jacobian_of_args

    @property
    def outputs(self) -> list[Node] | None:
        """Nodes of F's values in its graph; None without a graph."""
        return None if self._graph is None else list(self._graph.outputs)

    def switches(self, at: Point) -> list[Switch]:
        """Return the switches of F's graph at which its values jump; an empty list without a graph, where they are
        unknown."""
        return [] if self._graph is None else self._graph.switches(at)

    @property
    def surface(self) -> Any:
        """A function with F's arguments that changes its sign where F does, for an F of one value that takes two
        constants, as a condition does; None of another F, or without a graph."""
        if self._graph is None:
            return None
        found = surface(self._graph.outputs[0])
        return None if found is None else self._graph.with_values([found], self.called)

    @property
    def surfaces(self) -> Any:
        """A function as `surface` for an F of several values: with a function that changes its sign in the place of
        each condition; None if none is one, or without a graph."""
        if self._graph is None:
            return None
        found = [surface(one) for one in self._graph.outputs]
        if not any(one is not None for one in found):
            return None
        pairs = zip(found, self._graph.outputs, strict=True)
        return self._graph.with_values([one if one is not None else value for one, value in pairs], self.called)

    @property
    def is_condition(self) -> bool:
        """True if F has no graph and returns True or False, of which derivatives say nothing."""
        return self._graph is None and self._evaluate(*self._at).dtype == bool

    @property
    def has_conditions(self) -> bool:
        """True if F has a graph with conditions."""
        return self._graph is not None and self._graph.has_conditions()

    @property
    def knows_jumps(self) -> bool:
        """True if all jumps of F are known: it has a graph, without operations that may jump elsewhere."""
        return self._graph is not None and not has_steps(self._graph.outputs)

    def of_inputs(self, node: Node) -> bool:
        """Return whether a node depends on inputs, whose slopes are not known."""
        return self._graph is not None and self._graph.of_inputs(node)

    def on_graph(self, outputs: Sequence[Node], name: str) -> Any:
        """Return a function with F's arguments and these other nodes of its graph as values."""
        assert self._graph is not None
        return self._graph.with_values(outputs, name)

    def branch(self, outputs: Sequence[Node]) -> Callable[[float, Array], Array]:
        """Return the values of these nodes as a Python function of (t, y)."""
        assert self._graph is not None
        return self._graph.branch(outputs)

    def singular_at(self, t: float, y: Array) -> str | None:
        """The operation of the formula of F that has no derivative at a point, with its argument, in words; None: there
        is none, or no formula."""
        return None if self._graph is None else self._graph.singular_at(t, y, self.names)

    def value(self, t: float, y: Array) -> Array:
        """F itself, of shape (m,)."""
        return self._evaluate(t, y)


def _constant(fun: Any, shape: Shape, places: Sequence[int | None]) -> bool:
    """Return whether one of the parameters is a constant of the graph, such as the count of a loop."""
    inside, before = fun, 0
    if isinstance(fun, NativeWithInputs):
        inside, before = fun.fun, fun.arguments(NO_ARGUMENTS).size
        shape = shape._replace(parameters=fun.arguments(shape.parameters))
    known = inside.known(shape).parameters.known()
    return any(place is not None and bool(known[before + place]) for place in places)


def _as_floats(args: tuple[Any, ...], names: Sequence[ParameterPlace]) -> dict[int, dict[int, float]]:
    places = [(one.index, one.item) for one in names if one.kind == "args"]
    changes: dict[int, dict[int, float]] = {}
    for (index, item), number in zip(places, numbers_at_places(args, places), strict=True):
        changes.setdefault(index, {})[item or 0] = float(number)
    return changes


def with_graph(fun: Any) -> Any:
    """Return F in a form that may have a graph; None if it is machine code, or belongs to the core."""
    inside = fun.fun if isinstance(fun, NativeWithInputs) else fun
    if isinstance(inside, OnGraph):
        return fun
    compiled = isinstance(inside, CompiledFunction)
    if isinstance(inside, CoreFunction):
        return inside.on_graph()
    if is_native(inside) and not compiled:
        return None
    fills = isinstance(inside, Filling) or (compiled and inside.inplace)
    python = inside.fun if compiled else inside.__wrapped__ if fills else inside
    python = getattr(python, "py_func", python)  # numba's
    formula = isinstance(python, Formula)
    made = GraphFunction(python) if formula else TracedFunction(python, fills, "own", "trace")
    return fun._replace(fun=made) if isinstance(fun, NativeWithInputs) else made


class _OfGraph:
    """Derivatives of a graph."""

    def __init__(self, exact: Derived, fun: Any, places: Sequence[int | None], p: Array, n: int, m: int) -> None:
        before = self._before = fun.arguments(NO_ARGUMENTS).size if isinstance(fun, NativeWithInputs) else 0
        self._places = tuple(None if place is None else before + place for place in places)
        self.outputs = exact.outputs
        self._exact, self._fun, self._n, self._m, self._p = exact, fun, n, m, p

    @cached_property
    def native(self) -> Any:
        """Machine code of the derivatives, a function of (t, (y, S_1, S_2, ...))."""
        k = len(self._places)
        return native(self._exact.tangents(self._places), self._fun, (1 + k) * self._n, k * self._m, len(self._p))

    def tangent_nodes(self) -> list[Node]:
        """See `Directional.tangent_nodes`."""
        return self._exact.tangents(self._places).fun.outputs

    @cached_property
    def _tangent(self) -> Callable[[float, Array, Array], Array]:
        """Python function of (t, (y, S_1, S_2, ...)) that returns the derivatives."""
        k = len(self._places)
        return self._for_python(self._exact.tangents(self._places), (1 + k) * self._n, k * self._m)

    @cached_property
    def _transposed(self) -> Callable[[float, Array, Array], Array]:
        """Python function of (t, (y, w)) that returns the transposed derivatives times w."""
        n = self._n
        return self._for_python(self._exact.transposed(self._places), n + self._m, n + len(self._places))

    @cached_property
    def _jacobian(self) -> Callable[[float, Array, Array], Array]:
        return self._for_python(self._exact.dense(), self._n, self._m * self._n)

    def _for_python(self, made: GraphFunction, n: int, size: int) -> Callable[[float, Array, Array], Array]:
        """A Python function of t, n numbers and the parameters, made from the graph."""
        if has_llvm():
            return as_python(native(made, self._fun, n, size, len(self._p)), size)
        return made.fun.array

    def transposed(self, t: float, y: Array, w: Array) -> Array:
        """See `Directional.transposed`."""
        return self._transposed(t, np.concatenate([y, w]), self._numbers(t))

    def jacobian(self, t: float, y: Array) -> Array:
        """See `Directional.jacobian`."""
        return self.jacobian_of_args(t, y, self._numbers(t))

    def jacobian_of_args(self, t: float, y: Array, p: Array) -> Array:
        """See `Directional.jacobian_of_args`."""
        return self._jacobian(t, y, p).reshape(self._m, self._n)

    def switches(self, at: Point) -> list[Switch]:
        """See `Directional.switches`."""
        return switches(self._exact.outputs, at.t, at.y, self._numbers(at.t))

    def has_conditions(self) -> bool:
        """See `Directional.has_conditions`."""
        return bool(conditions(self._exact.outputs))

    def of_inputs(self, node: Node) -> bool:
        """See `Directional.of_inputs`."""
        return any(one.op == "p" and one.value < self._before for one in in_order([node]))

    def singular_at(self, t: float, y: Array, names: Sequence[ParameterPlace]) -> str | None:
        """See `Directional.singular_at`."""
        nodes = [node for node in in_order(self.outputs) if singular_where(node) is not None]
        zeros = [singular_where(node) for node in nodes]
        if not nodes:
            return None
        with np.errstate(all="ignore"):
            here = evaluated([one for one in zeros if one is not None])(t, y, self._numbers(t))
        called = {at: one.name for at, one in zip(self._places, names, strict=True) if at is not None}
        for node, is_there in zip(nodes, here, strict=True):
            if is_there == 1:
                return in_words(node, called)
        return None

    def with_values(self, outputs: Sequence[Node], name: str) -> Any:
        """See `Directional.on_graph`."""
        made = GraphFunction(Formula(name, lambda: outputs, (len(outputs),)), self._exact.elementary)
        return self._fun._replace(fun=made) if isinstance(self._fun, NativeWithInputs) else made

    def branch(self, outputs: Sequence[Node]) -> Callable[[float, Array], Array]:
        """See `Directional.branch`."""
        values = evaluated(outputs)
        return lambda t, y: values(t, y, self._numbers(t))

    def tangent(self, t: float, rows: Array) -> Array:
        """∂F/∂y S_j + ∂F/∂p_j, of shape (k, m)."""
        return self._tangent(t, rows.ravel(), self._numbers(t)).reshape(len(self._places), self._m)

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Derivatives along directions, in rows."""
        formula, p = self._exact.along(self._places).fun, self._numbers(t)
        along = np.column_stack([dt, dy, dp])
        return np.array([formula(t, np.concatenate([y, one]), p) for one in along])

    def _numbers(self, t: float) -> Array:
        return numbers_at(t, self._fun, self._p)


def numbers_at(t: float, fun: Any, p: Array) -> Array:
    """Return the parameters of machine code: the values of inputs at t, then the numbers of the arguments."""
    if not isinstance(fun, NativeWithInputs):
        return p
    return np.concatenate([*(one.evaluate(np.array([t]))[0] for one in fun.inputs), p])


def has_llvm() -> bool:
    """Return whether llvmlite, which makes machine code of graphs, is installed."""
    return find_spec("llvmlite") is not None


class _Evaluation:
    """F(t, y) with its arguments, or with other values of the parameters."""

    def __init__(
        self, fun: Any, args: tuple[Any, ...], names: Sequence[ParameterPlace], m: int | None, called: str, event: bool
    ) -> None:
        self.args, self._names = args, [one for one in names if one.kind == "args"]
        self._fun, self.m, self._name, self._event = fun, m, called, event
        #: Which of the parameters are in the arguments.
        self.own = np.array([one.kind == "args" for one in names], dtype=bool)
        self._flat = layout_of(args).numbers
        places = [place_of(args, one.index, one.item) for one in self._names]
        self.p = np.zeros(len(names))
        self.p[self.own] = self._flat[places]

    def __call__(self, t: Any, y: Array, p: Array | None = None) -> Array:
        """The values (m,); t, y and p may be complex if F takes that."""
        return self.called(t, y, self.args if p is None else self._with(p[self.own]))

    def called(self, t: Any, y: Array, args: tuple[Any, ...]) -> Array:
        """The values with other arguments."""
        inside = self._fun.fun if isinstance(self._fun, NativeWithInputs) else self._fun
        if is_native(inside) and not isinstance(inside, (CompiledFunction, CoreFunction)):
            return self._of_machine_code(t, y, args)
        given = [*self._inputs(t), *args]
        if isinstance(inside, CompiledFunction):
            return self._of_compiled(inside, t, y, given)
        return np.ravel(np.asarray(inside(t, y.copy(), *given)))

    def given(self, names: Sequence[ParameterPlace]) -> list[Any]:
        """The numbers of the parameters as they were given; 0.0 for initial values."""
        own = iter(numbers_at_places(self.args, ((one.index, one.item) for one in names if one.kind == "args")))
        return [next(own) if one.kind == "args" else 0.0 for one in names]

    def _with(self, p: Array) -> tuple[Any, ...]:
        changes: dict[int, dict[int, Any]] = {}
        for one, value in zip(self._names, p.tolist(), strict=True):
            changes.setdefault(one.index, {})[one.item or 0] = value
        return with_numbers(self.args, changes)

    def _inputs(self, t: Any) -> list[Any]:
        """Return the values of the inputs at t, in the shapes that F takes."""
        if not isinstance(self._fun, NativeWithInputs):
            return []
        rows = [one.evaluate(np.array([np.real(t)]))[0] for one in self._fun.inputs]
        return [row.reshape(shape)[()] for row, shape in zip(rows, self._fun.shapes, strict=True)]

    def _of_compiled(self, fun: CompiledFunction, t: Any, y: Array, given: list[Any]) -> Array:
        """Call the Python function of a compiled F with the arguments as it was traced or, failing that, with all
        numbers in one array, as numba takes it."""
        numbers = [np.concatenate([np.ravel(np.asarray(one)) for one in given])] if given else []
        out: Array | None = None
        if fun.inplace:
            out = np.full(self._count_values(), np.nan, dtype=np.result_type(y, float, *numbers))
        filled = [] if out is None else [out]
        try:
            returned = fun.fun(t, y.copy(), *filled, *given)
        except (TypeError, IndexError):
            returned = fun.fun(t, y.copy(), *filled, *numbers)
        return out if out is not None else np.ravel(np.asarray(returned))

    def _count_values(self) -> int:
        if self.m is None:
            raise ValueError(f"{self._name} fills an array: say how many values it has")
        return self.m

    def _of_machine_code(self, t: Any, y: Array, args: tuple[Any, ...]) -> Array:
        if np.iscomplexobj(t) or np.iscomplexobj(y) or self.m is None:
            raise TypeError(f"{self._name} is machine code for real numbers")
        arguments = layout_of(args)
        p = numbers_at(t, self._fun, arguments.numbers)
        if self._event:
            code = to_native(self._name, self._fun, len(y), 1, arguments, event=True)
            return np.array([event_value(code, t, np.ascontiguousarray(y), p)])
        return as_python(to_native(self._name, self._fun, len(y), self.m, arguments), self.m)(t, y, p)


class _Sides:
    """Derivatives from one side, along a direction, by differences of three values: where a function is singular on
    one side, or its formula is."""

    def __init__(self, evaluate: _Evaluation, n: int) -> None:
        self._evaluate, self._n = evaluate, n

    def __call__(self, t: float, y: Array, dt: float, dy: Array, dp: Array) -> Array:
        """The derivative along a direction, of shape (m,); NaN where there is none from either side."""
        p = self._evaluate.p
        x, direction = np.concatenate([[t], y, p]), np.concatenate([[dt], dy, dp])
        size = np.concatenate([[max(abs(t), 1.0)], sizes(y), np.where(p == 0, 1.0, np.abs(p))])
        length = np.max(np.abs(direction) / size)
        if length < np.finfo(float).tiny:
            return np.zeros(self._evaluate.m or 0)
        found, h = np.full(self._evaluate.m or 0, np.nan), INCREMENT / length
        for side in (h, -h):
            with warnings.catch_warnings(), np.errstate(all="ignore"):
                warnings.simplefilter("ignore")
                try:
                    wide, narrow = (self._quotient(x, part * side * direction) / (part * side) for part in (1, _PART))
                except (ValueError, ArithmeticError):  # F is not defined on this side
                    continue
                grows = ~(np.abs(narrow) <= _GROWTH * np.abs(wide))  # as it does where it is infinite
                one = np.where(grows, np.nan, narrow)
            found = np.where(np.isfinite(found), found, one)
        return found

    def _quotient(self, x: Array, step: Array) -> Array:
        """The derivative along a step, by the parabola through three values."""
        here, near, far = (self._values(x + part * step) for part in (0, 1, 2))
        return np.asarray((4 * near - far - 3 * here) / 2)

    def _values(self, x: Array) -> Array:
        return self._evaluate(float(x[0]), x[1 : 1 + self._n], x[1 + self._n :]).astype(float)


class _Steps:
    """Derivatives by complex steps, if these give what differences give; else by central differences."""

    def __init__(self, evaluate: _Evaluation, at: Point, moves_t: bool) -> None:
        self._evaluate, self._n = evaluate, len(at.y)
        p = evaluate.p
        self._size_of_p = np.where(p == 0, 1.0, np.abs(p))
        direction = np.concatenate(
            [[max(abs(at.t), 1.0) if moves_t else 0.0], somewhere(at.y), somewhere(p, self._size_of_p)]
        )
        beside = np.append(0.0, direction[1:])
        beside[1 + self._n :] = 0
        works = takes_complex(self._values, np.concatenate([[at.t], at.y, p]), direction, beside)
        self.how = "complex step" if works else "differences"

    def _values(self, z: Array) -> Array:
        t, y, p = z[0], z[1 : 1 + self._n], z[1 + self._n :]
        values = self._evaluate(t if np.iscomplexobj(t) and t.imag else float(t.real), y, p)
        if np.iscomplexobj(z):
            return values
        return values.astype(float)

    def __call__(self, t: float, y: Array, dt: float, dy: Array, dp: Array) -> Array:
        """The derivative along a direction."""
        x, direction = np.concatenate([[t], y, self._evaluate.p]), np.concatenate([[dt], dy, dp])
        if not direction.any():
            return np.zeros(self._evaluate.m or 0)
        if self.how == "complex step":
            with np.errstate(all="ignore"):
                try:
                    return np.imag(self._values(x + 1j * TINY * direction)) / TINY
                except NOT_COMPLEX:  # here, where a branch compares numbers, or the like
                    pass
        size = np.concatenate([[max(abs(t), 1.0)], sizes(y), self._size_of_p])
        h = INCREMENT / np.max(np.abs(direction) / size)
        up, down = (self._values(x + side * h * direction) for side in (1, -1))
        return np.asarray((up - down) / (2 * h))


def _of_compiled(fun: CompiledFunction, t: float, y: Array, args: tuple[Any, ...]) -> Directional:
    return Directional(fun, args, (), len(y), at=Point(t, y))


form_jacobians_by(
    lambda fun, t, y, args: _of_compiled(fun, t, y, args).jacobian_of_args(),
    lambda fun, t, y, args: _of_compiled(fun, t, y, args).jacobian(t, y),
)
