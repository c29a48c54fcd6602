"""One plant for another, by name: generated, real FMUs of four makes, a recorded log."""

import json
import re
import zipfile

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.scenario.exporting import export_component
from tests.scenario.fmu_edits import rewritten
from tests.scenario.signals import COARSE

ONE = {"components.one": {"kind": "constant", "value": 1.0}}
FOREIGN2 = {
    **ONE,
    "connections.plant.gain": "one.y",
    "connections.plant.sign": "one.y",
}  # inputs that the scenario does not have


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    """Export the plant of the example as a real FMU: C source and binary."""
    path = tmp_path_factory.mktemp("fmus") / "academic.fmu"
    export_component("academic", "plant", path)
    return path


@pytest.mark.parametrize(
    ("interface_type", "reference"), [("me", {"plant.solver": "rk4"}), ("cs", {})]
)
def test_an_exported_plant_has_the_bits_of_the_generated_one(plant, interface_type, reference):
    """They call the same C: the same solver, or the same discretization for co-simulation."""
    changes = {**COARSE, **reference, "plant.interface_type": interface_type}
    run = cosim.run("academic", swap={"plant": plant}, set=changes)
    assert cosim.diff(cosim.run("academic", set=COARSE | reference), run).equal


@pytest.mark.slow
def test_an_fmu_without_dependencies_is_warned_of(foreign2):
    """Unknown feedthrough is reported, not guessed."""
    run = cosim.run("academic", swap={"plant": foreign2}, set={**FOREIGN2, "scenario.stop": 0.01})
    warnings = json.loads(run.metadata["cosim.run"]["warnings"])
    assert any(name == "plant" and "may lag inputs" in text for name, text in warnings), warnings


def test_a_log_of_an_fmu_replays_without_the_fmu(plant, tmp_path):
    """The FMU's signals come from the log."""
    copy = tmp_path / "copy.fmu"
    copy.write_bytes(plant.read_bytes())
    log = cosim.run("academic", swap={"plant": copy}, set=COARSE, out=tmp_path / "a.mcap")
    copy.unlink()
    assert cosim.diff(log, cosim.replay(tmp_path / "a.mcap")).equal
    assert "plant/modelDescription.xml" in log.attachments
    assert json.loads(log.metadata["cosim.component.plant"]["metadata"])["sha256"]


def test_an_fmu_keeps_the_tolerance_of_its_table(plant):
    """At 1e-3 RK45 crosses a step of 0.1 s at once, with some (2 h)^6/720 = 1e-7.

    At 1e-11 it is the exact solution to 1e-9.
    """
    changes = {"scenario.step": 0.1, "scenario.stop": 4.0}

    def run(tolerance):
        return cosim.run(
            "academic",
            swap={"plant": plant},
            set={**changes, "plant.solver": "RK45", "plant.tolerance": tolerance},
        )

    exact = cosim.run("academic", set=changes)["plant.y"]
    loose = run(1e-3)
    tight = run(1e-11)
    assert abs(tight["plant.y"] - exact).max() < 1e-9 < 1e-8 < abs(loose["plant.y"] - exact).max()
    assert json.loads(tight.metadata["cosim.component.plant"]["metadata"])["tolerance"] == 1e-11


@pytest.mark.usefixtures("without_verdicts")
def test_a_sampled_fmu_responds_at_its_own_step(plant, tmp_path):
    """With a period the FMU lives on that step.

    Its outputs hold between, and its channel keeps the rows of that step.
    """
    changes = {"plant.interface_type": "cs", "plant.period": 0.01, "scenario.stop": 1.0}
    log = cosim.run("academic", swap={"plant": plant}, set=changes, out=tmp_path / "a.mcap")
    assert np.array_equal(np.unique(np.diff(log.time_ns("plant"))), [10_000_000])
    assert cosim.diff(log, cosim.replay(tmp_path / "a.mcap")).equal


