"""A plant is swapped in a run: an FMU goes on from its continuous states."""

import numpy as np
import pytest

import cosim
from cosim.errors import ScenarioError
from cosim.report.inspection import describe_log
from cosim.scenario.exporting import export_component
from tests.fmi.eventful import friction
from tests.scenario.actions.replays import verified_replay
from tests.scenario.refusals import check_refused

STOP = {"scenario.stop": 2.0, "scenario.step": 0.01, "observer.filter_rate": 100.0}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Export the plant of the shipped example for FMI 3."""
    folder = tmp_path_factory.mktemp("swap")
    export_component("academic", "plant", folder / "plant3.fmu", fmi="3")
    return folder


def swapped(path, **changes):
    """Return changes with which the plant is swapped at 1 s."""
    return {**STOP, **changes, "actions": [{"at": 1.0, "swap": {"plant": str(path)}}]}


@pytest.mark.parametrize("version", [pytest.param(2, marks=pytest.mark.slow), 3])
@pytest.mark.parametrize("block", [pytest.param(1, marks=pytest.mark.slow), 7])
def test_an_fmu_goes_on_from_the_states_of_the_plant(folder, version, block, tmp_path):
    """The same model: the run goes on as without a swap, but for the tolerance of the solver."""
    fmu = folder / f"plant{version}.fmu"
    if not fmu.exists():
        export_component("academic", "plant", fmu, fmi=str(version))
    path = f"{fmu}#me"
    log = cosim.run("academic", set=swapped(path), out=tmp_path / "a.mcap", block=block)
    plain = cosim.run("academic", set=STOP)
    for name in ("plant.x_a", "plant.y", "plant.x_b"):
        assert (log[name][:101] == plain[name][:101]).all()
        # relative tolerance 1e-9 of values up to 4, over 1 s
        assert abs(log[name] - plain[name]).max() < 1e-7, name
    assert (log["plant.x_a"][101:] != plain["plant.x_a"][101:]).any(), "another solver computes"
    (event,) = [event for event in log.events() if event.cause != "follow"]
    assert event[:3] == (10**9, "swap", f"plant.{path}")
    row = {"t": 1.0, "signal": "plant", "cause": "swap", "values": str(path)}
    assert describe_log(str(tmp_path / "a.mcap"))["overrides"] == [row]
    other = cosim.run("academic", set=swapped(path), out=tmp_path / "b.mcap")
    assert log.recorded_hash == other.recorded_hash


def test_a_replay_takes_the_swapped_plant_from_the_log(folder, tmp_path):
    """Like any plant."""
    path = folder / "plant3.fmu#me"
    log = cosim.run("academic", set=swapped(path), out=tmp_path / "a.mcap")
    verified_replay(log)


def test_a_session_goes_back_over_a_swap(folder):
    """To the plant that was there then."""
    with cosim.load("academic").edit(set=swapped(folder / "plant3.fmu#me")).start() as sim:
        sim.step(90)
        saved = sim.state
        first = sim.step(30)["plant.x_a"].tobytes()
        sim.state = saved
        assert sim.step(30)["plant.x_a"].tobytes() == first


def test_a_swap_without_hand_over_of_states_is_refused(folder, tmp_path):
    """Before the run, with what is missing."""
    fmu = str(folder / "plant3.fmu")
    cases = [
        ({"plant": f"{fmu}#cs"}, r"swap\.plant: the state of 'plant' cannot be trans.* to .*#cs"),
        ({"plant": str(friction(tmp_path, 2))}, r"the states x_a\[0\], x_a\[1\], got x, v"),
        ({"u": fmu}, r"the state of 'u' cannot be transferred: it has no named"),
        ({"plnt": fmu}, r"swap\.plnt: .*no component 'plnt'; did you mean 'plant'"),
        ({"plant": str(folder / "none.fmu")}, r"swap\.plant: .*none\.fmu"),
    ]
    actions = [([{"at": 1.0, "swap": swap}], words) for swap, words in cases]
    twice = [{"at": at, "swap": {"plant": fmu}} for at in (1.0, 1.5)]
    actions.append((twice, r"actions\[1\]\.swap\.plant: 'plant' is also changed by actions\[0\]"))

    def run(made):
        cosim.run("academic", set={**STOP, "actions": made})

    check_refused([(made, rf"\A.*{words}.*\Z") for made, words in actions], run, ScenarioError)


def test_parameters_of_an_fmu_are_set_at_any_conditions(tmp_path):
    """In place, whichever comes true first: v' = u - p, with p = 0, then 1.5, then 0.5."""
    path = tmp_path / "friction.toml"
    path.write_text(
        '[scenario]\nname = "friction"\nstop = 2.0\nstep = 0.1\n[components]\n'
        'u = { kind = "constant", value = 2.0 }\nd = { kind = "constant", value = 0.0 }\n'
        f'fmu = {{ kind = "fmu", path = "{friction(tmp_path, 2)}" }}\n'
        '[connections]\n"fmu.u" = "u.y"\n"fmu.d" = "d.y"\n'
    )
    actions = [
        {"when": "t >= 1.0", "set": {"fmu.p": 1.5}},
        {"when": "t >= 1.5", "set": {"fmu.p": 0.5}},
    ]
    run = cosim.run(path, set={"fmu.start": {"p": 0.0}, "actions": actions})
    rises = np.diff(run["fmu.v"])
    assert rises[[4, 12, 18]] == pytest.approx([0.2, 0.05, 0.15])
