"""Several runs side by side: on several plants, by several estimators, replayed with others."""

import json
from itertools import product

import numpy as np
import pytest

import cosim
from cosim.errors import CosimError, Interrupted, ScenarioError, UsageError
from cosim.report import comparing
from cosim.report.comparing import compare, results_of
from cosim.report.plots.runs import plot_comparison
from cosim.report.summary import summarize
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.variants import METHODS
from cosim.scenario.running.replay import Replays
from tests.scenario.field_recordings import BOTH, LOOP, field_log
from tests.scenario.refusals import check_refused
from tests.scenario.swapping.renamed import MAP, renamed

SHORT = {"scenario.stop": 7.0}
COARSE = {"scenario.stop": 15.0, "scenario.step": 5e-3, "observer.filter_rate": 100.0}
END = {"scenario.stop": 8.0}  # past the start of the identification at 6.461 s
FAILING = """
scenario = { name = "failing", stop = 0.2, step = 0.01 }
[components]
u = { kind = "sine", rate = 5.0 }
v = { kind = "expression", y = "2 * u.y" }
w = { kind = "expression", y = "t" }
"""
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


def errors(comparison):
    return [outcome.error for outcome in comparison.outcomes]


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
@pytest.mark.parametrize(
    "entries", [{"plant.x_a": "[s[0],s[1]]"}, {"plant.x_a[1]": "s[1]", "plant.x_a[0]": "s[0]"}]
)
def test_a_map_is_for_those_that_have_its_names(folder, entries):
    """The renamed FMU needs it, the exported one keeps the scenario's names."""
    others = {port: names for port, names in MAP.items() if port != "plant.x_a"}
    found = compare_two(folder, map={**others, **entries})
    assert errors(found) == ["", ""]
    plain, renamed_plant = found.recordings.values()
    assert np.array_equal(plain["plant.x_a"], renamed_plant["plant.x_a"])


def test_a_map_that_does_not_fit_a_plant_is_its_failure(folder, monkeypatch):
    """It is never left out there, and the others go on; a name that none has is refused."""
    plain, renamed_plant = errors(compare_two(folder, map={**MAP, "plant.y": "s[7]"}))
    assert plain == ""
    assert "map['plant.y']" in renamed_plant
    assert "s[7]" in renamed_plant
    monkeypatch.setattr(NO_RUN, None)
    for port, names, wrong in (
        ("plant.u", "forse", "forse'.*'force'"),
        ("plant.x_a", ["s[0]", "q[1]"], r"'q\[1\]'"),
    ):
        with pytest.raises(UsageError, match=rf"map\['{port}'\]: .*{wrong}"):
            compare_two(folder, map={**MAP, port: names})


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


def test_an_interruption_is_no_outcome(folder, failing, monkeypatch):
    """Neither of a plant, nor of an estimator, nor of a replay."""

    def interrupted(*_, **__):
        raise Interrupted("Ctrl-C")

    monkeypatch.setattr(comparing, "replay", interrupted)
    with pytest.raises(Interrupted):
        cosim.compare_estimators("academic", estimators="drem", set={"scenario.stop": 0.1})
    monkeypatch.setattr(Replays, "record", interrupted)
    with pytest.raises(Interrupted):
        cosim.replay_sweep(failing, vary={"u.amplitude": [1.0]})
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
        (("academic", ["drem", "drem"]), "drem .*twice"),
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
        ({"method": "least-squares", "size": 1.0}, "size: .*'least-squares'"),
    ]

    def run(table):
        cosim.run("academic", set={"identifier": {"kind": "identifier", **table}})

    check_refused(cases, run, ScenarioError)


