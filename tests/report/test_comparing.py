"""One scenario on several plants: their estimates, the differences, and one that fails."""

import json
import re
from itertools import product

import numpy as np
import pytest

import cosim
from cosim.cli import main
from cosim.errors import ScenarioError, UsageError
from cosim.report import comparing
from cosim.report.comparing import compare
from cosim.scenario.exporting import export_component
from tests.scenario.swapping.renamed import MAP, renamed

SHORT = {"scenario.stop": 7.0}


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


@pytest.mark.slow
def test_four_plants_are_one_scenario(four):
    """The co-simulation FMU and the log have the bits of the generated plant.

    Model exchange differs by rk4's error. That is (3 h)^4 / 120 = 7e-13 h a step, relative; over
    7 s less than 1e-11 in x_a, and delta_hat takes y times 1000.
    """
    assert [outcome.label for outcome in four.outcomes] == [
        "descriptor",
        "plant",
        "plant#cs",
        "log",
    ]
    assert four.estimates == {
        "observer.x_a": "plant.x_a",
        "observer.delta": "delta.y",
        "identifier.theta": [-0.1, -0.3],
    }
    apart = {(row.estimate, row.label): max(row.largest) for row in four.differences}
    assert set(apart) == set(product(four.estimates, ("plant", "plant#cs", "log")))
    for estimate in four.estimates:
        assert apart[estimate, "plant#cs"] == apart[estimate, "log"] == 0.0
    assert 0.0 < apart["observer.x_a", "plant"] <= 1e-11
    assert 0.0 < apart["observer.delta", "plant"] <= 1e-8


@pytest.mark.slow
def test_summaries_and_differences_are_computed_once(four):
    """Every access of a summary would read the whole logs again."""
    assert four.summaries is four.summaries
    assert four.differences is four.differences


@pytest.mark.slow
def test_files_are_looked_into_for_a_map_alone(folder, monkeypatch):
    """Without one their ports do not matter; each run reads its own."""
    looked = []
    monkeypatch.setattr(comparing, "_interface", lambda *arguments: looked.append(arguments))
    alternatives = {"plant": [folder / "missing.fmu", folder / "lost.mcap"]}
    found = compare("academic", swap=alternatives, set={"scenario.stop": 0.01})
    assert [bool(outcome.error) for outcome in found.outcomes] == [False, True, True]
    assert looked == []


@pytest.mark.slow
def test_a_failed_plant_does_not_lose_the_others(folder, tmp_path, capsys):
    """It stands in the table with its reason; exit 1; the logs of the others are there."""
    swaps = []
    for name in ("plant.fmu#cs", "other.fmu", "nix.fmu"):
        swaps += ["--swap", f"plant={folder / name}"]
    with pytest.raises(SystemExit) as left:
        main(
            [
                "compare",
                "academic",
                *swaps,
                "--set",
                "scenario.stop=7.0",
                "--out",
                str(tmp_path / "logs"),
                "--json",
            ]
        )
    assert left.value.code == 1
    found = json.loads(capsys.readouterr().out)
    plants = {plant["plant"]: plant for plant in found["plants"]}
    assert list(plants) == ["descriptor", "plant#cs", "other", "nix"]
    assert "--map plant.y=out1" in plants["other"]["error"]
    assert "there is no such file" in plants["nix"]["error"]
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == [
        "descriptor.mcap",
        "plant-cs.mcap",
    ]
    assert plants["plant#cs"]["summary"]["values"][0]["estimate"] == "identifier.theta[0]"
    assert {row["label"] for row in found["differences"]} == {"plant#cs"}
    with pytest.raises(SystemExit) as left:
        main(["compare", "academic", *swaps, "--set", "scenario.stop=7.0"])
    assert left.value.code == 1
    shown = capsys.readouterr()
    assert "from descriptor" in shown.out
    assert "failed" in shown.out
    assert "nix: failed: --swap plant: components.plant: " in shown.err


