"""Runs are deterministic, independent of blocks, and replay bit for bit."""

import os
import warnings

import numpy as np
import pytest

import cosim
from cosim.errors import LogError, NonFiniteError, ScenarioError, UsageError
from cosim.log import McapRecorder, open_log
from cosim.report.summary import summarize
from cosim.scenario.document.document import shipped
from cosim.scenario.exporting import export_component
from cosim.scenario.record import ReplayOrigin, replay_origin
from tests.fmi import lag
from tests.scenario.refusals import check_refused
from tests.scenario.signals import COARSE

HORIZONS = pytest.mark.parametrize(
    "changes", [COARSE, pytest.param({}, marks=pytest.mark.campaign)], ids=["coarse", "whole"]
)


def fitting(name, changes):
    """Return those changes that a scenario can have: `pair` has no observer."""
    if name != "pair":
        return changes
    return {key: value for key, value in changes.items() if key != "observer.filter_rate"}


@pytest.fixture(scope="module", params=shipped())
def logged(request, tmp_path_factory):
    """Run every shipped scenario to a log."""
    path = tmp_path_factory.mktemp("logs") / f"{request.param}.mcap"
    changes = fitting(request.param, COARSE)
    return request.param, path, cosim.run(request.param, out=path, set=changes)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return the path of a log of the example; no test changes it."""
    path = tmp_path_factory.mktemp("recorded") / "academic.mcap"
    cosim.run("academic", out=path, set=COARSE)
    return path


@pytest.mark.fast("academic-coarse", "pair-coarse")
@HORIZONS
@pytest.mark.parametrize("name", shipped())
def test_neither_blocks_nor_compiled_stages_change_a_bit(name, changes, tmp_path, monkeypatch):
    """One call of 1000 steps, 1000 calls of one step, and blocks of 7 give equal logs.

    So does a run whose stages call components from Python. Every bit is equal, identification
    included.
    """
    changes = fitting(name, changes)

    def content(block, kind):
        out = tmp_path / f"{block}-{kind}.mcap"
        return cosim.run(name, out=out, block=block, set=changes).content_hash()

    hashes = {content(block, "compiled") for block in (1000, 1, 7)}
    assert len(hashes) == 1
    monkeypatch.setattr("cosim.core.stages.engine.advancing_stages", lambda graph: graph.stages)
    assert {content(None, "called")} == hashes


@pytest.mark.fast("jacobi-cs")
@pytest.mark.parametrize("interface_type", ["me", "cs"])
@pytest.mark.parametrize("coupling", ["gauss-seidel", "jacobi"])
@pytest.mark.usefixtures("without_verdicts")
def test_a_loop_with_an_fmu_a_sampled_controller_and_noise_repeats_and_replays(
    interface_type, coupling, tmp_path
):
    """Blocks, replays and verification do not notice what is in the loop."""
    export_component("closed-loop", "plant", tmp_path / "plant.fmu")
    swap = {"plant": f"{tmp_path}/plant.fmu#{interface_type}"}
    reference = {"kind": "noise", "deviation": 0.01, "seed": 7}
    changes = {"scenario.coupling": coupling, "controller.period": 0.05, "reference": reference}
    changes |= {"scenario.stop": 2.0, "scenario.step": 0.01, "observer.filter_rate": 100.0}
    logs = [
        cosim.run(
            "closed-loop", swap=swap, set=changes, out=tmp_path / f"{block}.mcap", block=block
        )
        for block in (1000, 1, 7)
    ]
    assert len({log.content_hash() for log in logs}) == 1
    assert logs[0]["controller.y"].std() > 1e-3
    assert cosim.diff(logs[0], cosim.replay(tmp_path / "1000.mcap")).equal


def test_replay_is_bit_exact(logged):
    """The recorded plant stands in the plant's place, and everything else is computed again.

    Every signal has the same bits.
    """
    _, path, log = logged
    difference = cosim.diff(log, cosim.replay(path))
    assert difference.equal
    assert {row.status for row in difference.rows} == {"equal"}


@pytest.mark.usefixtures("without_verdicts")
def test_replay_with_other_parameters_changes_what_depends_on_them(logged):
    """Another filter changes the reconstruction and what follows it, not the recorded plant."""
    name, path, log = logged
    changes = {"observer.filter_rate": 500.0}
    if name in ("compensation", "pair"):  # all that it computes drives the plant
        text = "'compensator', on which 'plant' depends"
        if name == "pair":
            changes = {"controller.gain": 0.4}
            text = "'controller', on which 'motor' depends"
        with pytest.raises(UsageError, match=text):
            cosim.replay(path, set=changes)
        return
    if name == "closed-loop":  # its observer drives the plant
        changes = {"connections.regressor.delta": {"from": "observer.delta", "offset": 0.5}}
    again = cosim.replay(path, set=changes)
    changed = {row.signal for row in cosim.diff(log, again).rows if row.status != "equal"}
    assert "regressor.mu" in changed
    assert ("observer.delta" in changed) == (name != "closed-loop")
    assert not any(signal in changed for signal in ("plant.y", "plant.x_a", "delta.y"))


@pytest.mark.usefixtures("without_verdicts")
def test_a_replay_keeps_grid_end_and_plant_of_its_recording(recorded):
    """Recorded rows exist at the recorded instants only, whatever parameters the plant had."""
    cases = [
        ({"scenario.step": 5e-4}, r"scenario\.step: expected the recorded 0\.01 s, got 0\.0005 s"),
        ({"scenario.stop": 9.0}, r"scenario\.stop'\]: expected .* 7\.0 s .*, got 9\.0 s"),
        ({"plant.x_a0": [5.0, 5.0]}, "'plant' is taken from the recording; run the scenario to"),
    ]
    check_refused(cases, lambda changes: cosim.replay(recorded, set=changes))


def test_a_run_that_failed_replays_up_to_its_end(tmp_path):
    """What was recorded before a failure can be verified like any other log."""
    path = tmp_path / "a.mcap"
    bad = {"kind": "expression", "y": "1/(t - 7.0)"}
    changes = {**COARSE, "components.bad": bad, "scenario.stop": 8.0}
    with pytest.raises(NonFiniteError, match=r"'bad\.y' became inf"):
        cosim.run("academic", out=path, set=changes)
    log = open_log(path)
    assert (log.status, log.time("plant")[-1]) == ("failed", 6.99)
    assert cosim.diff(log, cosim.replay(path)).equal


@pytest.mark.slow
def test_a_design_is_not_reused_where_an_input_is_held_now(tmp_path):
    """A recorded discretization is for inputs that are linearly interpolated.

    If u is discrete for the observer, its design is computed anew, and the replay equals a run.
    """
    smooth = {
        **COARSE,
        "components.other": {"kind": "expression", "y": "sin(t)"},
        "connections.observer.u": "other.y",
        "scenario.stop": 8.0,
    }
    cosim.run("academic", out=tmp_path / "a.mcap", set=smooth)
    by_replay = cosim.replay(tmp_path / "a.mcap", set={"other.discrete": True})
    by_run = cosim.run("academic", set={**smooth, "other.discrete": True})
    assert cosim.diff(by_run, by_replay).equal


@pytest.mark.usefixtures("without_verdicts")
def test_numbered_logs_count_up(tmp_path):
    """A name is free where nothing stands: no file, no folder, no link that leads nowhere."""

    def name():
        out = tmp_path / "a.mcap"
        log = cosim.run("academic", out=out, numbered=True, set={"scenario.stop": 0.01})
        return log.path.name

    assert name() == "a.mcap"
    assert name() == "a-2.mcap"
    (tmp_path / "a-3.mcap").mkdir()
    (tmp_path / "a-4.mcap").symlink_to(tmp_path / "nowhere")
    assert name() == "a-5.mcap"
    with pytest.raises(UsageError, match="force and numbered exclude"):
        cosim.run("academic", out=tmp_path / "a.mcap", numbered=True, force=True)
    recorder = McapRecorder(tmp_path / "a.mcap", numbered=True, force=True)
    with pytest.raises(UsageError, match="force and numbered exclude"):
        cosim.run("academic", recorder=recorder)


def test_a_swap_of_what_is_no_fmu_is_refused_by_its_place(tmp_path):
    """The component, the file and the reason in one line; no file is written."""
    path = tmp_path / "plant.fmu"
    path.write_text("hello")
    with pytest.raises(ScenarioError) as caught:
        cosim.run("academic", swap={"plant": path}, out=tmp_path / "run.mcap")
    assert caught.value.exit_code == 2
    place = f"swap['plant']: components.plant: {path}: "
    assert str(caught.value).startswith(f"{place}not an FMU, as it is no zip archive")
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]


def test_options_of_a_log_are_refused_where_none_is_written(recorded):
    """It would be ignored."""
    cases = [
        (lambda **options: cosim.run("academic", **options), ["embed", "force", "numbered"]),
        (lambda **options: cosim.run("academic", recorder=Extremes(), **options), ["force"]),
        (lambda **options: cosim.replay(recorded, **options), ["force"]),
        (lambda **o: cosim.compare("academic", swap={"plant": [recorded]}, **o), ["force"]),
    ]
    for act, options in cases:
        for option in options:
            with pytest.raises(UsageError, match=f"{option}=True applies to a log; expected out"):
                act(**{option: True})


OF_A_RECORDING = {"kind": "recording", "log": "b.mcap", "component": "plant"}
UNFOLLOWED = {
    "academic": [
        ({"u.amplitude": 2.0}, r"\['u\.amplitude'\]: .*'u', on which 'plant' depends"),
        ({"components.u.amplitude": 2.0}, "'u', on which 'plant' depends"),
        ({"u": {"kind": "constant", "value": 1.0}}, "'u', on which 'plant' depends"),
        ({"delta.terms": [{"family": "sine", "theta": 2.0}]}, "'delta', on which 'plant' depends"),
        ({"connections.plant.u": "delta.y"}, "'plant' is taken from the recording"),
        ({"models.academic.Bu": [[0], [3], [1]]}, "'plant' is taken from the recording"),
        ({"plant.solver": "RK45"}, "'plant' is taken from the recording"),
        ({"plant": OF_A_RECORDING}, "taken from the recording"),
        ({"scenario.coupling": "jacobi"}, "may change the inputs of 'plant'"),
        ({"scenario.input_interpolation": "zero-order"}, "may change the inputs of"),
    ],
    "closed-loop": [
        ({"controller.B": [[5.0]]}, "'controller', on which 'plant' depends"),
        ({"observer.filter_rate": 500.0}, "on which 'plant' depends"),
        ({"connections.controller.u": "reference.y"}, "'controller', on which 'plant' depends"),
    ],
}


@pytest.mark.usefixtures("without_verdicts")
@pytest.mark.parametrize("scenario", UNFOLLOWED)
def test_a_replay_refuses_what_its_recording_cannot_follow(tmp_path, scenario):
    """A change of a recorded component, or of what drives one, in every spelling."""
    path = tmp_path / "a.mcap"
    cosim.run(scenario, out=path, set={"scenario.stop": 0.1})
    cases = [(set_, f"{named}.*run the scenario to change") for set_, named in UNFOLLOWED[scenario]]
    check_refused(cases, lambda changes: cosim.replay(path, set=changes))


@pytest.mark.usefixtures("without_verdicts")
def test_a_replay_says_what_it_is(recorded, tmp_path):
    """Its log names the log that it is made from, and what was copied from it."""
    log = cosim.open_log(recorded)
    origin = replay_origin(cosim.replay(recorded, out=tmp_path / "b.mcap"))
    assert origin == ReplayOrigin(os.path.relpath(recorded), log.content_hash(), ("plant",))
    with pytest.raises(LogError, match="this is not a replay"):
        replay_origin(log)


@pytest.mark.usefixtures("without_verdicts")
def test_a_log_is_never_written_over_what_is_no_log(tmp_path):
    """A log ends in .mcap, so a slip of the hand does not replace a scenario or an FMU."""
    with pytest.raises(UsageError, match=r"mine\.toml: expected a path that ends in \.mcap"):
        cosim.run("academic", out=tmp_path / "mine.toml", set={"scenario.stop": 0.1}, force=True)


@pytest.mark.usefixtures("without_verdicts")
def test_what_a_run_warns_of_is_shown_in_python(tmp_path):
    """In memory, in a log, in a recorder of one's own, and in a replay, as recorded there."""
    held = {"scenario.input_interpolation": "zero-order", "scenario.stop": 0.05}
    path = tmp_path / "a.mcap"
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        memory = cosim.run("academic", set=held)
        log = cosim.run("academic", set=held, out=path)
        cosim.run("academic", set=held, recorder=Extremes())
        again = cosim.replay(path)
    assert {one.category for one in shown} == {cosim.CosimWarning}
    texts = [str(one.message) for one in shown]
    assert texts[:7] == [*texts[:2] * 3, texts[0]]  # what a replay computes again warns anew
    assert "do not trust delta" in texts[0]
    assert "as recorded" in texts[7]
    assert memory.warnings == log.warnings == list(log.summary().warnings)
    assert again.warnings[0] == log.warnings[0]


