"""The equations of motion of a constrained mechanical system, in the form the core evaluates."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import Array
from .._base.matrices import compressed
from .._functions.compiled import (
    Callback,
    CompiledFunction,
    CoreFunction,
    Part,
    is_native,
    native_parameters,
    to_native,
)
from .._functions.graph.function import TracedFunction
from .._functions.increments import somewhere
from .._functions.layout import ArgumentLayout
from .._laws.jacobians import SparseJacobian
from .._problem.core_problem import MechanicsTerms
from .differentiable import Differentiable, full_pattern
from .motion_graph import MOST_UNKNOWNS, GraphsOfMotion, OfState, of_state

#: Rows of the constraints that depend on others to within this part of their length are left out of a solve. Their
#: derivatives are exact to roundoff, or from differences of order 4, good to 1e-11.
DEPENDENT = 1e-10
#: Matrices with this many columns, of which at most this fraction of the entries is not zero, are sparse in Python too.
MANY_COLUMNS, FEW_ENTRIES = 100, 0.1
#: From this many entries on it is worth knowing which entries of M are always zero.
_LARGE = 500
#: The patterns of M and Φ are sought at q, and at this distance from it, in units of the sizes of its components.
_BESIDE = (0.1, -0.07)

#: Beyond the end of a run that failed, a function that is not finite is sought up to 2 to this power smallest steps.
_STEPS_BEYOND = 12

#: A constraint that is left out is violated where it is off by this many tolerances, as is a correction that a step may
#: not make, times those by which the others are off; or by this part of its terms, if these are larger.
_VIOLATED = 100
_ROUNDOFF = 1e-11

#: What the slope of a problem takes before further arguments.
_STATE = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("t", "y")]

Columns = tuple[Array, Array, Array]  # a sparse matrix: starts of its columns, rows, values


class MotionPoint(NamedTuple):
    """A state of the system, and the extra arguments of its functions."""

    t: float
    q: Array
    v: Array
    args: tuple[Any, ...]

    @property
    def x(self) -> Array:
        """(q, v) as one array."""
        return np.concatenate([self.q, self.v])


class Accelerations(NamedTuple):
    """v' and the multipliers λ of all constraints."""

    a: Array
    multipliers: Array
    unique: bool  # M is definite on the null space of the constraints


class Functions(NamedTuple):
    """Functions that the user passes: `mass` may be constant, the rest functions or None."""

    mass: Any
    force: Any
    constraints: Any
    velocity_constraints: Any
    kinematics: Any
    jacobian: Any
    counts: dict[str, int]  # number of values, which a native function does not say


