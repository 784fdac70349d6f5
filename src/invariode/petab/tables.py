"""Tables of a PEtab problem, version 1: YAML and tab-separated values as plain data."""

from __future__ import annotations

import csv
import math
import os
from dataclasses import dataclass
from typing import Any, Literal

from .._base.extras import extra

#: A transformation of parameters or observables.
Scale = Literal["lin", "log", "log10"]


@dataclass
class ParameterRow:
    """A parameter: its nominal value and bounds on the linear scale, and the scale of its estimation."""

    name: str
    scale: Scale
    nominal: float
    lower: float
    upper: float
    estimated: bool
    prior: tuple[str, tuple[float, ...]] | None
    initialization: tuple[str, tuple[float, ...]] | None


@dataclass
class ObservableRow:
    """An observable: formulas, transformation and distribution of the noise."""

    name: str
    formula: str
    noise: str
    scale: Scale
    laplace: bool


@dataclass
class Measurement:
    """A datum."""

    observable: str
    before: str  # the condition of the pre-equilibration, or ""
    condition: str
    value: float
    time: float
    observable_parameters: tuple[str | float, ...]
    noise_parameters: tuple[str | float, ...]


@dataclass
class Tables:
    """A problem as its files have it. `conditions`: values by condition and symbol, numbers or names of parameters."""

    folder: str
    model: str
    parameters: dict[str, ParameterRow]
    conditions: dict[str, dict[str, float | str]]
    observables: dict[str, ObservableRow]
    measurements: list[Measurement]


def tables(path: str) -> Tables:
    """Read the files of a problem.

    Raises
    ------
    ValueError
        It is of another version, or describes several problems, or a model that is not in SBML.
    """
    yaml = extra("yaml", "invariode.petab needs PyYAML, which provides", "petab")
    folder = os.path.dirname(path)
    with open(path, encoding="utf-8") as file:
        given = yaml.safe_load(file)
    version = str(given.get("format_version"))
    if version.split(".")[0] != "1":
        raise ValueError(f"{path} is of version {version} of PEtab: version 1 is read")
    if len(given["problems"]) != 1:
        raise ValueError(f"{path} describes {len(given['problems'])} problems: one is read")
    one = given["problems"][0]
    if len(one["sbml_files"]) != 1:
        raise ValueError(f"{path} names {len(one['sbml_files'])} models: one is read")
    conditions = {
        row["conditionId"]: {
            name: _number_or_name(value)
            for name, value in row.items()
            if name not in ("conditionId", "conditionName") and not _missing(value)
        }
        for row in _rows(folder, one["condition_files"])
    }
    return Tables(
        folder,
        os.path.join(folder, one["sbml_files"][0]),
        {row["parameterId"]: _parameter(row) for row in _rows(folder, given["parameter_file"])},
        conditions,
        {row["observableId"]: _observable(row) for row in _rows(folder, one["observable_files"])},
        [_measurement(row) for row in _rows(folder, one["measurement_files"])],
    )


def rows_of(path: str) -> list[dict[str, str]]:
    """Return the rows of a table by column name."""
    with open(path, encoding="utf-8-sig", newline="") as file:
        return list(csv.DictReader(file, delimiter="\t"))


def _rows(folder: str, names: str | list[str]) -> list[dict[str, str]]:
    listed = [names] if isinstance(names, str) else names
    return [row for name in listed for row in rows_of(os.path.join(folder, name))]


def _missing(value: Any) -> bool:
    return value is None or str(value).strip() in ("", "nan", "NaN", "NA")


def _number_or_name(value: str) -> float | str:
    try:
        return float(value)
    except ValueError:
        return value.strip()


def _float(row: dict[str, str], name: str, default: float = math.nan) -> float:
    value = row.get(name)
    return default if value is None or _missing(value) else float(value)


def _scale(value: str | None) -> Scale:
    text = "lin" if value is None or _missing(value) else value.strip()
    if text not in ("lin", "log", "log10"):
        raise ValueError(f"there is no scale {text!r}: there are lin, log and log10")
    return text  # type: ignore[return-value]  # one of them


def _prior(row: dict[str, str], kind: str) -> tuple[str, tuple[float, ...]] | None:
    name, numbers = row.get(f"{kind}PriorType"), row.get(f"{kind}PriorParameters")
    if name is None or _missing(name):
        return None
    given = "" if numbers is None or _missing(numbers) else numbers
    return name.strip(), tuple(float(x) for x in given.split(";") if x.strip())


def _parameter(row: dict[str, str]) -> ParameterRow:
    estimated = str(row.get("estimate", "1")).strip().split(".")[0] == "1"
    return ParameterRow(
        row["parameterId"],
        _scale(row.get("parameterScale")),
        _float(row, "nominalValue"),
        _float(row, "lowerBound", -math.inf),
        _float(row, "upperBound", math.inf),
        estimated,
        _prior(row, "objective"),
        _prior(row, "initialization"),
    )


def _observable(row: dict[str, str]) -> ObservableRow:
    law = (row.get("noiseDistribution") or "normal").strip() or "normal"
    if law not in ("normal", "laplace"):
        raise ValueError(f"there is no distribution of noise {law!r}: there are normal and laplace")
    scale = _scale(row.get("observableTransformation"))
    return ObservableRow(row["observableId"], row["observableFormula"], row["noiseFormula"], scale, law == "laplace")


def _measurement(row: dict[str, str]) -> Measurement:
    def listed(name: str) -> tuple[str | float, ...]:
        text = row.get(name)
        return () if text is None or _missing(text) else tuple(_number_or_name(x) for x in text.split(";"))

    before = row.get("preequilibrationConditionId")
    return Measurement(
        row["observableId"],
        "" if before is None or _missing(before) else before,
        row["simulationConditionId"],
        float(row["measurement"]),
        float(row["time"]),
        listed("observableParameters"),
        listed("noiseParameters"),
    )