class Extremes:
    """A recorder of one's own: keeps the largest |value| of the row, no rows."""

    def __enter__(self):
        self.calls = ["enter"]
        self.largest = 0.0
        self.rows = 0
        return self

    def __exit__(self, kind, error, trace):
        self.calls.append("exit" if error is None else f"exit {kind.__name__}")

    def begin(self, plan):
        self.calls.append("begin")
        self.width = plan.layout.width

    def write(self, block, signals):
        assert signals.shape == (block.steps + 1, self.width)
        self.rows += block.steps
        self.largest = max(self.largest, np.nanmax(np.abs(signals)))

    def message(self, time_ns, level, source, text):
        self.calls.append((level, source))

    def event(self, event):
        self.calls.append(event.cause)

    def result(self, values):
        self.calls.append(sorted(values))


def test_a_recorder_of_ones_own_takes_a_scenario():
    """Its rows, its warnings, its results, and the error of a run that fails."""
    held = {"scenario.input_interpolation": "zero-order", "scenario.stop": 0.5}
    recorder = Extremes()
    assert cosim.run("academic", recorder=recorder, set=held, block=7) is recorder
    assert recorder.calls == [
        "enter",
        "begin",
        ("warning", "observer"),
        ("warning", "scenario.step"),
        ["last", "warnings"],
        ["identification"],
        "exit",
    ]
    memory = cosim.run("academic", set=held)
    assert recorder.rows == memory.steps == 500
    values = np.concatenate([memory[label] for label in memory.results["last"]])
    assert recorder.largest == np.nanmax(np.abs(values))
    bad = {"components.bad": {"kind": "expression", "y": "1/(t - 0.05)"}, "scenario.stop": 0.1}
    with pytest.raises(NonFiniteError):
        cosim.run("academic", recorder=recorder, set=bad)
    end = [("error", "run"), ["last", "warnings"], "exit NonFiniteError"]
    assert recorder.calls == ["enter", "begin", *end]


