"""The options of each way in, by name. The stub beside this file, made from the table of options by ``make stubs``,
spells them out: editors that do not read `Unpack` follow calls of these functions to complete and to show options."""

from __future__ import annotations

from typing import Unpack

from .options import (
    AllOptions,
    EnsembleOptions,
    ExtensionOptions,
    Options,
    ProblemEnsembleOptions,
    SolveOptions,
    StepperOptions,
)

__all__ = [
    "ensemble_options",
    "extension_options",
    "problem_ensemble_options",
    "run_options",
    "solve_options",
    "stepper_options",
    "suite_options",
]


def solve_options(**options: Unpack[SolveOptions]) -> SolveOptions:
    return options


def run_options(**options: Unpack[Options]) -> Options:
    return options


def suite_options(**options: Unpack[AllOptions]) -> AllOptions:
    return options


def ensemble_options(**options: Unpack[EnsembleOptions]) -> EnsembleOptions:
    return options


def problem_ensemble_options(**options: Unpack[ProblemEnsembleOptions]) -> ProblemEnsembleOptions:
    return options


def extension_options(**options: Unpack[ExtensionOptions]) -> ExtensionOptions:
    return options


def stepper_options(**options: Unpack[StepperOptions]) -> StepperOptions:
    return options
