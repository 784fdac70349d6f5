"""Arrays of nodes that behave as NumPy's arrays of floats: what a function is called with when it is traced."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any, Literal, NoReturn

import numpy as np

from .nodes import Graph, Node, TraceError
from .universal import BINARY, UNARY, _elementary, number, truth

#: What the branches that are being tried have written to: arrays, by id, and their cells before.
JOURNALS: ContextVar[tuple[dict[int, tuple[Any, Any]], ...]] = ContextVar("journals", default=())


def standing_for(kind: type, function: Any) -> Any:
    """Return a function that takes the place of a type in traced code. NumPy takes it as a dtype too, as anything whose
    attribute `dtype` is one."""
    function.dtype = np.dtype(kind)
    return function


def _method(name: str) -> Callable[..., Any]:
    """The method of arrays that does what the function of this name does."""

    def method(self: TracedArray, *args: Any, **options: Any) -> Any:
        return self._by(name, *args, **options)

    return method


class TracedArray(np.lib.mixins.NDArrayOperatorsMixin):
    """An array of nodes, of any shape; of shape () for one number.

    - `cells`: the nodes
    - `decide`: returns the truth value of a condition where Python asks for one
    """

    __slots__ = ("cells", "decide")
    #: The type of complex arrays, which `complexes` defines.
    paired: Any = None
    __array_priority__ = 1000

    def __init__(self, cells: Any, decide: Callable[[Node], bool]) -> None:
        self.cells, self.decide = cells, decide

    def __repr__(self) -> str:
        return f"traced{self.cells.tolist()!r}"

    # The attributes of an array

    @property
    def shape(self) -> tuple[int, ...]:
        return self.cells.shape  # type: ignore[no-any-return]  # cells are Any

    @property
    def ndim(self) -> int:
        return self.cells.ndim  # type: ignore[no-any-return]  # cells are Any

    @property
    def size(self) -> int:
        return self.cells.size  # type: ignore[no-any-return]  # cells are Any

    @property
    def dtype(self) -> Any:
        truths = self.cells.size and all(one.is_truth for one in self.cells.flat)
        return np.dtype(bool if truths else float)

    @property
    def T(self) -> TracedArray:  # noqa: N802 - NumPy's name
        return self._with(self.cells.T)

    @property
    def real(self) -> TracedArray:
        return self

    @property
    def imag(self) -> Any:
        return self * 0.0

    @property
    def flat(self) -> Iterator[TracedArray]:
        return iter(self.ravel())

    def _with(self, cells: Any) -> TracedArray:
        return TracedArray(cells, self.decide)

    def __len__(self) -> int:
        return len(self.cells)

    def __iter__(self) -> Iterator[TracedArray]:
        if not self.cells.ndim:
            raise TypeError("iteration over a 0-d array")
        return (self[i] for i in range(len(self.cells)))

    def __getitem__(self, key: Any) -> TracedArray:
        key = _plain_index(key)
        if isinstance(key, np.ndarray) and key.dtype == object:
            raise TraceError("an index or mask that depends on values: use np.where")
        view = self.cells[key]
        return self._with(view if isinstance(view, np.ndarray) else _scalar(view))

    def __setitem__(self, key: Any, value: Any) -> None:
        key = _plain_index(key)
        found = cells_of(value, self._graph)
        if isinstance(key, TracedArray):
            raise TraceError("an assignment under a mask that depends on values: use np.where")
        self._require_own()
        self.cells[key] = found if found.ndim else found[()]

    def _require_own(self) -> None:
        if not self.cells.flags.writeable:
            raise TraceError("it writes to an array that it does not make")
        whole = self.cells if self.cells.base is None else self.cells.base
        for journal in JOURNALS.get():
            journal.setdefault(id(whole), (whole, whole.copy()))

    @property
    def _graph(self) -> Graph:
        graph: Graph = self.cells.flat[0].graph
        return graph

    # What Python asks of a number

    def __bool__(self) -> bool:
        if self.cells.size != 1:
            raise TraceError("the truth value of an array with more than one element is ambiguous")
        return self.decide(truth(self.cells.flat[0]))

    def _as_constant(self, what: str) -> float:
        if self.cells.size == 1 and self.cells.flat[0].op == "number":
            return float(self.cells.flat[0].value)
        raise TraceError(f"{what} of a value")

    def __float__(self) -> float:
        return self._as_constant("float()")

    def __int__(self) -> int:
        return int(self._as_constant("int()"))

    def __index__(self) -> int:
        value = self._as_constant("an index, or the count of a loop,")
        if value != int(value):
            raise TypeError("only integers can be indices")
        return int(value)

    def __complex__(self) -> NoReturn:
        raise TraceError("complex numbers")

    def __round__(self, digits: int | None = None) -> NoReturn:
        raise TraceError("round()")

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        if all(one.op == "number" for one in self.cells.flat):
            return np.array([one.value for one in self.cells.flat], dtype=dtype).reshape(self.cells.shape)
        raise TraceError("a function that takes NumPy's own arrays only")

    # NumPy's protocols

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **options: Any) -> Any:
        if options.pop("where", True) is not True:
            raise TraceError(f"numpy.{ufunc.__name__} with where=")
        options.pop("dtype", None)
        if any(map(is_complex, inputs)):
            return self._complex().__array_ufunc__(ufunc, method, *inputs, out=out, **options)
        graph = next(one._graph for one in (*inputs, *(out or ())) if isinstance(one, TracedArray))
        given = [cells_of(one, graph) for one in inputs]
        if method == "__call__":
            found = _called(ufunc.__name__, given)
        elif method in ("reduce", "accumulate", "outer") and ufunc.__name__ in BINARY:
            counting = method == "reduce" and ufunc.__name__ == "add"  # sums of truths count them
            given = [mapped(number, one) for one in given] if counting else given
            found = getattr(np.frompyfunc(BINARY[ufunc.__name__], 2, 1), method)(*given, **options)
        else:
            raise TraceError(f"numpy.{ufunc.__name__}.{method}")
        found = found if isinstance(found, np.ndarray) else _scalar(found)
        if out is None:
            return self._with(found)
        (target,) = out
        if not isinstance(target, TracedArray):
            raise TraceError("a result that is written into an array of numbers: make the array in the function")
        if not target.ndim:
            return self._with(found)  # x += 1 for a number x does not change what else has this number
        target._require_own()
        target.cells[...] = found
        return target

    def __array_function__(self, function: Any, types: Any, args: Any, kwargs: Any) -> Any:
        name = function.__name__
        if any(map(is_complex, args)):
            return self._complex().__array_function__(function, types, args, kwargs)
        if _all_constant(args) and _all_constant([*kwargs.values()]):
            plain = {key: _constant(one) for key, one in kwargs.items()}
            found = function(*map(_constant, args), **plain)
            if isinstance(found, (float, np.ndarray)) and np.asarray(found).dtype.kind == "f":
                return self._with(cells_of(found, self._graph))
            return found
        if name in OWN:
            return wrapped(OWN[name](self._graph, *args, **kwargs), self.decide)
        if name not in BY_OPERATORS:
            raise TraceError(f"numpy.{name}")
        if np.dtype(kwargs.pop("dtype", None)) != float or kwargs.get("out") is not None:
            raise TraceError(f"numpy.{name} with dtype= or out=")
        unwrapped = [_unwrapped(one, self._graph) for one in args]
        options = {key: _unwrapped(one, self._graph) for key, one in kwargs.items()}
        return self._as_nodes(function(*unwrapped, **options))

    def _as_nodes(self, found: Any) -> Any:
        """Numbers that were moved with nodes are nodes."""
        if isinstance(found, (list, tuple)):
            return type(found)(map(self._as_nodes, found))
        mixed = isinstance(found, np.ndarray) and found.dtype == object
        return wrapped(cells_of(found, self._graph) if mixed else found, self.decide)

    def _complex(self) -> Any:
        return self.paired(self, self * 0.0)

    def constant(self, value: Any) -> TracedArray:
        """Numbers as an array of nodes of the same graph."""
        return self._with(cells_of(value, self._graph))

    # Methods of arrays

    def _by(self, name: str, *args: Any, **kwargs: Any) -> Any:
        return self.__array_function__(getattr(np, name), (), (self, *args), kwargs)

    def item(self, *index: Any) -> TracedArray:
        return self[index] if len(index) > 1 else self.ravel()[index[0] if index else 0]

    def ravel(self, order: str = "C") -> TracedArray:
        _require_c(order)
        return self._with(self.cells.ravel())

    def flatten(self, order: str = "C") -> TracedArray:
        _require_c(order)
        return self._with(self.cells.flatten())

    def reshape(self, *shape: Any, **options: Any) -> TracedArray:
        return self._with(self.cells.reshape(*shape, **options))

    def transpose(self, *axes: Any) -> TracedArray:
        return self._with(self.cells.transpose(*axes))

    def copy(self, *_: Any, **__: Any) -> TracedArray:
        return self._with(self.cells.copy())

    def squeeze(self, axis: Any = None) -> TracedArray:
        return self._with(self.cells.squeeze(axis))

    def astype(self, dtype: Any, **_: Any) -> TracedArray:
        kind = np.dtype(dtype).kind
        if kind == "f":
            return self._with(mapped(number, self.cells))
        if kind == "c":
            return self._complex()  # type: ignore[no-any-return]  # `paired` is set later
        raise TraceError(f"astype({np.dtype(dtype)})")

    def tolist(self) -> Any:
        return [one.tolist() if one.ndim else one for one in self] if self.ndim else self

    def fill(self, value: Any) -> None:
        self._require_own()
        self.cells[...] = cells_of(value, self._graph)[()]

    def dot(self, other: Any) -> Any:
        return self._by("dot", other)

    sum, prod, mean, cumsum = map(_method, ("sum", "prod", "mean", "cumsum"))
    max, min, any, all, clip = map(_method, ("max", "min", "any", "all", "clip"))

    def conjugate(self) -> TracedArray:
        return self

    conj = conjugate


def _scalar(node: Any) -> Any:
    """Return one node as an array of shape ()."""
    cells = np.empty((), dtype=object)
    cells[()] = node
    return cells


def mapped(function: Callable[..., Any], *cells: Any) -> Any:
    """A function of nodes over arrays of them, broadcast. Python folds numbers such as log 0 on its way, which sets the
    processor's flags: they say nothing about the user's function."""
    with np.errstate(all="ignore"):
        found = np.frompyfunc(function, len(cells), 1)(*cells)
    return found if isinstance(found, np.ndarray) else _scalar(found)


def _plain_index(key: Any) -> Any:
    """An index without traced numbers that are constants."""
    if isinstance(key, tuple):
        return tuple(_plain_index(one) for one in key)
    if isinstance(key, TracedArray):
        if key.dtype == bool:
            raise TraceError("a mask that depends on values: use np.where")
        return key.__index__() if not key.ndim else np.array(key, dtype=int)
    return key


def is_complex(value: Any) -> bool:
    """Return whether a value contains complex numbers."""
    if isinstance(value, (list, tuple)):
        return any(map(is_complex, value))
    if isinstance(value, (TracedArray, Node)):
        return False
    return isinstance(value, complex) or getattr(getattr(value, "dtype", None), "kind", "") == "c"


def has_traced(value: Any) -> bool:
    """Return whether a value contains nodes."""
    if isinstance(value, (TracedArray, Node, TracedArray.paired)):
        return True
    if isinstance(value, (list, tuple)):
        return any(has_traced(one) for one in value)
    return isinstance(value, np.ndarray) and value.dtype == object and any(has_traced(one) for one in value.flat)


def cells_of(value: Any, graph: Graph) -> Any:
    """Return numbers, arrays of numbers, or lists with traced ones as an array of nodes."""
    if isinstance(value, TracedArray):
        return value.cells
    if isinstance(value, Node):
        return _scalar(value)
    if is_complex(value):
        raise TraceError("complex values, where y is real")
    if isinstance(value, (list, tuple)) and has_traced(value):
        rows = [cells_of(one, graph) for one in value]
        if len({row.shape for row in rows}) > 1:
            raise TraceError("rows of different shapes")
        return np.stack(rows) if rows else np.empty(0, dtype=object)
    found = np.asarray(value)
    if found.dtype == object and not found.ndim:
        raise TraceError(f"a value of type {type(value).__name__}")
    if found.dtype == object:
        return mapped(lambda one: cells_of(one, graph)[()], found)
    if found.dtype.kind == "c":
        raise TraceError("complex numbers")
    if found.dtype.kind not in "biuf":
        raise TraceError(f"a value of type {type(value).__name__}")
    return mapped(lambda one: graph.node(float(one)), found.astype(object))


def _require_c(order: str) -> None:
    if order != "C":
        raise TraceError(f"order={order!r}")


def _all_constant(values: Any) -> bool:
    for one in values:
        if isinstance(one, (list, tuple)):
            if not _all_constant(one):
                return False
        elif isinstance(one, TracedArray) and any(cell.op != "number" for cell in one.cells.flat):
            return False
    return True


def _constant(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(_constant(one) for one in value)
    return np.asarray(value) if isinstance(value, TracedArray) else value


def _unwrapped(value: Any, graph: Graph) -> Any:
    """Arrays of nodes, for functions of NumPy's that need operators only; nothing else changes."""
    if isinstance(value, TracedArray):
        return mapped(number, value.cells)
    if isinstance(value, (list, tuple)) and has_traced(value):
        return type(value)(_unwrapped(one, graph) for one in value)
    return value


