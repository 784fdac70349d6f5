"""Scripts written for SciPy run with the import changed, and tell the same."""

from __future__ import annotations

import textwrap

import numpy as np
import pytest

TIGHT = "rtol=1e-8, atol=1e-10"

SCRIPTS = {
    "cannonball: terminal and other events, dense output": """
        from scipy.integrate import solve_ivp
        import numpy as np

        def upward_cannon(t, y):
            return [y[1], -0.5]
        def hit_ground(t, y):
            return y[0]
        hit_ground.terminal = True
        hit_ground.direction = -1
        def apex(t, y):
            return y[1]
        sol = solve_ivp(upward_cannon, [0, 100], [0, 10], events=(hit_ground, apex), dense_output=True)
        result = [sol.t[-1], *sol.t_events[0], *sol.t_events[1], *sol.sol(sol.t_events[1][0]), sol.status]
    """,
    "predator and prey: args, times of output": """
        from scipy.integrate import solve_ivp
        import numpy as np

        def lotkavolterra(t, z, a, b, c, d):
            x, y = z
            return [a * x - b * x * y, -c * y + d * x * y]
        t = np.linspace(0, 15, 300)
        sol = solve_ivp(lotkavolterra, [0, 15], [10, 5], args=(1.5, 1, 3, 1), t_eval=t, TIGHT)
        assert sol.success and np.array_equal(sol.t, t)
        result = sol.y
    """,
    "Lorenz: another method, dense output on a grid": """
        from scipy.integrate import solve_ivp
        import numpy as np

        def lorenz(t, state, sigma, beta, rho):
            x, y, z = state
            return np.array([sigma * (y - x), x * (rho - z) - y, x * y - beta * z])
        soln = solve_ivp(lorenz, (0, 5), (1.0, 1.0, 1.0), method="DOP853", args=(10, 8 / 3, 28),
                         dense_output=True, TIGHT)
        result = soln.sol(np.linspace(0, 5, 500))
    """,
    "van der Pol, stiff: BDF with a Jacobian": """
        from scipy.integrate import solve_ivp
        import numpy as np

        mu = 100.0
        def vdp(t, y):
            return [y[1], mu * (1 - y[0] ** 2) * y[1] - y[0]]
        def jac(t, y):
            return [[0, 1], [-2 * mu * y[0] * y[1] - 1, mu * (1 - y[0] ** 2)]]
        sol = solve_ivp(vdp, [0, 60], [2, 0], method="BDF", jac=jac, t_eval=[0, 20, 40, 60], TIGHT)
        assert sol["success"] and sol.njev > 0 and sol.nlu > 0
        result = sol.y
    """,
    "backwards, and there again": """
        from scipy.integrate import solve_ivp
        import numpy as np

        def pendulum(t, y):
            theta, omega = y
            return omega, -0.1 * omega - 5 * np.sin(theta)
        y0 = [np.pi - 0.1, 0.0]
        there = solve_ivp(pendulum, (0, 10), y0, TIGHT)
        back = solve_ivp(pendulum, (10, 0), there.y[:, -1], dense_output=True, TIGHT,
                         events=lambda t, y: y[0])
        result = [*there.y[:, -1], *back.y[:, -1], *back.sol(5.0), *back.t_events[0]]
    """,
    "a complex one, vectorized": """
        from scipy.integrate import solve_ivp
        import numpy as np

        A = np.array([[-0.25 + 0.14j, 0, 0.33 + 0.44j], [0.25 + 0.58j, -0.2 + 0.14j, 0], [0, 0.2 + 0.4j, -0.1 + 0.97j]])
        def deriv_vec(t, y):
            return A @ y
        result = solve_ivp(deriv_vec, [0, 25], np.array([10 + 0j, 20 + 0j, 30 + 0j]), vectorized=True,
                           t_eval=np.linspace(0, 25, 101), TIGHT)
        result = result.y
    """,
}  # fmt: skip


@pytest.mark.parametrize("name", SCRIPTS)
def test_only_the_import_changes(name):
    results = []
    for module in ("scipy.integrate", "invariode"):
        code = textwrap.dedent(SCRIPTS[name]).replace("TIGHT", TIGHT)
        code = code.replace("from scipy.integrate import", f"from {module} import")
        namespace: dict[str, object] = {}
        exec(compile(code, name, "exec"), namespace)
        results.append(np.asarray(namespace["result"]))
    theirs, ours = results
    assert theirs.shape == ours.shape
    np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=2e-4 * np.abs(theirs).max() * 1e-2)


STEPPING = """
    from scipy.integrate import RK45
    import numpy as np

    solver = RK45(lambda t, y: [y[1], -y[0]], 0, [0.0, 1.0], 10, 0.5, 1e-8, 1e-10)
    t, y = [], []
    while solver.status == "running":
        solver.step()
        half = (solver.t_old + solver.t) / 2
        t += [half, solver.t]
        y += [solver.dense_output()(half)[0], solver.y[0]]
    result = np.array(y) - np.sin(t)
"""


@pytest.mark.parametrize(
    ("module", "name"), [("scipy.integrate", "RK45"), ("invariode.scipy", "RK45"), ("invariode.scipy", "ODE113")]
)
def test_stepping_by_hand_with_only_the_import_changed(module, name):
    code = textwrap.dedent(STEPPING).replace("from scipy.integrate import RK45", f"from {module} import {name} as RK45")
    namespace: dict[str, object] = {}
    exec(compile(code, name, "exec"), namespace)
    assert np.abs(namespace["result"]).max() < 1e-5
