"""A short campaign of each kind: no crash, no hang, no error in another's words, no wrong answer."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import campaign

CASES = {
    "calls": 500,
    "runs": 20,
    "files": 100,
    "fields": 30,
    "exceptions": 100,
    "networks": 10,
    "patterns": 30,
    "seams": 5,
}
SEED = 2026


@pytest.mark.skipif(not hasattr(campaign.os, "fork"), reason="each campaign is a forked process, which may die")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # a fork beside the threads of a BLAS
@pytest.mark.parametrize("kind", campaign.KINDS)
def test_nothing_goes_wrong(kind: str) -> None:
    assert [f"--only {kind}:{SEED}:{i} {what}" for i, what in campaign.failures(kind, SEED, CASES[kind])] == []


def _dies(random: object) -> None:
    campaign.os.kill(campaign.os.getpid(), campaign.signal.SIGKILL)


def _hangs(random: object) -> None:
    campaign.time.sleep(100)


def _raises(random: object) -> None:
    raise KeyError("x")


@pytest.mark.skipif(not hasattr(campaign.os, "fork"), reason="each campaign is a forked process, which may die")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(
    ("does", "told"), [(_dies, "killed by SIGKILL"), (_hangs, "hung for"), (_raises, "not caught: KeyError")]
)
def test_what_goes_wrong_is_told_and_the_next_case_is_done(monkeypatch, does, told):
    """A campaign that could not fail would show nothing."""
    monkeypatch.setattr(campaign, "PATIENCE", 1)
    monkeypatch.setitem(campaign.KINDS, "calls", does)
    found = list(campaign.failures("calls", 1, 2))
    assert [i for i, _ in found] == [0, 1]
    assert all(told in what for _, what in found)
