"""Tables of a PEtab problem, versions 1 and 2: YAML and tab-separated values as plain data."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from .._base.package import extra

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


@dataclass
class ObservableRow:
    """An observable: formulas, transformation and distribution of the noise, and placeholders in both formulas, which
    measurements fill in their order; None: they are called by number, as in version 1."""

    name: str
    formula: str
    noise: str
    scale: Scale
    laplace: bool
    placeholders: tuple[str, ...] | None = None
    noise_placeholders: tuple[str, ...] | None = None


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
    """A problem as its files have it. `conditions`: values by condition and symbol, numbers or names of parameters.
    `resets`: the symbols that a condition sets after a pre-equilibration; all of its own if it is not there."""

    folder: str
    model: str
    parameters: dict[str, ParameterRow]
    conditions: dict[str, dict[str, float | str]]
    observables: dict[str, ObservableRow]
    measurements: list[Measurement]
    resets: dict[str, set[str]] = field(default_factory=dict)


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
    if version.split(".")[0] == "2":
        return _second(path, folder, given)
    if version.split(".")[0] != "1":
        raise ValueError(f"{path} is of version {version} of PEtab: versions 1 and 2 are read")
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


def _second(path: str, folder: str, given: dict[str, Any]) -> Tables:
    """Read the files of a problem of version 2, of which each experiment has one period, from t = 0 on, and perhaps a
    pre-equilibration."""

    def rows(kind: str) -> list[dict[str, str]]:
        return _rows(folder, given.get(f"{kind}_files") or [])

    models = [*(given.get("model_files") or {}).values()]
    if len(models) != 1 or models[0].get("language") != "sbml":
        listed = ", ".join(f"{one.get('location')} ({one.get('language')})" for one in models)
        raise ValueError(f"{path} names the models {listed or 'none'}: one in SBML is read")
    changes: dict[str, dict[str, float | str]] = {}
    for row in rows("condition"):
        value = _number_or_name(row["targetValue"])
        if isinstance(value, str) and not value.isidentifier():
            raise ValueError(
                f"condition {row['conditionId']!r} sets {row['targetId']!r} by the formula {value!r}: numbers and "
                "names of parameters are read"
            )
        changes.setdefault(row["conditionId"], {})[row["targetId"]] = value
    periods: dict[str, dict[float, dict[str, float | str]]] = {"": {}}
    for row in rows("experiment"):
        condition = row.get("conditionId")
        begun = periods.setdefault(row["experimentId"], {}).setdefault(float(row["time"]), {})
        if condition is not None and not _missing(condition):
            begun.update(changes[condition])
    conditions: dict[str, dict[str, float | str]] = {}
    resets: dict[str, set[str]] = {}
    for name, own in periods.items():
        finite = sorted(t for t in own if t > -math.inf)
        if finite not in ([], [0.0]):
            raise ValueError(
                f"experiment {name!r} has periods that begin at {', '.join(f'{t:g}' for t in finite)}: one that begins "
                "at 0 is read, and a pre-equilibration from -inf"
            )
        main: dict[str, float | str] = own.get(0.0, {})
        before = own.get(-math.inf)
        conditions[name] = {**(before or {}), **main}
        if before is not None:  # whose changes stay in effect
            conditions[_before(name)], resets[name] = before, {*main}
    measurements = [_measurement(row, conditions) for row in rows("measurement")]
    return Tables(
        folder,
        os.path.join(folder, models[0]["location"]),
        {row["parameterId"]: _parameter(row) for row in rows("parameter")},
        conditions,
        {row["observableId"]: _observable(row) for row in rows("observable")},
        measurements,
        resets,
    )


def _before(experiment: str) -> str:
    """Return the name of the condition of an experiment's pre-equilibration."""
    return f"{experiment} before"


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


def _prior(row: dict[str, str], kind: str, parameters: str) -> tuple[str, tuple[float, ...]] | None:
    name, numbers = row.get(kind), row.get(parameters)
    if name is None or _missing(name):
        return None
    given = "" if numbers is None or _missing(numbers) else numbers
    return name.strip().replace("-", ""), tuple(float(x) for x in given.split(";") if x.strip())


