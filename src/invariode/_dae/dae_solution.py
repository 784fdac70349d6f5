"""Solutions of DAEs in the unknowns of F, from those of the reduced problem."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, real_numbers, warn
from .._base.forks import cached_property
from .._functions.compiled import as_python
from .._functions.graph.array_code import ArrayFunction
from .._functions.graph.derived import Derived
from .._functions.graph.function import GraphFunction
from .._functions.graph.nodes import Node, in_order
from .._functions.graph.python import Formula
from .._functions.layout import ArgumentLayout, place_of
from .._laws.bound import BoundInvariants
from .._problem.options import ExtensionOptions
from .._problem.sensitivities import Sensitivities, SensitivitiesLike
from .._results.messages import blamed_on
from .._results.result import Names, Origin, RunSource
from .._results.sensitivity_data import AtEvents, SensitivityData
from .._results.solution import Solution
from .expressions import leaves, substituted
from .reduction import GivenValues, Reduction

#: Operations of Python's code, at all points together, beyond which machine code is made instead.
_MANY_OPERATIONS = 1_000_000


class ValuesOverTime:
    """Nodes as a function of many points (t, state); compiled if that pays.

    Parameters
    ----------
    name : str
        What they are.
    make : function
        Makes the nodes when they are first needed.
    """

    def __init__(self, name: str, make: Callable[[], Sequence[Node]]) -> None:
        self._name, self._make = name, make
        self._code: Callable[..., Array] | None = None
        self._arrays: ArrayFunction | None = None

    @cached_property
    def nodes(self) -> list[Node]:
        """Nodes of the values."""
        return list(self._make())

    @cached_property
    def formula(self) -> Formula:
        """The nodes as a Python function."""
        return Formula(self._name, lambda: self.nodes, (len(self.nodes),))

    @cached_property
    def _operations(self) -> int:
        return sum(1 for node in in_order(self.nodes) if node.arguments)

    def __call__(self, t: Array, states: Array, p: Array) -> Array:
        """Return the values, (m, n_t), at the points in columns."""
        found = np.empty((len(self.nodes), len(t)))
        at = self._one(len(t))
        for k in range(len(t)):
            found[:, k] = at(float(t[k]), states[:, k], p)
        return found

    def at(self, t: float, state: Array, p: Array) -> Array:
        """Return the values, (m,), at one point."""
        return np.asarray(self.formula(t, state, *([p] if len(p) else [])), dtype=float)

    def general(self, t: Any, state: Sequence[Any], p: Sequence[Any]) -> Array:
        """Return the values for whatever numbers there are: complex ones, or those with which functions are traced."""
        if self._arrays is None:
            self._arrays = ArrayFunction(self.nodes)
        return np.array(self._arrays.code(t, state, p))

    def _one(self, points: int) -> Callable[..., Any]:
        many = points * self._operations > _MANY_OPERATIONS
        if self._code is None and many and find_spec("llvmlite") is not None:
            n = 1 + max(leaves(self.nodes), default=0)
            code = GraphFunction(self.formula)
            count = 1 + max((one.value for one in in_order(self.nodes) if one.op == "p"), default=-1)
            parameters = ArgumentLayout.single(count)
            self._code = as_python(code.native(n, len(self.nodes), parameters, event=False), len(self.nodes))
        return self._code or self.at

    def __getstate__(self) -> dict[str, Any]:
        return {
            "_name": self._name,
            "formula": self.formula,
            "nodes": None,
            "_code": None,
            "_arrays": None,
            "_make": None,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.nodes = self.formula.outputs


class Unknowns:
    """The unknowns of F as functions of t and the state of the reduced problem; the equations, for checks.

    `equations` are functions of `arguments`, the x_j^(l) in `variables`, which are functions of the state.

    Parameters
    ----------
    given : sequence of Given
        The unknowns of F in terms of those that are left after aliases.
    equations : sequence of Node
        The equations as they were given, in terms of these.
    reduction : Reduction
        Their reduction.
    """

    def __init__(self, given: Sequence[GivenValues], equations: Sequence[Node], reduction: Reduction) -> None:
        def user(more: int) -> list[Node]:
            found = reduction.of([(order + more, j) for j, order, _ in given])
            return [x if one.sign > 0 else x.graph.negative(x) for x, one in zip(found, given, strict=True)]

        self.y = ValuesOverTime("unknowns", lambda: user(0))
        self.yp = ValuesOverTime("rates", lambda: user(1))
        places = sorted(leaves(equations))
        self.variables = [divmod(place, reduction.n) for place in places]
        self.arguments = ValuesOverTime("arguments", lambda: reduction.of(self.variables))
        graph = reduction.graph
        renumbered = {graph.y(place): graph.y(k) for k, place in enumerate(places)}
        self.equations = ValuesOverTime("residuals", lambda: substituted(equations, renumbered))
        self.rests = ValuesOverTime(
            "rests", lambda: [node for _, rest in reduction.rests for row in rest for node in row.values()]
        )
        self.sensitive: dict[tuple[int | None, ...], ValuesOverTime] = {}
        self.count = len(reduction.states) or 1

    def sensitivities(self, t: Array, states: Array, S: Array, p: Array, places: tuple[int | None, ...]) -> Array:
        """Return ∂y/∂p, (n, k, n_t), from those of the states, (s, k, n_t); `places` of the parameters among the
        arguments."""
        if places not in self.sensitive:
            nodes, n = self.y.nodes, self.count
            made = Derived("unknowns", nodes, n, "own").tangents(places).fun.outputs
            self.sensitive[places] = ValuesOverTime("sensitivities", lambda: made)
        k = len(places)
        behind = np.swapaxes(S, 0, 1).reshape(-1, len(t))
        found = self.sensitive[places](t, np.concatenate([states, behind]), p)
        return np.swapaxes(found.reshape(k, -1, len(t)), 0, 1)


class DenseUnknowns:
    """The unknowns as a continuous function of t: ``sol(t)`` has shape (n,) or (n, n_t).

    Outside [t_min, t_max] it extrapolates; ``sol(t, extrapolate=False)`` raises a ValueError instead.

    Attributes
    ----------
    t_min, t_max : float
        The ends of the interval.
    ts : ndarray
        The ends of the steps.
    """

    _imposed = None

    def __init__(self, dense: Any, unknowns: Any, p: Array) -> None:
        self._dense_states, self._unknowns, self._p = dense, unknowns, p
        self.t_min, self.t_max, self.ts = dense.t_min, dense.t_max, dense.ts

    def __call__(self, t: ArrayLike, *, extrapolate: bool = True) -> Array:
        return self._values(self._unknowns.y, t, extrapolate)

    def yp(self, t: ArrayLike) -> Array:
        """Return y' at t, with the shape of y."""
        return self._values(self._unknowns.yp, t)

    def _values(self, values: Any, t: ArrayLike, extrapolate: bool = True) -> Array:
        times = real_numbers("t", t)
        states = self._dense_states(np.atleast_1d(times), extrapolate=extrapolate)
        found: Array = values(np.atleast_1d(times), states, self._p)
        return found[:, 0] if times.ndim == 0 else found


