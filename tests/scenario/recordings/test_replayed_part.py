"""Which components a replay computes, copies or lacks: equal bit for bit, or refused by name."""

import random

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

import cosim
from cosim.errors import CosimError, LogError, ScenarioError, UsageError
from cosim.log.recovering import recover
from cosim.report.verification import verify
from cosim.scenario.document.document import shipped
from cosim.scenario.record import replay_origin
from tests.log.crafting import change_rows, put_together, take_apart
from tests.log.recordings import make_chunks_small
from tests.scenario.refusals import check_refused

pytestmark = pytest.mark.usefixtures("without_verdicts")

SHORT = {"scenario.stop": 0.2}
ALL = {"record.signals": ["*"], "record.every": 1}
LOOP = """
scenario = { name = "loop", stop = 3.0, step = 1e-2 }
actions = [
  { at = 0.5, signal = "pid.measurement", offset = 0.2 },
  { at = 1.0, set = { "pid.gain" = 4.0 } },
  { at = 1.5, signal = "plant.u", override = 0.0 },
  { at = 2.0, signal = ["plant.u", "pid.measurement"], release = true },
]
[components]
setpoint = { kind = "constant", value = 1.0 }
pid = { kind = "pid", gain = 2.0, integral_time = 1.0, lower = -3.0, upper = 3.0 }
plant = { kind = "lag", time_constant = 2.0, initial = 0.0 }
behind = { kind = "lag", time_constant = 0.5, initial = 0.0 }
[connections]
"pid.setpoint" = "setpoint.y"
"pid.measurement" = "plant.y"
"plant.u" = "pid.y"
"behind.u" = { from = "plant.y", gain = 2.0 }
"""


def recorded(signals, every=1):
    """Return the settings of the table [record]."""
    return {"record.signals": signals, "record.every": every}


def check_bits(again, whole, window_ns=None):
    """Check that all signals of a replay have the bits of the whole run, up to where it ends."""
    assert len(again) > 0
    begin_ns, end_ns = window_ns or (whole.grid.start_ns, again.end_ns)
    assert again.end_ns == end_ns
    for name, channel in again.channels.items():
        time_ns = whole.time_ns(name)
        inside = (time_ns >= begin_ns) & (time_ns <= end_ns)
        assert again.time_ns(name).tolist() == time_ns[inside].tolist()
        for signal in channel.signals:
            port = f"{name}.{signal.name}"
            assert again[port].tobytes() == whole[port][inside].tobytes(), port


# --- of any scenario, any components ---

OF_A_PID = ["setpoint", "measurement"]
KINDS = {  # table, inputs, whether the outputs follow these at the same instant
    "gain": ("{ kind = 'gain', K = [[0.5]] }", ["u"], True),
    "pid": ("{ kind = 'pid', gain = 0.5, integral_time = 1.0 }", OF_A_PID, True),
    "digital": (
        "{ kind = 'pid', gain = 0.2, integral_time = 1.0, period = PERIOD }",
        OF_A_PID,
        True,
    ),
    "lag": ("{ kind = 'lag', time_constant = 0.2, initial = 0.3 }", ["u"], False),
    "plant": ("{ kind = 'descriptor', model = 'mass', x0 = [1, 0] }", ["u"], False),
}


@st.composite
def scenarios(draw):
    """Return the text of a scenario in which inputs are driven by anything, loops among it.

    Some of the inputs are faulty for a while.
    """
    step, period = draw(st.sampled_from([("0.01", "0.03"), ("'1/60'", "'1/20'")]))
    coupling = draw(st.sampled_from(["gauss-seidel", "jacobi", "newton"]))
    kinds = draw(st.lists(st.sampled_from([*KINDS]), min_size=2, max_size=5))
    names = ["source", *(f"{kind}{i}" for i, kind in enumerate(kinds))]
    tables = ["source = { kind = 'sine', rate = 9.0 }"]
    connections = {}
    for i, kind in enumerate(kinds, start=1):
        table, inputs, follows = KINDS[kind]
        tables.append(f"{names[i]} = {table.replace('PERIOD', period)}")
        # no algebraic loop: what follows at once is driven by what stands before it
        for name in inputs:
            driver = draw(st.sampled_from(names[:i] if follows else names))
            connections[f"{names[i]}.{name}"] = f"{driver}.y"
    actions = []
    for signal in draw(st.sets(st.sampled_from([*connections]), max_size=2)):
        begin, end = sorted(draw(st.sets(st.integers(0, 9), min_size=2, max_size=2)))
        fault = draw(st.sampled_from(["override = 0.3", "offset = 0.2", "gain = 1.5"]))
        actions.append(f"{{ at = {begin / 20}, signal = '{signal}', {fault} }}")
        actions.append(f"{{ at = {end / 20}, signal = '{signal}', release = true }}")
    head = f"name = 'random', stop = 0.5, step = {step}, coupling = '{coupling}'"
    return "\n".join(
        [
            f"scenario = {{ {head}, coupling_check = 'warn' }}",
            "models.mass = { A = [[0, 1], [-4, -2]], Bu = [[0], [1]], C = [[1, 0]] }",
            f"actions = [{', '.join(actions)}]",
            "[components]",
            *tables,
            "[connections]",
            *(f"'{to}' = '{source}'" for to, source in connections.items()),
        ]
    )


