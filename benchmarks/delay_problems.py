"""Constant-delay problems from the literature by every method: ``python benchmarks/delay_problems.py [--rtol 1e-8]``.

Prints the largest error of each run at its steps, and between them, at 400 times. The unit is the tolerance, rtol times
the largest |y_i| of the run. A problem is as sensitive as the largest change, in tolerances, by which a change of the
history, of y0 or of y at a tenth, two tenths, ... of the interval by one tolerance moves the solution: errors of steps
grow like that, whatever the method. The last column is the larger error over that number. Solutions are compared with
exact ones where these are known; otherwise with dop853 at 1e-13, and of stiff problems with radau at 1e-11, whose
difference from the published values at the end is printed. Some of these are those of two methods at 1e-11.
"""

from __future__ import annotations

import argparse
import math
import warnings
from typing import Any, NamedTuple

import numpy as np

import invariode as iv

NONSTIFF = [name for name, about in iv.METHODS.items() if about.delays]
IMPLICIT = [name for name in NONSTIFF if "jac" in iv.METHODS[name].options]


class Case(NamedTuple):
    f: Any
    tf: float
    history: Any
    delays: list[float]
    end: list[float] | None = None  # published values at tf; None of a component: not known
    exact: Any = None
    y0: Any = None
    stiff: bool = False
    breakpoints: Any = None


def method_of_steps(t):
    return [sum((-1) ** k * (t - k + 1) ** k / math.factorial(k) for k in range(int(t) + 2))]


def ddex1(t, y, z):
    return [z[0, 0], z[0, 0] + z[1, 1], y[1]]


def infection(t, y, z):
    return [-y[0] * z[0, 1] + z[1, 1], y[0] * z[0, 1] - y[1], y[1] - z[1, 1]]


def mackey_glass(gain, power, loss):
    return lambda t, y, z: [gain * z[0, 0] / (1 + z[0, 0] ** power) - loss * y[0]]


def two_stage(t, y, z):  # DETEST A2
    flow = y[0] / (1 + 40 * y[1])
    return [1.1 / (1 + math.sqrt(10) * z[0, 0] ** 1.25) - 10 * flow, 100 * flow - 2.43 * y[1]]


def wright(rate):
    return lambda t, y, z: [-rate * z[0, 0] * (1 + y[0])]


def waltman(t, y, z):
    r, mu, c = 0.5, 0.05, 1 / math.sqrt(2)
    early = 0.4 * (1 - t)
    gain = 10 - math.exp(mu) * y[0]
    factor = np.where(
        t <= 1 - c, early, np.where(t <= 1, early + gain, np.where(t <= 2 - c, gain, math.exp(mu) * (z[0, 0] - y[0])))
    )
    return [-r * y[0] * factor]


def products(t, y, z):  # exercise 1 of dde23's tutorial
    return [z[0, 4] + z[0, 2], z[0, 0] + z[1, 1], z[0, 2] + z[1, 0], z[0, 4] * z[0, 3], z[0, 0]]


def rotation(t, y, z):
    return [z[0, 0] * z[1, 1], -y[0] * z[1, 1]]


def predators(t, y, z):
    return [0.25 * y[0] * (1 - y[0] / 200) - 0.01 * y[0] * y[1], -y[1] + 0.01 * z[0, 0] * z[0, 1]]


def flies(t, y, z):
    return [
        12 * (y[1] - y[0]) * y[0] / y[1] - 11.5 * y[0],
        80 * np.exp(-z[0, 1]) * z[0, 1] * math.exp(-0.2) - y[1] - 10 * y[0],
    ]


def seirs(t, y, z):
    birth, death, contact, cure, fatal, immune, latent = 0.33, 0.006, 0.308, 0.04, 0.06, 42.0, 0.15
    lost = cure * z[0, 2] * math.exp(-death * immune)
    infected = contact * y[0] * y[2] / (y[0] + y[1] + y[2] + y[3])
    ill = contact * z[1, 0] * z[1, 2] / (z[1, 0] + z[1, 1] + z[1, 2] + z[1, 3]) * math.exp(-death * latent)
    return [
        birth - death * y[0] - infected + lost,
        infected - ill - death * y[1],
        ill - (cure + fatal + death) * y[2],
        cure * y[2] - lost - death * y[3],
    ]