def wrapped(value: Any, decide: Callable[[Node], bool]) -> Any:
    """Nodes and arrays of nodes as traced ones, in lists and tuples too."""
    if isinstance(value, Node):
        return TracedArray(_scalar(value), decide)
    if isinstance(value, np.ndarray) and value.dtype == object:
        return TracedArray(value, decide)
    if isinstance(value, (list, tuple)):
        return type(value)(wrapped(one, decide) for one in value)
    return value


# ----------------------------------------------------------------------------------------------------------------------
# NumPy's functions, by name


def _called(name: str, given: Sequence[Any]) -> Any:
    """A ufunc, element by element."""
    if name == "matmul":
        return mapped(number, given[0]) @ mapped(number, given[1])
    known = UNARY if len(given) == 1 else BINARY
    if name == "clip":
        return mapped(lambda a, low, high: BINARY["minimum"](BINARY["maximum"](a, low), high), *given)
    if name not in known:
        raise TraceError(f"numpy.{name}")
    return mapped(known[name], *given)


#: Functions of NumPy's that move elements or need operators only, so that they work on arrays of nodes.
BY_OPERATORS = {
    *(
        "reshape",
        "ravel",
        "transpose",
        "concatenate",
        "stack",
        "hstack",
        "vstack",
        "column_stack",
        "roll",
        "diff",
        "flip",
    ),
    *("dot", "vdot", "inner", "outer", "cross", "trace", "diagonal", "diag", "kron", "matmul", "tensordot", "cumsum"),
    *("cumprod", "sum", "prod", "repeat", "tile", "take", "squeeze", "expand_dims", "moveaxis", "swapaxes", "append"),
    *("atleast_1d", "atleast_2d", "split", "array_split", "copy", "broadcast_to", "delete", "insert", "einsum"),
    *("flip", "einsum", "triu", "tril", "pad", "rot90", "flipud", "fliplr", "trapezoid", "trapz", "convolve"),
}


