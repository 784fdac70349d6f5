"""Problems of PEtab: the cases of its test suite, published problems, and a problem that is written here."""

import json
import math
import tarfile
import warnings
from pathlib import Path

import numpy as np
import pytest

import invariode as iv
from sbml_campaign import shared
from test_sbml import model, parameter, reaction, species

petab = pytest.importorskip("invariode.petab")
pytest.importorskip("libsbml")
yaml = pytest.importorskip("yaml")

HAS_CASES = shared("petab") is not None
beside = pytest.mark.skipif(not HAS_CASES, reason="the problems lie beside the project")


@pytest.fixture(scope="session")
def problems(tmp_path_factory):
    """The folder of the published problems, unpacked."""
    folder = tmp_path_factory.mktemp("petab")
    for name in ("benchmark", "tests-v1"):
        with tarfile.open(shared(f"petab/{name}.tar.xz")) as archive:
            archive.extractall(folder, filter="data")
    return folder


def yaml_in(folder, name):
    return min(
        (one for one in (folder / name).glob("*.yaml") if "visual" not in one.name), key=lambda one: len(one.name)
    )


def differences(objective, x, h=1e-4):
    """The gradient by differences of fourth order."""

    def slope(e):
        near, far = (objective.value(x + s * h * e) - objective.value(x - s * h * e) for s in (1, 2))
        return (8 * near - far) / (12 * h)

    return np.array([slope(e) for e in np.eye(len(x))])


@beside
@pytest.mark.parametrize("number", range(1, 21))
def test_cases_of_the_suite(problems, number):
    """Log-likelihood, χ² and simulations within the suite's tolerances; gradients are differences."""
    from invariode.petab.problem_files import rows_of

    folder = problems / "sbml" / f"{number:04d}"
    expected = yaml.safe_load((folder / f"_{number:04d}_solution.yaml").read_text())
    problem = petab.load(folder / f"_{number:04d}.yaml")
    assert abs(problem.log_likelihood() - expected["llh"]) <= expected["tol_llh"]
    assert abs(problem.chi2() - expected["chi2"]) <= expected["tol_chi2"]
    rows = [row for name in expected["simulation_files"] for row in rows_of(str(folder / name))]
    simulated, _ = problem.simulate()
    np.testing.assert_allclose(
        simulated, [float(row["simulation"]) for row in rows], rtol=0, atol=expected["tol_simulations"]
    )
    objective = problem.objective()
    gradient = objective(problem.nominal).gradient
    size = np.abs(gradient).max(initial=1e-300)
    np.testing.assert_allclose(gradient, differences(objective, problem.nominal), rtol=0, atol=2e-5 * size)


CHEAP = (
    "Boehm_JProteomeRes2014", "Borghans_BiophysChem1997", "Elowitz_Nature2000", "Rahman_MBS2016", "Zheng_PNAS2012",
    "Fiedler_BMCSystBiol2016", "Perelson_Science1996", "Bertozzi_PNAS2020", "Bruno_JExpBot2016", "Weber_BMC2015",
)  # fmt: skip


@beside
@pytest.mark.parametrize("name", CHEAP)
def test_published_likelihoods(problems, name):
    known = json.loads(Path(shared("petab/likelihoods.json")).read_text())[name]["log_likelihood"]
    problem = petab.load(yaml_in(problems, name))
    assert problem.log_likelihood() == pytest.approx(known, rel=2e-6)


@beside
@pytest.mark.parametrize(
    "name",
    [
        "Boehm_JProteomeRes2014",
        "Rahman_MBS2016",
        "Weber_BMC2015",
        "Borghans_BiophysChem1997",
        "Crauste_CellSystems2017",
    ],
)
def test_gradients_of_published_problems(problems, name):
    """Gradients at the nominal point are differences, in units of their standard deviation √F if that is above 1, with
    steps of at most 1 % of a standard deviation of the parameters: Borghans' model is close to a bifurcation, and
    Crauste's to a blow-up, where the likelihood is a parabola over 1e-6 only."""
    loose, sharp = (petab.load(yaml_in(problems, name), rtol=r, atol=1e-4 * r) for r in (1e-8, 1e-11))
    x, value = loose.nominal, sharp.objective().value
    found = loose.objective()(x)
    chosen = np.random.default_rng(2).permutation(len(x))[:3]
    unit = np.maximum(np.sqrt(np.diag(found.fisher))[chosen], 1.0)

    def along(j, h):
        e = h * np.eye(len(x))[j]
        near, far = (value(x + s * e) - value(x - s * e) for s in (1, 2))
        return (8 * near - far) / (12 * h)

    slopes = np.array([along(j, min(1e-3, 0.01 / u)) for j, u in zip(chosen, unit, strict=True)])
    np.testing.assert_allclose(found.gradient[chosen] / unit, slopes / unit, rtol=0, atol=1e-5)