# --- replays ---


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record a run past the start of its identification."""
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    return cosim.run("academic-as-printed", out=path, set=END)


@pytest.fixture(scope="module")
def failing(tmp_path_factory):
    """Record a run whose replays fail with other expressions."""
    folder = tmp_path_factory.mktemp("failing")
    (folder / "failing.toml").write_text(FAILING)
    return cosim.run(folder / "failing.toml", out=folder / "f.mcap")


@pytest.mark.slow
def test_each_row_is_a_replay_of_its_own(log):
    """With the values of its row and those that all have; in the order of the product.

    Its results are estimates, errors, verdicts and noise, by the names of the table.
    """
    common = {"observer.filter_rate": 500.0}
    vary = {"identifier.P0": [1e3, 1e9], "identifier.start": [7.0, 7.5]}
    sweep = cosim.replay_sweep(log.path, vary=vary, set=common)
    assert [tuple(row.values.values()) for row in sweep.rows] == list(product(*vary.values()))
    for row in sweep.rows:
        again = cosim.replay(log, set={**common, **row.values})
        assert row.summary == summarize(again)
        results = row.results
        assert results == results_of(summarize(again))
        theta = [results[name] for name in THETA]
        assert theta == again["identifier.theta"][-1].tolist()
        apart = [results[f"{name} error"] for name in THETA]
        assert apart == np.abs(np.array(theta) - [-0.1, -0.3]).tolist()
        assert isinstance(results["identifier verdict"], str)
        assert results["identifier noise"] > 0.0
    assert sweep["nothing"] == [None] * 4
    assert len(set(sweep[THETA[0]])) == 4
    assert sweep.passed


@pytest.mark.slow
def test_all_combinations_are_checked_before_the_first_runs(log, tmp_path):
    """The message names the one that is wrong, and nothing was written."""
    cases = [
        ({"identifier.P0": [1e3, -1.0]}, r"identifier\.P0 = -1\.0: .*P0: .*-1\.0"),
        ({"plant.solver": ["RK45"]}, r"plant.solver = 'RK45': .*'plant'"),
        ({"identifer.P0": [1.0]}, r"identifer.P0 = 1.0: .*component 'identifer"),
        ({"observer.L": [[8.0, 0.0], [-50.0, 0.0]]}, r"observer.L = \[-50.0, 0.0\]: .*Hurwitz"),
        ({"u.amplitude": [1.0, 2.0]}, "rerun=True"),  # the plant and its input are of the log
    ]
    check_refused(cases, lambda vary: cosim.replay_sweep(log, vary=vary, out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_varied_key_cannot_be_set_too(failing):
    """In whichever spelling."""
    message = r"set\['u.amplitude'\] or vary\['u.amplitude'\], got both"
    vary = {"components.u.amplitude": [1.0]}
    with pytest.raises(UsageError, match=message):
        cosim.replay_sweep(failing, vary=vary, set={"u.amplitude": 2.0})
    with pytest.raises(UsageError, match=r"v.y = '2 \*': .*components.v"):
        cosim.replay_sweep(failing, vary={"v.y": ["2 *"]})


def test_a_replay_that_fails_is_a_row(failing):
    """The others go on."""
    sweep = cosim.replay_sweep(failing, vary={"w.y": ["t", "1/(t - 0.1)", "2*t"]})
    assert [bool(row.problem) for row in sweep.rows] == [False, True, False]
    assert "'w.y' became inf at t = 0.1 s" in sweep.rows[1].problem
    assert sweep["w.y"] == [0.2, None, 0.4]
    assert not sweep.passed


def test_logs_of_replays_are_written_to_a_folder_that_is_named(failing, tmp_path):
    """In the order of the rows; those that are there are not replaced."""
    vary = {"u.amplitude": [1.0, 3.0]}
    folder = tmp_path / "new" / "logs"
    sweep = cosim.replay_sweep(failing, vary=vary, out=folder)
    first, second = sweep["u.y"]
    assert second == pytest.approx(3.0 * first)
    assert [row.path for row in sweep.rows] == [folder / "1.mcap", folder / "2.mcap"]
    assert cosim.open_log(folder / "2.mcap")["u.y"][-1] == second
    cases = [({"out": folder}, "exists"), ({"out": tmp_path / "x.mcap"}, r"out: .*x\.mcap'")]
    cases.append(({"force": True}, "force=True"))
    check_refused(cases, lambda options: cosim.replay_sweep(failing, vary=vary, **options))


def test_a_recording_of_another_tool_is_replayed_with_varied_values(tmp_path):
    """With the scenario and the map that a replay of it needs."""
    path = field_log(tmp_path)
    (tmp_path / "loop.toml").write_text(LOOP, encoding="utf-8")
    needed = {"scenario": tmp_path / "loop.toml", "map": BOTH}
    sweep = cosim.replay_sweep(path, vary={"model.time_constant": [0.1, 0.4]}, **needed)
    for row in sweep.rows:
        again = cosim.replay(path, set=row.values, **needed)
        assert repr(row.summary) == repr(summarize(again))  # NaN is not equal to itself
    assert len(set(sweep["model.y"])) == 2
    wrong = {"model.time_constant": [0.1, -1.0]}
    with pytest.raises(UsageError, match=r"model.time_constant = -1.0: .*components.model"):
        cosim.replay_sweep(path, vary=wrong, **needed)
