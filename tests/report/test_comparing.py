"""One scenario on several plants, or by several estimators: estimates, differences, failures."""

import json
import re
from itertools import product

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.report import comparing
from cosim.report.comparing import compare
from cosim.report.plots import plot_comparison
from cosim.report.tables.comparison import print_estimators
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.methods import METHODS
from tests.scenario.swapping.renamed import MAP, renamed

SHORT = {"scenario.stop": 7.0}
SHORTEST = {"scenario.stop": 0.1}
COARSE = {"scenario.stop": 15.0, "scenario.step": 5e-3, "observer.filter_rate": 100.0}
NO_RUN = "cosim.scenario.recordings.recording.run_into"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plants")
    export_component("academic", "plant", folder / "plant.fmu")
    renamed(folder / "other.fmu")
    cosim.run("academic", set=SHORT, out=folder / "log.mcap")
    return folder


@pytest.fixture(scope="module")
def four(folder):
    """Run it generated, as FMI 2 model exchange and co-simulation, recorded."""
    return compare(
        "academic",
        swap={"plant": [folder / "plant.fmu", f"{folder / 'plant.fmu'}#cs", folder / "log.mcap"]},
        set=SHORT,
    )


def compare_two(folder, **options):
    """Compare the FMU of the plant and that with other names, without the scenario's own."""
    plants = [folder / "plant.fmu", folder / "other.fmu"]
    return compare("academic", swap={"plant": plants}, set=SHORTEST, base=False, **options)


def errors(comparison):
    return [outcome.error for outcome in comparison.outcomes]


@pytest.mark.slow
def test_four_plants_are_one_scenario(four, tmp_path):
    """The co-simulation FMU and the log have the bits of the generated plant.

    Model exchange differs by rk4's error. That is (3 h)^4 / 120 = 7e-13 h a step, relative; over
    7 s less than 1e-11 in x_a, and delta_hat takes y times 1000.
    """
    labels = ["descriptor", "plant", "plant#cs", "log"]
    assert [outcome.label for outcome in four.outcomes] == labels
    assert four.estimates == {
        "observer.x_a": "plant.x_a",
        "observer.delta": "delta.y",
        "identifier.theta": [-0.1, -0.3],
    }
    apart = {(row.estimate, row.label): max(row.largest) for row in four.differences}
    assert set(apart) == set(product(four.estimates, labels[1:]))
    for estimate in four.estimates:
        assert apart[estimate, "plant#cs"] == apart[estimate, "log"] == 0.0
    assert 0.0 < apart["observer.x_a", "plant"] <= 1e-11
    assert 0.0 < apart["observer.delta", "plant"] <= 1e-8
    # every access would read the whole logs again
    assert four.summaries is four.summaries
    assert four.differences is four.differences
    plot_comparison(four, tmp_path / "c.svg")
    drawn = (tmp_path / "c.svg").read_text(encoding="utf-8")
    assert all(f">{label}<" in drawn for label in labels)
    assert all(estimate in drawn for estimate in four.estimates)


@pytest.mark.slow
def test_files_are_looked_into_for_a_map_alone(folder, monkeypatch):
    """Without one their ports do not matter; each run reads its own."""
    monkeypatch.setattr(comparing, "Builder", None)
    alternatives = {"plant": [folder / "missing.fmu", folder / "lost.mcap"]}
    found = compare("academic", swap=alternatives, set={"scenario.stop": 0.01})
    assert [bool(error) for error in errors(found)] == [False, True, True]


@pytest.mark.slow
def test_a_failed_plant_does_not_lose_the_others(folder, tmp_path, call):
    """It stands in the table with its reason; exit 1; the logs of the others are there."""
    swaps = [f"--swap=plant={folder / name}" for name in ("plant.fmu#cs", "other.fmu", "nix.fmu")]
    command = ("compare", "academic", *swaps, "--set", "scenario.stop=7.0")
    code, out, _ = call(*command, "--out", tmp_path / "logs", "--json")
    assert code == 1
    found = json.loads(out)
    plants = {plant["plant"]: plant for plant in found["plants"]}
    assert list(plants) == ["descriptor", "plant#cs", "other", "nix"]
    assert "--map plant.y=out1" in plants["other"]["error"]
    assert "there is no such file" in plants["nix"]["error"]
    logs = sorted(path.name for path in (tmp_path / "logs").iterdir())
    assert logs == ["descriptor.mcap", "plant-cs.mcap"]
    assert plants["plant#cs"]["summary"]["values"][0]["estimate"] == "identifier.theta[0]"
    assert {row["label"] for row in found["differences"]} == {"plant#cs"}
    code, out, err = call(*command)
    assert code == 1
    assert "from descriptor" in out
    assert "failed" in out
    assert "nix: failed: --swap plant: components.plant: " in err


