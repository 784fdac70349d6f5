"""Base class of systems that know their points."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from .._base.arguments import Array

if TYPE_CHECKING:  # an extra, imported when a film is made
    from .animation import Film


class HasPoints:
    """A system whose motion can be shown as that of its points."""

    def _places(self, sol: Any) -> Callable[[float, Array], Any]:
        """Return the points as a function of t and y, shape (k, 2) or (k, 3); a `ValueError` if there are no points."""
        raise NotImplementedError

    def animate(self, sol: Any, **options: Any) -> Film:
        """Show the motion of the `points` of the system as a film.

        Parameters
        ----------
        sol : Solution
            Of a problem of this system.
        **options
            Those of `invariode.Solution.animate`: links, trace, duration, fps, ax, and properties of the links.

        Returns
        -------
        Film

        Raises
        ------
        ValueError
            The system was made without `points`.
        """
        film: Film = sol.animate(self._places(sol), **options)
        return film
