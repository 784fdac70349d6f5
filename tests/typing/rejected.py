"""Wrong calls. mypy must reject each: an `ignore` that it does not need is an error."""

import invariode as iv
from invariode.scipy import ODE45


def f(t: float, y: list[float]) -> list[float]:
    return y


def g(t: float, y: list[float]) -> float:
    return y[0]


# Arguments of the wrong type
iv.solve_ivp("f", (0, 1), [1])  # type: ignore[arg-type]
iv.solve_ivp(f, 1, [1])  # type: ignore[arg-type]
iv.solve_ivp(f, "01", [1])  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], method=45)  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], dense_output="yes")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], args=3)  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], events="g")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], events=[0])  # type: ignore[list-item]
iv.solve_ivp(f, (0, 1), [1], invariants="energy")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], invariants=[1.0])  # type: ignore[list-item]
iv.solve_ivp(f, (0, 1))  # type: ignore[call-arg]

# Options: of the wrong type, with an unknown value, unknown
iv.solve_ivp(f, (0, 1), [1], rtol="tight")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], atol=["1e-6"])  # type: ignore[list-item]
iv.solve_ivp(f, (0, 1), [1], rtol=None)  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], refine=2.5)  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], max_step="large")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], callback=True)  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], callback=lambda t: True)  # type: ignore[arg-type,misc]
iv.solve_ivp(f, (0, 1), [1], interpolation="projekted")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], keep="none")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], keep="none")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], fsal=True)  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], tol=1e-6)  # type: ignore[call-arg]
iv.solve_ivp(f, (0, 1), [1], invariant=g)  # type: ignore[call-arg]
iv.ode45(f, (0, 1), [1], rtoll=1e-6)  # type: ignore[call-arg]
iv.ode45(f, (0, 1), [1], method="ode23")  # type: ignore[call-arg]
iv.ode15s(f, (0, 1), [1], linear_solver="krylov")  # type: ignore[arg-type]
iv.solve_ivp(f, (0, 1), [1], limits=100)  # type: ignore[arg-type]
iv.Limits(steps="many")  # type: ignore[arg-type]
iv.ode15s(f, (0, 1), [1], lband=1.5)  # type: ignore[arg-type]
iv.Problem(f, (0, 1), [1]).solve(rtolerance=1e-6)  # type: ignore[call-arg]
iv.Problem(f, (0, 1), [1]).solve(invariants=g)  # type: ignore[call-arg]
iv.Problem(f, (0, 1), [1], rtol=1e-6)  # type: ignore[arg-type]
iv.Problem(f, (0, 1), [1]).replace(y=[2])  # type: ignore[call-arg]
iv.solve_ivp(f, (0, 1), [1]).extend(2, rtol=1e-6)  # type: ignore[call-arg]
iv.solve_ivp(f, (0, 1), [1]).plot(0, 1)  # type: ignore[arg-type,call-arg]
ODE45(f, 0, [1], 1, t_eval=[0])  # type: ignore[call-arg]
ODE45(f, 0, [1], 1, check="no")  # type: ignore[arg-type]
iv.solve_ensemble(f, (0, 1), [[1]], dense_output=True)  # type: ignore[call-overload]
iv.solve_ensemble(f, (0, 1), [[1]], workers="all")  # type: ignore[call-overload]

# Invariants, events, projection
iv.Invariants(g, jac="4-point")  # type: ignore[arg-type]
iv.Invariants(g, when="sometimes")  # type: ignore[arg-type]
iv.Invariants(g, value="zero")  # type: ignore[arg-type]
iv.Invariants(g, names=3)  # type: ignore[arg-type]
iv.Event(1.0)  # type: ignore[arg-type]
iv.Event(f)  # type: ignore[arg-type]
iv.Event(g, direction="up")  # type: ignore[arg-type]
iv.impose(g, 0.0)  # type: ignore[call-overload]
iv.impose(g, 0.0, [1.0], tol=1e-9)  # type: ignore[call-overload]

# Results
sol = iv.solve_ivp(f, (0, 1), [1])
print(sol.succes)  # type: ignore[attr-defined]
print(sol.stats.nfevs)  # type: ignore[attr-defined]
sol.plot_fase(0, 1)  # type: ignore[attr-defined]
sol(0.5)  # type: ignore[operator]
message: int = sol.message  # type: ignore[assignment]
iv.ode46(f, (0, 1), [1])  # type: ignore[attr-defined]

# Names of methods
iv.solve_ivp(f, (0, 1), [1], method="ode54")  # type: ignore[arg-type]
iv.Problem(f, (0, 1), [1]).solve("RK54")  # type: ignore[arg-type]
iv.METHODS["ode54"]  # type: ignore[index]
iv.odeint(f, [1], [0, 1], method="lsoda")  # type: ignore[call-overload]
iv.odeint(f, [1], [0, 1], rtoll=1e-6)  # type: ignore[call-overload]
iv.quad(f, 0, 1)  # type: ignore[attr-defined]
iv.ode(f, invariants="energy")  # type: ignore[arg-type]