def test_a_path_that_no_plant_has_is_refused_before_the_first_run(call, monkeypatch):
    """All of them at once, exit 2; that a file is missing is the outcome of its plant."""
    monkeypatch.setattr(NO_RUN, None)
    swaps = [f"--swap=plant={path}" for path in ("/dev/zero", "a.fmu", "a.fmu#xs")]
    code, out, err = call("compare", "academic", *swaps)
    assert (code, out) == (2, "")
    first, second = err.splitlines()
    assert re.match(r"cosim: --swap plant: .*'/dev/zero'", first)
    assert re.match(r"cosim: --swap plant: .*'#xs'", second)


@pytest.mark.slow
def test_a_wrong_alternative_is_refused_before_the_first_run(folder, monkeypatch):
    """A key that one of them has is set there, and the outcome of the others."""
    plants = {"plant": [folder / "plant.fmu", f"{folder / 'plant.fmu'}#cs"]}
    with monkeypatch.context() as patch:
        patch.setattr(NO_RUN, None)
        with pytest.raises(UsageError, match=r"^set\['plant\.nope'\]: [^\n]*'nope'[^\n]*$"):
            compare("academic", swap=plants, set={"plant.nope": 1.0})
    mixed = {"plant": [folder / "plant.fmu", folder / "log.mcap"]}
    changes = {"plant.solver": "RK23", **SHORTEST}
    found = compare("academic", swap=mixed, set=changes, base=False)
    assert [bool(error) for error in errors(found)] == [False, True]


def test_a_map_is_for_those_that_have_its_names(folder):
    """The renamed FMU needs it, the exported one keeps the scenario's names."""
    found = compare_two(folder, map=MAP)
    assert errors(found) == ["", ""]
    assert found.estimates["observer.x_a"] == "plant.x_a"
    with pytest.raises(UsageError, match=r"map\['plant\.u'\]: .*'forse'.*'force'"):
        compare_two(folder, map={"plant.u": "forse"})


@pytest.mark.slow
def test_a_map_may_list_ports(folder):
    """As texts on the command line, as lists in Python; each listed name is checked."""
    for elements in ("[s[0],s[1]]", ["s[0]", "s[1]"]):
        found = compare_two(folder, map={**MAP, "plant.x_a": elements})
        assert errors(found) == ["", ""]
        plain, renamed_plant = found.recordings.values()
        assert np.array_equal(plain["plant.x_a"], renamed_plant["plant.x_a"])
    with pytest.raises(UsageError, match=r"(?s)map\['plant\.x_a'\]: .*'plant\.q\[1\]'"):
        compare_two(folder, map={**MAP, "plant.x_a": ["s[0]", "q[1]"]})


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["plant"], {"set": {"observer.filter_rat": 1.0}}, r"set\['observer\.filter_rat'\]: "),
        (["plant", "observer"], {}, "swap: .*one component.* plant, observer"),
        (["plnt"], {}, r"swap\['plnt'\]: .*'plnt'.*'plant'"),
        (["plant"], {"base": False}, r"swap\['plant'\]: .*two plants"),
    ],
)
def test_problems_of_all_plants_are_raised_once(folder, names, options, message):
    """Before anything runs."""
    swap = {name: [folder / "plant.fmu"] for name in names}
    with pytest.raises((ScenarioError, UsageError), match=message):
        compare("academic", swap=swap, **options)


# --- estimators ---


@pytest.fixture(scope="module")
def compared():
    return cosim.compare_estimators("academic-as-printed", set=COARSE)


@pytest.mark.slow
def test_every_method_estimates_from_the_same_data(compared, tmp_path):
    """Each replay has the recorded y, the error is that of its last theta; all are drawn."""
    assert [result.method for result in compared.results] == list(METHODS)
    recordings = compared.recordings
    assert list(recordings) == list(METHODS)
    first = recordings["output-error"]
    for result in compared.results:
        np.testing.assert_array_equal(result.recording["plant.y"], first["plant.y"])
        theta = result.recording["identifier.theta"][-1]
        np.testing.assert_array_equal(result.theta, theta)
        np.testing.assert_array_equal(result.error, theta - np.array([-0.1, -0.3]))
    plot_comparison(compared, tmp_path / "theta.svg")
    drawn = (tmp_path / "theta.svg").read_text(encoding="utf-8")
    assert all(f">{label}<" in drawn for label in (*METHODS, "truth"))


@pytest.mark.slow
def test_every_estimate_is_judged_by_the_data(compared):
    """A biased one is said to be so, whatever the method says of itself; not all say something."""
    for result in compared.results:
        for record, error in zip(result.verdicts, result.error, strict=True):
            assert (record.value is None) == bool(np.isnan(error))
    verdicts = {r.method: [record.verdict for record in r.verdicts] for r in compared.results}
    assert verdicts["output-error"] == ["IDENTIFIABLE"] * 2
    assert verdicts["least-squares"] == ["INCONSISTENT"] * 2
    stated = {r.method for r in compared.results if r.standard_error is not None}
    assert "output-error" in stated
    assert stated.isdisjoint({"least-squares", "projection", "rayleigh", "drem", "gradient"})


