"""Several runs side by side: on several plants, by several estimators."""

import json
import re
from itertools import product

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError, Interrupted, ScenarioError
from cosim.report import comparing
from cosim.report.comparing import compare, show_estimators, show_plants
from cosim.report.plots.runs import plot_comparison
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.variants import METHODS
from cosim.scenario.running.replay import Replays
from tests.scenario.refusals import check_refused
from tests.scenario.swapping.renamed import MAP, renamed

SHORT = {"scenario.stop": 7.0}
COARSE = {"scenario.stop": 15.0, "scenario.step": 5e-3, "observer.filter_rate": 100.0}
NO_RUN = "cosim.scenario.recordings.recording.run_into"
THETA = ("identifier.theta[0]", "identifier.theta[1]")


# --- plants ---


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make FMUs of the plant, one with other names, and a log."""
    folder = tmp_path_factory.mktemp("plants")
    export_component("academic", "plant", folder / "plant.fmu")
    renamed(folder / "other.fmu")
    cosim.run("academic", set=SHORT, out=folder / "log.mcap")
    return folder


def compare_two(folder, **options):
    """Compare the FMU of the plant and that with other names, without the scenario's own."""
    plants = [folder / "plant.fmu", folder / "other.fmu"]
    short = {"scenario.stop": 0.1}
    return compare("academic", swap={"plant": plants}, set=short, base=False, **options)


@pytest.mark.slow
def test_four_plants_are_one_scenario(folder):
    """Generated, as FMI 2 model exchange and co-simulation, recorded: the last two have its bits.

    Model exchange differs by rk4's error. That is (3 h)^4 / 120 = 7e-13 h a step, relative; over
    7 s less than 1e-11 in x_a, and delta_hat takes y times 1000.
    """
    fmu = folder / "plant.fmu"
    four = compare("academic", swap={"plant": [fmu, f"{fmu}#cs", folder / "log.mcap"]}, set=SHORT)
    labels = ["descriptor", "plant", "plant#cs", "log"]
    assert [outcome.label for outcome in four.outcomes] == labels
    apart = {(row.estimate, row.label): max(row.largest) for row in four.differences}
    assert set(apart) == set(product(four.estimates, labels[1:]))
    for estimate in four.estimates:
        assert apart[estimate, "plant#cs"] == apart[estimate, "log"] == 0.0
    assert 0.0 < apart["observer.x_a", "plant"] <= 1e-11
    assert 0.0 < apart["observer.delta", "plant"] <= 1e-8


@pytest.mark.slow
def test_a_failed_plant_does_not_lose_the_others(folder, tmp_path, call):
    """It stands in the table with its reason; exit 1; the logs of the others are there."""
    swaps = [f"--swap=plant={folder / name}" for name in ("plant.fmu#cs", "other.fmu", "nix.fmu")]
    command = ("compare", "academic", *swaps, "--set", "scenario.stop=7.0")
    code, out, _ = call(*command, "--out", tmp_path / "logs", "--json")
    plants = {plant["plant"]: plant for plant in json.loads(out)["plants"]}
    assert (code, list(plants)) == (1, ["descriptor", "plant#cs", "other", "nix"])
    assert "--map plant.y=out1" in plants["other"]["error"]
    assert "there is no such file" in plants["nix"]["error"]
    logs = sorted(path.name for path in (tmp_path / "logs").iterdir())
    assert logs == ["descriptor.mcap", "plant-cs.mcap"]
    assert plants["plant#cs"]["summary"]["values"][0]["estimate"] == THETA[0]


@pytest.mark.slow
def test_a_map_that_does_not_fit_a_plant_is_its_failure(folder, monkeypatch):
    """It is never left out there, and the others go on; a name that none has is refused.

    The exported FMU, which keeps the scenario's names, needs none.
    """
    found = compare_two(folder, map={**MAP, "plant.x_a": "[s[0],s[1]]"})
    assert [outcome.error for outcome in found.outcomes] == ["", ""]
    assert np.array_equal(*(run["plant.x_a"] for run in found.recordings.values()))
    found = compare_two(folder, map={**MAP, "plant.y": "s[7]"})
    plain, renamed_plant = (outcome.error for outcome in found.outcomes)
    assert plain == ""
    assert re.search(r"map\['plant\.y'\].*s\[7\]", renamed_plant)
    _, table = show_plants(found)
    names, values, *_ = (list(column.cells) for column in table.columns)
    assert names == ["plant", "other"]
    assert [value == "failed" for value in values] == [False, True]
    monkeypatch.setattr(NO_RUN, None)
    cases = [("plant.u", "forse", "forse'.*'force'"), ("plant.x_a", ["s[0]", "q[1]"], r"'q\[1\]'")]
    check_refused(cases, lambda port, names: compare_two(folder, map={**MAP, port: names}))


