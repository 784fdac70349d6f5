"""Answers of `invariode compare`: costs at equal error, and the sentence that sums them up."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from invariode._studies.precision import ComparedMethod, Judgement, Run, best, judge, judgements
from invariode.cli.compare import answer


def rows_of_order(
    p: int, ratio: float, method: str = "ode45", gain: float = 10.0, price: float = 1e-6
) -> list[ComparedMethod]:
    """Runs whose cost is error^(-1/p), and projected ones that take `ratio` times the time at equal error."""
    rows = []
    for k in range(3, 10):
        error, projected = 10.0 ** (1 - k), 10.0 ** (1 - k) / gain
        f = [round(1e3 * e ** (-1 / p)) for e in (error, projected)]
        runs = [
            Run(e, n, 0, 0, 1e3 * price * factor * e ** (-1 / p))
            for e, n, factor in zip((error, projected), f, (1, ratio), strict=True)
        ]
        rows.append(ComparedMethod(method, 10.0**-k, *runs))
    return rows


@pytest.mark.parametrize("ratio", [0.3, 1.0, 2.5])
@pytest.mark.parametrize("p", [3, 5, 8])
def test_cost_at_equal_error_is_interpolated_exactly_on_power_laws(p, ratio):
    (found,) = judgements(rows_of_order(p, ratio), floor=1e-15)
    assert len(found.errors) >= 5
    assert found.time == pytest.approx([ratio] * len(found.errors), rel=1e-9)
    assert found.f == pytest.approx([1.0] * len(found.errors), rel=0.01)  # counts are integers


@pytest.mark.parametrize(
    ("ratios", "kind"),
    [
        ([0.5, 0.6, 0.7], ("worth it", None)),
        ([1.5, 1.2, 1.3], ("not", None)),
        ([1.05, 0.95, 1.0], ("even", None)),
        ([0.5, 0.98, 0.8], ("worth it", None)),
        ([0.5, 0.7, 1.3], ("above", 1e-3)),
        ([1.5, 0.7, 0.3], ("below", 1e-3)),
        ([0.5, 1.5, 0.5], ("mixed", None)),
        ([], ("unknown", None)),
    ],
)
def test_verdict_on_ratios(ratios, kind):
    assert judge([1e-2, 1e-3, 1e-4][: len(ratios)], ratios) == kind


@pytest.mark.parametrize(
    ("time", "f", "says"),
    [
        ([0.5, 0.6], [0.5, 0.6], "is worth it here: at equal error it takes 0.5 to 0.6 × the time of a tighter"),
        ([2.0, 2.0], [2.0, 2.0], "is not worth it here: at equal error it takes 2 × the time of a tighter"),
        ([2.0, 2.0], [0.5, 0.5], "it takes 0.5 × the evaluations of f, so it is worth it if f is costly."),
        ([0.5, 2.0], [0.5, 2.0], "at errors from 1e-2 up, where it takes 0.5 × the time"),
        ([2.0, 0.5], [2.0, 0.5], "at errors from 1e-3 down, where it takes 0.5 × the time"),
        ([1.0, 1.0], [1.0, 1.0], "costs as much here as a tighter tolerance"),
    ],
)
def test_answer_is_one_sentence(time, f, says):
    text = answer(Judgement("", [1e-2, 1e-3], time, f, [("ode113", "ode45")] * 2))
    assert says in text
    assert re.fullmatch(r"[^.]*(\d\.\d[^.]*)*\.", text)  # no other full stop


def test_best_methods_are_compared_and_named():
    rows = [*rows_of_order(5, 0.5, "ode45"), *rows_of_order(5, 2.0, "dop853", price=0.5e-6)]
    found = best(rows, floor=1e-15)
    assert set(found.by) == {("dop853", "ode45")}
    assert found.time == pytest.approx([1.0] * len(found.errors), rel=1e-9)


def test_errors_that_a_cheaper_method_was_not_asked_for_are_left_out():
    cheap, dear = rows_of_order(8, 1.0, "dop853")[:3], rows_of_order(3, 1.0, "ode23")
    assert min(best([*cheap, *dear], floor=1e-15).errors) > min(best(dear, floor=1e-15).errors)


def test_errors_below_the_accuracy_of_the_reference_are_not_compared():
    (found,) = judgements(rows_of_order(5, 0.5), floor=1e-4)
    assert min(found.errors) >= 1e-4 * (1 - 1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_a_disturbed_clock_changes_costs_and_not_the_errors_compared(seed):
    """On a busy machine a loose run may seem dearer than a tight one."""
    rng = np.random.default_rng(seed)
    rows = rows_of_order(5, 2.0)[seed % 3 :][:3]
    disturbed = [
        ComparedMethod(
            row.method,
            row.rtol,
            *(replace(run, seconds=run.seconds * rng.uniform(1, 1000)) for run in (row.plain, row.projected)),
        )
        for row in rows
    ]
    for judged in (lambda rows: judgements(rows, 1e-15)[0], lambda rows: best(rows, 1e-15)):
        assert judged(rows).errors
        assert judged(disturbed).errors == judged(rows).errors
        assert judged(disturbed).f == judged(rows).f
