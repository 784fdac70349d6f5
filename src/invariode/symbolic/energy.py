"""The energy of equations of motion by Kane's method, which are formed without it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy
from sympy.physics.mechanics import KanesMethod, ReferenceFrame, kinetic_energy

from .code import System
from .noether import vanishes
from .vocabulary import Vocabulary


def energy(
    method: KanesMethod, words: Vocabulary, system: System, positions: Sequence[Any], velocities: Sequence[Any]
) -> Any | None:
    """Return T + V in the symbols of the code. None: the loads have no potential, or a motion is prescribed.

    The power of the loads is -dV/dt, which gives ∂V/∂q. T is the quadratic form of the mass matrix where all speeds are
    independent; otherwise that matrix is reduced, and T the sum over the bodies.
    """
    n = len(system.explicit)
    q, u = words.y[:n], words.y[n:]
    power = _coded(method, words, _power(method))
    forces = [power.diff(one) for one in u]
    zeros = [_beyond(one, u, 1) for one in [power, *system.explicit, *velocities]]
    if positions or velocities:
        kinetic = _coded(method, words, kinetic_energy(method._inertial, *method.bodies))
        zeros.append(_beyond(kinetic, u, 2))
    else:
        kinetic = sympy.Add(*(system.mass[i, j] * u[i] * u[j] / 2 for i in range(len(u)) for j in range(len(u))))
        at_rest = dict.fromkeys(u, 0)  # where only loads act, unless a frame is driven
        zeros += [right.xreplace(at_rest) - force for right, force in zip(system.force, forces, strict=True)]
    symbols = [words.t, *words.y, *words.p]
    if any(one.has(words.t) for one in [kinetic, power, *system.explicit, *positions, *velocities]):
        return None
    if any(force.has(*u) for force in forces) or not all(vanishes(one, symbols) for one in zeros):
        return None
    kinematics = sympy.Matrix(n, len(u), [rate.diff(one) for rate in system.explicit for one in u])
    gradient = _gradient(kinematics, forces)
    height = None if gradient is None else potential(gradient, q, symbols)
    return None if height is None else kinetic + height


def potential(gradient: Sequence[Any], q: Sequence[Any], symbols: Sequence[Any]) -> Any | None:
    """Return V with this gradient, integrated by each coordinate; None: no V has it, or SymPy does not find one."""
    found = sympy.S.Zero
    for slope, one in zip(gradient, q, strict=True):
        for term in sympy.Add.make_args(sympy.expand(slope - found.diff(one))):
            factor, rest = term.as_independent(one, as_Add=False)
            part = sympy.integrate(rest, one)
            if part.has(sympy.Integral):
                return None
            found += factor * part
    return found if all(vanishes(s - found.diff(one), symbols) for s, one in zip(gradient, q, strict=True)) else None


def _gradient(kinematics: Any, forces: Sequence[Any]) -> list[Any] | None:
    """Return ∂V/∂q, where q' = K u and the power of the loads is force · u; None: K is not square."""
    if not any(forces):
        return [sympy.S.Zero] * kinematics.rows
    if kinematics.rows != kinematics.cols:
        return None
    right = -sympy.Matrix(forces)
    return list(right if kinematics.is_Identity else kinematics.T.LUsolve(right))


def _power(method: KanesMethod) -> Any:
    frame = method._inertial
    power = sympy.S.Zero
    for place, load in method.loads or []:
        power += load.dot(place.ang_vel_in(frame) if isinstance(place, ReferenceFrame) else place.vel(frame))
    return power


def _coded(method: KanesMethod, words: Vocabulary, expression: Any) -> Any:
    """Return the expression in q and u alone; auxiliary speeds are 0."""
    rates = {**method.kindiffdict(), **dict.fromkeys(method._uaux, 0)}
    return words.coded("the energy", expression.xreplace(rates))


def _beyond(expression: Any, u: Sequence[Any], degree: int) -> Any:
    """Return an expression that is 0 if the given one is homogeneous in u, of this degree."""
    return degree * expression - sympy.Add(*(one * expression.diff(one) for one in u if expression.has(one)))