class Motion:
    """M v' = Q + Aᵀ λ, q' = K(t, q, v), φ(t, q) = 0, ψ(t, q, v) = 0.

    - `functions`: the user's
    - `start`: a point at which the functions are tried

    Attributes:
    - `kept`, (m,): which constraints are imposed, those of φ first
    - `names`: of all constraints, for messages
    - `derivatives`: how the derivatives of each function are formed
    """

    def __init__(self, functions: Functions, start: MotionPoint) -> None:
        self.n_q, self.n_v = len(start.q), len(start.v)
        called = [one for one in functions[:-1] if one is not None]
        self.native = any(map(is_native, called))
        self._called, self._force = called, functions.force
        p = self._parameters(start.args)
        self._core_functions: dict[str, Any] = {"mass": None, "jacobian": None}
        self._core_functions["force"] = to_native(
            "force(t, q, v)", functions.force, self.n_q + self.n_v, self.n_v, p, second=self.n_v
        )
        self.derivatives: dict[str, str] = {}
        self._patterns: dict[str, Columns] = {}
        at_q, at_x = (start.q,), (start.q, start.v)
        self.m_phi = self._differentiate("constraints", "(t, q)", functions, start, at_q)
        self.m_psi = self._differentiate("velocity_constraints", "(t, q, v)", functions, start, at_x)
        mapped = self._differentiate("kinematics", "(t, q, v)", functions, start, at_x)
        if mapped and mapped != self.n_q:
            raise ValueError(f"kinematics(t, q, v) returned shape ({mapped},), expected ({self.n_q},), the shape of q0")
        self.has_map = mapped > 0
        self._mass_writes, self._mass = self._choose_mass(functions.mass, start, p)
        self._jacobian_entries = False
        if functions.jacobian is not None:
            self._take_jacobian(functions.jacobian, start, p)
        self.names = [f"constraint {i + 1}" for i in range(self.m)]
        self.kept = np.ones(self.m, dtype=bool)
        self._sparse = True
        self._graphs = self._graphs_of(functions)
        self._specs: dict[bytes, MechanicsTerms] = {}
        self._parts: dict[tuple[bytes, str], _core.MotionPart] = {}
        self._idle: dict[bytes, tuple[tuple[Any, ...], _core.Motion]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_specs": {}, "_parts": {}, "_idle": {}}  # what belongs to the core is made again

    @property
    def further(self) -> list[inspect.Parameter]:
        """The arguments of the force after t, q and v; any number of them, where it does not name them."""
        compiled = isinstance(self._force, CompiledFunction)
        first = 3 + bool(compiled and self._force.inplace)
        with suppress(TypeError, ValueError):  # machine code
            python = self._force.fun if compiled else self._force
            found = [*inspect.signature(python).parameters.values()][first:]
            if not compiled or len(found) != 1:  # it may be an array of all of them
                return found
        return [inspect.Parameter("args", inspect.Parameter.VAR_POSITIONAL)]

    # ------------------------------------------------------------------------------------------------------------------
    # The user's functions

    def _differentiate(
        self, name: str, signature: str, functions: Functions, start: MotionPoint, parts: tuple[Array, ...]
    ) -> int:
        """Store the function with its derivatives; return the number of its values."""
        function = getattr(functions, name)
        n = sum(len(part) for part in parts)
        if function is None:
            self._core_functions[name], self._patterns[name] = None, full_pattern(0, n)
            return 0
        of = Differentiable(function, start.t, parts, start.args, name + signature, functions.counts.get(name))
        self._core_functions[name] = of.forms
        self._patterns[name] = of.pattern(start.t, np.concatenate(parts))
        self.derivatives[name] = of.how
        return of.m

    def _choose_mass(self, mass: Any, start: MotionPoint, p: ArgumentLayout) -> tuple[str, Columns]:
        """Return what the function of the mass writes, and the matrix or its pattern."""
        n = self.n_v
        if not callable(mass) and not is_native(mass):
            return "nothing", _columns(_square(mass, n))
        if isinstance(mass, CompiledFunction) and not mass.inplace:
            returned: Any = np.asarray(mass.at(start.t, start.q.copy(), parameters=p), dtype=float)
        elif is_native(mass):
            returned = np.ones((n, n))
        else:
            returned = mass(start.t, start.q.copy(), *start.args)
        if hasattr(returned, "toarray"):
            entries, pattern = _entries(mass, "mass(t, q)", returned, (n, n), start)
            self._core_functions["mass"] = entries
            return "entries", pattern
        shape = _square(returned, n).shape
        size = n if len(shape) == 1 else n * n
        self._core_functions["mass"] = to_native("mass(t, q)", mass, self.n_q, size, p)
        if len(shape) == 1:
            return "diagonal", _columns(np.ones(n))
        if n * n < _LARGE or is_native(mass):
            return "rows", full_pattern(n, n)
        return "rows", _pattern_of_matrix(mass, start, (n, n))

    def _take_jacobian(self, jacobian: Any, start: MotionPoint, p: ArgumentLayout) -> None:
        shape = (self.m_phi, self.n_q)
        self.derivatives["constraints"] = f"given and {self.derivatives['constraints']}"
        returned = None if is_native(jacobian) else jacobian(start.t, start.q.copy(), *start.args)
        if hasattr(returned, "toarray"):
            entries, pattern = _entries(jacobian, "jacobian(t, q)", returned, shape, start)
            self._core_functions["jacobian"] = entries
            self._patterns["constraints"], self._jacobian_entries = pattern, True
        else:
            native = to_native("jacobian(t, q)", jacobian, self.n_q, self.m_phi * self.n_q, p)
            self._core_functions["jacobian"] = native
            if self.m_phi * self.n_q >= _LARGE and not is_native(jacobian):
                known = _dense(self._patterns["constraints"], self.m_phi)
                self._patterns["constraints"] = compressed(
                    known + _dense(_pattern_of_matrix(jacobian, start, shape), self.m_phi)
                )

    def _graphs_of(self, functions: Functions) -> GraphsOfMotion:
        given = {
            "force": OfState(functions.force, True, self.n_v),
            "constraints": OfState(functions.constraints, False, self.m_phi),
            "velocity_constraints": OfState(functions.velocity_constraints, True, self.m_psi),
            "kinematics": OfState(functions.kinematics, True, self.n_q if self.has_map else 0),
        }
        if self._mass_writes == "nothing":
            mass = _dense(self._mass, self.n_v) if self.n_v <= MOST_UNKNOWNS else None
            return GraphsOfMotion(self.n_q, self.n_v, given, mass)
        if self._mass_writes != "entries":
            size = self.n_v if self._mass_writes == "diagonal" else self.n_v**2
            given["mass"] = OfState(functions.mass, False, size)
        return GraphsOfMotion(self.n_q, self.n_v, given)

    def on_graph(self, part: str) -> TracedFunction | None:
        """Return the slope or an invariant for tracing; None: it depends on machine code, or on sparse matrices."""
        return self._graphs.of(part, self.kept)

    @property
    def parts(self) -> list[Part]:
        """The user's functions that Python can call."""
        sizes = (self.n_q, 0), (self.n_q + self.n_v, self.n_v)
        given = self._graphs.functions.values()
        return [Part(one.function, *sizes[one.of_v], one.size) for one in given if one.may_be_traced]

    def _parameters(self, args: tuple[Any, ...]) -> ArgumentLayout:
        return native_parameters(args, self._called)

    # ------------------------------------------------------------------------------------------------------------------
    # The core's form

    @property
    def m(self) -> int:
        """Number of all constraints."""
        return self.m_phi + self.m_psi

    def spec(self, kept: Array | None = None) -> MechanicsTerms:
        """Return the system for the core; `kept`: which constraints it imposes."""
        imposed = self.kept if kept is None else kept
        key = imposed.tobytes()
        if key not in self._specs:
            self._specs[key] = MechanicsTerms(
                n_q=self.n_q,
                n_v=self.n_v,
                m_phi=self.m_phi,
                m_psi=self.m_psi,
                functions=self._core_functions,
                mass_writes=self._mass_writes,
                mass=self._mass,
                jacobian_entries=self._jacobian_entries,
                phi=self._patterns["constraints"],
                psi=self._patterns["velocity_constraints"],
                kinematics=self._patterns["kinematics"],
                kept=imposed.tolist(),
                sparse=self._sparse,
                dependent=DEPENDENT,
            )
        return self._specs[key]

    def part(self, name: str) -> _core.MotionPart:
        """Return one of the motion's functions for the core, always the same object."""
        key = (self.kept.tobytes(), name)
        if key not in self._parts:
            self._parts[key] = _core.MotionPart(self.spec(), name)
        return self._parts[key]

    @contextmanager
    def bound(self, args: tuple[Any, ...], kept: Array | None = None) -> Iterator[_core.Motion]:
        """Lend the motion with these arguments, for evaluations in Python; it is not shared meanwhile."""
        spec = self.spec(kept)
        key = (self.kept if kept is None else kept).tobytes()
        known = self._idle.pop(key, None)
        if known is None or known[0] is not args:
            known = (args, _core.Motion(spec, args, self._parameters(args).numbers.tolist()))
        yield known[1]
        self._idle[key] = known

    def choose_factors(self, points: Sequence[MotionPoint]) -> None:
        """Disable sparse factors if they fail at all of these points."""
        core = _core.Motion(self.spec(), points[0].args, self._parameters(points[0].args).numbers.tolist())
        if not core.sparse:
            return
        for at in points:
            core.accelerations(at.t, at.x)
        if core.work["dense"] == core.work["sparse"]:
            self._sparse, self._specs, self._parts, self._idle = False, {}, {}, {}

    # ------------------------------------------------------------------------------------------------------------------
    # Values at a point; all constraints

    @property
    def _all(self) -> Array:
        return np.ones(self.m, dtype=bool)

    def mass(self, at: MotionPoint) -> Any:
        """Return M, (n_v, n_v); like the rows of constraints sparse, if it is large and most entries are zero."""
        with self.bound(at.args) as motion:
            return _assembled(motion.mass(at.t, at.x), self.n_v)

    def metric(self) -> Any:
        """Return M as the metric of corrections: constant, its diagonal if that is all, or a function of t and (q, v).

        None if M is sparse with off-diagonal entries: corrections in that metric would cost more than they gain.
        """
        starts, rows, values = self._mass
        diagonal = np.array_equal(rows, np.arange(self.n_v)) and np.array_equal(starts, np.arange(self.n_v + 1))
        if not diagonal and self.is_sparse:
            return None
        if self._mass_writes != "nothing":
            return MotionFunction(self, "mass")
        return values.copy() if diagonal else _dense(self._mass, self.n_v)

    @property
    def is_sparse(self) -> bool:
        """Return whether the core tries sparse factors first."""
        return _core.Motion(self.spec(), (), []).sparse

    def slope(self, at: MotionPoint) -> Array:
        """Return (q', v'), (n_q + n_v,)."""
        with self.bound(at.args) as motion:
            return motion.evaluate("slope", at.t, at.x)

    def _evaluated(self, part: str, at: MotionPoint) -> Array:
        with self.bound(at.args, self._all) as motion:
            return motion.evaluate(part, at.t, at.x)

    def positions(self, at: MotionPoint) -> Array:
        """Return the residuals φ of the constraints of positions."""
        return self._evaluated("positions", at) if self.m_phi else np.zeros(0)

    def positions_jacobian(self, at: MotionPoint) -> Any:
        """Return Φ = ∂φ/∂q."""
        if not self.m_phi:
            return np.zeros((0, self.n_q))
        if not self.has_map and _is_sparse(len(self._patterns["constraints"][1]), self.m_phi, self.n_q):
            return self.rows(at)[: self.m_phi]
        return self._evaluated("positions_jacobian", at).reshape(self.m_phi, -1)[:, : self.n_q]

    def rates(self, at: MotionPoint) -> Array:
        """Return (φ', ψ), which consistent velocities make zero."""
        parts = [self._evaluated("rates", at)] if self.m_phi else []
        parts += [self._evaluated("velocities", at)] if self.m_psi else []
        return np.concatenate(parts) if parts else np.zeros(0)

    def rows(self, at: MotionPoint) -> Any:
        """Return A = (Φ K_v, ψ_v), of shape (m, n_v)."""
        with self.bound(at.args, self._all) as motion:
            return _assembled(motion.rows(at.t, at.x)[0], self.m)

    def violated(self, at: MotionPoint, weights: Array) -> list[int]:
        """Return the constraints that are not imposed and are off by many tolerances `weights` of (q, v)."""
        phi, psi = self.kept[: self.m_phi], self.kept[self.m_phi :]
        off = np.zeros(self.m, dtype=bool)
        if not phi.all():
            w = weights[: self.n_q]
            off[: self.m_phi] = _far(self.positions(at), self.positions_jacobian(at), at.q, w, phi)
        if not psi.all():
            w = weights[self.n_q :]
            off[self.m_phi :] = _far(self.rates(at)[self.m_phi :], self.rows(at)[self.m_phi :], at.v, w, psi)
        return np.flatnonzero(off).tolist()

    def accelerations(self, at: MotionPoint, every: bool = False) -> Accelerations:
        """Return v' and λ; `every`: with redundant constraints too, λ is then the one of least norm."""
        with self.bound(at.args, self._all if every else self.kept) as motion:
            return Accelerations(*motion.accelerations(at.t, at.x))

    def undefined(self, at: MotionPoint) -> str | None:
        """Return the name of a function of the user's that is not finite at a point, or a singular mass; None if the
        accelerations are finite."""
        with np.errstate(all="ignore"):
            mass, rates, slope = self.mass(at), self.rates(at), self.slope(at)
            force = slope if is_native(self._force) else self._force(at.t, at.q, at.v, *at.args)
            parts = {
                "mass": mass.data if hasattr(mass, "tocsc") else mass,
                "constraints": np.concatenate([self.positions(at), rates[: self.m_phi]]),
                "velocity_constraints": rates[self.m_phi :],
                "kinematics": slope[: self.n_q],
                "force": force,
            }
            singular = None if np.isfinite(slope).all() else "mass"
        return next((name for name, values in parts.items() if not np.isfinite(values).all()), singular)


class MotionFunction(CoreFunction):
    """A function of (t, y, *args) with y = (q, v) that a motion has: its slope, one of its laws or their Jacobians."""

    def __init__(self, motion: Motion, part: str) -> None:
        self._motion, self._part, self.functions = motion, part, motion._called
        self.__name__ = self.__qualname__ = "mechanism" if part == "slope" else part
        self.__signature__ = inspect.Signature([*_STATE, *motion.further])

    def __repr__(self) -> str:
        return f"<the {self._part.replace('_', ' ')} of a mechanical system>"

    def __call__(self, t: float, y: Any, *args: Any) -> Array:
        if np.iscomplexobj(y):
            raise TypeError(f"the {self._part} of a mechanical system is a function of real states")
        with self._motion.bound(args) as motion:
            values = motion.evaluate(self._part, float(t), np.ascontiguousarray(y, dtype=float))
        if self._part == "mass" and len(values) > self._motion.n_v:
            return values.reshape(self._motion.n_v, -1)
        return values.reshape(-1, self._motion.n_q + self._motion.n_v) if self._part.endswith("jacobian") else values

    @property
    def native(self) -> bool:  # type: ignore[override]  # a constant for others
        return self._motion.native

    @property
    def parts(self) -> list[Part]:  # type: ignore[override]  # a constant for others
        return self._motion.parts

    @property
    def positions(self) -> int:  # type: ignore[override]  # a constant for others
        return self._motion.n_q

    @property
    def derivatives(self) -> dict[str, str]:  # type: ignore[override]  # a constant for others
        """Methods by which the derivatives of the constraints are formed."""
        return self._motion.derivatives

    def on_graph(self) -> TracedFunction | None:
        return self._motion.on_graph(self._part)

    def watch(
        self, t0: float, y0: Array, args: tuple[Any, ...], rtol: ArrayLike, atol: ArrayLike, callback: Callback
    ) -> LeftOut | None:
        motion = self._motion
        if motion.kept.all():
            return None
        return LeftOut(motion, MotionPoint(t0, y0[: motion.n_q], y0[motion.n_q :], args), rtol, atol, callback)

    def undefined_near(self, t: float, y: Array, h: float, args: tuple[Any, ...]) -> str | None:
        n, slope = self._motion.n_q, self(t, y, *args)
        for step in (0.0, *(h * 2.0**k for k in range(_STEPS_BEYOND))):
            there = y + step * np.where(np.isfinite(slope), slope, 0.0)
            if found := self._motion.undefined(MotionPoint(t + step, there[:n], there[n:], args)):
                return found
        return None

    def for_core(self, n: int, size: int, parameters: ArgumentLayout) -> _core.MotionPart:
        return self._motion.part(self._part)


class LeftOut:
    """Test of the constraints that a motion leaves out, a `Watch`.

    It is the callback of a run, which sees each accepted step, kept or not, and ends the run at the first one after
    which a constraint does not hold.

    - `motion`: of which constraints are left out
    - `start`: where the run starts, with its arguments
    - `rtol`, `atol`: the tolerances of the run
    - `callback`: the user's

    Attributes:
    - `objection`: which constraint does not hold, and at which t the run ends for it
    """

    def __init__(
        self, motion: Motion, start: MotionPoint, rtol: ArrayLike, atol: ArrayLike, callback: Callback
    ) -> None:
        self._motion, self._start, self._callback = motion, start, callback
        self._rtol, self._atol = np.asarray(rtol, dtype=float), np.asarray(atol, dtype=float)
        self.objection: str | None = None
        self._look(start)

    def __call__(self, t: float, y: Array) -> bool:
        """Return whether the run is to stop at the end of a step."""
        stop = self._callback is not None and bool(self._callback(t, y))
        if self.objection is None:
            n = self._motion.n_q
            self._look(self._start._replace(t=float(t), q=y[:n], v=y[n : n + self._motion.n_v]))
        return stop or self.objection is not None

    def _look(self, at: MotionPoint) -> None:
        off = self._motion.violated(at, np.maximum(self._rtol * np.abs(at.x), self._atol))
        if not off:
            return
        self.objection = (
            f"{self._motion.names[off[0]]} depended on the others at the start, and was left out as redundant; "
            f"at t = {at.t:.6g} it is independent and does not hold: the solution is wrong from there on, or shortly "
            "before. Start from another position, where no constraints depend on each other, or remove those that do "
            "everywhere"
        )


class FunctionOfState(CoreFunction):
    """A user's ``function(t, q, v, *args)`` as one of (t, y, *args) with y = (q, v)."""

    def __init__(self, function: Any, n_q: int, n_v: int, name: str) -> None:
        self._function, self._n_q, self._n_v, self.functions = function, n_q, n_v, [function]
        self.__name__ = self.__qualname__ = name

    def __call__(self, t: Any, y: Array, *args: Any) -> Any:
        if isinstance(self._function, CompiledFunction) and args:
            parameters = native_parameters(args, [self._function])
            return self._function.at(t, y[: self._n_q], y[self._n_q :], parameters=parameters)
        return self._function(t, y[: self._n_q], y[self._n_q :], *args)

    @property
    def native(self) -> bool:  # type: ignore[override]  # a constant for others
        return is_native(self._function)

    def on_graph(self) -> TracedFunction | None:
        return of_state(OfState(self._function, True, 1), self._n_q)

    def for_core(self, n: int, size: int, parameters: ArgumentLayout) -> Any:
        return to_native(self.__name__, self._function, n, size, parameters, second=self._n_v) if self.native else self


# ----------------------------------------------------------------------------------------------------------------------
# Matrices


def _far(residual: Array, rows: Any, x: Array, weights: Array, kept: Array) -> Array:
    """Return which residuals of constraints that are not kept are many tolerances `weights` of x away from 0, (m,).

    Where they depend on those that are kept, they are off as far as these are, which may be held only roughly.
    """
    tolerances = lengths(rows * weights)
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.nan_to_num(np.abs(residual) / tolerances, posinf=0.0)[kept].max(initial=1.0)
    size = np.maximum(_VIOLATED * off * tolerances, _ROUNDOFF * (abs(rows) @ np.abs(x)))
    far: Array = (np.abs(residual) > size) & ~kept
    return far


def _square(given: Any, n: int) -> Any:
    """Return the mass as given, (n,), (n, n) or sparse, of numbers."""
    mass = given if hasattr(given, "toarray") else np.asarray(given, dtype=float)
    if mass.shape not in ((n,), (n, n)):
        raise ValueError(f"mass must have shape ({n},) or ({n}, {n}), as v0 has {n} components, got {mass.shape}")
    return mass


def _columns(mass: Any) -> Columns:
    """Return a diagonal, a dense matrix or a sparse one as compressed columns."""
    if hasattr(mass, "toarray"):
        sparse = mass.tocsc().astype(float)
        sparse.sum_duplicates()
        return sparse.indptr.astype(np.int32), sparse.indices.astype(np.int32), sparse.data.copy()
    if mass.ndim == 1:
        n = len(mass)
        return np.arange(n + 1, dtype=np.int32), np.arange(n, dtype=np.int32), mass.copy()
    return compressed(mass)


def _is_sparse(entries: int, m: int, n: int) -> bool:
    """Return whether a matrix is to be sparse outside the core."""
    return n >= MANY_COLUMNS and entries <= FEW_ENTRIES * m * n


def _assembled(columns: tuple[Any, Any, Any], rows: int) -> Any:
    """Return the matrix, dense, or by sparse rows if it is large and few entries are not zero."""
    starts, indices, values = columns
    n = len(starts) - 1
    if not _is_sparse(int(np.count_nonzero(values)), rows, n):
        return _dense(columns, rows)
    from scipy.sparse import csc_array  # takes longer to import than everything else

    matrix = csc_array((values, indices, starts), shape=(rows, n))
    matrix.eliminate_zeros()
    return matrix.tocsr()


def vanishing(rows: Any) -> Array:
    """Return which rows of a matrix, dense or sparse, are 0, (m,)."""
    return np.asarray(abs(rows).sum(axis=1) == 0)


def lengths(rows: Any) -> Array:
    """Return the Euclidean norms of the rows of a matrix, dense or sparse."""
    if not hasattr(rows, "toarray"):
        return np.asarray(np.linalg.norm(rows, axis=1))
    from scipy.sparse.linalg import norm

    return np.asarray(norm(rows, axis=1))


def _dense(columns: tuple[Any, Any, Any], rows: int) -> Array:
    starts, indices, values = columns
    dense = np.zeros((rows, len(starts) - 1))
    dense[np.asarray(indices, dtype=int), np.repeat(np.arange(len(starts) - 1), np.diff(starts))] = values
    return dense


def _beside(start: MotionPoint) -> Iterator[Array]:
    """Yield positions near the start, where nothing vanishes by chance."""
    for part in _BESIDE:
        yield start.q + part * somewhere(start.q)


def _entries(
    function: Callable[..., Any], name: str, at_start: Any, shape: tuple[int, int], start: MotionPoint
) -> tuple[SparseJacobian, Columns]:
    """Return the entries of a sparse matrix by columns, all that it stores at the start and near it, and their
    pattern."""
    known = [at_start, *(function(start.t, q, *start.args) for q in _beside(start))]
    entries = SparseJacobian(function, name, known, shape, by_columns=True)
    starts, rows = (np.array(one, dtype=np.int32) for one in entries.pattern)
    return entries, (starts, rows, np.ones(len(rows)))


def _pattern_of_matrix(function: Callable[..., Any], start: MotionPoint, shape: tuple[int, int]) -> Columns:
    """Return the pattern of a dense matrix of (t, q): entries that are not zero at some points, or that depend on q."""
    entries = np.zeros(shape, dtype=bool)
    for q in (start.q.copy(), *_beside(start), np.full(len(start.q), np.nan)):
        try:
            with np.errstate(all="ignore"):
                entries |= ~(np.asarray(function(start.t, q, *start.args), dtype=float) == 0)
        except (ValueError, ArithmeticError):
            return full_pattern(*shape)
    return compressed(entries)