def test_a_run_has_one_recorder(tmp_path):
    out = tmp_path / "a.mcap"
    with pytest.raises(UsageError, match=r"^recorder .* out$"):
        cosim.run("academic", out=out, recorder=Extremes())
    assert not out.exists()
    with pytest.raises(UsageError, match=r"^recorder .* notice$"):
        cosim.run("academic", recorder=Extremes(), notice=print)


@pytest.mark.usefixtures("without_verdicts")
def test_several_signals_of_a_recording_are_stacked():
    """Elements and slices too, of one component or several, where their instants are the same."""
    run = cosim.run("academic", set={"identifier.period": 0.01, "scenario.stop": 0.1})
    stacked = run[["plant.x_a[1]", "observer.x_a", "plant.y"]]
    columns = [run["plant.x_a"][:, 1:], run["observer.x_a"], run["plant.y"][:, np.newaxis]]
    assert np.array_equal(stacked, np.hstack(columns))
    with pytest.raises(LogError, match=r"'plant\.y' with 101 .* and 'identifier\.theta' with 11"):
        run[["plant.y", "identifier.theta"]]


@pytest.mark.usefixtures("without_verdicts")
def test_a_recording_must_cover_the_run_and_is_not_written_over(tmp_path):
    """Before the first step; a log that is replayed is not written over either."""
    path = tmp_path / "a.mcap"
    empty = tmp_path / "empty.mcap"
    short = {"scenario.stop": 0.1}
    cosim.run("academic", out=path, set=short)
    with pytest.raises(UsageError, match=r"0\.0 s to 0\.2 s .*0\.0 s to 0\.1 s"):
        cosim.run("academic", swap={"plant": path}, set={"scenario.stop": 0.2})
    with pytest.raises(UsageError, match="is read by this run"):
        cosim.run("academic", swap={"plant": path}, set=short, out=path, force=True)
    with pytest.raises(UsageError, match="is the log being replayed; choose another path"):
        cosim.replay(path, out=path, force=True)
    bad = {"u.offset": 1e308, "u.phase": 1.6, "u.amplitude": 1e308}
    with pytest.raises(NonFiniteError):
        cosim.run("academic", out=empty, set={**short, **bad})
    with pytest.raises(LogError, match="the log has no step to replay"):
        cosim.replay(empty)