#: Resistances, volumes and pressures of Ottesen's model of the circulation (ddex2).
VENOUS, STROKE = 0.068, 67.9


def circulation(t, y, z):
    resistance = np.where(t <= 600, 1.05, 0.21 * np.exp(np.minimum(600 - t, 0.0)) + 0.84)
    sympathetic, vagal = 1 / (1 + (z[0, 0] / 93) ** 7), 1 / (1 + (93 / y[0]) ** 7)
    return [
        (y[1] - y[0]) / (1.55 * resistance) + STROKE * y[2] / 1.55,
        y[0] / (519 * resistance) - (1 / (519 * resistance) + 1 / (519 * VENOUS)) * y[1],
        0.84 * sympathetic - 1.17 * vagal,
    ]


def hepatitis(t, y, z):
    """Marchuk's model of hepatitis B; the numbers are those of its literature, in the order of the equations."""
    a = HEPATITIS
    damage = 1 - y[2] / a[6]
    healthy = a[6] - y[1] - y[2]
    return [
        a[0] * y[1] + a[1] * a[2] * y[1] * y[6] - a[3] * y[0] * y[9] - a[4] * y[0] - a[5] * y[0] * healthy,
        a[7] * y[0] * healthy - a[2] * y[1] * y[6] - a[8] * y[1],
        a[2] * y[1] * y[6] + a[8] * y[1] - a[9] * y[2],
        a[10] * a[11] * y[0] - a[12] * y[3],
        a[13] * (damage * a[14] * z[0, 3] * z[0, 4] - y[3] * y[4])
        - a[15] * y[3] * y[4] * y[6]
        + a[16] * (a[17] - y[4]),
        a[18] * (damage * a[19] * z[0, 3] * z[0, 5] - y[3] * y[5])
        - a[20] * y[3] * y[5] * y[7]
        + a[21] * (a[22] - y[5]),
        a[23] * (damage * a[24] * z[1, 3] * z[1, 4] * z[1, 6] - y[3] * y[4] * y[6])
        - a[25] * y[1] * y[6]
        + a[26] * (a[27] - y[6]),
        a[28] * (damage * a[29] * z[1, 3] * z[1, 5] * z[1, 7] - y[3] * y[5] * y[7]) + a[30] * (a[31] - y[7]),
        a[32] * damage * a[33] * z[2, 3] * z[2, 5] * z[2, 7] + a[34] * (a[35] - y[8]),
        a[36] * y[8] - a[37] * y[9] * y[0] - a[38] * y[9],
    ]


HEPATITIS = [
    *(83.0, 5.0, 6.6e14, 3e11, 0.4, 2.5e7, 0.5e-12, 2.3e9, 0.052, 0.15, 9.4e9, 1e-15, 1.2, 2.7e16, 2.0, 5.3e27, 1.0),
    *(1e-18, 2.7e16, 2.0, 8e28, 1.0, 1e-19, 5.3e33, 16.0, 1.6e14, 0.4, 1e-18, 8e32, 16.0, 0.1, 1e-18, 1.7e30, 3.0),
    *(0.4, 4.3e-22, 0.85e7, 8.6e11, 0.043),
]


def robertson(t, y, z):
    slow, fast, last = 0.04 * y[0], 1e4 * z[0, 1] * y[2], 3e7 * y[1] ** 2
    return [-slow + fast, slow - fast - last, last]


def oregonator(t, y, z):
    gain, meets = 8e3 * 0.06, 1.6e9 * y[0] * z[0, 1]
    feed = 1.34 * 0.06 * y[1]
    return [feed - meets + gain * y[0] - 8e7 * y[0] ** 2, -feed - meets + gain * y[0]]


