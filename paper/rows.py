"""Rows of the table 'paper | here': a published number, the number computed here, and whether they agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from invariode._results.records import Stats

from .published import PAPER

__all__ = ["DIGITS", "LAST_DIGIT", "SIZE", "Row", "Rule", "at_digits_of", "of_the_paper", "within"]

#: 'Only the size' of an error is to be met where roundoff decides: within this factor.
SIZE_FACTOR = 3.0


def decimals(printed: str) -> int:
    """Digits after the decimal point, of the mantissa if there is an exponent."""
    mantissa = printed.partition("e")[0]
    return len(mantissa.partition(".")[2])


def at_digits_of(printed: str, value: float) -> str:
    """`value` with as many digits, and an exponent as wide, as `printed` has."""
    if "e" not in printed:
        return f"{value:.{decimals(printed)}f}"
    mantissa, _, exponent = f"{value:.{decimals(printed)}e}".partition("e")
    width = len(printed.partition("e")[2].lstrip("+-"))
    return f"{mantissa}e{'-' if exponent.startswith('-') else ''}{abs(int(exponent)):0{width}d}"


@dataclass(frozen=True)
class Rule:
    """When a value agrees with a printed one: `agree(printed, value)`, and that in words (empty for the usual rule)."""

    agree: Callable[[str, float], bool]
    words: str = ""


def last_unit(printed: str) -> float:
    """A unit in the last printed digit."""
    return 10.0 ** (int(printed.partition("e")[2] or 0) - decimals(printed))


def within(difference: float, words: str) -> Rule:
    """Agreement to an absolute difference from the printed number, which is rounded."""
    return Rule(lambda printed, value: abs(value - float(printed)) <= difference + last_unit(printed) / 2, words)


def _last_digit(printed: str, value: float) -> bool:
    return abs(float(at_digits_of(printed, value)) - float(printed)) < 1.5 * last_unit(printed)


#: Rounded to the printed digits, the value is what is printed.
DIGITS = Rule(lambda printed, value: float(at_digits_of(printed, value)) == float(printed))
#: The last digit may be off by one: roundoff has reached it.
LAST_DIGIT = Rule(_last_digit, "to one unit of the last digit")
#: Round-off is all there is.
SIZE = Rule(
    lambda printed, value: 1 / SIZE_FACTOR <= value / float(printed) <= SIZE_FACTOR,
    "in size only: roundoff decides",
)


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes
    ----------
    experiment : str
        The group of rows it belongs to.
    quantity : str
        What is measured.
    printed : str or None
        The number, or the words, as published; None if there is no published value.
    value : float
        What was computed here.
    source : str
        Where the published value stands.
    rule : Rule
        When the two agree.
    stats : Stats or None
        Counts of the run.
    """

    experiment: str
    quantity: str
    printed: str | None
    value: float
    source: str = ""
    rule: Rule = DIGITS
    stats: Stats | None = None

    @property
    def here(self) -> str:
        """The value at the printed digits, or at two where words or nothing is printed."""
        try:
            float(self.printed or "")
        except ValueError:
            return at_digits_of("0.0e-0", self.value)
        return at_digits_of(self.printed or "", self.value)

    @property
    def agrees(self) -> bool | None:
        """Whether the value is the published one; None if nothing is published."""
        return None if self.printed is None else self.rule.agree(self.printed, self.value)

    @property
    def counts(self) -> tuple[int, ...] | None:
        """Steps, failed attempts, evaluations of f, projections, evaluations of g."""
        s = self.stats
        return None if s is None else (s.steps, s.failed, s.nfev, s.projections, s.ng)


def of_the_paper(
    key: str, experiment: str, quantity: str, value: float, stats: Stats | None = None, rule: Rule = DIGITS
) -> Row:
    """The row of what the paper prints under this key."""
    printed, source = PAPER[key]
    return Row(experiment, quantity, printed, value, source, rule, stats)