@beside
@pytest.mark.parametrize("error_test", [True, False])
def test_sensitivities_below_roundoff_do_not_fail_attempts_of_radau(problems, error_test):
    """With an atol that S cannot reach, since terms of its slope cancel, hardly any attempt fails. The initial value is
    fixed."""
    loaded = petab.load(yaml_in(problems, "Bachmann_MSB2011"))
    names = [name for name in loaded.names if name in loaded.model.parameters]
    values = {name: 10.0**x for name, x in zip(loaded.names, loaded.nominal, strict=True) if name in names}
    problem = loaded.model.problem((0, 120), **values)
    wanted = iv.Sensitivities(names, error_test=error_test)
    sol = problem.replace(y0=problem.y0, sensitivities=wanted).solve("radau", rtol=1e-8, atol=1e-16)
    assert sol.stats.failed <= 0.05 * sol.stats.steps


# ----------------------------------------------------------------------------------------------------------------------
# A problem of our own: A ⇌ B, in equilibrium before k1 changes; noise with a parameter, on a logarithmic scale


def written(folder, **changes):
    """The files of a problem; `changes` replaces tables."""
    text = model(
        species("A", 1) + species("B", 0),
        parameter("k1", 0.8) + parameter("k2", 0.6),
        reactions=reaction("r", {"A": 1}, {"B": 1}, "k1 * A - k2 * B"),
    )
    files = {
        "model.xml": text,
        "problem.yaml": "format_version: 1\nparameter_file: parameters.tsv\nproblems:\n- sbml_files: [model.xml]\n"
        "  condition_files: [conditions.tsv]\n  observable_files: [observables.tsv]\n"
        "  measurement_files: [measurements.tsv]\n",
        "parameters.tsv": "parameterId\tparameterScale\tlowerBound\tupperBound\tnominalValue\testimate\n"
        "k1\tlog10\t0.01\t100\t0.8\t1\nk2\tlog\t0.01\t100\t0.6\t1\nk_after\tlin\t0\t10\t2\t1\ns\tlog10\t0.01\t10\t0.2\t1\n"
        "scale\tlin\t0\t10\t3\t0\n",
        "conditions.tsv": "conditionId\tk1\nbefore\tk1\nafter\tk_after\n",
        "observables.tsv": "observableId\tobservableFormula\tnoiseFormula\tobservableTransformation\t"
        "noiseDistribution\n"
        "b\tobservableParameter1_b * B\tnoiseParameter1_b\tlog\tlaplace\na\tA + 0.1\t0.1 + s * A\tlin\tnormal\n",
        "measurements.tsv": "observableId\tpreequilibrationConditionId\tsimulationConditionId\tmeasurement\ttime\t"
        "observableParameters\tnoiseParameters\n"
        "b\tbefore\tafter\t1.5\t0\tscale\ts\nb\tbefore\tafter\t2.0\t1\tscale\ts\na\tbefore\tafter\t0.4\t1\t\t\n"
        "a\tbefore\tafter\t0.3\tinf\t\t\na\t\tbefore\t0.8\t0.5\t\t\n",
        **changes,
    }
    for name, one in files.items():
        (folder / name).write_text(one)
    return folder / "problem.yaml"


