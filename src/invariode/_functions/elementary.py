"""sin, cos, exp, log and powers such as x^1.5 from + − × ÷ √ and operations on bits: the same results for one number
and in vector registers, on every processor.

Errors are below 1 unit in the last place for all arguments (tests/test_elementary.py). Each function is straight-line
code that is right for usual arguments, followed by one branch that is taken if some argument is unusual: large for
sin and cos, with an overflow or underflow for exp, not positive or subnormal for log, far from 1 for powers, which are
then the library's.

The functions are written once, with operators on values of LLVM's language: on doubles and on vectors of them.
`.ci/minimax.py` prints the constants.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

from .llvm_values import Value, bits_of, looked_up

#: sin(r) = r + r³ p(r²) and cos(r) = 1 − r²/2 + r⁴ p(r²) for |r| ≤ π/4, with relative errors of 2^-57.8 and 2^-63.8.
SINE = (
    -0.1666666666666663,
    0.00833333333332184,
    -0.00019841269829359227,
    2.75573135388159e-06,
    -2.5050734443372053e-08,
    1.589543674057031e-10,
)
COSINE = (
    0.041666666666666595,
    -0.0013888888888873342,
    2.4801587289002252e-05,
    -2.7557314217104304e-07,
    2.0875705406643596e-09,
    -1.135874986364231e-11,
)
#: exp(r) = 1 + r + r² p(r) for |r| ≤ ln(2)/256, with an error of 2^-60.7: Taylor's.
EXPONENTIAL = (1 / 2, 1 / 6, 1 / 24, 1 / 120)
#: ln((1 + s)/(1 − s)) = 2 s + s³ p(s²) between 1/√2 and √2, with a relative error of 2^-59.5.
LOGARITHM = (
    0.6666666666666734,
    0.3999999999941664,
    0.28571428742027494,
    0.2222219860515087,
    0.18183562844990972,
    0.15314085035748767,
    0.14795631069212814,
)
#: π/2 in parts: k times the first two, of 38 bits each, is exact for k up to 2^15.
HALF_PI = (1.5707963267923333, 2.5633441515839558e-12, 1.0562999066987428e-23)
TWO_OVER_PI = 2 / math.pi
#: ln 2 in parts: k times the first, of 42 bits, is exact for k up to 2^11.
LN2 = (0.6931471805598903, 5.497923018708371e-14)
#: exp has a table of the powers of two between 1 and 2 in steps of 2^(1/128).
PART_BITS = 7
PARTS_OF_TWO = 1 << PART_BITS
#: ln(2)/128 in parts: k times the first, of 35 bits, is exact for k up to 2^18.
LN2_128 = (0.005415212347998022, 1.2655086083325438e-13)
#: 128/ln(2)
PER_PART = 184.6649652337873
ROOT_HALF = math.sqrt(0.5)

#: Adding it rounds to an integer, which the low bits of the sum then hold.
ROUNDER = 1.5 * 2.0**52
#: Beyond it k has more than 15 bits.
LARGEST_ANGLE = 51471.0
#: Beyond it exp or its last bits are near overflow or subnormal.
LARGEST_EXPONENT = 690.0
#: Beyond them exp is 0 and inf.
LOWEST_EXPONENT, HIGHEST_EXPONENT = -746.0, 710.0
SMALLEST_NORMAL, LARGEST = 2.0**-1022, (2.0 - 2.0**-52) * 2.0**1023

# Parts of a double.
ABSOLUTE, SIGN = (1 << 63) - 1, 1 << 63
MANTISSA = (1 << 52) - 1
#: What 64 bits have beyond a double.
LAST_11 = (1 << 11) - 1
#: What 64 bits have beyond a mantissa.
LAST_12 = (1 << 12) - 1
#: Of exponents.
BIAS = 1023


def polynomial(x: Value, coefficients: Sequence[float]) -> Value:
    """Evaluate a polynomial by Estrin's scheme, a short chain of operations."""
    c = list(coefficients)
    terms = [x * high + low for low, high in zip(c[::2], c[1::2], strict=False)]
    last: list[Value | float] = [c[-1]] if len(c) % 2 else []
    sums: list[Any] = [*terms, *last]
    while len(sums) > 1:
        x = x * x
        odd = sums[-1:] if len(sums) % 2 else []
        sums = [low + x * high for low, high in zip(sums[::2], sums[1::2], strict=False)] + odd
    return sums[0]  # type: ignore[no-any-return]  # LLVM values are Any