def test_wrong_plants_are_refused_before_the_first_run(folder, monkeypatch):
    monkeypatch.setattr(NO_RUN, None)
    cases = [
        ((["plant"], {"set": {"observer.filter_rat": 1.0}}), r"set\['observer\.filter_rat'\]: "),
        ((["plant", "observer"], {}), "swap: .*one component.* plant, observer"),
        ((["plnt"], {}), r"swap\['plnt'\]: .*'plnt'.*'plant'"),
        ((["plant"], {"base": False}), r"swap\['plant'\]: .*two plants"),
    ]

    def run(case):
        names, options = case
        compare("academic", swap={name: [folder / "plant.fmu"] for name in names}, **options)

    check_refused(cases, run, CosimError)


def test_an_interruption_is_no_outcome(folder, monkeypatch):
    """Neither of a plant, nor of an estimator."""

    def interrupted(*_, **__):
        raise Interrupted("Ctrl-C")

    monkeypatch.setattr(Replays, "record", interrupted)
    with pytest.raises(Interrupted):
        cosim.compare_estimators("academic", estimators="drem", set={"scenario.stop": 0.1})
    monkeypatch.setattr(comparing, "run", interrupted)
    with pytest.raises(Interrupted):
        compare_two(folder)


# --- estimators ---


@pytest.fixture(scope="module")
def compared():
    return cosim.compare_estimators("academic-as-printed", set=COARSE)


@pytest.mark.slow
def test_every_method_estimates_from_the_same_data(compared, tmp_path):
    """Each replay has the recorded y, the error is that of its last theta; all are drawn."""
    assert [result.method for result in compared.results] == list(METHODS)
    assert list(compared.recordings) == list(METHODS)
    first = compared.recordings["output-error"]
    for result in compared.results:
        np.testing.assert_array_equal(result.recording["plant.y"], first["plant.y"])
        theta = result.recording["identifier.theta"][-1]
        np.testing.assert_array_equal(result.theta, theta)
        np.testing.assert_array_equal(result.error, theta - np.array([-0.1, -0.3]))
    plot_comparison(compared, tmp_path / "theta.svg")
    _, table, *_ = show_estimators(compared)
    cells = dict(zip(*(column.cells for column in table.columns[:2]), strict=True))
    for result in compared.results:
        value = f"{result.theta[0]:.6g}".replace("nan", "no value")
        assert cells[result.method].startswith(value)
    drawn = (tmp_path / "theta.svg").read_text(encoding="utf-8")
    assert all(f">{label}<" in drawn for label in (*METHODS, "truth"))


@pytest.mark.slow
def test_every_estimate_is_judged_by_the_data(compared):
    """A biased one is said to be so, whatever the method says of itself; not all say something."""
    for result in compared.results:
        of_theta = zip(result.verdicts, result.error, result.half_width, strict=True)
        for record, error, half_width in of_theta:
            assert (record.value is None) == bool(np.isnan(error))
            assert record.verdict in ("IDENTIFIABLE", "WEAK") or np.isnan(half_width)
    found = {result.method: result for result in compared.results}
    verdicts = {name: [one.verdict for one in own.verdicts] for name, own in found.items()}
    assert verdicts["output-error"] == ["IDENTIFIABLE"] * 2
    assert verdicts["least-squares"] == ["INCONSISTENT"] * 2
    stated = {name for name, own in found.items() if own.standard_error is not None}
    assert "output-error" in stated
    assert stated.isdisjoint({"least-squares", "projection", "rayleigh", "drem", "gradient"})
    best = found["output-error"]
    # the ends of an interval of 1e-14 around 0.3 are rounded to 5e-17
    np.testing.assert_allclose(best.half_width, 1.96 * best.standard_error, rtol=1e-2)


def test_unknown_methods_and_missing_identifiers_are_refused():
    """Before the run."""
    cases = [
        (("academic", "rayleih"), "'rayleih'.*'rayleigh'"),
        (("academic", []), "got none"),
        (("pair", "all"), "identifier.* got none"),
    ]
    check_refused(cases, lambda case: cosim.compare_estimators(case[0], estimators=case[1]))


def test_keys_of_no_use_are_refused():
    """A key of another method, or a number that makes no estimator."""
    cases = [
        ({"method": "rayleigh", "gain": 1.0}, "gain: .*'rayleigh'"),
        ({"method": "gradient", "forgetting": 1.0}, "forgetting: .*'gradient'; .*: gain"),
        ({"method": "drem", "gain": -1.0}, "gain: .*got -1.0 1/s"),
        ({"method": "extended-kalman", "deviation": 0.0}, "deviation: .*got 0.0"),
        ({"method": "augmented-kalman", "intensity": -2.0}, "intensity: .*got -2.0"),
    ]

    def run(table):
        cosim.run("academic", set={"identifier": {"kind": "identifier", **table}})

    check_refused(cases, run, ScenarioError)