def test_wrong_tables_are_errors_that_name_the_place(tmp_path):
    """No row, name or number of a table is dropped, replaced or misread in silence."""
    tables = {one.name: one.read_text() for one in written(tmp_path).parent.iterdir()}
    wrong = [
        ("parameters.tsv", "k2\t", "k1\t", "row 2: parameterId 'k1' is there twice"),
        ("parameters.tsv", "log10\t0.01", "log10\tabc", "row 1: lowerBound must be a number, got 'abc'"),
        ("parameters.tsv", "0.01\t100", "100\t0.01", "row 1: the bounds 100 and 0.01 leave no values"),
        ("conditions.tsv", "after", "before", "conditionId 'before' is there twice"),
        ("conditions.tsv", "\tk1\n", "\tk_1\n", "sets 'k_1', which is neither .* did you mean"),
        ("conditions.tsv", "k_after", "k_aft", "'k_aft', which is no parameter"),
        ("observables.tsv", "a\tA", "b\tA", "observableId 'b' is there twice"),
        ("observables.tsv", "noiseFormula", "noise", "no 'noiseFormula'"),
        ("measurements.tsv", "1.5", "1,5", "row 1: measurement must be a number, got '1,5'"),
        ("measurements.tsv", "a\tbefore", "aa\tbefore", "observable 'aa', which is not defined"),
        ("measurements.tsv", "before\tafter", "befor\tafter", "condition 'befor', .* did you mean 'before'"),
        ("measurements.tsv", "scale\ts", "scal\ts", "parameter 'scal', .* did you mean 'scale'"),
        ("parameters.tsv", "k2\t", "kk2\t", "'kk2' is estimated, and neither the model .* did you mean 'k2'"),
        ("parameters.tsv", "2\t1", "2\t2", "row 3: estimate must be 0 or 1, got '2'"),
        ("parameters.tsv", "0.8\t1", "\t1", "'k1' has no nominalValue"),
        ("problem.yaml", "observable_files", "observables", "no 'observable_files'"),
    ]
    for i, (name, old, new, why) in enumerate(wrong):
        folder = tmp_path / str(i)
        folder.mkdir()
        assert old in tables[name]
        with pytest.raises(ValueError, match=why):
            petab.load(written(folder, **{name: tables[name].replace(old, new, 1)})).log_likelihood()


def test_a_problem_with_its_solution(tmp_path):
    """The exact solution of A ⇌ B, with pre-equilibration, a time of infinity, and both kinds of noise."""
    problem = petab.load(written(tmp_path))
    assert problem.names == ["k1", "k2", "k_after", "s"]
    np.testing.assert_allclose(problem.nominal, [math.log10(0.8), math.log(0.6), 2, math.log10(0.2)])

    def b(k, t, start):
        rest = k / (k + 0.6)
        return rest + (start - rest) * math.exp(-(k + 0.6) * t)

    rest = 0.8 / 1.4
    expected = [3 * rest, 3 * b(2, 1, rest), 1.1 - b(2, 1, rest), 1.1 - 2 / 2.6, 1.1 - b(0.8, 0.5, 0)]
    simulated, sigma = problem.simulate()
    np.testing.assert_allclose(simulated, expected, rtol=1e-6)
    np.testing.assert_allclose(sigma, [0.2, 0.2, *(0.1 + 0.2 * (one - 0.1) for one in expected[2:])], rtol=1e-6)
    data = np.array([1.5, 2.0, 0.4, 0.3, 0.8])
    laplace = -np.log(2 * sigma[:2]) - np.abs(np.log(data[:2] / simulated[:2])) / sigma[:2] - np.log(data[:2])
    normal = -0.5 * np.log(2 * np.pi * sigma[2:] ** 2) - 0.5 * ((data[2:] - simulated[2:]) / sigma[2:]) ** 2
    assert problem.log_likelihood() == pytest.approx(laplace.sum() + normal.sum(), rel=1e-6)


def test_values_by_name_and_folders(tmp_path):
    """A dict names natural values, those of a fit; a folder is no problem, and the error names the file."""
    problem = petab.load(written(tmp_path))
    by_name = dict(zip(problem.names, problem._values(problem.nominal), strict=True))
    assert problem.log_likelihood(by_name) == problem.log_likelihood()
    with pytest.raises(ValueError, match=r"missing for 'k1'.* k1, k2"):
        problem.log_likelihood({})
    with pytest.raises(IsADirectoryError, match=r"problem\.yaml"):
        petab.load(tmp_path)


def test_gradient_and_information(tmp_path):
    problem = petab.load(written(tmp_path), rtol=1e-10, atol=1e-13)
    objective, x = problem.objective(), problem.nominal + 0.05
    found = objective(x)
    np.testing.assert_allclose(found.gradient, differences(objective, x), rtol=1e-5)
    assert found.fisher.shape == (4, 4)
    assert (np.linalg.eigvalsh(found.fisher) > 0).all()
    assert objective(x, gradient=False).gradient is None


