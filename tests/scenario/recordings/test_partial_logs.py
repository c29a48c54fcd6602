"""Runs of which chosen signals are recorded, every so many steps: the table [record]."""

import json
import math
from functools import partial

import numpy as np
import pytest
from mcap.reader import make_reader

import cosim
from cosim.errors import LogError, ScenarioError, UnknownSignalError
from cosim.log.metadata import add_checksum
from cosim.log.spans import cut, merge
from cosim.report.summary import summarize
from tests.log.crafting import put_together, take_apart, without_checksum
from tests.scenario.refusals import check_refused

pytestmark = pytest.mark.usefixtures("without_verdicts")

SHORT = {"scenario.stop": 0.2, "identifier.period": 0.01}
CHOSEN = ["plant.*", "observer.delta"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Record all of a run whose identifier answers every ten communication steps."""
    path = tmp_path_factory.mktemp("logs") / "whole.mcap"
    return cosim.run("academic", out=path, set=SHORT)


@pytest.fixture(scope="module")
def part(tmp_path_factory):
    """Record some signals of the same run, every ten steps."""
    path = tmp_path_factory.mktemp("logs") / "part.mcap"
    return cosim.run("academic", out=path, set=SHORT | record(CHOSEN, 10))


def record(signals=None, every=None):
    """Return the settings of the table [record]."""
    settings = {} if signals is None else {"record.signals": signals}
    return settings if every is None else settings | {"record.every": every}


@pytest.mark.parametrize(
    ("signals", "every", "in_memory"),
    [
        (CHOSEN, 1, False),
        (["*.delta", "identifier.theta"], 4, True),
        (["identifier.theta", "u.y"], 7, False),
        (None, 3, False),
        (["plant.y"], 1000, True),  # more steps than the run has
    ],
)
def test_recorded_signals_have_the_bits_of_the_whole_run(
    whole, tmp_path, signals, every, in_memory
):
    """Rows are those at the multiples of ``every`` and of the period of the component alike."""
    out = None if in_memory else tmp_path / "a.mcap"
    run = cosim.run("academic", out=out, set=SHORT | record(signals, every))
    assert run.partial is not None
    for name, channel in run.channels.items():
        period = whole.channels[name].period
        steps = np.arange(0, 201, math.lcm(period, every))
        assert run.time_ns(name).tolist() == (steps * 1_000_000).tolist()
        for signal in channel.signals:
            port = f"{name}.{signal.name}"
            expected = whole[port][steps // period]
            assert run[port].tobytes() == np.ascontiguousarray(expected).tobytes()
    assert (run.steps, run.end_ns, run.status) == (200, 200_000_000, "complete")


def test_a_selection_of_everything_is_a_whole_log(whole, tmp_path):
    """The file is no other one: the same hash, and nothing says that it is partial."""
    run = cosim.run("academic", out=tmp_path / "a.mcap", set=SHORT | record(["*"], 1))
    assert run.partial is None
    assert run.content_hash() == whole.content_hash()
    assert "cosim.record" not in run.metadata


def test_stock_readers_see_the_recorded_columns_alone(part):
    """The schema has a field for each recorded element; there are no other channels of signals."""
    with part.path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    topics = {channel.topic: channel for channel in summary.channels.values()}
    assert topics.keys() == {"/plant", "/observer", "/cosim/log"}
    observer = topics["/observer"]
    declared = json.loads(observer.metadata["cosim.signals"])
    assert [signal["name"] for signal in declared] == ["delta"]
    assert summary.statistics.channel_message_counts[observer.id] == 21


def test_a_partial_log_says_so(whole, part):
    """In its text, and where something else is asked for; it declares all that there was."""
    assert "partial: 6 of 24 signals, of 2 of 6 components, at every 10 steps" in repr(part)
    assert list(part.partial.declared) == list(whole.channels)
    assert part.partial.missing(part.channels)["regressor"] == ["delta", "mu"]
    assert part.content_hash() == part.recorded_hash  # of the rows that are there
    assert summarize(part).signals == ()  # truths are not recorded
    reason = r"the log is partial \(recorded with \[record\] signals = \[.*\], every = 10\)"
    for ask in (
        lambda: part["observer.x_a"],
        lambda: part.rows("regressor"),
        lambda: part.signal_hashes("u.*"),
        lambda: list(part.blocks("u")),
    ):
        with pytest.raises(UnknownSignalError, match=reason):
            ask()


def test_a_certificate_is_of_all_outputs():
    """What it says does not depend on what is recorded."""
    short = {"scenario.stop": 0.05}
    whole = cosim.run("academic", set=short, certify=True)
    part = cosim.run("academic", set=short | record(["u.y"], 5), certify=True)
    assert cosim.certificate(part).signals == cosim.certificate(whole).signals


def test_two_partial_logs_and_a_whole_one_are_compared_where_they_have_rows(whole, part, tmp_path):
    """Signals that one has not are named, and are no difference; a name asks for them in vain."""
    difference = cosim.diff(part, whole)
    assert difference.equal
    status = {row.signal: row.status for row in difference.rows}
    assert (status["plant.x_a"], status["u.y"]) == ("equal", "not recorded in a")
    other = cosim.run("academic", set=SHORT | record(["plant.y"], 4))
    rows = {row.signal: row for row in cosim.diff(other, part).rows}
    assert rows["plant.y"].rows == (51, 21, 11)  # at the multiples of 20
    with pytest.raises(UnknownSignalError, match=r"no signal of 'u': the log is partial"):
        cosim.diff(whole, part, signals=["u.y"])
    apart = cosim.run("academic", set=SHORT | record(["u.y"]))
    with pytest.raises(LogError, match="no recorded signal in common: one of them is partial"):
        cosim.diff(part, apart)
    changed = SHORT | {"plant.x_a0": [1.0, -0.5]}
    assert not cosim.diff(part, cosim.run("academic", out=tmp_path / "c.mcap", set=changed)).equal


def test_a_partial_log_is_cut_and_merged_again(part, tmp_path):
    """Both spans say what they have of the signals; merged they are the log again."""
    paths = [tmp_path / "first.mcap", tmp_path / "second.mcap"]
    first = cut(part.path, None, 0.1, paths[0])
    second = cut(part.path, 0.105, None, paths[1])
    assert first.partial == second.partial == part.partial
    assert (len(first["plant.y"]), len(second["plant.y"])) == (11, 10)
    merged = merge(paths, tmp_path / "merged.mcap")
    assert merged.content_hash() == part.content_hash()


@pytest.mark.parametrize("signals", [["plant.y"], ["plant.*"]])
def test_a_partial_log_takes_the_place_of_a_plant(whole, tmp_path, signals):
    """Its inputs stay connected, recorded or not; what follows from its outputs has their bits."""
    cosim.run("academic", out=tmp_path / "a.mcap", set=SHORT | record(signals))
    run = cosim.run("academic", swap={"plant": tmp_path / "a.mcap"}, set=SHORT)
    assert {"plant.u", "plant.delta", "plant.y", "identifier.theta"} <= set(run)
    for name in run:
        assert run[name].tobytes() == whole[name].tobytes(), name
    cosim.run("academic", out=tmp_path / "b.mcap", set=SHORT | record(["u.y"]))
    with pytest.raises(ScenarioError, match="no signal of 'plant': the log is partial"):
        cosim.run("academic", swap={"plant": tmp_path / "b.mcap"}, set=SHORT)


IMPOSSIBLE = [
    (record(["plan.*"]), r"record\.signals'\]: no signal matches 'plan\.\*'.* 'plant"),
    (record(["plant.yy"]), "'plant' has no signal 'yy'; did you mean 'y'"),
    (record([]), r"record\.signals'\]: .*\[\]"),
    (record("plant.y"), r"record\.signals'\]: .*'plant.y'"),
    (record([1]), r"record.signals\[0\]: .* 1"),
    (record(["plant.x_a[0]"]), r"'plant.x_a\[0\]'"),
    (record(every=0), r"record\.every'\]: .* 0"),
    (record(every=2.5), r"record\.every'\]: .* 2\.5"),
    ({"record.evry": 2}, "unknown key 'evry'; did you mean 'every'"),
]


def test_an_impossible_selection_is_refused_before_the_run(tmp_path):
    """Nothing is written."""
    out = tmp_path / "a.mcap"
    run = partial(cosim.run, "academic", out=out)
    check_refused(IMPOSSIBLE, lambda changes: run(set=SHORT | changes), ScenarioError)
    assert not out.exists()


def put(name, key, text):
    """Return what sets a text of a metadata record; None: it is left out."""

    def change(content):
        items = dict(content.metadata)[name]
        items[key] = text
        if text is None:
            del items[key]

    return change


def redeclare(content):
    """Declare another size of a recorded signal."""
    items = dict(content.metadata)["cosim.component.plant"]
    declared = without_checksum(json.loads(items["cosim.declared"]))
    declared["cosim.signals"] = declared["cosim.signals"].replace('"size":2', '"size":3')
    items["cosim.declared"] = json.dumps(add_checksum("cosim.channel", declared))


WRONG = [
    (put("cosim.record", "every", None), "'every'"),
    (put("cosim.record", "components", None), "'components'"),
    (put("cosim.record", "every", "-1"), "expected a whole number, got '-1'"),
    (put("cosim.record", "components", "[]"), "'plant'"),
    (put("cosim.record", "components", '["plant", "nope"]'), "'cosim.component.nope'"),
    (put("cosim.record", "signals", "7"), "7"),
    (put("cosim.component.u", "cosim.declared", None), "'cosim.declared'"),
    (put("cosim.component.u", "cosim.declared", "{}"), "checksum|missing|cosim"),
    (redeclare, "'plant' .*'x_a'"),
]


@pytest.mark.parametrize(("change", "message"), WRONG)
def test_the_metadata_of_a_partial_log_are_checked(part, tmp_path, change, message):
    """Somebody may have written it by hand."""
    content = take_apart(part.path)
    change(content)
    path = put_together(content, tmp_path / "a.mcap")
    with pytest.raises(LogError, match=f"record of the run cannot be parsed.*({message})"):
        cosim.open_log(path)


def test_a_damaged_record_of_the_parts_is_found(part, tmp_path):
    """Its metadata have a checksum of their own, which MCAP's CRCs do not cover."""
    data = part.path.read_bytes()
    place = data.index(b'["plant.*"', data.index(b"cosim.record"))
    path = tmp_path / "a.mcap"
    path.write_bytes(data[:place] + b'["plant.?"' + data[place + 10 :])
    with pytest.raises(LogError, match=r"cosim\.record"):
        cosim.open_log(path)
