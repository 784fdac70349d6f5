"""The matrices of an implicit method, ∂f/∂y and M, brought into the form that the core takes.

Dense ones need neither SciPy's sparse matrices nor LAPACK, which take longer to import than a first run takes: they are
imported where a matrix is sparse, wide in its bands, or large.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._base.arguments import Array, warn
from .._base.matrices import as_dense, as_matrix, compressed, is_sparse
from .._functions.compiled import NativeWithInputs, is_native, to_native
from .._functions.derivatives import way_of
from .._functions.graph.derived import Derived, derived, native
from .._functions.increments import compiled_at_complex, python_at_complex
from .._functions.layout import ArgumentLayout
from .._problem.bounds import Bounds
from .._problem.core_problem import LinearTerms
from .._problem.jacobian_and_mass import Matrices
from .krylov import Krylov, is_operator
from .null_space import null_space, roundoff, whole
from .sparsity import find_pattern, is_large, is_sparse_enough

if TYPE_CHECKING:
    import scipy.sparse as sp

_DENSE_LIMIT = 2**30  # bytes: a larger dense Jacobian draws a warning
_SMALL = 64  # n up to which the null space of M is sought by elimination of all its rows
_NULL_SPACE_LIMIT = 3000  # n up to which a null space that is not evident is computed
_NEARLY_WHOLE = 1e-6  # relative distance from whole numbers, within which they are tried
_SINGULAR_GROWTH = 1e13  # of a solution over its right-hand side, with rows and columns scaled


#: Compressed columns (starts, rows, values) of a matrix without columns.
_NO_COLUMNS = (np.zeros(1, dtype=np.int32), np.zeros(0, dtype=np.int32), np.zeros(0))


@dataclass(frozen=True)
class _Storage:
    """Storage of matrices of n components: dense, banded or sparse; complex ones as 2 × 2 blocks of reals."""

    kind: str
    n: int
    complex: bool
    lower: int = 0
    upper: int = 0

    @property
    def given_shape(self) -> tuple[int, int]:
        return (self.lower + self.upper + 1 if self.kind == "banded" else self.n, self.n)

    def values(self, name: str, given: Any) -> Any:
        """Check a user's matrix and return it as the core reads it: an array, or (starts, rows, values)."""
        matrix = as_matrix(name, given, self.given_shape, is_complex=self.complex, banded=self.kind == "banded")
        if self.kind == "sparse":
            return _columns(_real_blocks(_compressed(matrix)) if self.complex else _compressed(matrix))
        dense = as_dense(matrix)
        if self.complex:
            dense = _real_bands(dense, self.lower, self.upper) if self.kind == "banded" else _real_dense(dense)
        return np.ascontiguousarray(dense, dtype=float)

    def mass_values(self, given: Any) -> Any:
        """Check a mass matrix and return it as the core reads it; it is passed whole even if the Jacobian is banded."""
        matrix = as_matrix("mass", given, (self.n, self.n), is_complex=self.complex)
        if self.kind != "banded":
            return self.values("mass", matrix)
        from scipy.sparse import coo_array

        entries = coo_array(matrix)
        row = self.upper + entries.row - entries.col
        if ((row < 0) | (row > self.lower + self.upper)).any():
            raise ValueError(
                f"mass has entries outside the band of the Jacobian, lower = {self.lower}, upper = {self.upper}; "
                "give a band that holds both"
            )
        packed = np.zeros(self.given_shape, dtype=entries.dtype)
        packed[row, entries.col] = entries.data
        return self.values("mass", packed)


class _Jacobian(NamedTuple):
    """Storage and source of the Jacobian, for the core."""

    storage: _Storage
    kind: str
    source: Any  # its values or its function, with the pattern
    found: int = 0  # evaluations of f that found the pattern; 0: it was given
    product: Any = None  # of a large one, whose columns are products


