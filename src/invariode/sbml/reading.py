"""Reading: a document of SBML, Levels 1 to 3, as plain data."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from typing import Any

from .._base.arguments import shown
from .formulas import Expression, read
from .library import UnsupportedError, libsbml

#: Packages that change nothing of a simulation.
_HARMLESS = {"comp", "layout", "render", "groups", "annot", "l3v2extendedmath", "fbc", "req"}

#: Errors of libSBML whose meaning is clear: a missing XML declaration, ids of metadata, terms and units, rateOf() of
#: what a rule assigns, a species that its reaction does not list; and, by their first three digits of five, those of
#: annotations, terms, notes and definitions of units.
_CLEAR = {1001, 1002, 1003, 10224, 10225, 10307, 10308, 10309, 10311, 10313, 21121}
_CLEAR_GROUPS = {104, 107, 108, 204}

#: Errors that a message lists.
_LISTED = 3


@dataclass
class Compartment:
    """A compartment; `size` is NaN if the file has none."""

    size: float
    constant: bool
    dimensions: float


@dataclass
class Species:
    """A species.

    Attributes
    ----------
    compartment : str
        Where it is.
    initial : float
        The number in the file, NaN if the file has no number.
    initial_is_amount : bool
        Whether that is an amount; otherwise it is a concentration.
    is_amount : bool
        Whether its symbol in formulas means an amount.
    boundary, constant : bool
        As in the file.
    factor : str
        The symbol of its conversion factor, or "".
    """

    compartment: str
    initial: float
    initial_is_amount: bool
    is_amount: bool
    boundary: bool
    constant: bool
    factor: str


@dataclass
class Reaction:
    """A reaction: its rate, and how it changes species: (species, sign, number or symbol)."""

    law: Expression | None
    changes: list[tuple[str, int, float | str]]
    fast: bool


@dataclass
class EventRule:
    """An event as the file has it."""

    name: str
    trigger: Expression
    initial: bool
    persistent: bool
    priority: Expression | None
    delay: Expression | None
    at_trigger: bool
    assignments: dict[str, Expression]


@dataclass
class ModelContents:
    """Contents of the file of a model."""

    name: str
    level: int
    compartments: dict[str, Compartment] = field(default_factory=dict)
    species: dict[str, Species] = field(default_factory=dict)
    #: Numbers of parameters and stoichiometries; NaN where the file has none
    values: dict[str, float] = field(default_factory=dict)
    constants: set[str] = field(default_factory=set)  # symbols of these that may not change
    reactions: dict[str, Reaction] = field(default_factory=dict)
    rules: dict[str, Expression] = field(default_factory=dict)
    rates: dict[str, Expression] = field(default_factory=dict)
    algebraic: list[Expression] = field(default_factory=list)
    initial: dict[str, Expression] = field(default_factory=dict)
    events: list[EventRule] = field(default_factory=list)
    done: list[str] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)  # what has no effect on a simulation


def contents(source: str) -> ModelContents:
    """Read a model from a path, or from its text.

    Raises FileNotFoundError: There is no such file.
    Raises ValueError: It is no valid model.
    Raises UnsupportedError: It uses what has no equations here.
    """
    L = libsbml()
    document, folder = _document(L, source)
    model = document.getModel()
    found = ModelContents(model.getId() or model.getName() or "model", model.getLevel())
    _require_packages(document, found)
    _require_valid(L, document, found)
    if model.getPlugin("comp") is not None:
        _convert(L, document, "flatten comp", performValidation=False, basePath=folder)
        found.done.append("submodels of the package comp were flattened")
    _convert(L, document, "expandFunctionDefinitions")
    _convert(L, document, "promoteLocalParameters")
    model = document.getModel()
    found.level = model.getLevel()
    fbc = model.getPlugin("fbc")
    if fbc is not None and (fbc.getNumObjectives() or fbc.getNumFluxBounds()):
        raise UnsupportedError("flux balance", "the model is one of flux balance: it has an objective, and no rates")
    _symbols(model, found)
    _rules(model, found)
    _reactions(model, found)
    found.events = [
        _event(one, i, found.level)
        for i, one in enumerate(model.getListOfEvents())
        if one.isSetTrigger() and one.getTrigger().isSetMath()
    ]
    if count := model.getNumConstraints():
        found.ignored.append(f"{count} constraints, which report invalid states and change none")
    if model.getNumUnitDefinitions():
        found.ignored.append("units: numbers are taken as they are")
    return found


def _document(L: Any, source: str) -> tuple[Any, str]:
    """Return the document, and the folder of its references."""
    if source.lstrip().startswith("<"):
        document, folder = L.readSBMLFromString(source), ""
    else:
        is_text = any(sign in source for sign in ("\n", ";", "->"))
        if not (is_text or os.path.exists(source)):
            raise FileNotFoundError(f"there is no file {shown(source)}, and the text of a model begins with <")
        if is_text or source.endswith(".ant"):
            return L.readSBMLFromString(_from_antimony(source, is_text)), "" if is_text else os.path.dirname(source)
        document, folder = L.readSBMLFromFile(source), os.path.dirname(source)
    if document.getModel() is None:
        why = _in_words(document.getError(0)) if document.getNumErrors() else "it has no model"
        raise ValueError(f"this is no model in SBML: {why}")
    return document, folder


def _require_valid(L: Any, document: Any, found: ModelContents) -> None:
    """Raise an error where the model breaks SBML's rules: ids that are taken, symbols that are not defined, several
    rules for one variable, and so on. Errors whose meaning is clear go into `found.ignored`."""
    checked = (
        L.LIBSBML_CAT_GENERAL_CONSISTENCY,
        L.LIBSBML_CAT_IDENTIFIER_CONSISTENCY,
        L.LIBSBML_CAT_MATHML_CONSISTENCY,
    )
    for category in range(L.LIBSBML_CAT_SBML, L.LIBSBML_CAT_MODELING_PRACTICE + 1):
        document.setConsistencyChecks(category, category in checked)
    wrong, clear = _errors(L, document)
    if not wrong:  # otherwise it has not been read as it is meant
        document.checkConsistency()
        wrong, clear = _errors(L, document)
    if wrong:
        more = f"; and {len(wrong) - _LISTED} more" if len(wrong) > _LISTED else ""
        raise ValueError(f"this is no valid SBML: {'; '.join(wrong[:_LISTED])}{more}")
    found.ignored += dict.fromkeys(clear)


def _errors(L: Any, document: Any) -> tuple[list[str], list[str]]:
    """Return the errors that have been found in the document so far, and those whose meaning is clear."""
    wrong: list[str] = []
    clear: list[str] = []
    for i in range(document.getNumErrors()):
        one = document.getError(i)
        if one.getSeverity() >= L.LIBSBML_SEV_ERROR:
            number = one.getErrorId()
            (clear if number in _CLEAR or number // 100 in _CLEAR_GROUPS else wrong).append(_in_words(one))
    return wrong, clear


def _in_words(error: Any) -> str:
    """Return what is wrong, and in which line: the sentences behind the rule that is broken, or that rule."""
    rule, reference, about = error.getMessage().strip().partition("\nReference:")
    about = " ".join(about.split("\n", 1)[-1].split()) if "\n" in about else ""
    short = error.getShortMessage()
    return (
        f"line {error.getLine()}: {short}{': ' + (about or ' '.join(rule.split())) if about or not reference else ''}"
    )


def _from_antimony(source: str, is_text: bool) -> str:
    """Return the SBML of a file in Antimony, or of its text."""
    from .._base.package import extra

    antimony = extra("antimony", "models in Antimony need", "")
    antimony.clearPreviousLoads()
    if (antimony.loadAntimonyString if is_text else antimony.loadAntimonyFile)(source) < 0:
        raise ValueError(f"{shown(source)}: {antimony.getLastError().strip()}")
    text: str = antimony.getSBMLString(antimony.getMainModuleName())
    return text


def _require_packages(document: Any, found: ModelContents) -> None:
    for i in range(document.getNumPlugins()):
        plugin = document.getPlugin(i)
        name = plugin.getPackageName()
        if name in _HARMLESS:
            continue
        if document.getPackageRequired(name):
            raise UnsupportedError(
                f"package {name}", f"the model needs the package {name!r}, which changes its meaning"
            )
        found.ignored.append(f"the package {name}")
    for i in range(document.getNumUnknownPackages()):
        name = document.getUnknownPackagePrefix(i)
        if document.getUnknownPackageRequired(i) if hasattr(document, "getUnknownPackageRequired") else True:
            raise UnsupportedError(f"package {name}", f"the model needs the package {name!r}, which is not known")


def _convert(L: Any, document: Any, what: str, **options: Any) -> None:
    properties = L.ConversionProperties()
    properties.addOption(what, True)
    for name, value in options.items():
        properties.addOption(name, value)
    if document.convert(properties) != 0:
        log = document.getErrorLog()
        why = log.getError(log.getNumErrors() - 1).getMessage().strip() if log.getNumErrors() else "no reason is given"
        raise UnsupportedError(what, f"libSBML cannot {what}: {why}")


def _symbols(model: Any, found: ModelContents) -> None:
    """Read compartments, species and parameters into `found`."""
    for one in model.getListOfCompartments():
        dimensions = one.getSpatialDimensionsAsDouble()
        default = 1.0 if found.level < 3 or dimensions == 0 else math.nan
        size = one.getSize() if one.isSetSize() else default
        found.compartments[one.getId()] = Compartment(size, one.getConstant(), dimensions)
    for one in model.getListOfSpecies():
        where = one.getCompartment()
        flat = where in found.compartments and found.compartments[where].dimensions == 0
        is_amount = bool(one.getHasOnlySubstanceUnits() or flat)
        as_amount = one.isSetInitialAmount() or (is_amount and not one.isSetInitialConcentration())
        value = one.getInitialAmount() if one.isSetInitialAmount() else one.getInitialConcentration()
        given = one.isSetInitialAmount() or one.isSetInitialConcentration()
        factor = one.getConversionFactor() if one.isSetConversionFactor() else model.getConversionFactor()
        found.species[one.getId()] = Species(
            where,
            value if given else math.nan,
            as_amount,
            is_amount,
            one.getBoundaryCondition(),
            one.getConstant(),
            factor,
        )
    for one in model.getListOfParameters():
        _value(found, one.getId(), one.getValue() if one.isSetValue() else math.nan, one.getConstant())


def _value(found: ModelContents, name: str, value: float, constant: bool) -> None:
    found.values[name] = value
    if constant:
        found.constants.add(name)


def _rules(model: Any, found: ModelContents) -> None:
    for one in model.getListOfRules():
        if not one.isSetMath():
            continue
        formula = read(one.getMath())
        if one.isAlgebraic():
            found.algebraic.append(formula)
        elif one.isAssignment():
            found.rules[one.getVariable()] = formula
        else:
            found.rates[one.getVariable()] = formula
    for one in model.getListOfInitialAssignments():
        if one.isSetMath():
            found.initial[one.getSymbol()] = read(one.getMath())


def _reactions(model: Any, found: ModelContents) -> None:
    for one in model.getListOfReactions():
        law = one.getKineticLaw()
        formula = read(law.getMath()) if law is not None and law.isSetMath() else None
        reaction = Reaction(formula, [], bool(one.isSetFast() and one.getFast()))
        for sign, references in ((-1, one.getListOfReactants()), (1, one.getListOfProducts())):
            for k, each in enumerate(references):
                amount = each.getStoichiometry() if each.isSetStoichiometry() or found.level < 3 else math.nan
                name = each.getId() if each.isSetId() else ""
                if each.isSetStoichiometryMath():
                    name = name or f"stoichiometry_of_{each.getSpecies()}_in_{one.getId()}_{'-+'[sign > 0]}{k}"
                    found.rules[name] = read(each.getStoichiometryMath().getMath())
                elif name:
                    _value(found, name, amount, each.getConstant() if found.level > 2 else True)
                reaction.changes.append((each.getSpecies(), sign, name or amount))
        found.reactions[one.getId()] = reaction


def _event(one: Any, place: int, level: int) -> EventRule:
    trigger, delay = one.getTrigger(), one.getDelay() if one.isSetDelay() else None
    priority = one.getPriority() if level > 2 and one.isSetPriority() else None
    return EventRule(
        name=one.getId() or f"event{place}",
        trigger=read(trigger.getMath()),
        initial=trigger.getInitialValue() if level > 2 else True,
        persistent=trigger.getPersistent() if level > 2 else True,
        priority=read(priority.getMath()) if priority is not None and priority.isSetMath() else None,
        delay=read(delay.getMath()) if delay is not None and delay.isSetMath() else None,
        at_trigger=bool(one.getUseValuesFromTriggerTime())
        if one.isSetUseValuesFromTriggerTime() or level < 3
        else True,
        assignments={a.getVariable(): read(a.getMath()) for a in one.getListOfEventAssignments() if a.isSetMath()},
    )