CASES = {
    "y' = -y(t-1)": Case(lambda t, y, z: [-z[0, 0]], 5.5, [1.0], [1.0], exact=method_of_steps),
    "oscillator": Case(
        lambda t, y, z: [-z[0, 0]],
        2.5 * math.pi,
        lambda t: [math.sin(t)],
        [math.pi / 2],
        exact=lambda t: [math.sin(t)],
    ),
    "ddex1": Case(ddex1, 5, [1.0, 1, 1], [1.0, 0.2], [19.175, 176.42257844738, 190.34420193607]),
    "infection (exam4)": Case(
        infection, 40, [5.0, 0.1, 1], [1.0, 10.0], [0.091249120566351, 0.020299500335072, 5.9884513790986]
    ),
    "Wright 1.5 (exam3)": Case(wright(1.5), 20, lambda t: [t], [1.0], [-0.235184625530]),
    "Wright 3 (exam3)": Case(wright(3.0), 20, lambda t: [t], [1.0], [4.67143750]),
    "Waltman (exam5)": Case(
        waltman,
        10,
        [10.0],
        [1.0],
        [0.06302089869],
        breakpoints=[1 - 1 / math.sqrt(2), 1, 2 - 1 / math.sqrt(2)],
    ),
    "lemmings (exam6)": Case(
        lambda t, y, z: [3.5 * y[0] * (1 - z[0, 0] / 19)], 40, [19.0], [0.74], [2.05399610], y0=[19.001]
    ),
    "Mackey-Glass (exam2)": Case(mackey_glass(2.0, 9.65, 1.0), 100, [0.5], [2.0], [0.840255042]),
    "Mackey-Glass A1": Case(mackey_glass(0.2, 10, 0.1), 100, [0.5], [14.0], [0.8281877478104]),
    "Mackey-Glass (JiTCDDE)": Case(mackey_glass(0.25, 10, 0.1), 100, [1.0], [15.0], [1.2640841980157]),
    "A2": Case(two_stage, 100, [1.05767027 / 3, 1.030713491 / 3], [20.0], [0.08768011074439, 0.29376859433354]),
    "products (exer1)": Case(
        products,
        1,
        lambda t: [math.exp(t + 1), math.exp(t + 0.5), math.sin(t + 1), math.exp(t + 1), math.exp(t + 1)],
        [1.0, 0.5],
        [2 * math.e - math.cos(1), None, None, None, 2 * math.e - 1],
    ),
    "square wave (exer5)": Case(
        lambda t, y, z: [z[0, 0]],
        1,
        lambda t: [(-1.0) ** np.floor(-5 * t)],
        [1.0],
        [1.2],
        breakpoints=[-1, -0.8, -0.6, -0.4, -0.2],
    ),
    "rotation (exer6)": Case(
        rotation,
        4,
        lambda t: [math.cos(t), math.sin(t)],
        [1.0, 2.0],
        [-0.22051597384548, -1.0184976868473],
        y0=[0.0, 0.0],
    ),
    "predators (prob1)": Case(predators, 100, [80.0, 30.0], [1.0], [100.44308145373, 12.701656816087]),
    "Cooke (prob3)": Case(lambda t, y, z: [2 * z[0, 0] * (1 - y[0]) - y[0]], 60, [0.8], [7.0], [0.50056753703767]),
    "flies (prob4)": Case(flies, 25, [2.0, 3.5], [0.2], [0.15973849128261, 3.8337196151195]),
    "SEIRS": Case(
        seirs,
        350,
        [15.0, 0, 2, 3],
        [42.0, 0.15],
        [5.2312724899779, 0.054908462252139, 3.985112936729, 5.9156352731058],
    ),
    "circulation (ddex2)": Case(
        circulation,
        1000,
        [93.0, 93 / (1 + 1.05 / VENOUS), 93 / (1.05 * STROKE * (1 + VENOUS / 1.05))],
        [4.0],
        [88.62472153358, 6.6429005322088, 1.4367582654296],
        breakpoints=[600],
    ),
    "Oregonator": Case(oregonator, 100.5, [1e-10, 1e-5], [0.15], [2.74985278e-10, 3.55904905e-07], stiff=True),
    "Robertson": Case(robertson, 100, [1.0, 0, 0], [1e-4], [0.61723512, 6.1535945e-06, 0.38275873], stiff=True),
    "hepatitis": Case(
        hepatitis,
        130,
        [2.9e-16, 0, 0, 0, 1e-18, 1e-19, 1e-18, 1e-18, 4.3e-22, 0.85e7 * 4.3e-22 / 0.043],
        [0.6, 2.0, 3.0],
        [
            *(None, None, 8.395600e-15, 4.85530e-27, 9.999966811e-19, None, 2.80893978e-11, 2.24129637e-12),
            *(1.41701022e-17, 5.94452134e-08),
        ],
        stiff=True,
    ),
}


