"""Several estimators on the same recorded data."""

import json

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError, UsageError
from cosim.report.plots import plot_comparison
from cosim.report.tables.comparison import print_estimators
from cosim.scenario.kinds.methods import METHODS

SHORT = {"scenario.stop": 15.0, "scenario.step": 5e-3, "observer.filter_rate": 100.0}
EARLY = {**SHORT, "scenario.stop": 8.0}


@pytest.fixture(scope="module")
def compared():
    return cosim.compare_estimators("academic-as-printed", set=SHORT)


@pytest.mark.slow
def test_every_method_estimates_from_the_same_data(compared):
    """Each replay has the recorded y, and the error is that of its last theta."""
    assert [result.method for result in compared.results] == list(METHODS)
    recordings = compared.recordings
    assert list(recordings) == list(METHODS)
    first = recordings["output-error"]
    for result in compared.results:
        np.testing.assert_array_equal(result.recording["plant.y"], first["plant.y"])
        theta = result.recording["identifier.theta"][-1]
        np.testing.assert_array_equal(result.theta, theta)
        np.testing.assert_array_equal(result.error, theta - np.array([-0.1, -0.3]))


@pytest.mark.slow
def test_a_standard_error_is_shown_where_a_method_has_one(compared):
    """Baselines without a theory of their error have none."""
    stated = {r.method for r in compared.results if r.standard_error is not None}
    assert "output-error" in stated
    assert stated.isdisjoint({"least-squares", "projection", "rayleigh", "drem", "gradient"})


@pytest.mark.slow
def test_every_estimate_is_judged_by_the_data(compared):
    """A biased one is said to be so, whatever the method says of itself."""
    for result in compared.results:
        for record, error in zip(result.verdicts, result.error, strict=True):
            assert (record.value is None) == bool(np.isnan(error))
    verdicts = {r.method: [record.verdict for record in r.verdicts] for r in compared.results}
    assert verdicts["output-error"] == ["IDENTIFIABLE"] * 2
    assert verdicts["least-squares"] == ["INCONSISTENT"] * 2


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
def test_theta_is_drawn_by_every_method(compared, tmp_path):
    """One line of the legend a method, and the truth."""
    path = tmp_path / "theta.svg"
    plot_comparison(compared, path)
    drawn = path.read_text(encoding="utf-8")
    for method in METHODS:
        assert f">{method}<" in drawn
    assert ">truth<" in drawn


@pytest.mark.slow
def test_keys_of_another_method_are_left_out():
    """P0 belongs to least squares: the others run without it, least squares with it."""
    found = cosim.compare_estimators(
        "academic-as-printed",
        estimators=["least-squares", "drem"],
        set={**SHORT, "identifier.P0": 1.0},
    )
    bare = cosim.compare_estimators("academic", estimators="least-squares", set=SHORT)
    least_squares, drem = found.results
    assert not drem.failure
    assert np.abs(least_squares.error[1]) > 2.0 * np.abs(bare.results[0].error[1])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"estimators": "rayleih"}, r"no method 'rayleih'; did you mean 'rayleigh'\?"),
        ({"estimators": ["drem", "drem"]}, "drem is given twice"),
        ({"estimators": []}, "got none"),
    ],
)
def test_unknown_methods_are_refused(options, text):
    """Before the run."""
    with pytest.raises(UsageError, match=text):
        cosim.compare_estimators("academic", **options)


def test_a_scenario_needs_one_identifier(tmp_path):
    """Without one there is nothing to compare."""
    path = tmp_path / "source.toml"
    path.write_text(
        '[scenario]\nname = "one"\nstop = 1.0\nstep = 0.1\n'
        '[components.u]\nkind = "sine"\nrate = 1.0\n'
    )
    with pytest.raises(UsageError, match=r"identifier.* got none"):
        cosim.compare_estimators(path)


@pytest.mark.slow
def test_the_table_and_json_say_the_same(call, tmp_path):
    """One row a method; no value where a theta has none; logs in the folder."""
    settings = [f"--set={key}={value}" for key, value in EARLY.items()]
    arguments = ["compare", "academic", "--estimators", "drem,rayleigh", *settings]
    code, out, _ = call(*arguments)
    assert code == 0
    lines = out.splitlines()
    assert lines[1].split("\t")[:3] == ["method", "theta", "error"]
    assert [line.split("\t")[0] for line in lines[2:4]] == ["drem", "rayleigh"]
    code, out, _ = call(*arguments, "--json", "--out", str(tmp_path))
    found = json.loads(out)
    assert code == 0
    methods = {entry["method"]: entry for entry in found["methods"]}
    assert methods["drem"]["standard_error"] is None
    assert f"{methods['drem']['theta'][0]:+.6f}" in lines[2]
    assert methods["rayleigh"]["theta"] == [None, None]
    assert "no value, no value" in lines[3]
    assert methods["rayleigh"]["time_ratio"] > 0.0
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "academic.mcap",
        "drem.mcap",
        "rayleigh.mcap",
    ]
    code, _, err = call(*arguments, "--out", str(tmp_path))
    assert code == 2
    assert "--force" in err


def test_estimators_and_plants_are_compared_one_after_the_other(call):
    """Several plants beside --estimators, or nothing to compare, is wrong use."""
    plants = ["--swap", "plant=a.fmu", "--swap", "plant=b.fmu"]
    code, _, err = call("compare", "academic", "--estimators", "all", *plants)
    assert (code, "--swap plant" in err) == (2, True)
    code, _, err = call("compare", "academic", "--estimators", "all", "--no-base")
    assert (code, "--no-base" in err) == (2, True)
    code, _, err = call("compare", "academic")
    assert (code, "--swap or --estimators" in err) == (2, True)


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