LOOP = """
scenario = { name = "loop", stop = 0.2, step = 1e-3 }
[components]
a = { kind = "fmu", path = "lag.fmu", start = { inner = 0.01, x = 1.0 } }
b = { kind = "fmu", path = "lag.fmu", start = { inner = 0.01 } }
[connections]
"a.u" = { from = "b.x", gain = -1.0 }
"b.u" = "a.x"
"""


def test_two_fmus_in_a_loop_do_not_hide_an_inner_step_from_each_other(tmp_path):
    """Both change at every 10th step only, with their inputs: no order of an error then.

    It is said once, of the loop, in whatever blocks the run goes.
    """
    lag.able(lag.build(tmp_path, "2"), tmp_path / "lag.fmu", "2")
    scenario = tmp_path / "loop.toml"
    scenario.write_text(LOOP)
    of_b_first = {"components.a.start.inner": 0.02}
    for source, changes, block in (("a", {}, None), ("b", of_b_first, 1), ("b", of_b_first, 1000)):
        log = cosim.run(scenario, set=changes, block=block)
        (message,) = [m for m in log.messages() if "inner step" in m.text]
        assert (message.level, message.source) == ("warning", source)
        assert "an inner step of 0.01 s" in message.text or source == "b"
        assert summarize(log).loops == ()
    fine = cosim.run(scenario, set={"components.a.start": {}, "components.b.start": {}})
    assert "inner step" not in str(fine.messages())
    assert summarize(fine).loops == ("gauss-seidel a b (a)",)