def _parameter(row: dict[str, str]) -> ParameterRow:
    estimated = str(row.get("estimate", "1")).strip().lower().split(".")[0] in ("1", "true")
    return ParameterRow(
        row["parameterId"],
        _scale(row.get("parameterScale")),
        _float(row, "nominalValue"),
        _float(row, "lowerBound", -math.inf),
        _float(row, "upperBound", math.inf),
        estimated,
        _prior(row, "objectivePriorType", "objectivePriorParameters")
        or _prior(row, "priorDistribution", "priorParameters"),
    )


def _observable(row: dict[str, str]) -> ObservableRow:
    law = (row.get("noiseDistribution") or "normal").strip() or "normal"
    if law.removeprefix("log-") not in ("normal", "laplace"):
        raise ValueError(
            f"there is no distribution of noise {law!r}: there are normal, laplace, log-normal, log-laplace"
        )
    scale = "log" if law.startswith("log-") else _scale(row.get("observableTransformation"))
    placeholders = [
        None if name not in row else tuple(x.strip() for x in (row[name] or "").split(";") if x.strip())
        for name in ("observablePlaceholders", "noisePlaceholders")
    ]
    formulas = row["observableFormula"], row["noiseFormula"]
    return ObservableRow(row["observableId"], *formulas, scale, law.endswith("laplace"), *placeholders)


def _measurement(row: dict[str, str], conditions: Sequence[str] | dict[str, Any] = ()) -> Measurement:
    def listed(name: str) -> tuple[str | float, ...]:
        text = row.get(name)
        return () if text is None or _missing(text) else tuple(_number_or_name(x) for x in text.split(";"))

    if "simulationConditionId" in row:
        before, condition = row.get("preequilibrationConditionId"), row["simulationConditionId"]
        before = "" if before is None or _missing(before) else before
    else:
        condition = row.get("experimentId") or ""
        before = _before(condition) if _before(condition) in conditions else ""
    return Measurement(
        row["observableId"],
        before,
        condition,
        float(row["measurement"]),
        float(row["time"]),
        listed("observableParameters"),
        listed("noiseParameters"),
    )


def fit_prior(one: ParameterRow) -> Any:
    """Return the prior of a parameter as `invariode.Parameter` takes it; None: uniform within the bounds."""
    if one.prior is None:
        return None
    kind, numbers = one.prior
    plain = kind.removeprefix("parameterScale").lower()
    scale: Scale = one.scale if kind.startswith("parameterScale") else "lin"
    if plain == "uniform":
        return None
    if plain not in ("normal", "lognormal", "laplace", "loglaplace"):
        raise ValueError(f"there is no prior {kind!r}")
    middle, width = numbers
    if plain.startswith("log"):
        return plain, math.exp(middle), width
    if scale == "lin":
        return plain, middle, width
    unit = 1.0 if scale == "log" else math.log(10.0)  # of logarithms on the parameter's scale
    return f"log{plain}", math.exp(middle * unit), width * unit


def log_density(kind: str, numbers: tuple[float, ...], value: float, scaled: float) -> tuple[float, float, bool]:
    """Return the logarithm of a prior's density, its derivative, and whether that is on the parameter's scale.

    Raises
    ------
    ValueError
        There is no such prior.
    """
    on_scale = kind.startswith("parameterScale")
    plain = kind.removeprefix("parameterScale").lower()
    x = scaled if on_scale else value
    if plain == "uniform":
        low, high = numbers
        return (-math.log(high - low) if low <= x <= high else -math.inf), 0.0, on_scale
    if plain in ("normal", "lognormal"):
        mean, sd = numbers
        z = math.log(x) if plain == "lognormal" else x
        r = (z - mean) / sd
        inner = 1 / x if plain == "lognormal" else 1.0
        found = -0.5 * math.log(2 * math.pi) - math.log(sd) - 0.5 * r * r - (z if plain == "lognormal" else 0.0)
        return found, -r / sd * inner - (inner if plain == "lognormal" else 0.0), on_scale
    if plain in ("laplace", "loglaplace"):
        mean, width = numbers
        z = math.log(x) if plain == "loglaplace" else x
        inner = 1 / x if plain == "loglaplace" else 1.0
        found = -math.log(2 * width) - abs(z - mean) / width - (z if plain == "loglaplace" else 0.0)
        slope = -math.copysign(1.0, z - mean) / width * inner - (inner if plain == "loglaplace" else 0.0)
        return found, slope, on_scale
    raise ValueError(f"there is no prior {kind!r}")
