"""Scenarios advanced by hand: the bits of a run, logs that a replay verifies, states, resets."""

import pickle
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np
import pytest

import cosim
from cosim.errors import GraphError, LogError, RunError, UsageError
from cosim.fmi.component import Fmu
from cosim.log import Log
from cosim.report.verification import verify
from cosim.scenario.exporting import export_component
from cosim.scenario.kinds.variants import METHODS
from cosim.scenario.running.replay import replay
from tests.scenario.online import COARSE
from tests.scenario.refusals import check_refused

pytestmark = pytest.mark.usefixtures("without_verdicts")

SHORT = {"scenario.stop": 0.1}


def scenario(name="academic", **changes):
    return cosim.load(name).set({**SHORT, **changes})


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    path = tmp_path_factory.mktemp("session") / "plant.fmu"
    export_component("academic", "plant", path, fmi="3")
    return path


def overridden(name, path, *, swap=None, overrides=("plant.u",), size=7):
    """Record a session with overrides, changed and released; return its log."""
    loaded = scenario(name)
    if swap is not None:
        loaded = loaded.edit(swap={"plant": swap})
    with loaded.start(out=path) as sim:
        sim.step(size)
        for to in overrides:
            sim[to] = np.full(sim[to].shape, 0.3)
        sim.step(size)
        sim[overrides[0]] = np.full(sim[overrides[0]].shape, -2.0)
        sim.step(1)
        for to in overrides:
            sim.release(to)
        sim.step(size)
    return cosim.open_log(path)


# --- a run by hand ---


@pytest.mark.fast("academic")
@pytest.mark.parametrize("name", ["academic", "closed-loop", "academic-noisy", "compensation"])
def test_a_session_a_run_and_its_blocks_have_one_content_hash(name, tmp_path):
    """With a log, whatever the size of the steps."""
    hashes = set()
    for block in (None, 1, 13):
        log = cosim.run(scenario(name), out=tmp_path / f"run-{block}.mcap", block=block)
        hashes.add(log.recorded_hash)
    for size in (7, 100):
        path = tmp_path / f"session-{size}.mcap"
        with scenario(name).start(out=path) as sim:
            while sim.steps_left:
                sim.step(min(size, sim.steps_left))
        log = cosim.open_log(path)
        assert (log.status, log.reason, log.events()) == ("complete", "", [])
        hashes.add(log.recorded_hash)
    assert len(hashes) == 1


def test_a_session_without_a_log_has_the_values_of_a_run():
    """And writes nothing."""
    run = cosim.run(scenario())
    with scenario().start() as sim:
        assert sim.logs == ()
        assert set(sim.signals) == set(run)
        rows = sim.step(100)
        assert sim.t_ns == 10**8
        assert (sim.t, sim.steps_left) == (0.1, 0)
    for name in run:
        array = np.reshape(run[name], (len(run[name]), -1))
        assert rows[name].tobytes() == array[1:].tobytes() or name.startswith("identifier.")
        assert sim[name].tobytes() == rows[name][-1].tobytes()


def test_a_closed_session_takes_no_steps():
    """What it has reached can be read on."""
    sim = scenario().start()
    sim.step(3)
    sim.close()
    sim.close()
    assert sim["plant.u"].shape == (1,)
    for use in (sim.step, lambda: sim.release("plant.u"), lambda: sim.state, sim.reset):
        with pytest.raises(UsageError, match="is closed"):
            use()


# --- logs ---


@pytest.mark.fast("academic-noisy-overrides2")
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("academic", ("observer.y", "plant.delta")),
        ("closed-loop", ("controller.u", "plant.u")),
        ("academic-noisy", ("plant.u", "regressor.delta")),
    ],
)
def test_the_replay_of_a_session_equals_its_log(name, overrides, tmp_path):
    """Overrides, releases and what followed them, bit for bit; in blocks of any size."""
    log = overridden(name, tmp_path / "x.mcap", overrides=overrides)
    causes = [event.cause for event in log.events()]
    assert causes.count("release") == len(overrides)
    for block in (None, 1):
        verification = verify(log, replay(log, block=block))
        assert verification.passed, verification.problems
    again = replay(log, out=tmp_path / "again.mcap")
    assert again.events() == log.events()
    assert again.recorded_hash == log.recorded_hash


