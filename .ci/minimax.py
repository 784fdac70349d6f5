"""The constants of src/invariode/_elementary.py: ``python .ci/minimax.py`` prints them (needs mpmath; seconds).

Polynomials are of least largest relative error of the function that they are part of, by Remez' exchange in 60 digits.
The lowest coefficient is rounded first, and the others are then fitted anew.
"""

from __future__ import annotations

from collections.abc import Callable

from mpmath import atanh, cos, floor, ldexp, linspace, log, lu_solve, matrix, mp, mpf, pi, sin, sqrt

mp.dps = 60
Function = Callable[[mpf], mpf]


def remez(function: Function, weight: Function, low: mpf, high: mpf, powers: range) -> list[mpf]:
    """Coefficients of these powers, of the polynomial p of least largest |weight (p − function)| on [low, high]."""
    terms = len(powers)
    middle, half = (low + high) / 2, (high - low) / 2
    nodes = [middle - half * cos(pi * i / terms) for i in range(terms + 1)]
    for _ in range(12):
        rows = [[*(x**j for j in powers), (-1) ** i / weight(x)] for i, x in enumerate(nodes)]
        *p, level = lu_solve(matrix(rows), matrix([function(x) for x in nodes]))

        def error(x: mpf, p: list[mpf] = p) -> mpf:
            return weight(x) * (sum(c * x**j for c, j in zip(p, powers, strict=True)) - function(x))

        nodes = extrema(error, low, high, terms + 1)
        if max(abs(error(x)) for x in nodes) < abs(level) * (1 + mpf(10) ** -6):
            break
    return list(p)


def extrema(error: Function, low: mpf, high: mpf, count: int) -> list[mpf]:
    """Where |error| is largest between its changes of sign, of which there are count − 1."""
    grid = linspace(low, high, 40 * count)
    values = [error(x) for x in grid]
    found: list[tuple[mpf, mpf]] = []
    for x, value in zip(grid, values, strict=True):
        if found and (value > 0) == (found[-1][1] > 0):
            found[-1] = max(found[-1], (x, value), key=lambda pair: abs(pair[1]))
        else:
            found.append((x, value))
    while len(found) > count:
        found.pop(0 if abs(found[0][1]) < abs(found[-1][1]) else -1)
    step = grid[1] - grid[0]
    return [refined(error, x, step, low, high) for x, _ in found]


def refined(error: Function, x: mpf, step: mpf, low: mpf, high: mpf) -> mpf:
    """The vertex of the parabola through three values."""
    if x in (low, high):
        return x
    a, b, c = abs(error(x - step)), abs(error(x)), abs(error(x + step))
    return x + step * (a - c) / (2 * (a - 2 * b + c))


def rounded(function: Function, weight: Function, low: mpf, high: mpf, terms: int) -> tuple[list[float], mpf]:
    """The polynomial with coefficients in double precision, and its largest weighted error."""
    p: list[float] = []

    def rest(x: mpf) -> mpf:
        return function(x) - sum(c * x**j for j, c in enumerate(p))

    p.append(float(remez(rest, weight, low, high, range(terms))[0]))
    p += [float(c) for c in remez(rest, weight, low, high, range(1, terms))]
    return p, max(abs(weight(x) * rest(x)) for x in linspace(low, high, 2000))


def parts(x: mpf, *bits: int) -> list[float]:
    """x as a sum of numbers of so many bits, and what is left, rounded."""
    found = []
    for count in bits:
        unit = ldexp(mpf(1), int(floor(log(abs(x), 2))) + 1 - count)
        found.append(float(floor(x / unit) * unit))
        x -= found[-1]
    return [*found, float(x)]


def series(function: Function, terms: Callable[[int], mpf]) -> Function:
    """The function, or near 0, where its formula cancels, its power series."""
    near = mpf(10) ** -6
    return lambda x: sum(terms(j) * x**j for j in range(8)) if abs(x) < near else function(x)


def main() -> None:
    least = mpf(10) ** -9  # in place of 0, where weights vanish
    quarter = (pi / 4 * (1 + mpf(2) ** -20)) ** 2
    f = mp.factorial
    s = series(lambda z: (sin(sqrt(z)) / sqrt(z) - 1) / z, lambda j: (-1) ** (j + 1) / f(2 * j + 3))
    c = series(lambda z: (cos(sqrt(z)) - 1 + z / 2) / z**2, lambda j: (-1) ** j / f(2 * j + 4))
    ell = series(lambda z: (2 * atanh(sqrt(z)) / sqrt(z) - 2) / z, lambda j: mpf(2) / (2 * j + 3))
    wide = ((sqrt(2) - 1) / (sqrt(2) + 1)) ** 2
    for name, found in {
        "SINE": rounded(s, lambda z: z * sqrt(z) / sin(sqrt(z)), least, quarter, 6),
        "COSINE": rounded(c, lambda z: z**2 / cos(sqrt(z)), least, quarter, 6),
        "LOGARITHM": rounded(ell, lambda z: z / 2, least, wide, 7),
    }.items():
        print(name, found[0], f"error 2^{float(log(found[1], 2)):.1f}")
    print("HALF_PI", parts(pi / 2, 38, 38))
    print("LN2", parts(log(2), 42))
    print("LN2_128", parts(log(2) / 128, 35), "INVERSE", float(128 / log(2)))


if __name__ == "__main__":
    main()
