"""Sensitivities over t: a line for each parameter, or a map of all."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..._base.arguments import Array
from ..result import Result
from .canvas import components, drawable, indices, joined, legend, new, new_panels, properties, unused
from .curves import Curve, continuous_times, draw_over_t, interrupted, parts

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: The most components that have a panel each, and the most rows of a map: more could not be read.
_PANELS, _ROWS = 6, 60

#: Height of a row of a map, and what surrounds the rows, in inches.
_ROW, _AROUND = 0.28, 1.3

#: Width of the lines between the rows of two components in a map, in points.
_SEPARATOR = 1.2


def draw(
    sol: Result,
    chosen: Any,
    parameters: Any,
    kind: str,
    relative: bool | None,
    ax: Axes | None,
    line: dict[str, Any],
) -> Axes:
    """See `Solution.plot_sensitivities`."""
    if sol.sensitivities is None:
        raise ValueError("the run had no sensitivities: solve with sensitivities=True, or the names of parameters")
    if len(sol.t) < 2:
        raise ValueError("sensitivities are drawn over at least two outputs: solve with times in t_eval, or without it")
    rows, columns = components(sol, chosen), indices(sol.sensitivity_names, parameters, "parameter")
    relative = kind == "map" if relative is None else relative
    factors = _factors(sol) if relative else None
    if kind == "map":
        return _map(sol, rows, columns, factors, ax)
    return _lines(sol, rows, columns, factors, ax, line)


def _factors(sol: Result) -> Array:
    """Return p_j / max |y_i|, (n, parameters), which makes sensitivities numbers without unit."""
    values = None if sol._origin is None else sol._origin.parameters()
    if values is None:
        raise ValueError(
            "relative sensitivities need the values of the parameters, which a solution from a file or a pickle does "
            "not have: pass relative=False"
        )
    sizes = np.abs(sol.y).max(axis=1, initial=0)[:, None]
    found: Array = np.divide(np.abs(values), sizes, out=np.zeros((len(sizes), len(values))), where=sizes > 0)
    return found


def _curves(sol: Result, factors: Array | None) -> Curve:
    """Return the derivatives, (n, parameters, k), as curves over t."""
    if hasattr(sol.sol, "sensitivities"):  # that of a DAE is continuous in its unknowns alone
        t, cuts = continuous_times(sol)
        found = Curve(np.insert(t, cuts, np.nan), np.insert(sol.sol.sensitivities(t), cuts, np.nan, axis=2), True)
    else:
        found = Curve(interrupted(sol, sol.t), interrupted(sol, sol.sensitivities), smooth=False)
    return found if factors is None else found._replace(y=found.y * factors[:, :, None])


def _title(name: str, parameter: str, relative: bool) -> str:
    """Return the derivative of a component as text."""
    return f"{parameter} ∂{name}/∂{parameter} / max |{name}|" if relative else f"∂{name}/∂{parameter}"


def _lines(
    sol: Result, rows: list[int], columns: list[int], factors: Array | None, ax: Axes | None, line: dict[str, Any]
) -> Axes:
    """Draw a panel for each component with a line for each parameter; on given axes all of them."""
    names, parameters = sol._names.components, sol.sensitivity_names
    shown = rows if ax is not None else rows[:_PANELS]
    panels: list[Axes] = list(new_panels(sol._names.title, [1] * len(shown))) if ax is None else [ax] * len(shown)
    look, given = properties(line)
    curves = _curves(sol, factors)
    for panel, k in zip(panels, shown, strict=True):
        for j in columns:
            colour, dashes = unused(panel)
            title = parameters[j] if ax is None else _title(names[k], parameters[j], factors is not None)
            for style, part, values in zip(dashes, *parts(curves.y[k, j]), strict=False):
                label = joined(f"{part}{drawable(title)}", given)
                own = {"color": colour, "linestyle": style, "label": label, **look}
                draw_over_t(panel, sol, curves.t, values, curves.smooth, own)
        if ax is None:
            label = _title(names[k], parameters[columns[0]] if len(columns) == 1 else "p", factors is not None)
            panel.set_ylabel(drawable(label).replace(" / max", "\n/ max"))  # beside a low panel
    for place, panel in enumerate(dict.fromkeys(panels)):
        if ax is not None or (place == 0 and len(columns) > 1):  # all panels have the same lines
            legend(panel, f"{len(shown)} of {len(rows)} components" if len(shown) < len(rows) else None)
    panels[-1].set_xlabel("$t$")
    return panels[0]


def _map(sol: Result, rows: list[int], columns: list[int], factors: Array | None, ax: Axes | None) -> Axes:
    """Draw each derivative as a row of colours over t."""
    if np.iscomplexobj(sol.y):
        raise ValueError('a map shows real sensitivities: draw complex ones with kind="lines"')
    names, parameters = sol._names.components, sol.sensitivity_names
    pairs = [(k, j) for k in rows for j in columns]
    if len(pairs) > _ROWS:
        raise ValueError(
            f"a map of {len(rows)} components and {len(columns)} parameters has {len(pairs)} rows, of which {_ROWS} "
            "can be read: choose components or parameters"
        )
    S = sol.sensitivities if factors is None else sol.sensitivities * factors[:, :, None]
    values = np.array([S[k, j] for k, j in pairs])
    t = sol.t
    edges = np.concatenate([t[:1], (t[1:] + t[:-1]) / 2, t[-1:]])
    if ax is None:
        ax = new(sol._names.title, figsize=(6.4, _AROUND + _ROW * len(pairs)))
    ax.grid(False)
    largest = float(np.abs(values[np.isfinite(values)]).max(initial=0)) or 1.0
    image = ax.pcolormesh(
        edges, np.arange(len(pairs) + 1), values, cmap="RdBu_r", vmin=-largest, vmax=largest, rasterized=True
    )
    for place in range(len(columns), len(pairs), len(columns)):
        if len(columns) > 1:
            ax.axhline(place, color=ax.get_facecolor(), linewidth=_SEPARATOR)
    ax.set_yticks(np.arange(len(pairs)) + 0.5, [drawable(f"∂{names[k]}/∂{parameters[j]}") for k, j in pairs])
    ax.invert_yaxis()  # the first component at the top
    ax.set_xlabel("$t$")
    bar = ax.figure.colorbar(image, ax=ax)
    bar.set_label("∂y/∂p" if factors is None else "p ∂y/∂p / max |y|")
    return ax
