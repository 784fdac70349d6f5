"""A run has the same bits on every processor. Those of Intel and AMD differ in the kernels that OpenBLAS chooses for
NumPy's and SciPy's linear algebra."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

import invariode as iv
from cases import METHODS
from invariode._linear import linear_terms, null_space
from kernels import loaded, runnable
from problems import implicit
from stiff_ends import PROBLEMS as ENDS

CHOSEN = os.environ.get("OPENBLAS_CORETYPE")
C = np.array([1e-6, 3e-6, 0.7e-6])  # capacities between nodes and to the ground


def _between(*nodes: tuple[int, int]) -> np.ndarray:
    M = np.zeros((4, 4))
    for c, (i, j) in zip(C, nodes, strict=False):
        M[np.ix_((i, j), (i, j))] += c / C[0] * np.array([[1, -1], [-1, 1]])
    return M


#: Of 4 components; the last two are singular.
MASSES: dict[str, Any] = {
    "identity": None,
    "diagonal": np.diag([2.0, 1, 3, 0.7]),
    "constant": np.eye(4) + 0.3 * _between((0, 1), (1, 2), (2, 3)),
    "M(t)": lambda t: np.eye(4) * (1 + t * t) + 0.1 * _between((0, 3)),
    "singular, diagonal": np.diag([1.0, 1, 1, 0]),
    "singular, nodes": _between((0, 1), (1, 2)) + np.diag([0, 0, 0, 1.0]),
}


def fun(t: float, y: np.ndarray) -> list[float]:
    """Plain arithmetic, without functions that NumPy has in several versions. All modes decay."""
    a, b, c, d = y.tolist()
    return [1 + t - a - a * a * a, 0.5 * a - 40 * b, c * (b - 3) - 1000 * c * c * c, a - 5 * d - d * d * d]


def jac(t: float, y: np.ndarray) -> np.ndarray:
    a, b, c, d = y.tolist()
    return np.array(
        [[-1 - 3 * a * a, 0, 0, 0], [0.5, -40, 0, 0], [0, c, b - 3 - 3000 * c * c, 0], [1, 0, 0, -5 - 3 * d * d]]
    )


def cases() -> Iterator[tuple[str, iv.Solution]]:
    """Small runs of every implicit method, with each M that it takes."""
    for method in filter(implicit, METHODS):
        for kind, mass in MASSES.items():
            if (kind.startswith("singular") or callable(mass)) and iv.METHODS[method].mass != "any":
                continue
            for given in (None, jac):
                yield (
                    f"{method}, {kind}, {'given' if given else 'differences'}",
                    iv.solve_ivp(fun, (0, 2), [0.5, 0.1, 0.02, 0.1], method, mass=mass, jac=given, rtol=1e-5),
                )


def fingerprints() -> str:
    """A line for each case: the name, and a digest of the bits of its solution."""
    lines = []
    for name, sol in cases():
        assert sol.success, (name, sol.message)
        lines.append(f"{name}: {len(sol.t)} {hashlib.sha256(sol.t.tobytes() + sol.y.tobytes()).hexdigest()}")
    return "\n".join([*loaded(), *lines])


@pytest.mark.slow
def test_small_runs_of_every_implicit_method_have_the_same_bits_under_every_kernel():
    kernels = runnable()
    if len(kernels) < 2:
        pytest.skip("the kernels of this installation's BLAS cannot be chosen")
    found = {}
    for kernel in kernels:
        run = subprocess.run(
            [sys.executable, "-c", "import test_kernels as t; print(t.fingerprints())"],
            env={**os.environ, "OPENBLAS_CORETYPE": kernel},
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=120,
        )
        assert run.returncode == 0, run.stderr
        lines = run.stdout.splitlines()
        count = len(loaded())
        assert lines[:count] == [kernel] * count
        found[kernel] = lines[count:]
    first = found[kernels[0]]
    assert len(first) > len(MASSES)
    for kernel in kernels[1:]:
        assert found[kernel] == first


@pytest.mark.skipif(CHOSEN is None, reason="no kernel was chosen")
def test_the_kernel_that_was_chosen_is_loaded():
    assert set(loaded()) == {CHOSEN}


# ----------------------------------------------------------------------------------------------------------- null space


def _nodes(n: int, rng: np.random.Generator) -> np.ndarray:
    """M of a circuit: capacities of any size between some of its nodes, of which r groups float."""
    M = np.zeros((n, n))
    for _ in range(n):
        i, j = rng.choice(n, 2, replace=False)
        M[np.ix_((i, j), (i, j))] += np.exp(rng.uniform(-20, 0)) * np.array([[1, -1], [-1, 1]])
    return M


@pytest.mark.parametrize("n", [2, 8, 30])
def test_the_null_space_of_a_circuit_is_the_sums_over_its_floating_groups(n):
    """Sums of currents, without roundoff: each node is in one group."""
    rng = np.random.default_rng(n)
    for _ in range(5):
        M = _nodes(n, rng)
        Z = linear_terms.null_basis(sparse.csc_array(M)).toarray()
        groups, label = sparse.csgraph.connected_components(sparse.csr_array(M))
        expected = {tuple(label == k) for k in range(groups)}
        assert {tuple(z == 1) for z in Z.T} == expected
        assert set(np.unique(Z)) <= {0.0, 1.0}


@pytest.mark.parametrize("n", [3, 12, 40])
def test_the_null_space_of_any_matrix_is_found_in_any_units(n):
    """Products of random matrices, their rows and columns in units of 1e-8 to 1e8: Zᵀ M is roundoff of its terms."""
    rng = np.random.default_rng(n)
    rank = n - n // 3
    M = rng.standard_normal((n, rank)) @ rng.standard_normal((rank, n))
    M *= 10.0 ** rng.integers(-8, 9, n) * 10.0 ** rng.integers(-8, 9, n)[:, None]
    Z = linear_terms.null_basis(sparse.csc_array(M)).toarray()
    assert Z.shape == (n, n - rank)
    assert np.all(np.abs(Z.T @ M) <= 1e3 * n * np.finfo(float).eps * (np.abs(Z.T) @ np.abs(M)))


def test_elimination_counts_pivots_and_says_what_is_left():
    A = np.array([[1.0, 2, 3], [2, 4, 6 + 1e-9], [3, 6, 9]])
    exact, crude = (null_space.null_space(A, tolerance) for tolerance in (1e-12, 1e-6))
    assert (len(exact.pivots), len(crude.pivots)) == (2, 1)
    assert exact.left <= 1e-15
    assert 1e-10 < crude.left < 1e-8
    np.testing.assert_allclose(A @ exact.vectors.T, 0, atol=1e-14)
    everything = null_space.null_space(np.zeros((0, 3)), 1e-12).vectors
    np.testing.assert_array_equal(everything, np.eye(3))


@pytest.mark.parametrize("seed", range(3))
def test_a_null_space_with_noise_in_its_last_bits_serves_as_well(monkeypatch, seed):
    """Noise as another processor's linear algebra makes it: no run of the amplifier fails, in either form."""
    rng = np.random.default_rng(seed)
    exact = linear_terms.null_vectors

    def noisy(mass: np.ndarray) -> np.ndarray:
        Z = exact(mass)
        return Z * (1 + np.finfo(float).eps * rng.choice([-1, 0, 1], Z.shape))

    monkeypatch.setattr(linear_terms, "null_vectors", noisy)
    problem = ENDS["transistor amplifier"]
    for jacobian in (problem.jac, None):
        for bdf in (False, True):
            for rtol in 10.0 ** -np.arange(2, 5.5, 0.5):
                sol = iv.ode15s(
                    problem.fun, problem.t_span, problem.y0, rtol=rtol, atol=rtol * problem.scale, mass=problem.mass,
                    jac=jacobian, bdf=bdf, t_eval=problem.times,
                )  # fmt: skip
                assert sol.success, sol.message
                assert problem.error(sol.y) <= 2 * rtol