@dataclass(frozen=True)
class FunctionAtStart:
    """f, as users write it, with what it is called with at the start.

    `traced`: the same function with a graph, if Jacobians are made of that; with delays it takes y and z in one vector,
    and `fun` takes y alone. `complex_by_default`: complex steps are the
    default of an f that numba compiles. Not if the core keeps f within bounds, or if a second compilation may be in
    vain.
    """

    fun: Any
    t: float
    y: Array
    args: tuple[Any, ...]
    parameters: ArgumentLayout
    bounds: Bounds | None = None
    complex_by_default: bool = True
    traced: Any = None
    delays: int = 0

    @property
    def exact(self) -> Derived | None:
        """The exact derivatives of f; with delays those along y of a function of y, z and ∂z_j/∂y."""
        n = len(self.y)
        if np.iscomplexobj(self.y):
            return None
        found = derived(self.traced, n * (1 + self.delays), n, self.parameters)
        return found.shifted if found is not None and self.delays else found

    @property
    def product(self) -> Any:
        """Return the function ∂f/∂y v of (t, (y, v)); None if it is not known."""
        exact = self.exact
        return exact and self.derivative(exact.product(), len(self.y), vectors=2)

    def derivative(self, made: Any, size: int, vectors: int = 1) -> Any:
        """A derivative of `traced` for the core."""
        n = vectors * len(self.y) * (1 + self.delays) + self.delays
        return native(made, self.traced, n, size, self.parameters.size)


def prepare(given: Matrices, start: FunctionAtStart, matrix_free: Krylov | None = None) -> LinearTerms:
    """Return a problem's matrices for the core. A Jacobian function is called once, at (t0, y0), to see what it
    returns.

    With `matrix_free` there is no Jacobian, and the mass matrix is sparse.
    """
    made = _jacobian(given, start) if matrix_free is None else _no_jacobian(given, start.y)
    storage, kind, source, found, product = made
    mass = None if given.mass is None else _mass(given.mass, storage, start.args)
    reals = 2 if storage.complex else 1
    banded = storage.kind == "banded"
    n = reals * storage.n
    return LinearTerms(
        structure=storage.kind,
        n=n,
        lower=reals * storage.lower + (reals - 1) * banded,
        upper=reals * storage.upper + (reals - 1) * banded,
        kind=kind,
        jacobian=source,
        mass=mass,
        null_basis=_NO_COLUMNS if mass is None else _null_basis(storage, mass, start.t),
        lapack=_lapack,
        found_pattern=found,
        rate=_rate(given, start),
        **({"product": product} if matrix_free is None else vars(matrix_free)),
    )


def _no_jacobian(given: Matrices, y0: Array) -> _Jacobian:
    """Return the Jacobian that is known by its products. The structure is that of the mass matrix; bands of nothing
    take no memory."""
    stored = "banded" if given.mass is None else "sparse"
    return _Jacobian(_Storage(stored, len(y0), np.iscomplexobj(y0)), "products", None)


def _storage(given: Matrices, y0: Array, is_sparse: bool) -> _Storage:
    """Return the storage of the Jacobian: in bands if these are given."""
    kind = "banded" if given.bands is not None else "sparse" if is_sparse else "dense"
    return _Storage(kind, len(y0), np.iscomplexobj(y0), *(given.bands or ()))


def _has_pattern(given: Matrices) -> bool:
    """Return whether the sparsity pattern is given, not only a word for how it is found."""
    return given.jac_sparsity is not None and not isinstance(given.jac_sparsity, str)


def _jacobian(given: Matrices, start: FunctionAtStart) -> _Jacobian:
    """Return the storage of the Jacobian, its kind, and its values or its function."""
    y0, args = start.y, start.args
    if is_native(given.jac):
        return _native_jacobian(given, y0, start.parameters)
    chosen = given.jac if isinstance(given.jac, str) else None
    known, at_complex = None if chosen else given.jac, partial(_complex_steps, chosen, start)
    how, source = way_of(chosen, known, traced=lambda: start.exact, at_complex=at_complex)
    if how == "traced":
        return _exact_jacobian(given, start, source)
    if how != "given":
        return _computed(given, start, source)
    if given.jac_sparsity is not None:
        warn("jac_sparsity has no effect together with jac")
    if callable(given.jac) and not is_operator(given.jac):
        first = given.jac(start.t, y0.copy(), *args)
        held = _storage(given, y0, is_sparse(first))
        return _Jacobian(held, "function", _JacobianFunction(given.jac, args, held, start.t, y0, first))
    held = _storage(given, y0, is_sparse(given.jac))
    return _Jacobian(held, "constant", held.values("jac", given.jac))