@dataclasses.dataclass
class _OnStates(BoundInvariants):
    """The invariants of the reduced problem, evaluated at its states where a solution asks for those of its y."""

    states: Array = dataclasses.field(kw_only=True)
    tolerances: tuple[ArrayLike, ArrayLike] = dataclasses.field(kw_only=True)

    @classmethod
    def of(cls, sol: Solution) -> _OnStates:
        """Return the invariants of a solution of the reduced problem."""
        bound = sol._invariants
        fields = {one.name: getattr(bound, one.name) for one in dataclasses.fields(BoundInvariants)}
        return cls(**fields, states=sol.y, tolerances=(sol._rtol, sol._atol))

    def departure(self, t: Array, y: Array, pieces: Array | None = None) -> Array:
        return super().departure(t, self.states, pieces)

    def distance(self, t: Array, y: Array, rtol: ArrayLike, atol: ArrayLike, pieces: Array | None = None) -> Array:
        return super().distance(t, self.states, *self.tolerances, pieces)


class _OriginOfUnknowns(Origin):
    """Origin of a solution of a DAE: the reduced solution, and the way back to the unknowns.

    Parameters
    ----------
    reduced : Solution
        The solution of the reduced problem.
    reduction : Reduction or ResidualForm
        How it was reduced.
    present : callable
        ``present(solution, on_failure=None)`` expresses another solution of the reduced problem in the unknowns.
    unknowns : callable
        ``unknowns(t, state)``.
    derivatives : callable or None
        ``derivatives(t, names)``, those of the unknowns for the state, (n, s, m), and for parameters, (n, k, m), at
        times (m,). None: F has no expressions.
    """

    source: RunSource

    def __init__(
        self,
        reduced: Solution,
        reduction: Any,
        present: Callable[..., Solution],
        unknowns: Callable[[float, Array], Array],
        derivatives: Callable[[Array, Sequence[Any]], tuple[Array, Array]] | None,
    ) -> None:
        self.reduced, self.reduction, self.present, self.unknowns = reduced, reduction, present, unknowns
        self.derivatives = derivatives
        self.source, self.y = reduced._source, reduced._run.y

    def extend(self, sol: Solution, t_end: float, options: ExtensionOptions) -> Solution:
        """See `Solution.extend`."""
        own = options.copy()
        on_failure = own.pop("on_failure", None)
        own["on_failure"] = "return"
        if (callback := own.get("callback")) is not None:
            own["callback"] = lambda t, state: callback(t, self.unknowns(t, state))
        return self.present(self.reduced.extend(t_end, **own), on_failure)

    def gradient(
        self,
        sol: Solution,
        dG_dy: ArrayLike | None,
        dG_dp: ArrayLike | None,
        wrt: SensitivitiesLike | None,
        t: ArrayLike | None,
        integrand: Callable[..., Any] | None,
    ) -> Array:
        """See `Solution.gradient`: of a function of the unknowns, which are functions of the state and of the
        parameters. Initial values among the parameters are those of the reduced problem."""
        if self.derivatives is None:
            raise ValueError("gradient needs the expressions of F, which cannot be traced")
        if integrand is not None:
            raise ValueError("gradient of a DAE takes no integrand: make the integral an unknown with its own equation")
        reduced, problem = self.reduced, self.source.problem
        if wrt is not None or problem.sensitivities is None:
            problem = problem.replace(sensitivities=wrt if wrt is not None else Sensitivities())
        names = problem.parameter_names()
        if dG_dy is None:
            return np.asarray(reduced.gradient(None, dG_dp, wrt, t=t))
        costs = real_numbers("dG_dy", dG_dy)
        single = costs.ndim == 1
        costs = costs[:, None] if single else costs
        if t is None:
            times = np.array([sol.t_end]) if costs.shape[1] == 1 else sol.t
        else:
            times = np.atleast_1d(real_numbers("t", t))
        if costs.shape != (len(sol.y), len(times)):
            raise ValueError(f"dG_dy must have shape ({len(sol.y)}, {len(times)}), got {np.shape(dG_dy)}")
        of_state, of_p = self.derivatives(times, names)
        direct = np.einsum("im,ikm->k", costs, of_p)
        if dG_dp is not None:
            direct = direct + real_numbers("dG_dp", dG_dp)
        return np.asarray(reduced.gradient(np.einsum("im,ism->sm", costs, of_state), direct, wrt, t=times))

    def parameters(self) -> Array | None:
        """See `Origin.parameters`: the reduced problem has the same ones."""
        return self.reduced._run.parameters()