def _where(graph: Graph, condition: Any, yes: Any = None, no: Any = None) -> Any:
    if yes is None:
        raise TraceError("numpy.where with one argument")
    given = [cells_of(one, graph) for one in (condition, yes, no)]
    return mapped(lambda c, a, b: graph.select(truth(c), number(a), number(b)), *given)


def _select(graph: Graph, condlist: Any, choicelist: Any, default: Any = 0.0) -> Any:
    if len(condlist) != len(choicelist):
        raise ValueError("numpy.select needs as many choices as conditions")
    found = cells_of(default, graph)
    for condition, choice in [*zip(condlist, choicelist, strict=True)][::-1]:
        given = [cells_of(one, graph) for one in (condition, choice)]
        found = mapped(lambda c, a, b: graph.select(truth(c), number(a), number(b)), *given, found)
    return found


def _piecewise(graph: Graph, x: Any, condlist: Any, funclist: Any, *args: Any, **options: Any) -> Any:
    """The value of the last condition that holds, as NumPy has it."""
    shape = np.shape(x)
    alone = not isinstance(condlist, (list, tuple)) and np.ndim(condlist) == len(shape)
    conditions = [condlist] if alone else condlist

    def value(of: Any) -> Any:
        if not callable(of):
            return cells_of(of, graph)
        if np.size(x) != 1:
            raise TraceError("numpy.piecewise with functions of several points")
        return cells_of(of(np.reshape(x, 1), *args, **options), graph).reshape(shape)

    if len(funclist) not in (len(conditions), len(conditions) + 1):
        raise ValueError("numpy.piecewise needs as many values as conditions, or one more")
    otherwise = funclist[-1] if len(funclist) > len(conditions) else 0.0
    found = mapped(lambda _, v: number(v), cells_of(x, graph), value(otherwise))
    for condition, of in zip(conditions, funclist, strict=False):
        given = [cells_of(condition, graph), value(of)]
        found = mapped(lambda c, a, b: graph.select(truth(c), number(a), b), *given, found)
    return found