class Angle(NamedTuple):
    """|x| = k π/2 + r − lost, |r| ≤ π/4, lost below a unit in the last place of r, or of k 2^-62; only the last two
    bits of k matter."""

    k: Value
    r: Value
    lost: Value


def nearest_quarter(x: Value) -> Angle:
    """Split |x|, which is below LARGEST_ANGLE, into the nearest multiple of π/2 and the rest. All but the last product
    and difference are exact: a is a multiple of the last place of b, so that the part lost in a − b is recovered, even
    where a is smaller (Dekker)."""
    absolute = (x.bits & ABSOLUTE).number
    rounded = absolute * TWO_OVER_PI + ROUNDER
    k = rounded - ROUNDER
    a = absolute - k * HALF_PI[0]
    b = k * HALF_PI[1]
    r = a - b
    return Angle(rounded.bits, r, k * HALF_PI[2] - ((a - r) - b))


def of_quarter(angle: Angle, sign: Value, shift: int) -> Value:
    """The sine of angle + shift π/2, with the sign (a bit) reversed or not."""
    k, r, lost = angle
    z = r * r
    half = z * 0.5
    w = 1.0 - half
    sine = r + ((z * r) * polynomial(z, SINE) - lost * w)
    cosine = w + (((1.0 - w) - half) + ((z * z) * polynomial(z, COSINE) + r * lost))
    k = k + shift if shift else k
    chosen = (k & 1).compared("==", 0).choose(sine, cosine)
    return (chosen.bits ^ sign ^ ((k << 62) & SIGN)).number