def test_a_run_in_memory_has_the_messages_of_its_log(tmp_path):
    """Those of FMUs, too: one that ignores the step, and has its input set to a mean."""
    lag.build(tmp_path, "2").rename(tmp_path / "lag.fmu")
    (tmp_path / "loop.toml").write_text(LOOP)
    changes = {"components.u": {"kind": "sine", "rate": 1.0}, "connections.a.u": "u.y"}
    log = cosim.run(tmp_path / "loop.toml", set=changes, out=tmp_path / "a.mcap")
    assert cosim.run(tmp_path / "loop.toml", set=changes).messages() == log.messages()
    (message,) = [m for m in log.messages() if "inner step" in m.text]
    assert (message.time_ns, message.level, message.source) == (100_000_000, "warning", "a")
    assert ("info", "a") in {m[1:3] for m in log.messages() if "to the mean of both" in m.text}


def test_a_run_without_verdicts_has_the_bits_of_one_with_them(tmp_path):
    """Only what its end says of the estimates is left out; they can be identified later."""
    short = {"scenario.stop": 0.05}
    judged = cosim.run("academic", set=short)
    path = tmp_path / "bare.mcap"
    bare = cosim.run("academic", set={**short, "scenario.verdicts": False}, out=path)
    assert "identification" not in bare.results
    assert cosim.diff(bare, judged).equal
    record = judged.results["identification"]["identifier"]
    verdicts = [one["verdict"] for one in record["parameters"]]
    assert [one.verdict for one in cosim.identify(path).assessment.parameters] == verdicts
