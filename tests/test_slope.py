"""f is called outside of a run as in the run: with the values of its inputs and with its arguments, compiled or not."""

from __future__ import annotations

import functools

import numpy as np
import pytest

import invariode as iv
from invariode._results.pictures.curves import curve

#: y₀' = u(t) r and y₁' = -u(t) r, with u = 1 in (2, 3): y₀ rises by r in that second, and y₀ + y₁ stays.
RATE = 2.0


def pour(t, y, u, rate):
    return [u * rate, -u * rate]


def total(t, y, rate):
    return y[0] + y[1]


@functools.cache
def compiled():
    pytest.importorskip("numba")
    return iv.compile(lambda t, y, p: (p[0] * p[1], -p[0] * p[1]))


@pytest.fixture(params=["Python", "compiled"])
def poured(request):
    tap = iv.Input([0, 2, 3], [0.0, 1.0, 0.0])
    fun = pour if request.param == "Python" else compiled()
    return iv.Problem(fun, (0, 10), [0.0, 1.0], args=(RATE,), inputs=tap, invariants=total)


@pytest.mark.parametrize("method", ["ode45", "ode15s"])
def test_curves_stay_between_the_values_of_the_run(poured, method):
    """The exact solution rises from 0 to r; a slope from the wrong side of a jump makes a cubic leave that range."""
    sol = poured.solve(method, rtol=1e-8, atol=1e-10)
    drawn = curve(sol)
    assert drawn.smooth
    exact = RATE * np.clip(drawn.t - 2, 0, 1)
    np.testing.assert_allclose(drawn.y[0], exact, atol=1e-3)
    sol.plot()


def test_jumps_at_breakpoints_are_seen_from_both_sides_by_curves():
    """A jump of f at 1 is given as a breakpoint, backwards too."""

    def f(t, y):
        return [1.0 if t > 1 else 0.0]

    for span in ((0, 2), (2, 0)):
        drawn = curve(iv.solve_ivp(f, span, [0.0], breakpoints=np.ones(1), max_step=2.0))
        exact = np.maximum(drawn.t - 1, 0) - max(span[0] - 1, 0)
        np.testing.assert_allclose(drawn.y[0], exact, atol=1e-12)


def test_direction_fields_have_the_inputs_of_the_start(poured):
    sol = poured.replace(t_span=(2.5, 10)).solve()
    states = np.array([[0.0, 1.0], [5.0, -3.0]])
    np.testing.assert_array_equal(sol._origin.field(states), [[RATE, RATE], [-RATE, -RATE]])
    sol.plot_phase(0, 1, field=True)


def test_films_and_thumbnails_are_drawn(poured):
    sol = poured.solve()
    film = sol.animate(lambda t, y: [[t, y[0]]], duration=0.2)
    film._init_draw()
    film._draw_was_started = True
    assert "<img" in sol._repr_html_()


def test_the_command_checks_along_the_run(poured, tmp_path, monkeypatch):
    pytest.importorskip("typer")
    from typer.testing import CliRunner

    from invariode.cli import check
    from invariode.cli.app import app

    monkeypatch.setattr(check, "load", lambda file: poured)
    found = CliRunner().invoke(app, ["check", "problem.py", "--along", "8"])
    assert found.exit_code == 0, found.output
    assert "8 of 8" in found.output


def test_files_tell_problems_apart(poured, tmp_path):
    """Files tell problems apart by f at the start, where the tap may be open."""
    opened = poured.replace(t_span=(2.5, 10))
    opened.solve().save(tmp_path / "run.npz")
    assert iv.load(tmp_path / "run.npz", opened).extend(11).success
    other = opened.replace(fun=lambda t, y, u, rate: [u * rate, 3.0], invariants=iv.Invariants(total))
    with pytest.raises(ValueError, match="another problem"):
        iv.load(tmp_path / "run.npz", other)


def test_compiled_mechanisms_are_drawn():
    """The f of compiled mechanisms is the core's own."""
    numba = pytest.importorskip("numba")
    assert numba
    force = iv.compile(lambda t, q, v: (0.0 * t, -9.81))
    rod = iv.compile(lambda t, q: q[0] * q[0] + q[1] * q[1] - 1)
    bob = iv.MechanicalSystem([1.0, 1.0], force, constraints=iv.compile(rod.fun))
    sol = bob.problem((0, 2), [1.0, 0.0], [0.0, 0.0]).solve(rtol=1e-6)
    drawn = curve(sol)
    np.testing.assert_allclose(np.hypot(drawn.y[0], drawn.y[1]), 1, atol=1e-3)


def test_a_vectorized_f_keeps_its_name():
    def cooling(t, y):
        return -y

    sol = iv.solve_ivp(cooling, (0, 1), [1.0], vectorized=True)
    assert sol._names.problem == "cooling"
    with pytest.raises(ValueError, match="returned shape"):
        iv.solve_ivp(lambda t, y: y[:1], (0, 1), [1.0, 2.0], vectorized=True)