def recording_of(data, path, folder):
    """Record a run; return its log: in one file, in several, or what was saved of a part of it."""
    out = folder / "log.mcap"
    way = data.draw(st.sampled_from(["whole", "rotated", "recovered"]), label="recording")
    with pytest.MonkeyPatch.context() as patch:
        make_chunks_small(patch, 2**10)
        log = cosim.run(path, out=out, rotate="0.2s" if way == "rotated" else None)
    if way == "recovered":
        with out.open("rb") as stream:
            chunks = make_reader(stream).get_summary().chunk_indexes
        last = data.draw(st.sampled_from(chunks[len(chunks) // 2 :]), label="last chunk")
        content = out.read_bytes()[: last.chunk_start_offset + last.chunk_length]
        (folder / "cut.mcap").write_bytes(content)
        log = recover(folder / "cut.mcap", folder / "recovered.mcap").log
    return log


def check_any(data, folder):
    """Check that any components follow from the others, of a whole log and of a part of one."""
    path = folder / "random.toml"
    path.write_text(data.draw(scenarios(), label="scenario"))
    whole = cosim.run(path)
    rerun = data.draw(st.booleans(), label="rerun")
    computable = [n for n in whole.channels if rerun or not n.startswith("plant")]
    chosen = data.draw(st.sets(st.sampled_from(computable), min_size=1), label="components")
    log = recording_of(data, path, folder)
    last = np.searchsorted(whole.time_ns("source"), log.end_ns) // 3  # all have rows at each third
    points = st.sets(st.integers(0, int(last)), min_size=2, max_size=2)
    window_ns = [whole.grid.stamp(3 * point) for point in sorted(data.draw(points, label="window"))]
    window = tuple(time_ns / 1e9 for time_ns in window_ns)
    again = cosim.replay(log, components=sorted(chosen), rerun=rerun, window=window)
    assert set(replay_origin(again).copied) == whole.channels.keys() - chosen
    assert list(again) == list(whole)
    check_bits(again, whole, window_ns)
    check_bits(cosim.replay(log, components=sorted(chosen), rerun=rerun), whole)
    signals = data.draw(st.sets(st.sampled_from([*whole]), min_size=1), label="signals")
    part = cosim.run(path, out=folder / "part.mcap", set=recorded(sorted(signals)))
    try:
        again = cosim.replay(part, components=sorted(chosen), rerun=rerun, set=ALL)
    except (LogError, UsageError) as error:
        assert "cannot be computed" in str(error) or "can be computed" in str(error)  # noqa: PT017
    else:
        check_bits(again, whole)


@pytest.mark.filterwarnings("ignore::cosim.errors.CosimWarning")
@settings(max_examples=8, derandomize=True, deadline=None, suppress_health_check=HealthCheck)
@given(data=st.data())
def test_any_components_follow_from_the_others(tmp_path_factory, data):
    """Of random scenarios; with a fraction as a step, loops, sampled parts and plants."""
    check_any(data, tmp_path_factory.mktemp("random"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::cosim.errors.CosimWarning")
@settings(max_examples=50, deadline=None, suppress_health_check=HealthCheck)
@given(data=st.data())
def test_any_components_of_many_scenarios_follow_from_the_others(tmp_path_factory, data):
    """The same, more often."""
    check_any(data, tmp_path_factory.mktemp("random"))


def check_each(log):
    """Check that every component alone follows, bit for bit, from the rows of the others."""
    others = set(replay_origin(cosim.replay(log)).copied)
    for name in log.channels.keys() - others:
        verification = verify(log, cosim.replay(log, components=[name]))
        assert verification.passed, (name, verification.problems)
        statuses = {entry.component: entry.status for entry in verification.components}
        assert statuses.pop(name) == "equal"
        assert set(statuses.values()) == {"copied"}


@pytest.mark.fast("pair")
@pytest.mark.parametrize("name", shipped())
def test_a_shipped_scenario_is_replayed_from_what_is_recorded(name, tmp_path):
    """Each component alone from a whole log, and whatever of it was recorded."""
    short = {"scenario.stop": 0.1}
    log = cosim.run(name, out=tmp_path / "whole.mcap", set=short)
    check_each(log)
    if name == "compensation":  # its estimates are what its plant needs
        return
    source = random.Random(name)
    for _ in range(3):
        patterns = [source.choice([f"{c}.*" for c in log.channels]), source.choice([*log])]
        changes = short | recorded(patterns, source.choice([1, 1, 10]))
        part = cosim.run(name, out=tmp_path / "a.mcap", force=True, set=changes)
        check_bits(cosim.replay(part, set=ALL), log)


# --- what is chosen of a whole log ---


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Record the example."""
    changes = SHORT | {"scenario.verdicts": False}
    return cosim.run("academic", out=tmp_path_factory.mktemp("whole") / "a.mcap", set=changes)


def test_a_chosen_component_is_computed_from_the_rows_of_the_log(log, tmp_path):
    """A changed row of the observer is found in it; what it drives follows from it, as it is."""
    observer = log.channels["observer"]
    column = observer.signal_columns["delta"].start - observer.start
    content = take_apart(log.path)

    def change(number, values):
        if number == 100:
            values[column] += 1.0

    change_rows(content, "observer", change)
    path = put_together(content, tmp_path / "b.mcap")
    for chosen, changed in (("observer", {"observer"}), ("regressor", {"regressor", "identifier"})):
        found = verify(cosim.open_log(path), cosim.replay(path, components=[chosen]))
        first = {e.component: e.first.time_ns for e in found.components if e.first is not None}
        assert first == dict.fromkeys(changed, 100_000_000)


CHOICES = [
    (["obserer"], r"'obserer'; did you mean 'observer'\? Available"),
    (["observer", "plant"], "'plant' cannot be computed.*rerun=True; .*: u, delta, observer, regr"),
    ([], r"components: expected at least one .*; got none"),
    ("observer", r"components: .*'observer'"),
]


def test_an_impossible_choice_is_refused(log):
    """Unknown names, plants, no name at all."""
    check_refused(CHOICES, lambda components: cosim.replay(log, components=components))


def test_changes_of_what_is_not_chosen_are_refused(log):
    """It comes from the log, which knows nothing of them; so does what rests on it."""
    changes = {"observer.filter_rate": 500.0}
    for chosen, name in (("regressor", "observer"), ("observer", "regressor")):
        message = f"'{name}' is taken from the recording; compute this component, too"
        with pytest.raises(UsageError, match=message):
            cosim.replay(log, components=[chosen], set=changes)
    again = cosim.replay(log, components=["observer", "regressor", "identifier"], set=changes)
    assert cosim.diff(again, cosim.replay(log, set=changes)).equal


SAMPLED = """
scenario = { name = "sampled", stop = 0.4, step = 1e-2 }
actions = [ { at = TIME, signal = "pid.measurement", gain = 1.5 } ]
[components]
source = { kind = "constant", value = 1.0 }
pid = { kind = "pid", gain = 0.5, period = 0.1, offset = OFFSET }
behind = { kind = "lag", time_constant = 0.3 }
[connections]
"pid.setpoint" = "source.y"
"pid.measurement" = "source.y"
"behind.u" = "pid.y"
"""


SENSOR = {
    'kind = "pid", gain = 0.5': 'kind = "sensor"',
    "offset = OFFSET": "dropout = 0.4, seed = 3",
    '"pid.setpoint" = "source.y"\n': "",
    "pid.measurement": "pid.u",
}
UNRECORDED = [["behind.*"], ["behind.u"], ["pid.y", "behind.y"]]
STEADY = {", period = 0.1": "", ", offset = OFFSET": ""}
FAULTS = [  # changes of the text, offset of the samples, stop, recorded signals
    *(({}, offset, stop, ["*"]) for offset in (0.0, 0.03, 0.05) for stop in (0.27, 0.4)),
    (SENSOR, 0.0, 0.4, ["*"]),
    *((edits, 0.0, 0.4, named) for edits in ({}, STEADY) for named in UNRECORDED),
]


@pytest.mark.parametrize(("edits", "offset", "stop", "signals"), FAULTS)
def test_what_followed_a_fault_is_held_until_the_next_sample(
    edits, offset, stop, signals, tmp_path
):
    """The fault falls on a sample of a copied controller, whose row there is the left limit.

    A partial log has nothing of the faulted input, and not what drives it, but what followed.
    """
    text = SAMPLED
    for old, new in edits.items():
        text = text.replace(old, new)
    path = tmp_path / "sampled.toml"
    path.write_text(text.replace("OFFSET", str(offset)).replace("TIME", str(0.2 + offset)))
    whole = cosim.run(path, stop=stop)
    log = cosim.run(path, stop=stop, set=recorded(signals), out=tmp_path / "log.mcap")
    for component in ("source", "behind") if signals == ["*"] else ("behind",):
        again = cosim.replay(log, components=[component], set=ALL)
        check_bits(again, whole)
        assert ("behind.u", "follow") in [(event.signal, event.cause) for event in again.events()]
        assert log.partial is not None or again.events() == log.events()


def test_a_sensor_whose_log_has_not_all_its_rows_is_to_be_computed(tmp_path):
    """Where its samples are read: between them it has no value, and no row."""
    table = {"kind": "sensor", "period": 0.01}
    changes = {**SHORT, "components.sensor": table, "connections.sensor.u": "plant.y"}
    read = changes | {"connections.identifier.y": "sensor.y"}
    log = cosim.run("academic", out=tmp_path / "a.mcap", set=read)
    message = (
        r"set\['sensor'\]: .* for 'identifier\.samples', .* only every 10 communication steps .*; "
        "recompute it, too"
    )
    with pytest.raises(ScenarioError, match=message):
        cosim.replay(log, components=["identifier"])
    assert verify(log, cosim.replay(log, components=["identifier", "sensor"])).passed


# --- of a partial log ---


@pytest.fixture
def part(tmp_path):
    """Return what records a part of the same run."""

    def record(signals, every=1, **changes):
        chosen = SHORT | recorded(signals, every) | changes
        return cosim.run("academic", out=tmp_path / "a.mcap", force=True, set=chosen)

    return record


@pytest.fixture
def loop(tmp_path):
    """Return what records a part of a run with a loop."""
    path = tmp_path / "loop.toml"
    path.write_text(LOOP)

    def record(signals, every=1):
        out = tmp_path / f"{len(list(tmp_path.iterdir()))}.mcap"
        return cosim.run(path, out=out, set=recorded(signals, every))

    return record


@pytest.mark.parametrize(
    ("signals", "copied", "computed"),
    [
        (["plant.y"], {"plant"}, {"u", "delta", "observer", "regressor", "identifier"}),
        # what the observer took in is what the plant gave
        (["observer.y"], {"plant"}, {"u", "delta", "observer", "regressor", "identifier"}),
        (["regressor.delta"], {"observer"}, {"u", "delta", "regressor"}),
        (["identifier.theta"], {"identifier"}, {"u", "delta"}),
        (["u.y"], set(), {"u", "delta"}),
    ],
)
def test_a_replay_computes_what_the_recorded_signals_allow(log, part, signals, copied, computed):
    """With the bits of the run; what the log has not is left out, each with its reason."""
    again = cosim.replay(part(signals), set=ALL)
    check_bits(again, log)
    origin = replay_origin(again)
    assert set(origin.copied) == copied
    assert set(again.channels) == copied | computed
    assert set(origin.absent) == set(log.channels) - copied - computed


def test_plants_are_computed_again_from_sources_alone(log, part):
    """Nothing needs to be recorded where everything can be computed."""
    again = cosim.replay(part(["u.y"], 50), rerun=True, set=ALL)
    check_bits(again, log)
    assert list(again) == list(log)


def test_a_replay_records_what_its_scenario_says(part):
    """So that it is equal to its log, as that of a whole one."""
    log = part(["plant.y", "observer.delta"], 4)
    again = cosim.replay(part(["plant.y", "observer.delta"]))
    assert list(again) == ["plant.y", "observer.delta"]
    assert cosim.diff(log, again).equal


def test_rows_between_the_recorded_ones_are_not_made_up(part):
    """Every third row drives nothing: what needs it is refused, in a replay and as a swap."""
    log = part(["*"], 3)
    again = cosim.replay(log, set=ALL)
    assert set(again.channels) == {"u", "delta"}
    reason = replay_origin(again).absent["observer"]
    assert "'observer.y' comes from 'plant.y', which is neither computed nor recorded" in reason
    with pytest.raises(CosimError, match=r"has one row of 'plant' in 3 steps .recorded with"):
        cosim.run("academic", swap={"plant": log.path}, set=SHORT)


def test_what_a_partial_log_does_not_allow_is_refused_by_name(part):
    """A chosen component with the reason, a change of what is not there."""
    log = part(["observer.delta"])
    reason = "'identifier' cannot be computed: its input 'identifier.y' comes from 'plant.y'"
    with pytest.raises(UsageError, match=reason):
        cosim.replay(log, components=["regressor", "identifier", "u", "delta"])
    with pytest.raises(LogError, match=r"no component can be computed: the log is partial, .*\["):
        cosim.replay(log, components=["identifier"])
    changed = {"observer.filter_rate": 500.0}
    with pytest.raises(UsageError, match=r"recording; its input 'observer\.y' comes from"):
        cosim.replay(log, set=changed)
    with pytest.raises(UsageError, match=r"rate'\]: 'observer' is not in this replay"):
        cosim.replay(part(["regressor.mu"]), set=changed)
    again = cosim.replay(part(["plant.y"]), set=ALL | changed)
    check_bits(again, cosim.run("academic", set=SHORT | changed))


def test_a_loop_is_computed_as_a_whole_or_beside_members_recorded_whole(loop):
    """Faults and steps of parameters happen in it again."""
    whole = loop(["*"])
    again = cosim.replay(loop(["behind.y"], 5), set=ALL)
    assert replay_origin(again).copied == ()
    check_bits(again, whole)
    again = cosim.replay(loop(["plant.*", "pid.*", "setpoint.y"]), set=ALL, components=["pid"])
    assert set(again.channels) == {"setpoint", "pid", "plant"}
    check_bits(again, whole)
    with pytest.raises(LogError, match=r"pid: it is in a loop with 'plant', which is not recorded"):
        cosim.replay(loop(["plant.y", "pid.*", "setpoint.y"]), components=["pid"])
    with pytest.raises(LogError, match=r"with 'plant', which is copied, and 'pid' is not"):
        cosim.replay(loop(["plant.*", "pid.y", "setpoint.y"]), components=["pid"])


@pytest.mark.parametrize("signal", ["pid.measurement", "behind.u"])
def test_an_input_with_a_fault_or_a_gain_is_not_what_drives_it(loop, signal):
    """So that it says nothing of the plant."""
    with pytest.raises(LogError, match=r"its input 'behind\.u' comes from 'plant\.y'"):
        cosim.replay(loop([signal]), components=["behind"])


def test_events_of_signals_that_a_copied_component_lacks_are_passed_over(tmp_path):
    """A fault of the plant, of which the log has the output, reaches states, too."""
    changes = SHORT | recorded(["observer.y", "observer.delta"])
    with cosim.load("academic").set(changes).start(out=tmp_path / "a.mcap") as session:
        session.step(50)
        session["plant.u"] = 1.0
        session.step(150)
    log = cosim.open_log(tmp_path / "a.mcap")
    assert "plant.x_b" in [event.signal for event in log.events()]
    assert verify(log, cosim.replay(log)).passed
    with cosim.load("academic").set(SHORT).start(out=tmp_path / "b.mcap") as session:
        session.step(50)
        session["plant.u"] = 1.0
        session.step(150)
    check_bits(cosim.replay(log, set=ALL), cosim.open_log(tmp_path / "b.mcap"))


SWITCHED = """
scenario = { name = "switched", stop = 0.2, step = 1e-2 }
[components]
source = { kind = "sine", rate = 3.0 }
switch = { kind = "switch", discrete = true }
behind = { kind = "lag", time_constant = 0.3 }
[connections]
"switch.u1" = "source.y"
"switch.u2" = "source.y"
"switch.control" = "source.y"
"behind.u" = "switch.y"
"""


def test_a_copied_component_without_its_inputs_has_its_recorded_warnings(tmp_path):
    """A switch warns of its control, which a copied one need not have."""
    path = tmp_path / "switched.toml"
    path.write_text(SWITCHED)
    whole = cosim.run(path, out=tmp_path / "a.mcap")
    (warning,) = [text for _, _, name, text in whole.warnings if name == "switch"]
    part = cosim.run(path, set=recorded(["switch.y"]), out=tmp_path / "b.mcap")
    for log, before in ((whole, ""), (part, "as recorded at t = 0.0 s: ")):
        again = cosim.replay(log, components=["behind"], set=ALL)
        check_bits(again, whole)
        texts = [text for _, _, name, text in again.warnings if name == "switch"]
        assert f"{before}{warning}" in texts
        assert verify(log, again).passed


def test_a_verification_names_what_it_did_not_check(part):
    """Components are verified as a whole where all of their signals are in the log."""
    log = part(["observer.*", "regressor.mu", "plant.y"])
    verification = verify(log, cosim.replay(log))
    assert verification.passed
    status = {entry.component: entry.status for entry in verification.components}
    assert status == dict.fromkeys(("u", "delta", "identifier"), "unrecorded") | {
        "plant": "copied",
        "observer": "equal",
        "regressor": "partial",
    }
    assert "no signals of: u, delta, identifier" in "\n".join(verification.lines)
    log = part(["observer.delta"])
    verification = verify(log, cosim.replay(log))
    assert "recomputed no signal of the log, so none is verified" in "\n".join(verification.lines)


def test_a_change_of_what_a_partial_log_has_is_found(part, tmp_path):
    """Also in a component of which it has only a part."""
    content = take_apart(part(["plant.y", "observer.delta"]).path)

    def change(number, values):
        if number == 100:
            values[0] += 1.0

    change_rows(content, "observer", change)
    changed = cosim.open_log(put_together(content, tmp_path / "changed.mcap"))
    verification = verify(changed, cosim.replay(changed))
    assert not verification.passed
    assert "observer.delta at t = 0.1 s" in "\n".join(verification.problems)


def test_a_log_of_nothing_that_a_replay_has_cannot_be_verified(part):
    """It does not pass by having nothing to compare."""
    log = part(["plant.x_a"], 2)
    with pytest.raises(LogError, match="nothing to verify: the partial log"):
        verify(log, cosim.replay(log, set={"record.signals": ["*"]}))
    with pytest.raises(UsageError, match="matches no signal of this run's components: u, delta"):
        cosim.replay(log)


def test_a_partial_log_without_a_row_is_refused(loop, tmp_path):
    """Its rows stand in the place of the run's, one for each step."""
    content = take_apart(loop(["plant.y"]).path)
    number = next(n for n, (topic, _, _) in content.channels.items() if topic == "/plant")
    index = [i for i, message in enumerate(content.messages) if message[0] == number][100]
    del content.messages[index]
    with pytest.raises(CosimError):
        cosim.replay(put_together(content, tmp_path / "b.mcap"))


def test_a_partial_log_whose_inputs_changed_otherwise_is_refused(part, tmp_path):
    """What is computed has to take them as in the run, also where only a window is recorded."""
    content = take_apart(part(["plant.y"]).path)
    items = dict(content.metadata)["cosim.component.observer"]
    items["cosim.held"] = "[true,false]"
    path = put_together(content, tmp_path / "b.mcap")
    for window in (None, (0.1, 0.2)):
        with pytest.raises(LogError, match="'observer' cannot be computed as in the run"):
            cosim.replay(path, window=window)


def test_a_part_rests_on_what_it_rests_on_in_the_whole_run(tmp_path):
    """What the observer reads to warn of its filter is no reason of another component's design."""
    lag = {"kind": "lag", "time_constant": 1.0}
    more = {"components.a": lag, "connections.a.u": "u.y"}  # computed: the last one of the replay
    more |= {"components.b": lag, "connections.b.u": "plant.y"}  # absent: the last one of the run
    log = cosim.run(
        "academic",
        out=tmp_path / "a.mcap",
        set={**more, "scenario.stop": 0.2, "scenario.step": 0.01, **recorded(["regressor.delta"])},
    )
    again = cosim.replay(log)
    assert set(replay_origin(again).absent) >= {"plant", "b"}
    verification = verify(log, again)
    assert verification.passed, verification.problems