def scaled_pi(bits: int) -> int:
    """π times 2^bits, by Machin's formula."""

    def arctangent_of_inverse(n: int) -> int:
        term, total, k = (1 << guarded) // n, 0, 0
        while term:
            total += -(term // (2 * k + 1)) if k % 2 else term // (2 * k + 1)
            term //= n * n
            k += 1
        return total

    guarded = bits + 64
    return (4 * (4 * arctangent_of_inverse(5) - arctangent_of_inverse(239))) >> 64


def two_over_pi(words: int) -> list[int]:
    """A word 0, then that many words of 64 bits of 2/π after the point."""
    bits = 64 * words + 64
    digits = ((2 << (2 * bits)) // scaled_pi(bits)) >> 64
    return [0, *((digits >> 64 * i) % (1 << 64) for i in reversed(range(words)))]


#: Words of 2/π that the largest exponent reaches.
WORDS = 19


def nearest_quarter_of_large(x: Value) -> Angle:
    """Split one |x| above LARGEST_ANGLE into the nearest multiple of π/2 and the rest, by Payne and Hanek: x = m 2^e,
    and m times the 192 bits of 2/π that matter."""
    absolute = x.bits & ABSOLUTE
    m = (absolute & MANTISSA) | (MANTISSA + 1)
    start = (absolute >> 52) - (BIAS + 52 + 2 - 64)  # bits of 2/π before it give multiples of 4
    words = looked_up(two_over_pi(WORDS), start >> 6, 4)
    shift = start & 63
    windows = [(high << shift) | ((low >> 1) >> (63 - shift)) for high, low in pairwise(words)]
    wide = m.resized(128)
    middle = wide * windows[1].resized(128) + ((wide * windows[2].resized(128)) >> 64)
    top = m * windows[0] + (middle >> 64).resized(64)
    turns = (top.resized(128) << 64) | middle.resized(64).resized(128)  # x 2/π modulo 4, times 2^126
    k = (top >> 62) + ((top >> 61) & 1)
    fraction = turns << 2  # between −1/2 and 1/2, times 2^128
    size = fraction.compared("<", 0).choose(-fraction, fraction)
    zeros = size.leading_zeros()
    normal = ((size << zeros) >> 64).resized(64)
    product = ((normal.resized(128) * scaled_pi(62)) >> 64).resized(64)
    unit = ((BIAS - 63 - zeros.resized(64)) << 52) | ((top << 2) & SIGN)  # the fraction has the sign of its first bit
    head, tail = product & ~LAST_11, product & LAST_11
    return Angle(k, head.as_number * unit.number, tail.as_number * (unit ^ SIGN).number)


def is_finite(x: Value) -> Value:
    return (x.bits & ABSOLUTE).number.compared("<=", LARGEST)


def sine(x: Value) -> Value:
    return of_quarter(nearest_quarter(x), x.bits & SIGN, 0)


def cosine(x: Value) -> Value:
    return of_quarter(nearest_quarter(x), x.bits & 0, 1)


def sine_of_large(x: Value) -> Value:
    value = of_quarter(nearest_quarter_of_large(x), x.bits & SIGN, 0)
    return is_finite(x).choose(value, x - x)


def cosine_of_large(x: Value) -> Value:
    value = of_quarter(nearest_quarter_of_large(x), x.bits & 0, 1)
    return is_finite(x).choose(value, x - x)


def is_small_angle(x: Value) -> Value:
    return (x.bits & ABSOLUTE).number.compared("<=", LARGEST_ANGLE)


def roots_of_two() -> list[int]:
    """2^(j/128) − 1, j = 0, ..., 127, times 2^64."""
    bits = 192
    root = 2 << bits
    for _ in range(PART_BITS):
        root = math.isqrt(root << bits)
    powers = [1 << bits]
    while len(powers) < PARTS_OF_TWO:
        powers.append((powers[-1] * root) >> bits)
    return [(power - (1 << bits)) >> (bits - 64) for power in powers]


def multiple_and_rest(x: Value) -> tuple[Value, Value]:
    """x = m ln(2)/128 + r; m as the low bits of a number."""
    rounded = x * PER_PART + ROUNDER
    m = rounded - ROUNDER
    return rounded.bits, (x - m * LN2_128[0]) - m * LN2_128[1]  # the first product and difference are exact


def power_of_two_times_exponential(m: Value, r: Value, exponent: Value) -> Value:
    """Return 2^(m mod 128 / 128) exp(r) times the power of two whose exponent bits are `exponent`; the table has 64
    bits of the first factor."""
    entry = looked_up(roots_of_two(), m & (PARTS_OF_TWO - 1), 1)[0]
    high = (((entry >> 12) | bits_of(1.0)) + exponent).number
    base = exponent + bits_of(2.0**-12)  # of such numbers a unit in the last place is 2^-64
    low = ((entry & LAST_12) + base).number - base.number
    square = r * r
    return high + (low + high * (r + square * polynomial(r, EXPONENTIAL)))


def exponential(x: Value) -> Value:
    m, r = multiple_and_rest(x)
    return power_of_two_times_exponential(m, r, (m >> PART_BITS) << 52)


def exponential_of_large(x: Value) -> Value:
    """Evaluate exp(x) for any x, also |x| above LARGEST_EXPONENT, with two more factors, neither of which overflows or
    is subnormal."""
    x = x.compared("<", LOWEST_EXPONENT).choose(LOWEST_EXPONENT, x)
    x = x.compared(">", HIGHEST_EXPONENT).choose(HIGHEST_EXPONENT, x)
    m, r = multiple_and_rest(x)
    k = ((m - bits_of(ROUNDER) + PARTS_OF_TWO * 2 * BIAS) >> PART_BITS) - 2 * BIAS
    half = ((k + 2 * BIAS) >> 1) - BIAS

    def power_of_two(exponent: Value) -> Value:
        return ((exponent + BIAS) << 52).number

    return power_of_two_times_exponential(m, r, m & 0) * power_of_two(half) * power_of_two(k - half)


def is_small_exponent(x: Value) -> Value:
    return (x.bits & ABSOLUTE).number.compared("<=", LARGEST_EXPONENT)


def logarithm(x: Value, exponent: Value | float = 0.0) -> Value:
    """ln x + exponent ln 2 of a normal x > 0, = m 2^k with m between 1/√2 and √2, f = m − 1, s = f/(2 + f)."""
    shifted = x.bits + (bits_of(1.0) - bits_of(ROOT_HALF))
    k = ((shifted >> 52) | bits_of(2.0**52)).number - (2.0**52 + BIAS)
    k = k + exponent if isinstance(exponent, Value) else k
    f = ((shifted & MANTISSA) + bits_of(ROOT_HALF)).number - 1.0
    s = f / (f + 2.0)
    z, half = s * s, (f * f) * 0.5
    # ln x = k ln 2 + f − f²/2 + s (f²/2 + s² p(s²)); the first three of the sum are added without error
    a = k * LN2[0]
    b = a + f
    c = b - half
    lost = (f - (b - a)) + ((b - c) - half)
    return c + (s * (half + z * polynomial(z, LOGARITHM)) + (lost + k * LN2[1]))


def logarithm_of_any(x: Value) -> Value:
    subnormal = x.compared("<", SMALLEST_NORMAL)
    normal = subnormal.choose(x * 2.0**54, x)
    value = logarithm(normal, subnormal.choose((x.bits & 0).number - 54.0, (x.bits & 0).number))
    value = x.compared("<=", LARGEST).choose(value, x)
    value = x.compared("==", 0.0).choose(-math.inf, value)
    return x.compared("<", 0.0).choose(math.nan, value)


def is_normal_and_positive(x: Value) -> Value:
    return x.compared(">=", SMALLEST_NORMAL) & x.compared("<=", LARGEST)


def half_power(x: Value, n: int) -> Value:
    """x^(n/2) of odd n from −5 to 5, as one would write it: √x, x √x or x² √x, or 1 divided by that. Each operation
    adds at most one unit of roundoff."""
    root = x.square_root()
    power = root if abs(n) == 1 else x * root if abs(n) == 3 else x * x * root
    return 1.0 / power if n < 0 else power


def has_half_powers(x: Value) -> Value:
    """Return whether x is in [2^-200, 2^200], where the formulas for half powers do not overflow or underflow in
    between."""
    return x.compared(">=", 2.0**-200) & x.compared("<=", 2.0**200)


class TwoFormulas(NamedTuple):
    """Formulas of a function: `usual` where `is_usual` is true, `unusual` elsewhere, which may take one number at a
    time."""

    usual: Callable[[Value], Value]
    is_usual: Callable[[Value], Value]
    unusual: Callable[[Value], Value]
    one_at_a_time: bool


FORMULAS = {
    "sin": TwoFormulas(sine, is_small_angle, sine_of_large, one_at_a_time=True),
    "cos": TwoFormulas(cosine, is_small_angle, cosine_of_large, one_at_a_time=True),
    "exp": TwoFormulas(exponential, is_small_exponent, exponential_of_large, one_at_a_time=False),
    "log": TwoFormulas(logarithm, is_normal_and_positive, logarithm_of_any, one_at_a_time=False),
}
#: Constant exponents of its power that have formulas, and their names.
POWERS = {n / 2: f"half_power_{n}".replace("-", "minus_") for n in (-5, -3, -1, 3, 5)}
FORMULAS |= {
    name: TwoFormulas(
        partial(half_power, n=round(2 * exponent)),
        has_half_powers,
        partial(Value.library_power, exponent=exponent),
        one_at_a_time=True,
    )
    for exponent, name in POWERS.items()
}