@pytest.mark.slow
def test_the_table_shows_half_of_the_intervals_that_the_verdicts_have(compared, capsys):
    """As the table of a run does; 1.96 standard errors, and none beside INCONSISTENT."""
    print_estimators(compared, as_json=False)
    lines = capsys.readouterr().out.splitlines()
    shown = {line.split("\t")[0]: line.split("\t") for line in lines[2:]}
    assert any("half width of the 95 % interval" in line for line in lines)
    for result in compared.results:
        assert shown[result.method][1].count("±") == np.isfinite(result.half_width).sum()
        for record, half_width in zip(result.verdicts, result.half_width, strict=True):
            assert record.verdict in ("IDENTIFIABLE", "WEAK") or np.isnan(half_width)
    (found,) = [result for result in compared.results if result.method == "output-error"]
    # the ends of an interval of 1e-14 around 0.3 are rounded to 5e-17
    np.testing.assert_allclose(found.half_width, 1.96 * found.standard_error, rtol=1e-2)
    assert f"± {found.half_width[0]:.2g}" in shown["output-error"][1]


@pytest.mark.slow
def test_keys_of_another_method_are_left_out():
    """P0 belongs to least squares: the others run without it, least squares with it."""
    found = cosim.compare_estimators(
        "academic-as-printed",
        estimators=["least-squares", "drem"],
        set={**COARSE, "identifier.P0": 1.0},
    )
    bare = cosim.compare_estimators("academic", estimators="least-squares", set=COARSE)
    least_squares, drem = found.results
    assert not drem.failure
    assert np.abs(least_squares.error[1]) > 2.0 * np.abs(bare.results[0].error[1])


@pytest.mark.parametrize(
    ("estimators", "text"),
    [
        ("rayleih", "'rayleih'.*'rayleigh'"),
        (["drem", "drem"], "drem .*twice"),
        ([], "got none"),
    ],
)
def test_unknown_methods_are_refused(estimators, text):
    """Before the run."""
    with pytest.raises(UsageError, match=text):
        cosim.compare_estimators("academic", estimators=estimators)


def test_a_scenario_needs_one_identifier():
    """Without one there is nothing to compare."""
    with pytest.raises(UsageError, match=r"identifier.* got none"):
        cosim.compare_estimators("pair")


@pytest.mark.slow
def test_the_table_and_json_say_the_same(call, tmp_path):
    """One row a method; no value where a theta has none; logs in the folder."""
    settings = [f"--set={key}={value}" for key, value in {**COARSE, "scenario.stop": 8.0}.items()]
    arguments = ["compare", "academic", "--estimators", "drem,rayleigh", *settings]
    code, out, _ = call(*arguments)
    assert code == 0
    _, header, *rows = [line.split("\t") for line in out.splitlines()]
    assert header[:3] == ["method", "theta", "error"]
    assert [row[0] for row in rows[:2]] == ["drem", "rayleigh"]
    code, out, _ = call(*arguments, "--json", "--out", tmp_path)
    assert code == 0
    methods = {entry["method"]: entry for entry in json.loads(out)["methods"]}
    assert methods["drem"]["standard_error"] is None
    assert f"{methods['drem']['theta'][0]:+.6f}" in rows[0][1]
    assert methods["rayleigh"]["theta"] == [None, None]
    assert rows[1][1] == "no value, no value"
    assert methods["rayleigh"]["time_ratio"] > 0.0
    logs = sorted(path.name for path in tmp_path.iterdir())
    assert logs == ["academic.mcap", "drem.mcap", "rayleigh.mcap"]
    code, _, err = call(*arguments, "--out", tmp_path)
    assert code == 2
    assert "--force" in err


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--estimators=all", "--swap=plant=a.fmu", "--swap=plant=b.fmu"], "--swap plant"),
        (["--estimators=all", "--no-base"], "--no-base"),
        ([], "--swap or --estimators"),
    ],
)
def test_estimators_and_plants_are_compared_one_after_the_other(call, options, named):
    """Several plants beside --estimators, or nothing to compare, is wrong use."""
    code, _, err = call("compare", "academic", *options)
    assert (code, named in err) == (2, True)


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ({"method": "rayleigh", "gain": 1.0}, "gain: .*'rayleigh'"),
        ({"method": "gradient", "forgetting": 1.0}, "forgetting: .*'gradient'; .*: gain"),
        ({"method": "drem", "gain": -1.0}, "gain: .*got -1.0 1/s"),
        ({"method": "extended-kalman", "deviation": 0.0}, "deviation: .*got 0.0"),
        ({"method": "augmented-kalman", "intensity": -2.0}, "intensity: .*got -2.0"),
        ({"method": "least-squares", "size": 1.0}, "size: .*'least-squares'"),
    ],
)
def test_keys_of_no_use_are_refused(table, text):
    """A key of another method, or a number that makes no estimator."""
    with pytest.raises(ScenarioError, match=text):
        cosim.run("academic", set={"identifier": {"kind": "identifier", **table}})
