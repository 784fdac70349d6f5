"""Typical code of users, which mypy --strict accepts; executed by nobody."""

from collections.abc import Callable

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy import LowLevelCallable
from scipy.integrate import solve_ivp

import invariode as iv
from invariode.scipy import ODE15S, ODE45

Vector = NDArray[np.float64]


def pendulum(t: float, y: Vector) -> list[float]:
    return [y[1], -np.sin(y[0])]


def with_arguments(t: float, y: Vector, length: float, damping: float) -> Vector:
    return np.array([y[1], -np.sin(y[0]) / length - damping * y[1]])


def energy(t: float, y: Vector) -> float:
    return float(y[1] ** 2 / 2 - np.cos(y[0]))


def energies(t: float, y: Vector) -> Vector:
    return np.array([energy(t, y), y[0] * y[1]])


def gradient(t: float, y: Vector) -> Vector:
    return np.array([np.sin(y[0]), y[1]])


def bottom(t: float, y: Vector) -> float:
    return float(y[0])


def kick(t: float, y: Vector) -> Vector:
    return np.array([y[0], -0.9 * y[1]])


# Functions, initial values, tolerances, times of all kinds
sol = iv.solve_ivp(lambda t, y: [y[1], -y[0]], (0, 10), [1, 0])
sol = iv.solve_ivp(pendulum, [0, 10], np.array([1.0, 0.0]), "RK45", np.linspace(0, 10, 11))
sol = iv.solve_ivp(pendulum, (0.0, np.inf), (1, 0), callback=lambda t, y: y[0] < 0, max_step=np.inf)
sol = iv.solve_ivp(with_arguments, (0, 10), [1.0, 0.0], args=(1.0, 0.1), rtol=1e-6, atol=[1e-9, 1e-8])
sol = iv.solve_ivp(pendulum, sol.t[[0, -1]], sol.y[:, -1], rtol=np.full(2, 1e-6), atol=np.float64(1e-9))
sol = iv.solve_ivp(pendulum, (0, 1), [1j, 0], method="ode113", keep="end", check=False, max_order=5)
sol = iv.solve_ivp(pendulum, (0, 1), [1, 0], fsal="evaluate", interpolation="raw", refine=4, first_step=1e-3)
for name in iv.METHODS:
    sol = iv.solve_ivp(pendulum, (0, 1), [1, 0], name)

# The suite's functions
sol = iv.ode45(pendulum, (0, 10), [1.0, 0.0], refine=10, invariants=energy)
sol = iv.ode23(pendulum, (0, 10), [1.0, 0.0], t_eval=[0, 1, 2], dense_output=True, events=bottom)
sol = iv.dop853(pendulum, (0, 10), [1.0, 0.0], rtol=1e-10)
sol = iv.ode15s(pendulum, (0, 10), [1.0, 0.0], jac=[[0, 1], [-1, 0]], mass=np.eye(2), lband=1, uband=1, bdf=True)

# Invariants and events of all kinds
invariants = iv.Invariants(energy, jac=gradient, value=0.5, names="energy", iterations=2, when="needed")
both = iv.Invariants(energies, jac="complex-step", value=[0, 0], names=["energy", "product"])
for kept in (energy, invariants, [energy, energies], [invariants, both]):
    sol = iv.solve_ivp(pendulum, (0, 10), [1, 0], invariants=kept)
sol = iv.solve_ivp(pendulum, (0, 10), [1, 0], invariants={"energy": energy})
bibliography: str = iv.cite(sol)
sol.plot("angle")
maybe = energy if sol.success else None
sol = iv.solve_ivp(pendulum, (0, 10), [1, 0], invariants=maybe)
hit = iv.Event(bottom, terminal=3, direction=-1, action=kick, rehold=False)
sol = iv.solve_ivp(pendulum, (0, 10), [1, 0], events=[hit, bottom, lambda t, y: y[1]], dense_output=True)
sol = iv.solve_ivp(pendulum, (0, 10), [1, 0], events=iv.Event(lambda t, y: y[0], terminal=True))

# One step at a time
stepper = ODE45(pendulum, 0, [1.0, 0.0], 10, rtol=1e-6, invariants=energy, interpolation="raw")
stepper.step()
stiff = ODE15S(pendulum, 0, [1.0, 0.0], 10, bdf=True, jac=np.eye(2)).dense_output

# Native functions
native = iv.compile(pendulum)
sol = iv.solve_ivp(native, (0, 10), [1, 0], invariants=iv.compile(energy))


