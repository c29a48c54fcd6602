"""One plant for another, by name: generated, real FMUs of four makes, a recorded log."""

import json
import re
import zipfile
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.cli import main
from cosim.errors import ScenarioError
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import find
from cosim.scenario.exporting import export_component
from tests.scenario.fmu_edits import rewritten
from tests.scenario.signals import COARSE, signals

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


@pytest.fixture(scope="module")
def generated():
    return cosim.run("academic", set={"plant.solver": "rk4", "scenario.stop": 10.0})


def relative(run, other, signal):
    """Largest difference of a signal relative to its largest value."""
    return abs(run[signal] - other[signal]).max() / abs(run[signal]).max()


@pytest.mark.slow
@pytest.mark.parametrize("interface_type", ["me", "cs"])
def test_an_exported_plant_takes_the_plants_place(plant, generated, interface_type):
    """The plant's outputs agree within 1e-12 of each signal's largest value.

    In delta_hat the last bit of y is multiplied by 1000. Model exchange uses the same solver, rk4;
    co-simulation solves exactly, which rk4 at 1 ms misses by (3 h)^4 / 120 = 7e-13 h.
    """
    run = cosim.run(
        "academic",
        swap={"plant": plant},
        set={"plant.interface_type": interface_type, "scenario.stop": 10.0},
    )
    for signal in ("plant.y", "plant.x_a", "plant.x_b"):
        assert relative(generated, run, signal) <= 1e-12, signal
    assert relative(generated, run, "observer.delta") <= 1e-9


def test_model_exchange_with_the_same_solver_has_the_same_bits(plant):
    """The generated instance and the FMU have the same arithmetic: they call the same C."""
    changes = {**COARSE, "plant.solver": "rk4"}
    run = cosim.run("academic", swap={"plant": plant}, set=changes)
    assert cosim.diff(cosim.run("academic", set=changes), run).equal


def test_co_simulation_has_the_bits_of_the_exact_solver(plant):
    """The FMU discretizes with the same C as the generated plant."""
    exact = cosim.run("academic", set=COARSE)
    changes = {**COARSE, "plant.interface_type": "cs"}
    run = cosim.run("academic", swap={"plant": plant}, set=changes)
    assert cosim.diff(exact, run).equal


@pytest.mark.slow
@pytest.mark.usefixtures("without_verdicts")
def test_a_model_exchange_fmu_that_others_made_takes_the_plants_place(foreign3):
    """FMI 3 model exchange by pythonfmu3: the derivatives are its own, the solver is ours.

    The results differ by rounding: 1e-16 in y times filter_rate is 1e-13 in delta_hat, and theta2
    responds to that with less than 1e2 times as much.
    """
    run = cosim.run(
        "academic",
        swap={"plant": foreign3},
        set={"plant.interface_type": "me", "scenario.stop": 10.0},
    )
    reference = cosim.run("academic", set={"plant.solver": "rk4", "scenario.stop": 10.0})
    assert relative(reference, run, "plant.y") <= 1e-12
    assert abs(run["identifier.theta"][-1] - reference["identifier.theta"][-1]).max() <= 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "changes"),
    [
        pytest.param("foreign2", FOREIGN2, marks=pytest.mark.campaign),
        ("foreign3", {"plant.interface_type": "cs"}),
    ],
    ids=["pythonfmu CS 2", "pythonfmu3 CS 3"],
)
def test_a_co_simulation_fmu_that_others_made_takes_the_plants_place(make, changes, request):
    """Without input interpolation and dependencies, y = x1 - u belongs to the mean input.

    The error is known, of first order, and reported.

    The generated plant with just that error added to y, (u(t) - u(t - h))/2, identifies the same
    theta. What remains is of second order: the mean of the inputs, h^2/12, and the FMU's own
    solver, h^2/6 at most (Heun), for signals up to 2.7 in all 7e-7. To an error of y at the rates
    of these signals theta2 responds with about nine times as much (5e-4 moves it by 6e-3, as 7e-4
    in delta_hat): 6e-6.
    """
    run = signals("academic", swap={"plant": request.getfixturevalue(make)}, set=changes)
    late = {
        "components.late": {
            "kind": "expression",
            "y": "0.5*(sin(t) - sin(max(t - 0.001, -t)))",
        },
        "components.measured": {"kind": "sum", "signs": [1.0, 1.0]},
        "connections.measured.u1": "plant.y",
        "connections.measured.u2": "late.y",
    }
    text = find("academic")
    document = replace(
        text, text=text.text.replace('"observer.y" = "plant.y"', '"observer.y" = "measured.y"')
    )
    reference = signals(parse(document.with_changes(late)))
    assert abs(run["plant.y"] - reference["measured.y"]).max() <= 1e-6
    assert abs(run["identifier.theta"][-1] - reference["identifier.theta"][-1]).max() <= 6e-6


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
def test_a_dry_run_compares_port_by_port(plant, foreign2, tmp_path, monkeypatch, capsys):
    """Nothing runs; every port is shown.

    An input that the scenario does not have keeps its start value.
    """
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        main(["run", "academic", "--swap", f"plant={plant}", "--dry-run"])
    assert not left.value.code
    assert "dry run: no problems found" in capsys.readouterr().out
    with pytest.raises(SystemExit) as left:
        main(["run", "academic", "--swap", f"plant={foreign2}", "--dry-run", "--json"])
    assert not left.value.code
    output = capsys.readouterr()
    found = json.loads(output.out)
    verdicts = {
        (row["port"], row["aspect"]): row["verdict"] for row in found["swaps"]["plant"]["ports"]
    }
    assert verdicts["plant.gain", "causality"] == "differs"
    assert (
        verdicts["plant.y", "causality"]
        == verdicts["plant.y", "size"]
        == verdicts["plant.y", "initial output"]
        == "ok"
    )
    assert verdicts["plant.y", "feedthrough"] == "differs"
    assert found["problems"] == []
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
    """Start values come from the FMU unless set."""
    run = cosim.run(
        "academic",
        swap={"plant": plant},
        set={"plant.start": {"x_a[0]": 2.0}, "scenario.stop": 0.01},
    )
    assert list(run["plant.x_a"][0]) == [2.0, -1.0]


def test_an_unknown_start_value_names_the_nearest(plant):
    """A misspelt variable is refused before the run."""
    with pytest.raises(ScenarioError, match=r"x_a\[2\].*did you mean"):
        cosim.run("academic", swap={"plant": plant}, set={"plant.start": {"x_a[2]": 2.0}})


def test_states_that_are_no_outputs_are_logged_too(tmp_path):
    """A log holds every state.

    An FMU's continuous states are read even where they are no outputs.
    """
    path = tmp_path / "lag.fmu"
    scenario = tmp_path / "lag.toml"
    scenario.write_text(
        '[scenario]\nname = "lag"\nstop = 0.1\nstep = 0.01\n[components.u]\nkind = '
        '"constant"\nvalue = 1.0\n'
        '[components.c]\nkind = "controller"\nA = [[-1.0]]\nB = [[1.0]]\nC = '
        '[[2.0]]\n[connections]\n"c.u" = "u.y"\n'
    )
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
    for interface_type in ("me", "cs"):
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


def test_an_output_driven_as_an_input_says_so():
    """The name is right, the causality is not."""
    with pytest.raises(
        ScenarioError,
        match=r"'plant\.y': expected an input of 'plant', got an output; available: u, delta",
    ):
        cosim.run("academic", set={"connections.plant.y": "u.y"})