def _polyval(graph: Graph, p: Any, x: Any) -> Any:
    """By Horner's rule."""
    first, *others = [*mapped(number, cells_of(p, graph).ravel())] or [graph.node(0.0)]
    return mapped(lambda x: functools.reduce(lambda total, c: total * x + c, others, first), cells_of(x, graph))


def _gradient(graph: Graph, f: Any, *spacing: Any, axis: int | None = None, edge_order: Literal[1, 2] = 1) -> Any:
    """By the weights that `numpy.gradient` has for unit vectors: it is linear in f."""
    cells = mapped(number, cells_of(f, graph))
    if len(spacing) > 1 or (cells.ndim != 1 and not isinstance(axis, int)):
        raise TraceError("numpy.gradient along several axes")
    along = 0 if axis is None else axis
    rows, step = np.moveaxis(cells, along, 0), None
    if any(map(has_traced, spacing)):
        step = cells_of(spacing[0], graph)
        if step.ndim:
            raise TraceError("numpy.gradient with coordinates that are arguments")
        spacing = ()
    weights = np.gradient(np.eye(len(rows)), *spacing, axis=0, edge_order=edge_order)
    found = np.empty_like(rows)
    for i, row in enumerate(weights):
        total = sum(weight * rows[j] for j, weight in enumerate(row.tolist()) if weight)
        found[i] = total if step is None else total / number(step[()])
    return np.moveaxis(found, 0, along)