def from_library(fun: LowLevelCallable) -> iv.Solution:
    return iv.solve_ivp(fun, (0, 10), [1, 0], invariants=iv.Invariants(fun, value=0), events=iv.Event(fun))


# Results
end: Vector = sol.y[:, -1]
amplitude = float(np.abs(sol.y[0]).max() - sol.t[0])
passages = sol.t_events[0].round(3)
states: Vector = sol.y_events[0]
middle = sol.sol(0.5) + sol.sol(np.linspace(0, 1, 5))[:, 0]
if sol.steps is not None:
    largest = sol.steps.h.max()
print(sol.message, sol["t"], sol.residual.max(), sol.drift().correction, sol.stats.nfev + sol.nfev, sol.success)
sol.save("orbit.npz")
again: iv.Solution = iv.load("orbit.npz", invariants=[energy, both], args=(1, 2))

# Problem
problem = iv.Problem(pendulum, (0, 10), [1, 0], invariants=energy, name="pendulum", labels=["angle", "speed"])
sol = problem.solve("ode113", rtol=1e-6, dense_output=True)
more = sol.extend(20, t_eval=None, max_step=0.1, progress=False).t_end + 1
sol = problem.replace(y0=[2, 0], labels=None).solve(keep="end")
sol = problem.solve(method="ode15s", t_eval=np.linspace(0, 10), max_order=2)

# Projection, checks, discovery
point: Vector = iv.impose(energy, 0, [1.1, 0.0], value=0.5).y
points = iv.impose([energy, both], sol.t, sol.y, rtol=1e-6).converged
points = iv.impose(invariants, sol).y
points = iv.impose(energy, solve_ivp(pendulum, (0, 10), [1, 0])).y
projected: iv.Solution = sol.impose()
report = iv.check_invariants(pendulum, [energy], 0, [1, 0])
print(report.ok, report.findings)
found = iv.find_invariants(lambda t, w: [w[1], -w[0]], (0, 10), [0.3, 1.0], labels=["a", "b"])
sol = iv.solve_ivp(pendulum, (0, 10), [1, 0], invariants=found)

# Ensembles
sol = problem.solve("ode15s", linear_solver=iv.GMRES(dimension=20), limits=iv.Limits(steps=9, time=1.5), max_steps=None)
sol = problem.replace(jac=iv.Banded(1, 1)).solve(checkpoint=iv.Checkpoint("run", every=5))
rows: iv.EnsembleSolution = problem.solve_ensemble(np.ones((10, 2)), "ode23", workers=1, retry={"method": "radau"})
many = iv.solve_ensemble(with_arguments, (0, 1), [[1, 0], [2, 0]], args=(1, 0), workers=2, progress=True, rtol=1e-6)
many = iv.solve_ensemble(with_arguments, (0, 1), [1, 0], "ode23", args=np.ones((10, 2)), t_eval=[0, 1], keep="all")
ends: Vector = many.y_end[many.success, 0]
print(many.stats.steps.sum(), many.messages.get(3), many.events[0].t)

# Pictures
figure, (left, right) = plt.subplots(1, 2)
sol.plot(ax=left, components=["angle"], label="angle", lw=2)
sol.plot_phase(0, 1, ax=right)
sol.plot_drift(invariants=[energy]).set_title("drift")
sol.plot_steps()


# Wrappers that hand on what they get
def solve_with(fun: Callable[[float, Vector], list[float]], y0: Vector, rtol: float = 1e-6) -> Vector:
    return iv.solve_ivp(fun, (0, 1), y0, rtol=rtol).y


# SciPy's older calls
older_rows: Vector = iv.odeint(lambda y, t: [y[1], -y[0]], [1, 0], np.linspace(0, 1, 11), rtol=1e-6, hmax=0.1)
older_rows, about = iv.odeint(lambda t, y: y, 1.0, [0, 1], tfirst=True, full_output=True, method="ode113")
last: str = about["message"]
run = iv.ode(with_arguments, invariants=energy).set_integrator("dopri5", rtol=1e-6, nsteps=1000)
run.set_initial_value([1.0, 0.0], 0.0).set_f_params(1.0, 0.1).set_solout(lambda t, y: -1 if t > 1 else None)
while run.successful() and run.t < 10:
    older_rows = run.integrate(run.t + 1)
rotated: complex = iv.complex_ode(lambda t, y: 1j * y).set_integrator("dopri5").set_initial_value(1.0).integrate(1)[0]
