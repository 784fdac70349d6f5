"""Ready-made invariants: unit vectors, unit quaternions and rotation matrices, for one body or several.

All are quadratic: each equation is a sum of products of two components, so the Jacobian is exact and linear in y.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from .._base.arguments import Array, as_array, encodable, items, shown
from .invariants import Invariants

#: The entries of RᵀR that are prescribed: a symmetric matrix has six.
_UPPER = tuple((i, j) for i in range(3) for j in range(i, 3))


class _NativeQuadratic(_core.Quadratic):
    """The equations in the core, made again from a pickle."""

    def __init__(self, *made_of: Any) -> None:
        super().__init__(*made_of)
        self._made_of = made_of

    def __reduce__(self) -> tuple[type[_NativeQuadratic], tuple[Any, ...]]:
        return type(self), self._made_of


class _PairEquations(NamedTuple):
    """Σ_k y[first_ek] y[second_ek] = value_e. In an equation the first are distinct; the second are the same or all
    others."""

    first: Array
    second: Array
    value: Sequence[float]
    names: list[str]


class _Quadratic(Invariants):
    """Sums of products of two components, by the indices of the vectors or matrices that consist of these."""

    def __init__(
        self,
        indices: ArrayLike,
        *,
        name: str | Sequence[str] | None = None,
        iterations: int | None = None,
        when: Literal["always", "needed"] = "always",
    ) -> None:
        self._first, self._second, value, names = self._equations(indices, name)
        self._rows = np.arange(len(names))[:, None]
        self._least = int(self._first.max()) + 1  # components that the state must have
        super().__init__(self._products, self._gradients, value=value, names=names, iterations=iterations, when=when)

    def _equations(self, indices: ArrayLike, name: str | Sequence[str] | None) -> _PairEquations:
        raise NotImplementedError

    def _in_core(self, n: int) -> tuple[Any, Any]:
        first, second = self._first.ravel().tolist(), self._second.ravel().tolist()
        made_of = n, self._first.shape[1], first, second
        return _NativeQuadratic(*made_of, False), _NativeQuadratic(*made_of, True)

    def _state(self, y: ArrayLike) -> Array:
        state = np.asarray(y)
        if len(state) < self._least:
            name = type(self).__name__
            raise ValueError(
                f"{name} uses y[{self._least - 1}], but the state has {len(state)} components: give indices below "
                f"{len(state)}"
            )
        return state

    def _products(self, t: float, y: ArrayLike, *args: Any) -> Array:
        state = self._state(y)
        values: Array = (state[self._first] * state[self._second]).sum(axis=1)
        return values

    def _gradients(self, t: float, y: ArrayLike, *args: Any) -> Array:
        state = self._state(y)
        jacobian = np.zeros((len(self._first), len(state)), dtype=state.dtype)
        jacobian[self._rows, self._first] = state[self._second]
        jacobian[self._rows, self._second] += state[self._first]
        return jacobian


class _UnitNorms(_Quadratic):
    """Vectors of length 1."""

    _symbol: ClassVar[str]
    _size: ClassVar[int | None]

    def _equations(self, indices: ArrayLike, name: str | Sequence[str] | None) -> _PairEquations:
        bodies = _bodies(type(self).__name__, indices, self._size)
        names = [f"|{one}|²" for one in _named(name, self._symbol, len(bodies))]
        return _PairEquations(bodies, bodies, [1.0] * len(bodies), names)


class UnitVector(_UnitNorms):
    """Components that form vectors of length 1, such as directions and points on a sphere.

    Parameters
    ----------
    indices : array_like of int, (d,) or (k, d)
        Which components of y form the vector, or each of k vectors.
    name : str or sequence of k str, optional
        What the vectors are called in messages and tables. Default: u, or u1, u2, ...
    iterations, when
        As for `Invariants`.

    Raises
    ------
    TypeError, ValueError
        The indices are not integers, are negative, have another shape, or occur twice. When it is used: the state has
        fewer components.

    Notes
    -----
    One equation y·y = 1 for each vector, for real states. The functions also take complex y, for complex steps: y·y is
    then not ``|y|²``.

    Examples
    --------
    >>> import invariode as iv
    >>> iv.UnitVector([0, 1, 2])
    UnitVector(|u|², value=[1.0])
    >>> iv.UnitVector([[0, 1], [2, 3]], name=["east", "west"])
    UnitVector(|east|², |west|², value=[1.0, 1.0])
    """

    _symbol = "u"
    _size = None


class UnitQuaternion(_UnitNorms):
    """Components that form unit quaternions: attitudes of one body or several.

    Parameters
    ----------
    indices : array_like of int, (4,) or (k, 4)
        Which components of y form the quaternion, or each of k quaternions. The scalar part may come first or last.
    name : str or sequence of k str, optional
        What the quaternions are called in messages and tables. Default: q, or q1, q2, ...
    iterations, when
        As for `Invariants`.

    Raises
    ------
    TypeError, ValueError
        As for `UnitVector`.

    Notes
    -----
    One equation q·q = 1 for each quaternion. Components pass through zero: give ``atol = rtol``, so that projection
    may move all four alike.

    Examples
    --------
    >>> import invariode as iv
    >>> def turn(t, q):
    ...     return [-q[3] / 2, q[2] / 2, -q[1] / 2, q[0] / 2]
    >>> sol = iv.ode45(turn, (0, 100), [0.8, 0, 0.6, 0], invariants=iv.UnitQuaternion(range(4)), atol=1e-3)
    >>> bool(abs(sol.residual).max() < 1e-9)
    True
    """

    _symbol = "q"
    _size = 4


class RotationMatrix(_Quadratic):
    """Components that form rotation matrices: RᵀR = I, six equations for each.

    Parameters
    ----------
    indices : array_like of int, (9,), (3, 3), (k, 9) or (k, 3, 3)
        Which components of y form the matrix, or each of k matrices, row by row.
    name : str or sequence of k str, optional
        What the matrices are called in messages and tables. Default: R, or R1, R2, ...
    iterations, when
        As for `Invariants`.

    Raises
    ------
    TypeError, ValueError
        As for `UnitVector`.

    Notes
    -----
    The equations make the columns orthonormal, and hence the rows. They cannot tell a rotation from a reflection; a
    solution that starts as a rotation stays one, since the determinant ±1 cannot jump.

    Examples
    --------
    >>> import invariode as iv
    >>> import numpy as np
    >>> attitude = iv.RotationMatrix(np.arange(9))
    >>> attitude.names
    ['R: 1·1', 'R: 1·2', 'R: 1·3', 'R: 2·2', 'R: 2·3', 'R: 3·3']
    >>> rough = [0.36, 0.48, -0.81, -0.79, 0.6, 0.01, 0.48, 0.65, 0.6]
    >>> R = iv.impose(attitude, 0.0, rough, atol=1e-3).y.reshape(3, 3)
    >>> bool(abs(R.T @ R - np.eye(3)).max() < 1e-14)
    True
    """

    def _equations(self, indices: ArrayLike, name: str | Sequence[str] | None) -> _PairEquations:
        given = as_array("indices of RotationMatrix", indices)
        if given.ndim in (2, 3) and given.shape[-2:] == (3, 3):
            given = given.reshape(*given.shape[:-2], 9)
        columns = _bodies("RotationMatrix", given, 9).reshape(-1, 3, 3).swapaxes(1, 2)
        first = np.array([body[i] for body in columns for i, _ in _UPPER])
        second = np.array([body[j] for body in columns for _, j in _UPPER])
        titles = _named(name, "R", len(columns))
        names = [f"{one}: {i + 1}·{j + 1}" for one in titles for i, j in _UPPER]
        identity = [float(i == j) for i, j in _UPPER] * len(columns)
        return _PairEquations(first, second, identity, names)


def _bodies(what: str, indices: ArrayLike, size: int | None) -> Array:
    """The indices as an array (k, d), a row for each body."""
    given = as_array(f"indices of {what}", indices)
    d = "d" if size is None else size
    wanted = f"integers of shape ({d},) or (k, {d})" + (", (3, 3) or (k, 3, 3)" if size == 9 else "")
    if given.dtype.kind not in "iu" and given.size:
        raise TypeError(f"indices of {what} must be {wanted}, got {shown(indices)}: give range(a, b) or a list")
    if given.ndim not in (1, 2) or given.size == 0 or (size is not None and given.shape[-1] != size):
        raise ValueError(f"indices of {what} must be {wanted}, got shape {given.shape}")
    if given.min() < 0:
        raise ValueError(f"indices of {what} must not be negative, got {given.min()}: count from the first component")
    single, counts = np.unique(given, return_counts=True)
    if counts.max() > 1:
        raise ValueError(f"indices of {what} must be different, got {single[counts > 1][0]} more than once")
    return np.atleast_2d(given)


def _named(name: str | Sequence[str] | None, symbol: str, count: int) -> list[str]:
    """A name for each body; one name for several is numbered."""
    if name is None or isinstance(name, str):
        title = symbol if name is None else encodable(name)
        return [title] if count == 1 else [f"{title}{k + 1}" for k in range(count)]
    names = items(name)
    if names is None or len(names) != count or not all(isinstance(one, str) for one in names):
        raise ValueError(f"name must be one str, or {count} str, one for each body, got {shown(name)}")
    return [encodable(one) for one in names]