def _clip(graph: Graph, a: Any, a_min: Any = None, a_max: Any = None, **options: Any) -> Any:
    _no_others(options)
    found = cells_of(a, graph)
    for bound, name in ((a_min, "maximum"), (a_max, "minimum")):
        if bound is not None:
            found = mapped(BINARY[name], found, cells_of(bound, graph))
    return found


def _no_others(options: Mapping[str, Any]) -> None:
    """Options that are understood nowhere must not be given."""
    for name, value in options.items():
        if value is not None and value is not np._NoValue:  # NumPy's 'not given'
            raise TraceError(f"the option {name}= of a function of NumPy's")


def _reduced(name: str) -> Callable[..., Any]:
    def reduction(graph: Graph, a: Any, axis: Any = None, *, keepdims: bool = False, **options: Any) -> Any:
        _no_others(options)
        cells = cells_of(a, graph)
        kept = (1,) * cells.ndim if axis is None and keepdims else None
        cells, axis = (cells.ravel(), 0) if axis is None else (cells, axis)
        found = np.frompyfunc(BINARY[name], 2, 1).reduce(cells, axis=axis, keepdims=keepdims and kept is None)
        return found if kept is None else _scalar_or_array(found).reshape(kept)

    return reduction


def _mean(graph: Graph, a: Any, axis: Any = None, *, keepdims: bool = False, **options: Any) -> Any:
    _no_others(options)
    cells = mapped(number, cells_of(a, graph))
    total = cells.sum(axis=axis, keepdims=keepdims)
    axes = range(cells.ndim) if axis is None else np.atleast_1d(axis)
    return total / float(math.prod(cells.shape[one] for one in axes))


