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
    #: Positions of the parameters' values: among the numbers of the arguments, or from the end of the initial values
    places: Array
    floors: Array  # the least sizes of the parameters: atol / rtol of initial values, (k,)
    of_args: bool  # no parameter is an initial value

    @classmethod
    def of(
        cls, wanted: Sensitivities, names: Sequence[ParameterName], weights: Weights, args: tuple[object, ...], n: int
    ) -> Sizes:
        """Return the sizes for a problem with these arguments."""
        places = [place_of(args, one.index, one.item) if one.kind == "args" else one.index - n for one in names]
        absolute = np.full(n, weights.rtol * weights.threshold)
        threshold = np.broadcast_to(weights.threshold, (n,))
        floors = np.array([0.0 if one.kind == "args" else threshold[one.index] for one in names])
        of_args = all(one.kind == "args" for one in names)
        return cls(wanted, names, weights, absolute if absolute.all() else None, np.array(places), floors, of_args)

    @property
    def of_any_start(self) -> bool:
        """True if the tolerances are those of every start: all sizes are given, and no atol is 0."""
        scale = self.wanted.scale
        return scale is not None and not isinstance(scale, Mapping) and self.absolute is not None

    def tolerances(self, y0: Array, values: Array) -> Array:
        """Return the tolerances of ∂y/∂p, of shape (..., k, n), for values (..., k) of the parameters."""
        scale = self.of_parameters(values)
        return np.divide(self._of_state(y0)[..., None, :], scale[..., None], order="C")

    def of_parameters(self, values: Array) -> Array:
        """The sizes of the parameters, of the shape (..., k) of their values; default: |p|, 1 of one that is zero, and
        of initial values at least atol / rtol."""
        sizes = np.abs(values) if self.of_args else np.maximum(np.abs(values), self.floors)
        if np.count_nonzero(sizes) < sizes.size:
            sizes[sizes == 0] = 1
        return self.wanted.sizes(self.names, sizes)

    def at(self, y0: Array, numbers: Array) -> Array:
        """Return the tolerances of ∂y/∂p, of shape (..., k, n), for initial values (..., n) and the numbers (..., m) of
        the arguments."""
        every = numbers if self.of_args else np.concatenate([numbers, y0], axis=-1)
        return self.tolerances(y0, every.take(self.places, axis=-1))

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
