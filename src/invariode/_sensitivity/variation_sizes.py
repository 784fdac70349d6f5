"""The absolute tolerances of sensitivities, at one point or at many: (..., n) initial values, (..., k) parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from .._base.arguments import Array, Weights
from .._functions.layout import place_of
from .._problem.parameters import ParameterName
from .._problem.sensitivities import Sensitivities


class Sizes(NamedTuple):
    """Sizes from which the tolerances of sensitivities follow."""

    wanted: Sensitivities  # the option
    names: Sequence[ParameterName]  # the parameters
    weights: Weights  # weights of y in the error test
    #: Absolute tolerances of y, (n,); None with pure relative control of a component, whose tolerance follows from y0
    absolute: Array | None
    #: Positions of the parameters' values among the numbers of the arguments and the initial values behind them
    places: Array

    @classmethod
    def of(
        cls, wanted: Sensitivities, names: Sequence[ParameterName], weights: Weights, args: tuple[object, ...], n: int
    ) -> Sizes:
        """Return the sizes for a problem with these arguments."""
        m = place_of(args, len(args), None)
        places = [place_of(args, one.index, one.item) if one.kind == "args" else m + one.index for one in names]
        absolute = np.full(n, weights.rtol * weights.threshold)
        return cls(wanted, names, weights, absolute if absolute.all() else None, np.array(places))

    @property
    def of_any_start(self) -> bool:
        """True if the tolerances are those of every start: all sizes are given, and no atol is 0."""
        scale = self.wanted.scale
        return scale is not None and not isinstance(scale, Mapping) and self.absolute is not None

    def tolerances(self, y0: Array, values: Array) -> Array:
        """Return the tolerances of ∂y/∂p, of shape (..., k, n), for values (..., k) of the parameters."""
        scale = self.of_parameters(values, y0.shape[-1])
        return np.ascontiguousarray(self._of_state(y0)[..., None, :] / scale[..., None])

    def of_parameters(self, values: Array, n: int) -> Array:
        """The sizes of the parameters, of the shape (..., k) of their values."""
        return self.wanted.sizes(self.names, self._default(np.abs(values), n))

    def at(self, y0: Array, numbers: Array) -> Array:
        """Return the tolerances of ∂y/∂p, of shape (..., k, n), for initial values (..., n) and the numbers (..., m) of
        the arguments."""
        of_args = all(one.kind == "args" for one in self.names)
        return self.tolerances(y0, (numbers if of_args else np.concatenate([numbers, y0], axis=-1))[..., self.places])

    def _default(self, sizes: Array, n: int) -> Array:
        """|p|, 1 of a parameter that is zero; of initial values at least atol / rtol."""
        for j, one in enumerate(self.names):
            if one.kind != "args":
                floor = np.broadcast_to(self.weights.threshold, (n,))
                sizes[..., j] = np.maximum(sizes[..., j], floor[one.index])
        if np.count_nonzero(sizes) < sizes.size:
            sizes[sizes == 0] = 1
        return sizes

    def _of_state(self, y0: Array) -> Array:
        """The absolute tolerances of y. Pure relative control, atol = 0, is not possible for S, which may begin at 0:
        then that of y at the start."""
        if self.absolute is not None:
            return self.absolute
        rtol = self.weights.rtol
        absolute = np.full(y0.shape, rtol * self.weights.threshold)
        sizes = np.abs(y0)
        largest = sizes.max(axis=-1, initial=0, keepdims=True)
        relative = rtol * np.where(y0 == 0, np.where(largest == 0, 1.0, largest), sizes)
        return np.where(absolute == 0, relative, absolute)