@pytest.mark.parametrize("interface_type", ["#cs", "#me"])
def test_the_replay_of_a_session_with_an_fmu_equals_its_log(plant, interface_type, tmp_path):
    """Its outputs are copied, and so are their jumps: the observer follows these."""
    swap = f"{plant}{interface_type}"
    log = overridden("academic", tmp_path / "x.mcap", swap=swap)
    followed = {event.signal for event in log.events() if event.cause == "follow"}
    assert {"plant.y", "observer.y", "observer.delta"} <= followed
    verification = verify(log, replay(log))
    assert verification.passed, verification.problems


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Return the log of a session of the example whose plant.u was overridden."""
    return overridden("academic", tmp_path_factory.mktemp("overridden") / "x.mcap")


def test_a_replay_of_other_overrides_is_found_out(log, monkeypatch):
    """The rows differ, and what the log says of its overrides."""
    again = replay(log)
    events = log.events()
    changed = [events[0]._replace(values=(0.31,)), *events[1:]]
    monkeypatch.setattr(Log, "events", lambda self: changed)
    verification = verify(log, again)
    assert not verification.passed
    assert "the log contradicts its scenario: overrides." in "\n".join(verification.problems)
    other = verify(log, replay(log))
    assert not other.difference.equal


MISFITS = [
    ({"signal": "plant.z"}, r"event of 'plant.z' at t = 0.007 s .*no input"),
    ({"values": (1.0, 2.0)}, r"event of 'plant.u' at t = 0.007 s .*expected 1 value.*, got 2"),
    ({"time_ns": 7_000_001}, r"event at t = 0\.007000001 s .*communication point"),
    ({"cause": "release"}, r"event of 'plant.u' .* is not overridden"),
]


def test_an_event_that_does_not_fit_is_refused(log, monkeypatch):
    """Of a log that was changed."""
    event = log.events()[0]

    def changed(change):
        monkeypatch.setattr(Log, "events", lambda self: [event._replace(**change)])
        replay(log)

    check_refused(MISFITS, changed, LogError)


def test_overrides_hold_in_a_what_if_replay_too(tmp_path):
    """They come from outside; events behind an earlier stop are left out."""
    log = overridden("academic", tmp_path / "x.mcap", overrides=("observer.u",))
    again = replay(log, set={"observer.filter_rate": 100.0, "scenario.stop": 0.012})
    assert again["observer.u"].tobytes() == log["observer.u"][:13].tobytes()
    assert [event.cause for event in again.events() if event.cause != "follow"] == ["override"]


def test_the_log_of_a_session_that_is_not_closed_is_completed(plant, tmp_path):
    """Where nobody has it any more; a warning says so, as of a file."""
    path = tmp_path / "x.mcap"
    sim = scenario().edit(swap={"plant": f"{plant}#cs"}).start(out=path)
    sim.step(20)
    sim["plant.u"] = 0.5
    sessions = [sim]
    del sim
    with pytest.warns(ResourceWarning, match=r"x\.mcap: the session was not closed"):
        sessions.clear()
    log = cosim.open_log(path)
    assert log.status == "interrupted"
    assert log.reason == "the session was not closed, at t = 0.02 s"
    assert log.events()[0].signal == "plant.u"
    assert verify(log, replay(log)).passed


@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (KeyError("plant.u"), "failed", "KeyError: 'plant.u'"),
        (SystemExit(0), "interrupted", "SystemExit: 0"),
        (KeyboardInterrupt(), "interrupted", "interrupted by the user"),
        (GraphError("no such input"), "failed", "no such input"),
        (None, "complete", "the session was closed at t = 0.001 s, before its stop"),
    ],
)
def test_a_log_says_what_its_session_was_left_by(error, status, reason, tmp_path):
    """With the type of an error that is none of cosim; to leave the program is no failure."""
    sim = scenario().start(out=tmp_path / "x.mcap")
    sim.step()
    with pytest.raises(type(error)) if error else nullcontext(), sim:
        if error:
            raise error
    log = cosim.open_log(sim.logs[0])
    assert (log.status, log.reason) == (status, reason)


def test_a_log_that_cannot_be_written_is_refused_first(tmp_path):
    """As of a run; nothing has begun then."""
    path = tmp_path / "x.mcap"
    path.write_text("")
    with pytest.raises(LogError, match="exists; choose another path, or force=True"):
        scenario().start(out=path)
    with pytest.raises(UsageError, match="force=True applies to a log"):
        scenario().start(force=True)
    with pytest.raises(UsageError, match=r"expected a path that ends in .mcap"):
        scenario().start(out=tmp_path / "x.txt")
    with pytest.raises(UsageError, match="numbered"):
        scenario().start(numbered=3)
    with scenario().start(out=path, numbered=True) as sim:
        assert sim.logs == (tmp_path / "x-2.mcap",)


def test_a_reset_begins_the_next_log(tmp_path):
    """Each is complete, and equals a run of its own."""
    path = tmp_path / "x.mcap"
    with scenario().start(out=path) as sim:
        for count in (100, 20, 30):
            sim.step(count)
            sim["plant.u"] = 0.3
            if count != 30:
                sim.reset()
                assert (sim.t_ns, sim.overrides) == (0, {})
    names = ["x.mcap", "x-2.mcap", "x-3.mcap"]
    assert [log.name for log in sim.logs] == names
    logs = [cosim.open_log(tmp_path / name) for name in names]
    assert [log.steps for log in logs] == [100, 20, 30]
    assert logs[1].reason == "the session was reset at t = 0.02 s, before its stop"
    for log in logs:
        assert verify(log, replay(log)).passed
        assert log["plant.y"].tobytes() == logs[0]["plant.y"][: log.steps + 1].tobytes()


# --- states ---


def bits(rows):
    """Return the bytes of rows by signal."""
    return {name: values.tobytes() for name, values in rows.items()}


@pytest.mark.parametrize("method", METHODS)
def test_a_state_is_set_back(method):
    """In its own session, in any order, behind a reset, and pickled in one with a later stop."""
    changes = {**COARSE, "identifier.method": method, "scenario.stop": 12.0}
    coarse = cosim.load("academic-noisy").set(changes)
    with coarse.start() as sim:
        sim.step(300)
        early = sim.state
        sim.step(300)
        saved = sim.state
        pickled = pickle.dumps(saved)
        expected = bits(sim.step(300))
        sim.state = early
        sim["plant.delta"] = 1.0
        sim.step(400)
        sim.state = saved
        assert bits(sim.step(300)) == expected
        sim.reset()
        sim.state = saved
        assert bits(sim.step(300)) == expected
    with coarse.set({"scenario.stop": 13.0}).start() as other:
        other.step(100)
        other.state = pickle.loads(pickled)
        assert other.t == 6.0
        assert bits(other.step(300)) == expected


def test_a_state_that_does_not_fit_is_refused():
    """Beyond the stop nothing would be left to step; one other parameter is another scenario."""
    with scenario().start() as sim:
        sim.step(80)
        saved = sim.state

    def set_in(changes):
        with scenario(**changes).start() as other:
            other.state = saved

    cases = [
        ({"scenario.stop": 0.05}, r"state: .*stop at 0\.05 s, got 0\.08 s"),
        ({"u.amplitude": 2.0}, "state: .*got one of another graph"),
        ({"scenario.step": 5e-4}, "state: .*got one of another graph"),
    ]
    check_refused(cases, set_in)


def test_the_state_of_an_fmu_stays_in_its_session(plant):
    """It lies in the memory of the FMU."""
    swapped = scenario().edit(swap={"plant": f"{plant}#cs"})
    refusal = "that of 'plant' cannot leave its simulation"
    with swapped.start() as sim:
        sim.step(5)
        saved = sim.state
        first = bits(sim.step(20))
        sim.state = saved
        assert bits(sim.step(20)) == first
        with pytest.raises(UsageError, match=refusal):
            pickle.dumps(saved)
        with swapped.start() as other, pytest.raises(UsageError, match=refusal):
            other.state = saved
        sim.reset()
        sim.step(5)
        assert bits(sim.step(20)) == first
    del saved  # after its FMU is gone


def test_with_a_log_a_state_is_taken_and_not_set(tmp_path):
    """A log goes forward only."""
    with scenario().start(out=tmp_path / "x.mcap") as sim:
        saved = sim.state
        with pytest.raises(UsageError, match=r"state: a log is open.*or reset\(\), which begins"):
            sim.state = saved
    with scenario().start() as other:
        other.state = saved


# --- threads, ends and warnings ---


def test_a_session_used_from_another_thread_is_an_error(tmp_path):
    """Whoever resets or closes it, too; the log goes on."""
    with (
        ThreadPoolExecutor(1) as other,
        scenario().start(out=tmp_path / "x.mcap") as sim,
    ):
        for function in (sim.step, sim.reset, sim.close, lambda: sim["plant.u"]):
            with pytest.raises(UsageError, match="was started in another thread"):
                other.submit(function).result()
        sim.step(3)
    (path,) = sim.logs
    assert len(cosim.open_log(path)["plant.y"]) == 4


def test_an_fmu_that_fails_at_its_end_fails_the_session(plant, monkeypatch):
    """Without a log nobody else would say it."""

    def fails(self):
        raise RunError("no")

    sim = scenario().edit(swap={"plant": str(plant)}).start()
    sim.step()
    monkeypatch.setattr(Fmu, "terminate", fails)
    with pytest.raises(RunError, match="'plant' failed at the end of the run: no"):
        sim.close()


HELD = {"scenario.input_interpolation": "zero-order", "scenario.stop": 0.01}


def test_a_session_shows_its_warnings_when_it_starts():
    """Each once; a reset does not repeat them."""
    with pytest.warns(cosim.CosimWarning, match="observer: .*do not trust delta") as shown:
        session = cosim.load("academic").edit(set=HELD).start()
    session.step()
    session.reset()
    session.close()
    assert len(shown) == len({str(one.message) for one in shown}) == 2


def test_a_session_whose_warnings_are_errors_does_not_start(tmp_path):
    """Its log is closed."""
    path = tmp_path / "a.mcap"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(cosim.CosimWarning, match="do not trust delta"):
            cosim.load("academic").edit(set=HELD).start(out=path)
    assert cosim.open_log(path).status == "complete"
