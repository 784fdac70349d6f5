"""Derivatives of user functions F(t, y, *args) in directions of t, y and parameters.

They are exact if F is compiled from a graph or can be traced. Otherwise they are the user's, or complex steps if these
agree with finite differences. Finite differences are the last resort.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, call_name
from .._base.forks import cached_property
from .._base.matrices import as_matrix
from .compiled import CompiledFunction, CoreFunction, NativeWithInputs, as_python, form_jacobians_by, is_native
from .forms import Filling
from .graph.derived import Derived, derived, native
from .graph.differentiation import singular_where
from .graph.function import GraphFunction, OnGraph, TracedFunction
from .graph.nodes import Node, in_order, in_words
from .graph.python import Formula
from .graph.switches import Switch, conditions, evaluated, has_steps, surface, switches
from .increments import NOT_COMPLEX, ByIncrements, Sides
from .layout import NO_ARGUMENTS, TRUTHS, Shape, layout_of, place_of, with_numbers
from .with_arguments import ParameterPlace, Point, WithArguments, as_floats, numbers_at

#: Where the entries of each row of a matrix begin, and their columns.
RowPattern: TypeAlias = tuple[Sequence[int], Sequence[int]]


class Given(NamedTuple):
    """Derivatives that the user gives.

    Attributes
    ----------
    jac : callable, machine code or array_like, optional
        ``jac(t, y, *args)``, ∂F/∂y of shape (m, n), which may be sparse.
    dfdp : callable or array_like, optional
        ``dfdp(t, y, *args)``, ∂F/∂p, a column for each of the parameters that are no initial values.
    bands : (int, int), optional
        The bandwidths of a `jac` that is packed by its bands.
    """

    jac: Any = None
    dfdp: Any = None
    bands: tuple[int, int] | None = None

    @classmethod
    def of(cls, jac: Any, dfdp: Any = None, bands: tuple[int, int] | None = None) -> Given:
        """Return the given derivatives, without a Jacobian given as a word or as products, which have no entries."""
        return cls(None if isinstance(jac, str) or hasattr(jac, "matvec") else jac, dfdp, bands)

    def jacobian(self, called: str, shape: tuple[int, int], args: tuple[Any, ...], t: float, y: Array) -> Any:
        """Return ∂F/∂y at a point, dense or sparse, with its shape checked."""
        found = _matrix(f"jac of {called}", self.jac, shape, args, t, y, self.bands)
        if self.bands is None:
            return found
        from scipy.sparse import dia_array

        return dia_array((np.asarray(found), self.bands[1] - np.arange(len(found))), shape).tocsr()

    def of_parameters(self, called: str, shape: tuple[int, int], args: tuple[Any, ...], t: float, y: Array) -> Any:
        """Return ∂F/∂p at a point, with its shape checked."""
        return _matrix(f"dfdp of {called}", self.dfdp, shape, args, t, y)


def _matrix(
    name: str,
    given: Any,
    shape: tuple[int, int],
    args: tuple[Any, ...],
    t: float,
    y: Array,
    bands: tuple[int, int] | None = None,
) -> Any:
    """Return the value of a matrix that a user gives as a constant, a function or machine code."""
    shape = shape if bands is None else (sum(bands) + 1, shape[1])
    if is_native(given):
        values = WithArguments(given, args, (), shape[0] * shape[1], name, event=False)(t, y)
        return as_matrix(name, values.reshape(shape) if values.size == shape[0] * shape[1] else values, shape, at=t)
    found = given(t, y.copy(), *args) if callable(given) else given
    return as_matrix(name, found, shape, banded=bands is not None, at=t)


def way_of(
    chosen: str | None, given: Any, *, traced: Callable[[], Any], at_complex: Callable[[], Any] = lambda: None
) -> tuple[str, Any]:
    """Return how a derivative is formed, and by what: the first that is available of "given", the user's derivative,
    "traced", "complex step", and "differences", which are formed by nothing else.

    - `chosen`: the user's word for a way; "differences", "2-point" and "3-point" leave out those before them
    - `given`: the user's derivative, or None
    - `traced`, `at_complex`: return what the derivative is formed by, or None if this way is not available
    """
    if given is not None:
        return "given", given
    if chosen is None or chosen not in ("differences", "2-point", "3-point"):
        for how, make in (("traced", traced), ("complex step", at_complex)):
            if (source := make()) is not None:
                return how, source
    return "differences", None


def derivative_of(
    function: Any,
    shape: tuple[int | None, int],
    given: Given | None = None,
    *,
    at: Point,
    args: tuple[Any, ...] = (),
    names: Sequence[ParameterPlace] = (),
    called: str | None = None,
    moves_t: bool = False,
    event: bool = False,
    traces: bool | Literal["unnoticed"] = True,
) -> Derivative:
    """Return the derivative of F(t, y, *args) with respect to y, t and parameters.

    The first available source is used: the given `dfdp`; the graph of F, which is exact; the given `jac`; complex
    steps, if they agree with finite differences; finite differences. A derivative that is not finite although F is,
    such as 0 · ∞, is replaced by one-sided differences.

    - `function`: F, a Python or native function; `fed` has bound its inputs
    - `shape`: (m, n), the numbers of values and of components of y. m is None: F is called to see it, which a native
      function does not say.
    - `given`: derivatives that are known
    - `at`: a point at which F is defined: F is called there, to find whether it takes complex numbers
    - `args`: its further arguments, with the values of the parameters
    - `names`: the parameters
    - `called`: name of the function in messages
    - `moves_t`: derivatives with respect to t are needed too
    - `event`: machine code has the signature of events
    - `traces`: F may be called with symbols, to find its graph; "unnoticed": only if the call has no effect outside F

    Raises TypeError: A parameter is an integer, and F takes no other number in its place.
    """
    evaluate = WithArguments(function, args, names, shape[0], called or call_name(function, "fun"), event)
    if evaluate.m is None:
        evaluate.m = len(evaluate(at.t, at.y))
    graph = OfGraph.of(function, evaluate, shape[1], unnoticed=traces == "unnoticed") if traces else None
    return Derivative(evaluate, at, moves_t, given or Given(), graph)


class Derivative:
    """The derivative of F(t, y, *args), as `derivative_of` returns it.

    - `graph`: F as a graph, of which the derivatives are exact; None: it has none
    - `m`, `n`, `k`: the number of values, of components of y and of parameters
    - `args`, `names`, `called`: as given to `derivative_of`
    """

    def __init__(self, evaluate: WithArguments, at: Point, moves_t: bool, given: Given, graph: OfGraph | None) -> None:
        self.n, self.m, self.k = len(at.y), evaluate.size, len(evaluate.names)
        self.args, self.names, self.called = evaluate.args, evaluate.names, evaluate.called
        self._evaluate, self._at, self._moves_t, self.graph = evaluate, at, moves_t, graph
        self._given = given if graph is None else given._replace(jac=None)
        if graph is None:
            evaluate.require_numbers(at)

    @cached_property
    def _steps(self) -> ByIncrements | None:
        """Complex steps or differences; None: they are not needed."""
        given = self._given
        if self.graph is not None or not (given.jac is None or (given.dfdp is None and self.k) or self._moves_t):
            return None
        return ByIncrements(self._evaluate, self._at, self._moves_t)

    @cached_property
    def how(self) -> str:
        """Way in which derivatives are formed: "traced", "given", "complex step" or "differences"; "given and traced"
        and so on if only some were given."""
        partly = self._given.dfdp is not None or self._given.jac is not None
        found = "traced" if self.graph is not None else None if self._steps is None else self._steps.how
        return " and ".join(filter(None, ["given" if partly else "", found]))

    def with_args(self, args: tuple[Any, ...]) -> Derivative:
        """Return the derivative for other arguments of the same kinds, formed in the same way: its code is shared."""
        made = copy(self)
        made.args, made._evaluate = args, self._evaluate.of_args(args)
        if self.graph is not None:
            made.graph = self.graph.with_numbers(layout_of(args).numbers)
        elif self._steps is not None:
            made._steps = self._steps.of(made._evaluate)
        return made

    def takes_complex_at(self, at: Point) -> bool:
        """Return whether F accepts complex steps at this point too; True if derivatives are not formed by complex
        steps."""
        if self._steps is None or self._steps.how != "complex step":
            return True
        try:
            return ByIncrements(self._evaluate, at, self._moves_t).how == "complex step"
        except NOT_COMPLEX:
            return True  # F is not defined there, whatever the numbers

    def for_core(self, t: float, Y: ArrayLike) -> Any:
        """`tangent` as the core calls it: machine code, unless that gives NaN at the start (t, Y), which Python mends
        with other derivatives."""
        graph = self.graph
        if graph is None or self._given.dfdp is not None or not has_llvm():
            return self.tangent
        return graph.native if is_finite(graph.tangent(t, self._rows(Y))) else self.tangent

    def _rows(self, Y: ArrayLike) -> Array:
        return np.asarray(Y, dtype=float).reshape(1 + self.k, self.n)

    def tangent(self, t: float, Y: ArrayLike) -> Array:
        """∂F/∂y S_j + ∂F/∂p_j in row j, of shape (k, m); Y (1 + k, n) has the rows y, S_1, S_2 and so on."""
        rows = self._rows(Y)
        if self.graph is not None and self._given.dfdp is None:
            found = self.graph.tangent(t, rows)
            if is_finite(found):
                return found
        return self.columns(t, rows[0], np.zeros(self.k), rows[1:], np.eye(self.k))

    def along(self, t: float, y: Array, dt: float, dy: Array, dp: Array) -> Array:
        """d/ds of F(t + s dt, y + s dy, p + s dp) at s = 0, of shape (m,)."""
        found = self.columns(t, y, np.array([dt]), np.atleast_2d(dy), np.atleast_2d(dp))
        return np.ravel(found)

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return the derivatives of F in c directions, dt (c,), dy (c, n) and dp (c, k), as rows: of shape (c, m)."""
        with np.errstate(all="ignore"):  # values that are not finite are replaced below
            found = self._columns(t, y, dt, dy, dp)
        return found if is_finite(found) else self._mended(found, t, y, dt, dy, dp)

    def of_parameters(self, t: float, y: Array) -> Array:
        """∂F/∂p, of shape (m, k)."""
        return self.columns(t, y, np.zeros(self.k), np.zeros((self.k, self.n)), np.eye(self.k)).T

    def of_time(self, t: float, y: Array) -> Array:
        """∂F/∂t, of shape (m,)."""
        return self.along(t, y, 1.0, np.zeros(self.n), np.zeros(self.k))

    def _mended(self, found: Array, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Return `found` (c, m) with one-sided finite differences in place of entries that are not finite though F is,
        such as 0 · ∞ where a formula is singular and the function is not. Entries that these do not give stay: there F
        has no derivative along this direction, or is not defined."""
        found, sides = found.copy(), Sides(self._evaluate, self.n)
        for row, one in zip(found, zip(dt, dy, dp, strict=True), strict=True):
            gaps = ~np.isfinite(row)
            if gaps.any():
                row[gaps] = sides(t, y, *one)[gaps]
        return found

    def _columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        given, of = self._given, self._evaluate
        rest = dp if given.dfdp is None else np.zeros_like(dp)
        if self.graph is not None:
            found = self.graph.columns(t, y, dt, dy, rest)
        elif given.jac is None:
            assert self._steps is not None
            found = np.array([self._steps(t, y, *one) for one in zip(dt, dy, rest, strict=True)], dtype=float)
        else:
            found = np.array((given.jacobian(self.called, (self.m, self.n), self.args, t, y) @ dy.T).T)
            if dt.any() or rest.any():
                assert self._steps is not None
                found += [self._steps(t, y, one, np.zeros(self.n), other) for one, other in zip(dt, rest, strict=True)]
        found = np.reshape(found, (len(dt), self.m))
        if given.dfdp is not None:
            shape = self.m, int(of.own.sum())
            found = found + (given.of_parameters(self.called, shape, self.args, t, y) @ dp[:, of.own].T).T
        return found

    def transposed(self, t: float, y: Array, w: Array) -> Array:
        """(∂F/∂y)ᵀ w, then wᵀ ∂F/∂p_j for each parameter: of shape (n + k,)."""
        if self.graph is not None and self._given.dfdp is None:
            found = self.graph.transposed(t, y, w)
            if is_finite(found):
                return found
        return np.asarray(self.columns(t, y, *self._unit_directions) @ w)

    @cached_property
    def _unit_directions(self) -> tuple[Array, Array, Array]:
        """Unit directions (dt, dy, dp) of each component of y, then of each parameter."""
        both = self.n + self.k
        return np.zeros(both), np.eye(both, self.n), np.eye(both, self.k, -self.n)

    def jacobian(self, t: float, y: Array) -> Array:
        """∂F/∂y, of shape (m, n)."""
        if self.graph is not None:
            found = self.graph.jacobian(t, y)
            if is_finite(found):
                return found
        n = self.n
        return np.asarray(self.columns(t, y, np.zeros(n), np.eye(n), np.zeros((n, self.k))).T)

    def entries(self, t: float, y: Array, rows: RowPattern) -> Array:
        """Return the entries of ∂F/∂y of a pattern, row by row."""
        if self.graph is not None and (found := self.graph.entries(t, y, rows)) is not None:
            return found
        starts, columns = rows
        return self.jacobian(t, y)[np.repeat(np.arange(self.m), np.diff(starts)), columns]

    @property
    def outputs(self) -> Sequence[Node]:
        """The nodes of F's values; none without a graph."""
        return () if self.graph is None else self.graph.outputs

    @property
    def is_condition(self) -> bool:
        """True if F has no graph and returns True or False, which has no derivative."""
        return self.graph is None and self._evaluate(*self._at).dtype == bool

    @property
    def knows_jumps(self) -> bool:
        """True if all jumps of F are known: it has a graph, without operations that may jump elsewhere."""
        return self.graph is not None and not has_steps(self.graph.outputs)

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


class OfGraph:
    """A function F given by a graph, with exact derivatives.

    - `exact`: the derivatives, for all values of the parameters
    - `outputs`: the values of F
    - `fun`: F as it was traced
    """

    def __init__(self, exact: Derived, fun: Any, places: Sequence[int | None], p: Array, n: int, m: int) -> None:
        before = self._before = fun.arguments(NO_ARGUMENTS).size if isinstance(fun, NativeWithInputs) else 0
        self._places = tuple(None if place is None else before + place for place in places)
        self.outputs: list[Node] = list(exact.outputs)
        self.exact, self.fun, self._n, self._m, self._p = exact, fun, n, m, p
        self._codes: dict[str, Callable[[float, Array, Array], Array]] = {}

    @classmethod
    def of(cls, fun: Any, evaluate: WithArguments, n: int, *, unnoticed: bool) -> OfGraph | None:
        """Return the derivatives of a function from its graph; None: it has none, or a parameter is a constant of it,
        such as the count of a loop."""
        args, names, m = evaluate.args, evaluate.names, evaluate.size
        if unnoticed:
            exact = derived_unnoticed(fun, n, m, args)
            return None if exact is None else cls(exact, None, (), layout_of(args).numbers, n, m)
        traced = with_graph(fun)
        if traced is None:
            return None
        floating = with_numbers(args, as_floats(args, names))  # an integer may be an index, a parameter may not
        parameters = layout_of(floating)
        places = [place_of(args, one.index, one.item) if one.kind == "args" else None for one in names]
        try:
            exact = derived(traced, n, m, parameters)
        except TypeError:  # it cannot be traced
            return None
        if exact is None or _constant(traced, Shape(n, m, parameters, event=False), places):
            return None
        return cls(exact, traced, places, parameters.numbers, n, m)

    @cached_property
    def native(self) -> Any:
        """Machine code of the derivatives, a function of (t, (y, S_1, S_2, ...))."""
        k = len(self._places)
        return native(self.exact.tangents(self._places), self.fun, (1 + k) * self._n, k * self._m, len(self._p))

    def tangent_nodes(self) -> list[Node]:
        """Return the nodes of the derivative, functions of (t, (y, S_1, S_2, ...)) and the numbers of the arguments."""
        return self.exact.tangents(self._places).fun.outputs

    def _code(self, key: str, make: Callable[[], Any], n: int, size: int) -> Callable[[float, Array, Array], Array]:
        """A Python function of t, n numbers and the parameters, made once for all values of the arguments."""
        found = self._codes.get(key)
        if found is None:
            made = make()
            machine = has_llvm()
            found = as_python(native(made, self.fun, n, size, len(self._p)), size) if machine else made.fun.array
            self._codes[key] = found
        return found

    def with_numbers(self, p: Array) -> OfGraph:
        """Return the function with other numbers of the arguments, which shares its code."""
        made = copy(self)
        made._p = p
        return made

    def value(self, t: float, y: Array) -> Array:
        """F itself, of shape (m,)."""
        return self._code("value", self._itself, self._n, self._m)(t, y, self._numbers(t))

    def _itself(self) -> GraphFunction:
        return GraphFunction(Formula("value", lambda: self.outputs, (self._m,)), self.exact.elementary)

    def transposed(self, t: float, y: Array, w: Array) -> Array:
        """See `Derivative.transposed`."""
        n, size = self._n + self._m, self._n + len(self._places)
        code = self._code("transposed", lambda: self.exact.transposed(self._places), n, size)
        return code(t, np.concatenate([y, w]), self._numbers(t))

    def jacobian(self, t: float, y: Array) -> Array:
        """See `Derivative.jacobian`."""
        return self.jacobian_of_args(t, y, self._numbers(t))

    def jacobian_of_args(self, t: float, y: Array, p: Array) -> Array:
        """Return ∂F/∂y, (m, n), for these numbers of the arguments."""
        return self._code("jacobian", self.exact.dense, self._n, self._m * self._n)(t, y, p).reshape(self._m, self._n)

    def entries(self, t: float, y: Array, rows: RowPattern) -> Array | None:
        """See `Derivative.entries`; None: they are not finite, or the pattern is another one."""
        if self.exact.row_pattern != rows:
            return None
        found = self._code("entries", self.exact.by_rows, self._n, self.exact.entries)(t, y, self._numbers(t))
        return found if is_finite(found) else None

    def switches(self, at: Point) -> list[Switch]:
        """Return the switches at which the values jump."""
        return switches(self.exact.outputs, at.t, at.y, self._numbers(at.t))

    def has_conditions(self) -> bool:
        """Return whether there are conditions."""
        return bool(conditions(self.outputs))

    def is_smooth(self) -> bool:
        """Return whether no derivative is infinite, or undefined, where the values are not."""
        return all(singular_where(node) is None for node in in_order(self.outputs))

    def surface(self, name: str) -> Any:
        """Return a function with F's arguments in which functions that change their signs take the place of conditions,
        values of F that are one of two constants; None: F has no conditions."""
        found = [surface(one) for one in self.outputs]
        if all(one is None for one in found):
            return None
        pairs = zip(found, self.outputs, strict=True)
        return self.with_values([value if one is None else one for one, value in pairs], name)

    def of_inputs(self, node: Node) -> bool:
        """Return whether a node depends on inputs, whose slopes are not known."""
        return any(one.op == "p" and one.value < self._before for one in in_order([node]))

    def singular_at(self, t: float, y: Array, names: Sequence[ParameterPlace]) -> str | None:
        """The operation of the formula that has no derivative at a point, with its argument, in words; None: there is
        none."""
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
        """Return a function with F's arguments and other nodes of its graph as values."""
        made = GraphFunction(Formula(name, lambda: outputs, (len(outputs),)), self.exact.elementary)
        return self.fun._replace(fun=made) if isinstance(self.fun, NativeWithInputs) else made

    def branch(self, outputs: Sequence[Node]) -> Callable[[float, Array], Array]:
        """Return the values of these nodes as a Python function of (t, y)."""
        values = evaluated(outputs)
        return lambda t, y: values(t, y, self._numbers(t))

    def tangent(self, t: float, rows: Array) -> Array:
        """∂F/∂y S_j + ∂F/∂p_j, of shape (k, m)."""
        k, n, m = len(self._places), self._n, self._m
        code = self._code("tangent", lambda: self.exact.tangents(self._places), (1 + k) * n, k * m)
        return code(t, rows.ravel(), self._numbers(t)).reshape(k, m)

    def columns(self, t: float, y: Array, dt: Array, dy: Array, dp: Array) -> Array:
        """Derivatives along directions, in rows."""
        formula, p = self.exact.along(self._places).fun, self._numbers(t)
        along = np.column_stack([dt, dy, dp])
        return np.array([formula(t, np.concatenate([y, one]), p) for one in along])

    def _numbers(self, t: float) -> Array:
        return numbers_at(t, self.fun, self._p)


def derived_unnoticed(fun: Any, n: int, m: int, args: tuple[Any, ...]) -> Derived | None:
    """Return the derivatives of a Python function, traced without a call that users could notice; None if it cannot
    be traced so."""
    from .graph.plain import plain_graph  # imported when a function may be traced

    graph = plain_graph(fun, n, layout_of(args).fixed(TRUTHS), size=m, of_objects=False)
    if graph is None:
        return None
    if graph.exact is None:
        graph.exact = Derived(call_name(fun, "g"), graph.outputs, n, "own")
    found: Derived = graph.exact
    return found


def is_finite(values: Array) -> bool:
    """Return whether all numbers are finite. The sum of squares is a faster test, unless it overflows."""
    flat = values.ravel()
    return math.isfinite(flat.dot(flat)) or bool(np.isfinite(values).all())


def has_llvm() -> bool:
    """Return whether llvmlite, which makes machine code of graphs, is installed."""
    return find_spec("llvmlite") is not None


def _of_compiled(fun: CompiledFunction, t: float, y: Array, args: tuple[Any, ...]) -> Derivative:
    return derivative_of(fun, (None, len(y)), at=Point(t, y), args=args)


def _jacobian_of_args(fun: CompiledFunction, t: float, y: Array, args: tuple[Any, ...]) -> Any:
    graph = _of_compiled(fun, t, y, args).graph
    return None if graph is None else graph.jacobian_of_args


form_jacobians_by(_jacobian_of_args, lambda fun, t, y, args: _of_compiled(fun, t, y, args).jacobian(t, y))