def _computed(given: Matrices, start: FunctionAtStart, at_complex: Any | None) -> _Jacobian:
    """Return a Jacobian computed from f, by complex steps if f for complex y is there, else by finite differences, in a
    structure that is given or found."""
    y0, found, pattern = start.y, 0, None
    if given.bands is None and not _has_pattern(given):
        searched = find_pattern(given, start.fun, start.t, y0, start.args, start.parameters, start.bounds)
        pattern, found = searched or (None, 0)
    held = _storage(given, y0, _has_pattern(given) or pattern is not None)
    if held.kind == "sparse" and pattern is None:
        pattern = _given_pattern(given, held)
    if held.kind == "dense" and too_large_to_be_dense(given, y0):
        size = _dense_bytes(y0) / 2**30
        warn(
            f"a dense Jacobian of {len(y0)} components takes {size:.1f} GiB: give jac_sparsity, or "
            "jac=Banded(lower, upper), to say which entries are zero"
        )
    if at_complex is None:
        return _Jacobian(held, "differences", pattern, found)
    return _Jacobian(held, "complex-step", (at_complex, pattern), found)


def _exact_jacobian(given: Matrices, start: FunctionAtStart, exact: Derived) -> _Jacobian:
    """Return the Jacobian from the graph of f: in bands if these are given, sparse if that is chosen or pays. Its
    pattern is that of the graph, whatever was given."""
    n, bands, pattern = len(start.y), given.bands, None
    held = _storage(given, start.y, bands is None and _is_sparse(given, exact.entries, n))
    if bands is not None:
        lower, upper = exact.bands
        if lower > bands[0] or upper > bands[1]:
            warn(
                f"the bands of the Jacobian, lower = {bands[0]}, upper = {bands[1]}, miss entries: those of fun have "
                f"lower = {lower}, upper = {upper}. Steps may be short; give jac=Banded({lower}, {upper}), or these as "
                "lband and uband"
            )
        made = exact.banded(*bands)
        return _Jacobian(held, "derived", (start.derivative(made, made.size), pattern))
    if held.kind == "sparse":
        pattern = _columns(exact.pattern.matrix(np.ones(exact.entries)))
    if exact.is_product(n if pattern is None else exact.widest):
        return _Jacobian(held, "derived", (None, pattern), product=start.product)
    made = exact.dense() if pattern is None else exact.sparse()
    return _Jacobian(held, "derived", (start.derivative(made, made.size), pattern))


def _is_sparse(given: Matrices, entries: int, n: int) -> bool:
    way = given.jac_sparsity
    if way is None:
        return is_large(given, n) and is_sparse_enough(entries, n)
    return not isinstance(way, str) or way == "detect"


def _rate(given: Matrices, start: FunctionAtStart) -> Any:
    """∂f/∂t, if f has a graph and no inputs, whose rates are not known."""
    exact = start.exact
    differences = isinstance(given.jac, str) and given.jac == "differences"
    if differences or exact is None or isinstance(start.traced, NativeWithInputs) or start.delays:
        return None
    return start.derivative(exact.rate(), len(start.y))


def _complex_steps(jac: str | None, start: FunctionAtStart) -> Any:
    """f for complex y, where complex steps were chosen, or f is compiled. None: differences."""
    if jac is None and (np.iscomplexobj(start.y) or not start.complex_by_default):
        return None
    if np.iscomplexobj(start.y):
        raise ValueError(
            'jac="complex-step" is for real y, and y0 is complex: fun need not be analytic. Use jac="differences", or '
            "write the problem in real and imaginary parts"
        )
    compiled = compiled_at_complex(start.fun, len(start.y), start.parameters)
    if compiled is not None or jac is None:
        return compiled
    return python_at_complex(start.fun, start.t, start.y, start.args)


def too_large_to_be_dense(given: Matrices, y0: Array) -> bool:
    """Return whether nothing is known of the Jacobian, and a dense one would fill the memory."""
    known = (given.jac, given.jac_sparsity, given.bands)
    return all(one is None or isinstance(one, str) for one in known) and _dense_bytes(y0) > _DENSE_LIMIT


def _dense_bytes(y0: Array) -> int:
    return 8 * y0.view(float).size ** 2


def _native_jacobian(given: Matrices, y0: Array, p: ArgumentLayout) -> _Jacobian:
    """Return a Jacobian that machine code computes: its values are dense, bands, or those of the pattern."""
    reals, held = y0.view(float).size, _storage(given, y0, _has_pattern(given))
    pattern = _given_pattern(given, held) if held.kind == "sparse" else None
    size = reals * (held.given_shape[0] if held.kind == "banded" else reals) if pattern is None else len(pattern[2])
    return _Jacobian(held, "function", (to_native("jac", given.jac, reals, size, p), pattern))


def _mass(mass: Any, storage: _Storage, args: tuple[Any, ...]) -> Any:
    return (lambda t: storage.mass_values(mass(t, *args))) if callable(mass) else storage.mass_values(mass)