def test_priors_are_apart(tmp_path):
    rows = (
        "parameterId\tparameterScale\tlowerBound\tupperBound\tnominalValue\testimate\tobjectivePriorType\t"
        "objectivePriorParameters\n"
        "k1\tlog10\t0.01\t100\t0.8\t1\tparameterScaleNormal\t0;0.5\nk2\tlog\t0.01\t100\t0.6\t1\tlogNormal\t-1;2\n"
        "k_after\tlin\t0\t10\t2\t1\tlaplace\t1;2\ns\tlog10\t0.01\t10\t0.2\t1\t\t\nscale\tlin\t0\t10\t3\t0\t\t\n"
    )
    plain = petab.load(written(tmp_path)).log_likelihood()
    problem = petab.load(written(tmp_path, **{"parameters.tsv": rows}))
    objective = problem.objective()
    found = objective(problem.nominal)
    assert found.log_likelihood == pytest.approx(plain)
    x = math.log10(0.8)
    normal = -0.5 * math.log(2 * math.pi * 0.25) - x * x / 0.5
    z = math.log(0.6)
    lognormal = -0.5 * math.log(2 * math.pi * 4) - (z + 1) ** 2 / 8 - z
    assert found.log_prior == pytest.approx(normal + lognormal - math.log(4) - 0.5)
    h = 1e-6
    steps = [(objective(problem.nominal + h * e).log_prior - objective(problem.nominal - h * e).log_prior) / (2 * h)
             for e in np.eye(4)]  # fmt: skip
    np.testing.assert_allclose(found.log_prior_gradient, steps, rtol=1e-6, atol=1e-9)


def test_failed_runs_are_minus_infinity(tmp_path):
    """B' = B², which ends at t = 1."""
    text = model(
        "", parameter("x", 1, "false") + parameter("k1", 1) + parameter("k2", 1),
        '<rateRule variable="x"><math xmlns="http://www.w3.org/1998/Math/MathML"><apply><times/><ci>k1</ci><ci>x</ci>'
        "<ci>x</ci></apply></math></rateRule>",
    )  # fmt: skip
    observables = "observableId\tobservableFormula\tnoiseFormula\nb\tx\t1\n"
    measurements = "observableId\tsimulationConditionId\tmeasurement\ttime\nb\tbefore\t1\t2\n"
    parameters = "parameterId\tparameterScale\tlowerBound\tupperBound\tnominalValue\testimate\n"
    parameters += "k1\tlog10\t0.01\t100\t0.8\t1\nk_after\tlin\t0\t10\t2\t1\n"
    changes = {"model.xml": text, "observables.tsv": observables, "measurements.tsv": measurements}
    problem = petab.load(written(tmp_path, **changes, **{"parameters.tsv": parameters}))
    found = problem.objective()(problem.nominal)
    assert found.log_likelihood == -np.inf
    assert np.isnan(found.gradient).all()


def test_check_compares_with_simulated_data(tmp_path):
    path = written(tmp_path)
    problem = petab.load(path)
    lines = (tmp_path / "measurements.tsv").read_text().splitlines()
    simulated, _ = problem.simulate()
    rows = [lines[0].replace("measurement", "simulation")]
    for line, value in zip(lines[1:], simulated, strict=True):
        cells = line.split("\t")
        rows.append("\t".join([*cells[:3], repr(float(value) * (1 + 1e-5)), *cells[4:]]))
    (tmp_path / "simulatedData.tsv").write_text("\n".join(rows) + "\n")
    assert 1e-6 < problem.check()["difference"] < 1.1e-5


