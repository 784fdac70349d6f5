"""Tables of a PEtab problem, versions 1 and 2: YAML and tab-separated values as plain data."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from .._base.package import extra
from .._base.suggestions import meant

_T = TypeVar("_T")

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

    Raises ValueError: It is of another version, or describes several problems, or a model that is not in SBML.
    """
    yaml = extra("yaml", "invariode.petab needs PyYAML, which provides", "petab")
    folder = os.path.dirname(path)
    if os.path.isdir(path):
        files = ", ".join(sorted(one for one in os.listdir(path) if one.endswith((".yaml", ".yml")))) or "none"
        raise IsADirectoryError(f"{path} is a folder: give the YAML file of the problem in it ({files})")
    with open(path, encoding="utf-8") as file:
        read = yaml.safe_load(file)
    if not isinstance(read, dict):
        raise ValueError(f"{path} is no problem of PEtab: it has no format_version")
    given = _Fields(path, read)
    version = str(given.get("format_version"))
    if version.split(".")[0] == "2":
        return _second(path, folder, given)
    if version.split(".")[0] != "1":
        raise ValueError(f"{path} is of version {version} of PEtab: versions 1 and 2 are read")
    if len(given["problems"]) != 1:
        raise ValueError(f"{path} describes {len(given['problems'])} problems: one is read")
    one = _Fields(path, given["problems"][0])
    if len(one["sbml_files"]) != 1:
        raise ValueError(f"{path} names {len(one['sbml_files'])} models: one is read")
    return _consistent(
        Tables(
            folder,
            os.path.join(folder, one["sbml_files"][0]),
            _by_id(_rows(folder, given["parameter_file"]), "parameterId", _parameter),
            _by_id(_rows(folder, one["condition_files"]), "conditionId", _condition),
            _by_id(_rows(folder, one["observable_files"]), "observableId", _observable),
            [_measurement(row) for row in _rows(folder, one["measurement_files"])],
        )
    )


class _Fields(dict[str, Any]):
    """The entries of a file, or of a row of it; one that is needed and not there is an error that names the file."""

    def __init__(self, where: str, given: dict[str, Any]) -> None:
        super().__init__(given)
        self.where = where

    def __missing__(self, name: str) -> Any:
        raise ValueError(f"{self.where}: there is no {name!r}{meant(name, self)}")

    def number(self, name: str, default: float | None = None) -> float:
        """Return a number; one that is not there is the default, or an error."""
        value: Any = self.get(name) if default is not None else self[name]
        if default is not None and _missing(value):
            return default
        try:
            return float(value)
        except (TypeError, ValueError):
            raise ValueError(f"{self.where}: {name} must be a number, got {value!r}") from None


def _by_id(rows: Iterable[_Fields], column: str, make: Callable[[_Fields], _T]) -> dict[str, _T]:
    """Return what rows describe by their ids, each of which must occur once."""
    found: dict[str, _T] = {}
    for row in rows:
        if row[column] in found:
            raise ValueError(f"{row.where}: {column} {row[column]!r} is there twice")
        found[row[column]] = make(row)
    return found


def _condition(row: _Fields) -> dict[str, float | str]:
    about = ("conditionId", "conditionName")
    return {name: _number_or_name(value) for name, value in row.items() if name not in about and not _missing(value)}


def _consistent(found: Tables) -> Tables:
    """Return the tables, whose ids must all be defined."""
    for one in found.measurements:
        ids: list[tuple[str | float, Collection[str], str]] = [
            (one.observable, found.observables, "observable"),
            (one.condition, found.conditions, "condition"),
            (one.before or one.condition, found.conditions, "condition"),
            *((each, found.parameters, "parameter") for each in (*one.observable_parameters, *one.noise_parameters)),
        ]
        for name, known, what in ids:
            if isinstance(name, str) and name not in known:
                raise ValueError(
                    f"the datum {one.value:g} at time {one.time:g} has the {what} {name!r}, which is not "
                    f"defined{meant(name, known)}"
                )
    return found


def _second(path: str, folder: str, given: _Fields) -> Tables:
    """Read the files of a problem of version 2, of which each experiment has one period, from t = 0 on, and perhaps a
    pre-equilibration."""

    def rows(kind: str) -> list[_Fields]:
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
        begun = periods.setdefault(row["experimentId"], {}).setdefault(row.number("time"), {})
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
    return _consistent(
        Tables(
            folder,
            os.path.join(folder, models[0]["location"]),
            _by_id(rows("parameter"), "parameterId", _parameter),
            conditions,
            _by_id(rows("observable"), "observableId", _observable),
            measurements,
            resets,
        )
    )


def _before(experiment: str) -> str:
    """Return the name of the condition of an experiment's pre-equilibration."""
    return f"{experiment} before"


def rows_of(path: str) -> list[_Fields]:
    """Return the rows of a table by column name."""
    with open(path, encoding="utf-8-sig", newline="") as file:
        return [_Fields(f"{path}, row {i}", one) for i, one in enumerate(csv.DictReader(file, delimiter="\t"), 1)]


def _rows(folder: str, names: str | list[str]) -> list[_Fields]:
    listed = [names] if isinstance(names, str) else names
    return [row for name in listed for row in rows_of(os.path.join(folder, name))]


def _missing(value: Any) -> bool:
    return value is None or str(value).strip() in ("", "nan", "NaN", "NA")


def _number_or_name(value: str) -> float | str:
    try:
        return float(value)
    except ValueError:
        return value.strip()


def _scale(value: str | None) -> Scale:
    text = "lin" if value is None or _missing(value) else value.strip()
    if text not in ("lin", "log", "log10"):
        raise ValueError(f"there is no scale {text!r}: there are lin, log and log10")
    return text  # type: ignore[return-value]  # one of them


def _prior(row: _Fields, kind: str, parameters: str) -> tuple[str, tuple[float, ...]] | None:
    name, numbers = row.get(kind), row.get(parameters)
    if name is None or _missing(name):
        return None
    given = "" if numbers is None or _missing(numbers) else numbers
    return name.strip().replace("-", ""), tuple(float(x) for x in given.split(";") if x.strip())


def _parameter(row: _Fields) -> ParameterRow:
    estimate = str(row.get("estimate", "1")).strip().lower().removesuffix(".0")
    if estimate not in ("0", "1", "true", "false"):
        raise ValueError(f"{row.where}: estimate must be 0 or 1, got {row['estimate']!r}")
    estimated = estimate in ("1", "true")
    scale = _scale(row.get("parameterScale"))
    lower, upper = row.number("lowerBound", -math.inf), row.number("upperBound", math.inf)
    if estimated and (lower > upper or (scale != "lin" and -math.inf < lower < 0)):
        raise ValueError(f"{row.where}: the bounds {lower:g} and {upper:g} leave no values on the scale {scale}")
    return ParameterRow(
        row["parameterId"],
        scale,
        row.number("nominalValue", math.nan),
        lower,
        upper,
        estimated,
        _prior(row, "objectivePriorType", "objectivePriorParameters")
        or _prior(row, "priorDistribution", "priorParameters"),
    )


def _observable(row: _Fields) -> ObservableRow:
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


def _measurement(row: _Fields, conditions: Sequence[str] | dict[str, Any] = ()) -> Measurement:
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
        row.number("measurement"),
        row.number("time"),
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

    Raises ValueError: There is no such prior.
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