def _norm(graph: Graph, a: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Any:
    cells = mapped(number, cells_of(a, graph))
    if ord not in (None, 2) or (ord == 2 and cells.ndim > 1) or keepdims:
        raise TraceError(f"numpy.linalg.norm with ord={ord}")
    squares = cells * cells
    return mapped(_elementary("sqrt"), _scalar_or_array(squares.sum() if axis is None else squares.sum(axis=axis)))


def _scalar_or_array(value: Any) -> Any:
    return value if isinstance(value, np.ndarray) else _scalar(value)


def _solve(graph: Graph, a: Any, b: Any) -> Any:
    matrix, right = (mapped(number, cells_of(one, graph)) for one in (a, b))
    if matrix.ndim != 2 or right.ndim > 2:
        raise TraceError("numpy.linalg.solve with several systems")
    found = graph.solve(matrix.tolist(), right.reshape(len(right), -1).tolist())
    cells = np.empty((len(found), len(found[0])), dtype=object)
    cells[...] = found
    return cells.reshape(right.shape)


def _inverse(graph: Graph, a: Any) -> Any:
    return _solve(graph, a, np.eye(len(cells_of(a, graph))))


def _like(value: float) -> Callable[..., Any]:
    def filled(graph: Graph, a: Any, *_: Any, **__: Any) -> Any:
        return mapped(lambda _: graph.node(value), cells_of(a, graph))

    return filled


OWN: dict[str, Callable[..., Any]] = {
    "where": _where,
    "select": _select,
    "piecewise": _piecewise,
    "polyval": _polyval,
    "gradient": _gradient,
    "clip": _clip,
    "max": _reduced("maximum"),
    "amax": _reduced("maximum"),
    "min": _reduced("minimum"),
    "amin": _reduced("minimum"),
    "any": _reduced("logical_or"),
    "all": _reduced("logical_and"),
    "mean": _mean,
    "average": _mean,
    "norm": _norm,
    "solve": _solve,
    "inv": _inverse,
    "zeros_like": _like(0.0),
    "empty_like": _like(math.nan),
    "ones_like": _like(1.0),
    "full_like": lambda graph, a, value, **_: mapped(lambda _: cells_of(value, graph)[()], cells_of(a, graph)),
    "real": lambda graph, a: cells_of(a, graph),
    "shape": lambda graph, a: cells_of(a, graph).shape,
    "size": lambda graph, a: cells_of(a, graph).size,
    "ndim": lambda graph, a: cells_of(a, graph).ndim,
}
