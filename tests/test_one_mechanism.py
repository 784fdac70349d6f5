"""Each thing is done by one mechanism, in the files that a table names."""

from __future__ import annotations

import re
from pathlib import Path

import invariode as iv

PACKAGE = Path(iv.__file__).parent

#: What stands in one file alone: how a plan runs again, who prepares plans, what keeps the latest of them, what a
#: problem is, weights of the error test, the course of a plan, derivatives of functions, the order of the ways to them
#: and increments for them, matrices of users, archives. No record is made by position, and no former format is read.
ONLY_IN = {
    r"\.integrate_anew\(": {"_run/prepared.py"},
    r"\bPrepared\(": {"_run/prepared.py", "_solve/prepared_solver.py"},
    r"\bPreparedSolver\(": {"_solve/prepared_solver.py", "_solve/bridge.py", "_problem/problem.py"},
    r"next\(iter\(\w+\)\)\]": {"_base/latest.py"},
    r"^class ArgumentLayout\b": {"_functions/layout.py"},
    r"^class \w+\((int|float|np\.ndarray)\b": set(),
    r"__dict__(\.get\(|\[)\"_make\"|^class Deferred\b": {"_results/records.py"},
    r"^class (Problem|Posed|Description)\b": {"_problem/problem.py", "petab/estimation_problem.py"},
    r"^class (Weights|Tolerances)\b": {"_base/arguments.py"},
    r"^class Course\b": {"_plan/plan.py"},
    r"from functools import .*\bcached_property|functools\.cached_property": {"_base/forks.py"},
    r"^class (\w+Spec|\w+Terms|CoreProblem)\b": {"_problem/core_problem.py"},
    r"(Settings|Plan|Course)\._make\(": set(),
    r"^def derivative_of\b|^class Derivative\b": {"_functions/derivatives.py"},
    r"^def way_of\b|def _mended\b|\bSides\(self": {"_functions/derivatives.py"},
    r"\bway_of\(": {"_functions/derivatives.py", "_linear/linear_terms.py", "_laws/bound.py"},
    r"^def as_matrix\b": {"_base/matrices.py"},
    r"\bOnCourse\(": {"_run/prepared.py", "_solve/prepared_solver.py"},
    r"\b[A-Z]\w*\._make\(|_origin: Any\b|Origin \| Any\b": set(),
    r"\bsavez\(": {"_base/files.py", "_base/formats.py"},
    r"earlier version|former (version|format)": set(),
    r"\b(TINY|INCREMENT|NOT_COMPLEX)\b": {"_functions/increments.py", "_functions/derivatives.py"},
    r"^def (compared|takes_complex|somewhere|sizes)\b": {"_functions/increments.py"},
    r"__signature__ = .*Problem|Problem\.__init__\.__qualname__": set(),
    r"\.__reduce_ex__\(|\.co_code\b": {"_functions/contents.py", "_files/code_digest.py"},
    r"^class \w+\(Contents\)": {"_files/code_digest.py"},
}


def test_each_thing_has_one_mechanism():
    texts = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    for pattern, files in ONLY_IN.items():
        found = {path for path, text in texts.items() if re.search(pattern, text, re.M)}
        assert {path.relative_to(PACKAGE).as_posix() for path in found} == files, pattern