@pytest.mark.slow
def test_a_dry_run_compares_port_by_port(plant, foreign2, tmp_path, call):
    """Nothing runs, exit 0; an input that the scenario does not have keeps its start value."""
    code, out, _ = call("run", "academic", "--swap", f"plant={plant}", "--dry-run")
    assert (code, "dry run: no problems found" in out) == (0, True)
    code, out, _ = call("run", "academic", "--swap", f"plant={foreign2}", "--dry-run", "--json")
    found = json.loads(out)
    rows = found["swaps"]["plant"]["ports"]
    verdicts = {(row["port"], row["aspect"]): row["verdict"] for row in rows}
    assert verdicts["plant.gain", "causality"] == verdicts["plant.y", "feedthrough"] == "differs"
    for aspect in ("causality", "size", "initial output"):
        assert verdicts["plant.y", aspect] == "ok"
    assert (code, found["problems"]) == (0, [])
    assert not (tmp_path / "logs").exists()


def test_a_missing_output_is_refused_before_the_run(plant, tmp_path):
    """An FMU without the port that the scenario connects cannot stand there.

    The message has the nearest name.
    """
    path = rewritten(plant, tmp_path / "renamed.fmu", ('name="y"', 'name="y_m"'))
    with pytest.raises(
        ScenarioError,
        match=r"'plant\.y': 'plant' has no output 'y'; (did you mean 'y_m'\? )?Available: y_m, "
        r"x_a, x_b",
    ):
        cosim.run("academic", swap={"plant": path})


def test_a_start_value_of_the_fmu_can_be_set(plant):
    """Start values come from the FMU unless set; a misspelt variable is refused before the run."""
    short = {"scenario.stop": 0.01}
    changes = {**short, "plant.start": {"x_a[0]": 2.0}}
    run = cosim.run("academic", swap={"plant": plant}, set=changes)
    assert list(run["plant.x_a"][0]) == [2.0, -1.0]
    with pytest.raises(ScenarioError, match=r"x_a\[2\].*did you mean"):
        cosim.run("academic", swap={"plant": plant}, set={"plant.start": {"x_a[2]": 2.0}})


@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_states_that_are_no_outputs_are_logged_too(tmp_path, interface_type):
    """A log holds every state; those of an FMU are read even where they are no outputs."""
    scenario = tmp_path / "lag.toml"
    scenario.write_text("""
        scenario = { name = "lag", stop = 0.1, step = 0.01 }
        [components]
        u = { kind = "constant", value = 1.0 }
        c = { kind = "controller", A = [[-1.0]], B = [[1.0]], C = [[2.0]] }
        [connections]
        "c.u" = "u.y"
    """)
    path = tmp_path / "lag.fmu"
    export_component(str(scenario), "c", path)
    hidden = tmp_path / "hidden.fmu"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(hidden, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "modelDescription.xml":
                text, count = re.subn(
                    r'(name="x"[^>]*)causality="output"', r'\1causality="local"', content.decode()
                )
                assert count == 1
                content = re.sub(r'<Unknown index="3"[^>]*/>', "", text, count=1).encode()
            target.writestr(name, content)
    run = cosim.run(scenario, swap={"c": hidden}, set={"c.interface_type": interface_type})
    assert run["c.x"][-1] == pytest.approx(1.0 - np.exp(-0.1), rel=1e-9)


def test_a_binary_for_another_platform_is_refused_before_the_run(plant, tmp_path):
    """The message names what is there and what would be needed."""
    bare = rewritten(
        plant, tmp_path / "bare.fmu", members=lambda name: not name.startswith("binaries/")
    )
    with zipfile.ZipFile(bare, "a") as archive:
        archive.writestr("binaries/win64/academic_plant.dll", b"MZ")
    with pytest.raises(
        ScenarioError,
        match=r"swap\['plant'\]: .*no binary for this platform; .*win64; expected binaries/",
    ):
        cosim.run("academic", swap={"plant": bare})


def test_a_wrong_causality_is_refused_before_the_run(tmp_path):
    """The observer has delta as an output and y as an input: the other way round from the plant."""
    path = tmp_path / "observer.fmu"
    export_component("academic", "observer", path)
    with pytest.raises(ScenarioError) as caught:
        cosim.run("academic", swap={"plant": path})
    for text in (
        "'plant.delta': expected an input of 'plant', got an output; available: u, y",
        "'plant.y': expected an output of 'plant', got an input; available: x_a, delta",
    ):
        assert text in str(caught.value)