def problem_of(case):
    y0 = case.y0 if case.y0 is not None else (None if callable(case.history) else case.history)
    return iv.Problem(case.f, (0, case.tf), y0, delays=case.delays, history=case.history, breakpoints=case.breakpoints)


def compiled(case):
    try:
        return case._replace(f=iv.compile(case.f, by="trace"))
    except TypeError:
        return case


def solved(problem, method, rtol, sizes):
    return problem.solve(method, rtol=rtol, atol=rtol * 1e-3 * sizes, dense_output=True, max_steps=3_000_000)


def sensitivity_of(case, sizes):
    """The largest change, in tolerances, by which small changes of the past and of y move the solution."""
    small, t = 1e-7, np.linspace(0, case.tf, 400)
    method, rtol = ("radau", 1e-10) if case.stiff else ("dop853", 1e-12)

    def run(history, y0, at=None):
        push = [(at, lambda t, y: y + small * sizes)] if at is not None else []
        other = case._replace(history=history, y0=y0, breakpoints=[*(case.breakpoints or ()), *push])
        return solved(problem_of(other), method, rtol, sizes).sol(t)

    def past(t):
        return np.array(case.history(t) if callable(case.history) else case.history, dtype=float)

    y0 = past(0.0) if case.y0 is None else np.array(case.y0)
    plain = run(case.history, y0)
    others = [run(lambda t: past(t) + small * sizes, y0 + small * sizes)]
    others += [run(case.history, y0, case.tf * part / 10) for part in range(1, 10)]
    return max(1.0, *((np.abs(one - plain) / (small * sizes[:, None])).max() for one in others))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rtol", type=float, default=1e-8)
    parser.add_argument("--only", help="part of the name of a problem")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"largest error in tolerances of {given.rtol:g}: at steps, between them; steps; error over sensitivity\n")
    worst: dict[str, tuple[float, str]] = {}
    for name, case in CASES.items():
        if given.only and given.only not in name:
            continue
        problem = problem_of(compiled(case))
        rough = problem.solve("radau" if case.stiff else "dop853", rtol=1e-4, atol=1e-40)
        sizes = np.abs(rough.y).max(axis=1)
        best = solved(problem, *(("radau", 1e-11) if case.stiff else ("dop853", 1e-13)), sizes)
        wanted = (lambda t, of=case.exact: np.array([of(s) for s in t]).T) if case.exact else best.sol
        off = ""
        if case.end is not None:
            known = [i for i, one in enumerate(case.end) if one is not None]
            ends = np.array([case.end[i] for i in known])
            off = f", {np.abs(best.y_end[known] / ends - 1).max():.0e} off the published values"
        sensitive = sensitivity_of(compiled(case), sizes)
        print(f"{name}: sensitivity {sensitive:.3g}, reference in {best.stats.steps} steps{off}")
        between = np.linspace(0, case.tf, 400)
        for method in IMPLICIT if case.stiff else NONSTIFF:
            sol = solved(problem, method, given.rtol, sizes)
            if not sol.success:
                print(f"  {method:8} {sol.message[:80]}")
                continue
            t, unit = sol.t, given.rtol * sizes[:, None]
            step_error = (np.abs(sol.y - wanted(t)) / unit).max()
            between_error = (np.abs(sol.sol(between) - wanted(between)) / unit).max()
            ratio = max(step_error, between_error) / sensitive
            print(f"  {method:8} {step_error:9.1f} {between_error:9.1f} {sol.stats.steps:8d} {ratio:8.2f}")
            worst[method] = max(worst.get(method, (0.0, "")), (ratio, name))
    print("\nlargest error over sensitivity of each method")
    for method, (error, name) in worst.items():
        print(f"  {method:8} {error:8.1f} {name}")


if __name__ == "__main__":
    main()
