"""The sources of a run as BibTeX: nothing that they say is lost, nothing is cited that was not used."""

from __future__ import annotations

import pickle
import re

import pytest

import invariode as iv
from invariode._results import citations


def keys(sol) -> list[str]:
    return re.findall(r"^@\w+\{(\w+),$", iv.cite(sol), re.MULTILINE)


def decay(t, y, rate=1.0):
    return [-rate * y[0]]


@pytest.mark.parametrize("name", iv.METHODS)
def test_entries_of_a_method_have_all_authors_years_and_pages_of_its_source(name):
    source, text = iv.METHODS[name].source, iv.cite(name).replace(r"{\o}", "o").replace(r"{\"o}", "o")
    for surname in re.findall(r"(?:[A-Z]\. )+([A-Z][\w-]+),", source):
        assert re.search(rf"author = .*\b{surname}\b", text)
    for year in re.findall(r"\b(?:19|20)\d\d\b", source):
        assert f"year = {{{year}}}" in text
    for pages in re.findall(r"\) (\d+-\d+)", source):
        assert f"pages = {{{pages.replace('-', '--')}}}" in text


def test_entries_are_well_formed():
    """Braces match, no field is empty, no key occurs twice."""
    for name in iv.METHODS:
        entries = iv.cite(name).strip().split("\n\n")
        assert len({*keys(name)}) == len(entries) >= 2
        for entry in entries:
            assert re.fullmatch(r"@\w+\{\w+,\n(  \w+ = \{.+\},\n)+\}", entry)
            assert entry.count("{") == entry.count("}")


def test_what_was_not_a_method_is_cited_if_and_only_if_it_was_used():
    others = {
        "shampine1999conservation": {"invariants": lambda t, y, rate: y[0]},
        "shampine2005non": {"nonnegative": [0]},
        "maly1996numerical": {"sensitivities": "y0"},
    }
    plain = iv.Problem(decay, (0, 1), [1.0], args=(0.0,))
    assert keys(plain.solve("ode23")) == ["invariode", "bogacki1989pair"]
    for key, given in others.items():
        assert keys(plain.replace(**given).solve("ode23")) == ["invariode", "bogacki1989pair", key]
    assert keys(plain.solve("ode23", adjoint=True)) == ["invariode", "bogacki1989pair", "cao2003adjoint"]
    assert keys(plain.solve("BDF", linear_solver=iv.GMRES())) == ["invariode", "shampine1997matlab", "saad1986gmres"]
    dae = iv.ode15i(lambda t, y, yp: [yp[0] + y[0]], (0, 1), [1.0], [-1.0])
    assert "pryce2001simple" in keys(dae)
    assert citations.PROJECTION in citations._DOI


def test_auto_cites_the_methods_that_took_steps():
    sol = iv.solve_ivp(decay, (0, 1), [1.0], method="auto")
    assert keys(sol) == ["invariode", "petzold1983automatic", "shampine1975computer"]
    assert keys(iv.solve_ivp(decay, (0, 1), [1.0], method="auto", keep="end")) == keys("auto")


def test_a_loaded_solution_cites_as_the_original(tmp_path):
    problem = iv.Problem(decay, (0, 1), [1.0], nonnegative=True)
    sol = problem.solve("BDF", linear_solver=iv.GMRES())
    sol.save(tmp_path / "run.npz")
    assert iv.cite(iv.load(tmp_path / "run.npz")) == iv.cite(sol) == iv.cite(iv.load(tmp_path / "run.npz", problem))
    with pytest.raises(ValueError, match="cite the method by name"):
        iv.cite(pickle.loads(pickle.dumps(sol)))


@pytest.mark.parametrize(("wrong", "error"), [(decay, TypeError), ("ode54", ValueError)])
def test_what_cannot_be_cited_is_an_error(wrong, error):
    with pytest.raises(error, match=r"ode45|cite takes a Solution"):
        iv.cite(wrong)
