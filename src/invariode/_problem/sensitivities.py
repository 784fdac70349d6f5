"""The option `sensitivities`: which derivatives with respect to parameters a run computes, and how."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .._base.arguments import Array, flag, items, numbers, real_numbers, shown
from .._base.labelled import named
from .._base.suggestions import meant, naming_arguments
from .parameters import Y0, ParameterName, parameter_names

#: A selection of initial values: labels or indices.
_Components: TypeAlias = bool | int | str | Sequence[int | str]


@naming_arguments
@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Derivatives of the solution with respect to parameters: ``sensitivities=Sensitivities(...)``.

    With S = ∂y/∂p, of shape (n, k), the run solves M S' = (∂f/∂y) S + ∂f/∂p - (∂M/∂p) y' together with M y' = f.

    Parameters
    ----------
    args : bool, str, int, or list of these, optional
        Numbers in `args`: True for all, names of f's arguments (``"k1"``; ``"p[2]"`` in an array p; ``"args[0]"`` if f
        takes ``*args``), or indices of arguments. Default: all, unless `y0` is given.
    y0 : bool, str, int, or list of these, optional
        Initial values: True for all, or labels or indices of components. In the results they come after `args`. Those
        of complex problems need an f that is analytic in y.
    dfdp : callable, optional
        ``dfdp(t, y, *args)`` returns ∂f/∂p, of shape (n, k): a column for each selected parameter in `args`. Default:
        from the expressions of f if it can be traced, otherwise by complex steps if f accepts complex numbers,
        otherwise by finite differences, with a warning.
    dy0dp : array_like of shape (n, k) or callable, optional
        ∂y0/∂p, if `y0` depends on parameters: a column for each selected parameter in `args`; or a function
        ``dy0dp(*args)`` that returns it. Complex if y0 is. Default: 0.
    scale : array_like or dict, optional
        The sizes of the parameters, one number for each, or numbers by name: the error of ∂y_i/∂p_j is controlled with
        the tolerance ``max(rtol_i |∂y_i/∂p_j|, atol_i / scale_j)``. Default: the absolute value of the parameter, or 1
        for a parameter that is zero; for an initial value at least atol / rtol.
    error_test : bool, default True
        Whether the errors of the sensitivities limit the steps, as those of y do. False: the steps are those of a run
        without sensitivities, and the errors of the sensitivities are not controlled.

    Raises
    ------
    TypeError, ValueError
        A field has a wrong type. Names and shapes are checked by the problem.

    Notes
    -----
    T. Maly and L. R. Petzold, Appl. Numer. Math. 20 (1996) 57-79.

    Examples
    --------
    >>> import numpy as np
    >>> import invariode as iv
    >>> def decay(t, y, rate):
    ...     return [-rate * y[0]]
    >>> sol = iv.solve_ivp(
    ...     decay, (0, 1), [1.0], args=(2.0,), rtol=1e-8, sensitivities=iv.Sensitivities(args="rate", y0=True)
    ... )
    >>> sol.sensitivity_names
    ['rate', 'y0[0]']
    >>> bool(np.allclose(sol.sensitivities[0, :, -1], [-np.exp(-2), np.exp(-2)], rtol=1e-6))
    True
    """

    args: Any = None
    y0: _Components | None = None
    dfdp: Any = None
    dy0dp: Any = None
    scale: ArrayLike | Mapping[str, float] | None = None
    error_test: bool = True

    def __post_init__(self) -> None:
        if (scale := named("scale of Sensitivities", self.scale)) is not None:
            object.__setattr__(self, "scale", scale)
        object.__setattr__(self, "error_test", flag("error_test of Sensitivities", self.error_test))
        if self.dfdp is not None and not callable(self.dfdp):
            raise TypeError(f"dfdp of Sensitivities must be a function dfdp(t, y, *args), got {shown(self.dfdp)}")
        if self.dy0dp is not None and not callable(self.dy0dp):
            object.__setattr__(self, "dy0dp", numbers("dy0dp of Sensitivities", self.dy0dp))

    def names(
        self, fun: Any, args: tuple[Any, ...], labels: Sequence[str] | None, n: int, first: int = 2
    ) -> tuple[ParameterName, ...]:
        """Names of the selected parameters of a problem."""
        wanted: list[Any] = []
        of_start = self.y0 is not None and self.y0 is not False
        if self.args is True or (self.args is None and not of_start):
            every = parameter_names(fun, args, labels, n, wanted=True, first=first)
            if not of_start:
                return every
            wanted += every
        elif self.args is not None and self.args is not False:
            wanted += _listed(self.args)
        if self.y0 is True:
            wanted.append(Y0)
        elif self.y0 is not None and self.y0 is not False:
            wanted += [f"{Y0}[{_component(one, n)}]" for one in _listed(self.y0)]
        return parameter_names(fun, args, labels, n, wanted, first=first)

    def sizes(self, names: Sequence[ParameterName], default: Array) -> Array:
        """Sizes p̄ of the parameters, of shape (..., k), with defaults for those that `scale` does not specify."""
        scale = self.scale
        if scale is None:
            return default
        if isinstance(scale, Mapping):
            known = {one.name: j for j, one in enumerate(names)}
            size = default.copy()
            for name, given in scale.items():
                if name not in known:
                    raise ValueError(
                        f"scale of Sensitivities names {name!r}, which is not a parameter{meant(name, known)}"
                    )
                size[..., known[name]] = real_numbers(f"the scale of {name}", given)
            numbers = size[..., [known[name] for name in scale]]
        else:
            numbers = real_numbers("scale of Sensitivities", scale)
            if numbers.shape not in ((), (len(names),)):
                raise ValueError(
                    f"scale of Sensitivities must be one number for each of {len(names)} parameters, got "
                    f"{shown(self.scale)}"
                )
            size = np.broadcast_to(numbers, default.shape)
        if not (np.isfinite(numbers) & (numbers > 0)).all():
            raise ValueError(f"scale of Sensitivities must be positive, got {shown(self.scale)}")
        return size

    def start(self, names: Sequence[ParameterName], args: tuple[Any, ...], n: int) -> Array:
        """S at the start, of shape (n, k)."""
        S = np.zeros((n, len(names)))
        own = [j for j, one in enumerate(names) if one.kind == "args"]
        for j, one in enumerate(names):
            if one.kind == Y0:
                S[one.index, j] = 1
        if self.dy0dp is None:
            return S
        given = real_numbers("dy0dp", self.dy0dp(*args) if callable(self.dy0dp) else self.dy0dp)
        if given.ndim == 1 and len(own) == 1:
            given = given[:, None]
        if given.shape != (n, len(own)):
            raise ValueError(
                f"dy0dp must have shape ({n}, {len(own)}), a column for each of the parameters in args, got "
                f"{given.shape}"
            )
        if not np.isfinite(given).all():
            raise ValueError(f"dy0dp must be finite, got {shown(given)}")
        S[:, own] = given
        return S


#: What True requests.
OF_ALL_ARGS = Sensitivities(args=True)

SensitivitiesLike: TypeAlias = bool | str | int | Sequence[str | int] | Sensitivities


def to_sensitivities(given: SensitivitiesLike | None) -> Sensitivities | None:
    """Convert the option; None if no sensitivities are requested."""
    if given is None or given is False:
        return None
    if given is True:
        return OF_ALL_ARGS
    return given if isinstance(given, Sensitivities) else Sensitivities(args=given)


def _component(given: Any, n: int) -> str | int:
    """Check a label or an index."""
    if isinstance(given, str):
        return given
    try:
        if isinstance(given, (bool, np.bool_)):
            raise TypeError
        index = operator.index(given)
    except TypeError:
        raise TypeError(f"y0 of Sensitivities must be True, labels or indices, got {shown(given)}") from None
    if not 0 <= index < n:
        raise ValueError(f"y0 of Sensitivities has components 0 to {n - 1}, got {shown(given)}")
    return index


def _listed(given: Any) -> list[Any]:
    listed = None if isinstance(given, (str, ParameterName)) else items(given)
    return [given] if listed is None else listed