def test_a_path_that_no_plant_has_is_refused_before_the_first_run(call, monkeypatch):
    """All of them at once, exit 2; that a file is missing is the outcome of its plant."""
    monkeypatch.setattr("cosim.scenario.recordings.recording.run_into", None)
    swaps = ("--swap", "plant=/dev/zero", "--swap", "plant=a.fmu", "--swap", "plant=a.fmu#xs")
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
        patch.setattr("cosim.scenario.recordings.recording.run_into", None)
        message = r"^set\['plant\.nope'\]: unknown key 'nope'[^\n]*$"
        with pytest.raises(UsageError, match=message):
            compare("academic", swap=plants, set={"plant.nope": 1.0})
    mixed = {"plant": [folder / "plant.fmu", folder / "log.mcap"]}
    changes = {"plant.solver": "RK23", "scenario.stop": 0.1}
    found = compare("academic", swap=mixed, set=changes, base=False)
    assert [bool(outcome.error) for outcome in found.outcomes] == [False, True]


def test_a_map_is_for_those_that_have_its_names(folder):
    """The renamed FMU needs it, the exported one keeps the scenario's names."""
    found = compare(
        "academic",
        swap={"plant": [folder / "plant.fmu", folder / "other.fmu"]},
        map=MAP,
        set={"scenario.stop": 0.1},
        base=False,
    )
    assert [outcome.error for outcome in found.outcomes] == ["", ""]
    assert found.estimates["observer.x_a"] == "plant.x_a"
    with pytest.raises(
        UsageError,
        match=r"map\['plant\.u'\]: no alternative has a port 'forse'; did you mean 'force'\?",
    ):
        compare(
            "academic",
            swap={"plant": [folder / "plant.fmu", folder / "other.fmu"]},
            map={"plant.u": "forse"},
        )


@pytest.mark.slow
def test_a_map_may_list_ports(folder):
    """As texts on the command line, as lists in Python; each listed name is checked."""
    plants = {"plant": [folder / "plant.fmu", folder / "other.fmu"]}
    short = {"scenario.stop": 0.1}
    for elements in ("[s[0],s[1]]", ["s[0]", "s[1]"]):
        maps = {**MAP, "plant.x_a": elements}
        found = compare("academic", swap=plants, map=maps, set=short, base=False)
        assert [outcome.error for outcome in found.outcomes] == ["", ""]
        plain, renamed_plant = found.recordings.values()
        assert np.array_equal(plain["plant.x_a"], renamed_plant["plant.x_a"])
    with pytest.raises(
        UsageError, match=r"map\['plant\.x_a'\]: no alternative has a port 'q\[1\]'"
    ):
        compare("academic", swap=plants, map={**MAP, "plant.x_a": ["s[0]", "q[1]"]})


@pytest.mark.slow
def test_a_picture_shows_all_of_them(four, tmp_path):
    """Estimates with truth on the left, differences on the right."""
    from cosim.report.plots import plot_comparison

    plot_comparison(four, tmp_path / "c.svg")
    drawn = (tmp_path / "c.svg").read_text(encoding="utf-8")
    for label in ("descriptor", "plant", "plant#cs", "log"):
        assert f">{label}<" in drawn
    for estimate in four.estimates:
        assert estimate in drawn


def test_problems_of_all_plants_are_raised_once(folder):
    """Before anything runs."""
    plant = folder / "plant.fmu"
    with pytest.raises(ScenarioError, match=r"set\['observer\.filter_rat'\]: "):
        compare("academic", swap={"plant": [plant]}, set={"observer.filter_rat": 1.0})
    with pytest.raises(
        UsageError, match=r"swap: .*one component.* alternatives of plant, observer"
    ):
        compare("academic", swap={"plant": [plant], "observer": [plant]})
    with pytest.raises(
        UsageError, match=r"swap\['plnt'\]: unknown component 'plnt'; did you mean 'plant'"
    ):
        compare("academic", swap={"plnt": [plant]})
    with pytest.raises(
        UsageError, match=r"swap\['plant'\]: expected two plants to compare, got one"
    ):
        compare("academic", swap={"plant": [plant]}, base=False)