def _null_basis(storage: _Storage, mass: Any, t0: float) -> tuple[Array, Array, Array]:
    values = mass(t0) if callable(mass) else mass
    small = storage.kind == "dense" and len(values) <= _SMALL
    matrix: Any = values if small else _whole(storage, values)
    if not np.isfinite(matrix if small else matrix.data).all():
        i, j, entry = _not_finite(matrix if small else matrix.toarray())
        reals = 2 if storage.complex else 1
        at = f"({t0})" if callable(mass) else ""
        raise ValueError(f"mass{at} must be finite, got mass{at}[{i // reals}, {j // reals}] = {entry}")
    if small:
        return compressed(null_vectors(np.where(np.abs(matrix) < np.finfo(float).tiny, 0.0, matrix)))
    return _columns(null_basis(matrix))


def _not_finite(matrix: Array) -> tuple[int, int, float]:
    """The place of the first entry that is not finite, column by column, and the entry."""
    j, i = (int(index[0]) for index in np.nonzero(~np.isfinite(matrix.T)))
    return i, j, float(matrix[i, j])


class _JacobianFunction:
    """The user's Jacobian, with its values as the core reads them. The first ones are at hand already."""

    def __init__(
        self, jac: Callable[..., Any], args: tuple[Any, ...], storage: _Storage, t0: float, y0: Array, first: Any
    ) -> None:
        self._jac, self._args, self._storage = jac, args, storage
        self._first: tuple[float, Array, Any] | None = (t0, y0, storage.values("jac(t, y)", first))

    def __call__(self, t: float, y: Array) -> Any:
        if self._first is not None:
            (t0, y0, values), self._first = self._first, None
            if t == t0 and np.array_equal(y, y0):
                return values
        return self._storage.values("jac(t, y)", self._jac(t, y, *self._args))


def null_basis(mass: sp.csc_array) -> sp.csc_array:
    """A basis Z (n, r) of the left null space of M: Zᵀ M = 0. r = 0 where M is regular.

    Each column of Z has a row of its own. Of a small M it has the same bits on every processor. In a large one rows of
    zeros are evident; if what remains is singular too, elimination finds the null space.
    """
    from scipy.sparse import csc_array, csr_array

    n = mass.shape[0]
    rows = csr_array(mass)
    rows.data[np.abs(rows.data) < np.finfo(float).tiny] = 0
    rows.eliminate_zeros()
    if n > _SMALL:
        units = _rows_of_zeros(rows)
        if units is not None:
            return units
    if n > _NULL_SPACE_LIMIT:
        raise ValueError(
            f"mass is singular beyond its rows of zeros, and with {n} rows too large to find its null space: "
            "transform the system so that each algebraic equation has a row of zeros in mass"
        )
    return csc_array(null_vectors(rows.toarray()))


def null_vectors(mass: Array) -> Array:
    """The basis of a dense M, (n, r)."""
    transposed = mass.T
    tolerance = roundoff(transposed)
    basis = [_exact(vector, transposed, tolerance) for vector in null_space(transposed, tolerance).vectors]
    return np.reshape(basis, (len(basis), len(mass))).T


def _exact(z: Array, transposed: Array, tolerance: float) -> Array:
    """An integer solution z of Mᵀ z = 0, if it fits as well as the computed one, which rounding of M may have moved."""
    candidate = whole(z, _NEARLY_WHOLE)
    if candidate is None:
        return z
    terms = transposed * candidate
    solved = (np.abs(terms.sum(axis=1)) <= tolerance * np.abs(terms).max(axis=1)).all()
    return candidate if solved else z


def _rows_of_zeros(rows: sp.csr_array) -> sp.csc_array | None:
    """Return unit vectors for the rows of zeros, if these make up the left null space, else None."""
    from scipy.sparse import csc_array

    n = rows.shape[0]
    empty_rows, empty_columns = (np.flatnonzero(abs(rows).max(axis=axis).toarray().ravel() == 0) for axis in (1, 0))
    if len(empty_rows) != len(empty_columns):
        return None
    kept_rows, kept_columns = np.delete(np.arange(n), empty_rows), np.delete(np.arange(n), empty_columns)
    if not _regular(csc_array(rows[kept_rows][:, kept_columns])):
        return None
    return csc_array((np.ones(len(empty_rows)), (empty_rows, np.arange(len(empty_rows)))), (n, len(empty_rows)))