class DaeSolution(Solution):
    """A solution of a DAE: a `Solution` in the unknowns of F, in their order.

    Attributes
    ----------
    y, yp : ndarray, (n, n_t)
        The unknowns, algebraic ones included, and their derivatives.
    """

    @property
    def yp(self) -> Array:
        """y' at the outputs, (n, n_t), computed when it is first needed."""
        found: Array = self["yp"]
        return found

    def __missing__(self, key: Any) -> Any:
        rates = self.__dict__.pop("_rates", None) if key == "yp" else None
        if rates is None:
            return super().__missing__(key)
        self["yp"] = found = rates()
        return found

    def __getstate__(self) -> dict[str, Any]:
        if "_rates" in self.__dict__:
            self["yp"]  # which a copy cannot compute
        return super().__getstate__()

    @property
    def reduced(self) -> Solution:
        """The solution of the reduced problem, in its states."""
        return cast("_OriginOfUnknowns", self._run).reduced

    def impose(self) -> Solution:
        """Project the values to roundoff onto all constraints.

        Returns
        -------
        Solution
        """
        reduced = self.reduced.impose()
        return cast("_OriginOfUnknowns", self._origin).present(reduced)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Save t, y, yp, events, counts and residuals to a file that ``invariode.load`` reads.

        Parameters
        ----------
        path : str or path-like
            The file.

        Notes
        -----
        The continuous solution and what an extension needs belong to the reduced problem: save ``sol.reduced`` to
        keep these, and load it with ``dae.problem(...)``.
        """
        if self.sol is not None:
            warn("save keeps the outputs of a DAE, and leaves out sol(t): save sol.reduced to keep it")
        Solution.save(self.changed(sol=None, _origin=None), path)


def in_unknowns(
    sol: Solution, unknowns: Any, p: Array, labels: Sequence[str], reduction: Any, present: Callable[..., Solution]
) -> DaeSolution:
    """Return a solution of the reduced problem in the unknowns of F."""
    states = sol.y
    y = unknowns.y(sol.t, states, p)
    y_events = None
    if sol.y_events is not None:
        y_events = sol.y_events.replaced(
            unknowns.y(t, np.reshape(found, (len(t), len(states))).T, p).T if len(t) else np.zeros(0)
            for t, found in zip(sol.t_events, sol.y_events, strict=True)
        )
    names = sol._names
    private = {
        "_invariants": _OnStates.of(sol),
        "_rtol": sol._rtol,
        "_atol": sol._atol if np.ndim(sol._atol) == 0 else float(np.min(sol._atol)),
        "_drift": sol._drift,
        "_y_end": unknowns.y(np.array([sol.t_end]), sol.y_end[:, None], p)[:, 0],
        "_names": Names(names.problem, names.title, list(labels), len(labels), names.events),
        "_sensitivities": _sensitivities(sol, unknowns, p),
        "_rates": lambda: unknowns.yp(sol.t, states, p),
        "_origin": _OriginOfUnknowns(
            sol, reduction, present, lambda t, state: unknowns.y.at(t, state, p), _derivatives(sol, unknowns, p)
        ),
    }
    dense = None if sol.sol is None else DenseUnknowns(sol.sol, unknowns, p)
    message = blamed_on("F", sol.message)
    return DaeSolution(private, **{**sol, "y": y, "sol": dense, "y_events": y_events, "message": message})


def _sensitivities(sol: Solution, unknowns: Any, p: Array) -> SensitivityData | None:
    known = sol._sensitivities
    if known is None:
        return None
    problem = sol._source.problem
    places = tuple(_place(one, problem.args) for one in problem.parameter_names())
    values = unknowns.sensitivities(sol.t, sol.y, known.values, p, places)
    end = unknowns.sensitivities(np.array([sol.t_end]), sol._run.y[:, None], known.end[:, :, None], p, places)
    return SensitivityData(known.names, values, end[:, :, 0], _at_events(sol, unknowns, p, places))


def _at_events(sol: Solution, unknowns: Any, p: Array, places: tuple[int | None, ...]) -> AtEvents | None:
    """Return the derivatives of times of events, and those of the unknowns there; after an action, whose state is not
    kept, these are NaN."""
    known = None if sol._sensitivities is None else sol._sensitivities.events
    if known is None or sol.y_events is None:
        return None
    before, after = [], []
    for t, states, S, behind in zip(sol.t_events, sol.y_events, known.before, known.after, strict=True):
        if not len(t):
            none = np.zeros((0, len(unknowns.y.nodes), len(places)))
            before.append(none)
            after.append(none)
            continue
        found = unknowns.sensitivities(t, np.asarray(states).T, np.moveaxis(S, 0, 2), p, places)
        before.append(np.moveaxis(found, 2, 0))
        same = np.array([np.array_equal(a, b) for a, b in zip(S, behind, strict=True)])
        after.append(np.where(same[:, None, None], before[-1], np.nan))
    return AtEvents(before, after, known.times)


def _derivatives(
    sol: Solution, unknowns: Any, p: Array
) -> Callable[[Array, Sequence[Any]], tuple[Array, Array]] | None:
    if not hasattr(unknowns, "sensitivities"):
        return None

    def found(times: Array, names: Sequence[Any]) -> tuple[Array, Array]:
        args, s, m = sol._source.problem.args, len(sol.y), len(times)
        if sol.sol is not None:
            states = sol.sol(times)
        else:
            ends = {float(t): sol.y[:, i] for i, t in enumerate(sol.t)} | {float(sol.t_end): sol.y_end}
            if not {*times.tolist()} <= ends.keys():
                raise ValueError("gradient: values at other times than those of the outputs need dense_output=True")
            states = np.array([ends[t] for t in times.tolist()]).T
        unit = np.repeat(np.eye(s)[:, :, None], m, axis=2)
        of_state = unknowns.sensitivities(times, states, unit, p, (None,) * s)
        places = tuple(_place(one, args) for one in names)
        of_p = unknowns.sensitivities(times, states, np.zeros((s, len(places), m)), p, places)
        return of_state, of_p

    return found


def _place(parameter: Any, args: tuple[Any, ...]) -> int | None:
    return None if parameter.kind == "y0" else place_of(args, parameter.index, parameter.item)