def test_the_search_finds_the_optimum_from_many_starts(tmp_path):
    written(tmp_path)
    table = (tmp_path / "observables.tsv").read_text().replace("laplace", "normal")
    problem = petab.load(written(tmp_path, **{"observables.tsv": table}))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # five data for four parameters, some of which end at bounds
        fit = iv.fit(problem.experiments, problem.parameters, starts=4, seed=1)
    assert fit.parameters.keys() == {"k1", "k2", "k_after", "s"}
    units = [math.log(10), 1.0, None, math.log(10)]
    x = np.array([v if u is None else math.log(v) / u for v, u in zip(fit.parameters.values(), units, strict=True)])
    gradient = problem.objective()(x).gradient
    inside = (x > problem.lower + 1e-9) & (x < problem.upper - 1e-9)
    assert fit.log_likelihood >= problem.log_likelihood()
    assert np.abs(gradient[inside]).max(initial=0) < 1e-2
    assert len(fit.starts) == 4


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"problem.yaml": "format_version: 3.0.0\nproblems: []\n"}, "version 3"),
        ({"problem.yaml": "format_version: 2.0.0\nmodel_files: {}\n"}, "models none"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        petab.load(written(tmp_path, **changes)).log_likelihood()


def second(folder, **changes):
    """The problem in version 2: parameters on the linear scale, conditions by row, experiments, named placeholders."""
    written(
        folder,
        **{
            "problem.yaml": "format_version: 2.0.0\nmodel_files:\n  m:\n    location: model.xml\n    language: sbml\n"
            + "".join(
                f"{one}_files: [{one}s.tsv]\n"
                for one in ("parameter", "condition", "experiment", "observable", "measurement")
            ),
            "parameters.tsv": "parameterId\tlowerBound\tupperBound\tnominalValue\testimate\tpriorDistribution\t"
            "priorParameters\nk1\t0.01\t100\t0.8\ttrue\t\t\nk2\t0.01\t100\t0.6\ttrue\tlog-normal\t-1;2\n"
            "k_after\t0\t10\t2\ttrue\t\t\ns\t0.01\t10\t0.2\ttrue\t\t\nscale\t0\t10\t3\tfalse\t\t\n",
            "conditions.tsv": "conditionId\ttargetId\ttargetValue\nc\tk1\tk_after\n",
            "experiments.tsv": "experimentId\ttime\tconditionId\ne\t-inf\t\ne\t0\tc\n",
            "observables.tsv": "observableId\tobservableFormula\tnoiseFormula\tnoiseDistribution\t"
            "observablePlaceholders\tnoisePlaceholders\nb\tgain * B\twidth\tlog-laplace\tgain\twidth\n"
            "a\tA + 0.1\t0.1 + s * A\tnormal\t\t\n",
            "measurements.tsv": "observableId\texperimentId\tmeasurement\ttime\tobservableParameters\t"
            "noiseParameters\nb\te\t1.5\t0\tscale\ts\nb\te\t2.0\t1\tscale\ts\na\te\t0.4\t1\t\t\n"
            "a\te\t0.3\tinf\t\t\na\t\t0.8\t0.5\t\t\n",
            **changes,
        },
    )
    return folder / "problem.yaml"


def test_version_2_is_the_same_problem(tmp_path):
    """Likelihood, simulations and gradient are those of version 1, apart from the scales of the parameters."""
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    one, two = petab.load(written(tmp_path / "one")), petab.load(second(tmp_path / "two"))
    assert two.log_likelihood() == pytest.approx(one.log_likelihood(), rel=1e-12)
    np.testing.assert_allclose(two.simulate(), one.simulate(), rtol=1e-9)
    slopes = one.objective()(one.nominal).gradient / [0.8 * math.log(10), 0.6, 1, 0.2 * math.log(10)]
    found = two.objective()(two.nominal)
    np.testing.assert_allclose(found.gradient, slopes, rtol=1e-6)
    z = math.log(0.6)
    assert found.log_prior == pytest.approx(-0.5 * math.log(2 * math.pi * 4) - (z + 1) ** 2 / 8 - z)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"experiments.tsv": "experimentId\ttime\tconditionId\ne\t0\t\ne\t5\tc\n"}, "periods that begin at 0, 5"),
        ({"conditions.tsv": "conditionId\ttargetId\ttargetValue\nc\tk1\t2 * k_after\n"}, "by the formula"),
    ],
)
def test_what_is_not_read_of_version_2_is_named(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        petab.load(second(tmp_path, **changes))


def test_other_searches_get_what_they_need(tmp_path):
    """Value and gradient for SciPy's minimize."""
    from scipy.optimize import minimize

    problem = petab.load(written(tmp_path))
    objective = problem.objective()
    bounds = [*zip(objective.lower, objective.upper, strict=True)]
    bounds[2] = (0.0, 10.0)

    def both(x):
        found = objective(x)
        return -found.log_likelihood, -found.gradient

    found = minimize(both, problem.nominal, jac=True, method="L-BFGS-B", bounds=bounds)
    assert -found.fun > problem.log_likelihood()