def _regular(A: sp.csc_array) -> bool:
    """Return whether a square matrix is regular, once its rows and columns are scaled."""
    from scipy.sparse import csc_array, diags_array
    from scipy.sparse.linalg import splu

    if A.shape[0] == 0:
        return True
    for axis in (1, 0):
        size = abs(A).max(axis=axis).toarray().ravel()
        if (size == 0).any():
            return False
        factors = diags_array(1 / size)
        A = csc_array(factors @ A if axis == 1 else A @ factors)
    try:
        probe = splu(A).solve(np.where(np.arange(A.shape[0]) % 3 == 0, -1.0, 1.0))
    except RuntimeError as failed:
        if "singular" in str(failed):
            return False
        raise MemoryError(
            f"no memory for the LU factors of mass ({A.shape[0]} rows, {A.nnz} entries): {failed}. Give a mass of "
            "fewer entries, or of narrower bands"
        ) from failed
    return bool(np.abs(probe).max() < _SINGULAR_GROWTH)


def _given_pattern(given: Matrices, storage: _Storage) -> Any:
    """Return the given sparsity pattern as the core reads it."""
    pattern = _compressed(as_matrix("jac_sparsity", given.jac_sparsity, is_complex=storage.complex) != 0).astype(float)
    # A complex f need not be analytic: real and imaginary parts may depend on both.
    return storage.values("jac_sparsity", _compressed(pattern * (1 + 1j)) if storage.complex else pattern)


def _compressed(matrix: Any) -> sp.csc_array:
    from scipy.sparse import csc_array

    return csc_array(matrix)


def _columns(A: sp.csc_array) -> tuple[Array, Array, Array]:
    """(starts, rows, values) of compressed columns with ascending rows."""
    # A new object: one that was changed may still claim that its rows ascend.
    from scipy.sparse import csc_array

    A = csc_array((A.data, A.indices, A.indptr), A.shape)
    if not A.has_canonical_format:
        A = A.copy()  # the user's arrays stay as they are
        A.sum_duplicates()
    return A.indptr.astype(np.int32), A.indices.astype(np.int32), A.data.astype(float)


def _real_blocks(A: sp.csc_array) -> sp.csc_array:
    """z -> A z of complex z as a map of pairs of reals."""
    from scipy.sparse import csc_array, eye_array, kron

    turn = csc_array([[0.0, -1.0], [1.0, 0.0]])
    real, imaginary = kron(A.real, eye_array(2)), kron(A.imag, turn)
    return csc_array(real + imaginary)


def _real_dense(A: Array) -> Array:
    out = np.empty((2 * A.shape[0], 2 * A.shape[1]))
    out[0::2, 0::2] = out[1::2, 1::2] = A.real
    out[1::2, 0::2] = A.imag
    out[0::2, 1::2] = -A.imag
    return out


def _real_bands(A: Array, lower: int, upper: int) -> Array:
    """Return the packed bands of a complex matrix as bands of its real form, 2 lower + 1 and 2 upper + 1 wide."""
    out = np.zeros((2 * (lower + upper) + 3, 2 * A.shape[1]))
    for d in range(lower + upper + 1):
        out[2 * d + 1, 0::2] = out[2 * d + 1, 1::2] = A[d].real
        out[2 * d + 2, 0::2] = A[d].imag
        out[2 * d, 1::2] = -A[d].imag
    return out


def _whole(storage: _Storage, values: Any) -> sp.csc_array:
    """The matrix that the core's values make up."""
    from scipy.sparse import csc_array, dia_array

    n = storage.n * (2 if storage.complex else 1)
    if storage.kind == "sparse":
        starts, rows, data = values
        return csc_array((data, rows, starts), (n, n))
    if storage.kind == "dense":
        return csc_array(values)
    width = len(values)
    upper = 2 * storage.upper + 1 if storage.complex else storage.upper
    return csc_array(dia_array((values, upper - np.arange(width)), (n, n)))


@functools.cache
def _lapack() -> dict[str, Any]:
    """LAPACK as SciPy ships it. The core asks for it where it does not eliminate by itself."""
    from scipy.linalg import cython_blas, cython_lapack

    routines = ("getrf", "getrs", "gbtrf", "gbtrs", "laswp", "trsm", "gemm")
    capi: dict[str, Any] = {**cython_lapack.__pyx_capi__, **cython_blas.__pyx_capi__}
    return {kind + name: capi[kind + name] for kind in "dz" for name in routines}
