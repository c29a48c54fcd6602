"""What is intact in a damaged log is recovered, and what is lost is told."""

from __future__ import annotations

import random
import shutil
from io import BytesIO

import numpy as np
import pytest
from mcap import records
from mcap.reader import make_reader

import cosim
from cosim.errors import LogError
from cosim.instants import Grid
from cosim.log import open_log, store
from cosim.log.container import Container
from cosim.log.mcap_records import encoded
from cosim.log.recovering import Interval, missing_rows, recover, searched
from cosim.log.spans import cut
from tests.log.crafting import put_together, take_apart
from tests.log.recordings import STEP_NS, layout, make_chunks_small, record, same_bits, table

STEPS = 5000


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return the bytes of a log of several chunks a component, its rows and its chunk indexes."""
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    with pytest.MonkeyPatch.context() as monkeypatch:
        make_chunks_small(monkeypatch, 2**17)
        rows = record(path, steps=STEPS, messages=[(0, "info", "run", "begin")])
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    assert len(chunks) > 4
    return path.read_bytes(), rows, chunks


def recovered(tmp_path, data):
    """Recover a file of these bytes."""
    (tmp_path / "broken.mcap").write_bytes(data)
    return recover(tmp_path / "broken.mcap", tmp_path / "good.mcap", force=True)


def check_rows(recovery, rows):
    """Check that each row that is there has its bits, and each other one is told to be lost."""
    log = open_log(recovery.log.path)
    for name, period, columns in [("plant", 1, slice(0, 5)), ("identifier", 5, slice(5, 10))]:
        steps = log.time_ns(name) // STEP_NS
        assert same_bits(log.rows(name), rows[steps, columns])
        told = recovery.rows[name]
        lost = set()
        for interval in told.lost:
            own = range(interval.first_ns // STEP_NS, interval.last_ns // STEP_NS + 1, period)
            assert len(own) == interval.count
            lost |= set(own)
        assert told.count == len(steps)
        last = recovery.end_ns // STEP_NS
        assert set(steps.tolist()) | lost == set(range(0, last + 1, period))
        assert not set(steps.tolist()) & lost
    shown = recovery.to_dict()
    assert shown["end"] == recovery.end_ns / 1e9  # s
    assert shown["components"] == {
        name: {
            "rows": own.count,
            "lost": [
                {"from": gap.first_ns / 1e9, "to": gap.last_ns / 1e9, "rows": gap.count}
                for gap in own.lost
            ],
        }
        for name, own in recovery.rows.items()
    }
    assert log.content_hash() == log.recorded_hash
    with log.path.open("rb") as stream:
        sum(1 for _ in make_reader(stream, validate_crcs=True).iter_messages())


def test_missing_rows_are_named_by_their_instants():
    """The closed form of a few cases."""
    times = np.array([0, 10, 40, 50])
    assert missing_rows(times, Grid(0, 1), 10, 50).lost == (Interval(20, 30, 2),)
    assert missing_rows(times, Grid(0, 5), 2, 75).lost == (Interval(20, 30, 2), Interval(60, 70, 2))
    assert missing_rows(np.array([20]), Grid(0, 10), 1, 29).lost == (Interval(0, 10, 2),)
    none = missing_rows(np.empty(0, np.int64), Grid(5, 10), 1, 25)
    assert (none.count, none.lost) == (0, (Interval(5, 25, 3),))


def test_a_log_that_is_whole_comes_back_as_it_was(tmp_path, written):
    """With its result: nothing is lost."""
    data, rows, _ = written
    recovery = recovered(tmp_path, data)
    check_rows(recovery, rows)
    assert recovery.log.status == "complete"
    assert recovery.end_is_known
    assert recovery.lost_records == 0
    assert all(not own.lost for own in recovery.rows.values())
    source = tmp_path / "a.mcap"
    source.write_bytes(data)
    assert cosim.diff(open_log(source), recovery.log).equal
    assert recovery.log.messages() == open_log(source).messages()
    assert recovery.log.results == open_log(source).results


def test_one_flipped_bit_costs_one_chunk(tmp_path, written):
    """Every other one is there, before it and behind it."""
    data, rows, chunks = written
    chunk = [chunk for chunk in chunks if 1 in chunk.message_index_offsets][1]
    broken = bytearray(data)
    broken[chunk.chunk_start_offset + chunk.chunk_length - 50] ^= 4
    (tmp_path / "broken.mcap").write_bytes(broken)
    assert len(Container(tmp_path / "broken.mcap", find=searched).places.chunks) == len(chunks) - 1
    recovery = recovered(tmp_path, broken)
    check_rows(recovery, rows)
    assert recovery.log.status == "partial"
    assert recovery.log.reason == "recovered from broken.mcap"
    lost = sum(interval.count for own in recovery.rows.values() for interval in own.lost)
    assert lost == sum(chunk_counts(data, chunk))


def chunk_counts(data, chunk):
    """Return how many messages of components a chunk has, by its message indexes."""
    return [
        int.from_bytes(data[start + 11 : start + 15], "little") // 16
        for start in chunk.message_index_offsets.values()
        if int.from_bytes(data[start + 9 : start + 11], "little") < 3
    ]


def test_what_is_intact_is_found_wherever_it_stands(tmp_path, written, subtests):
    """A chunk or a row twice, or without a CRC; what looks like statistics; no head, or no end.

    The summary repeats schemas and channels, but not metadata and attachments. The end of the run
    is known where its result is.
    """
    data, rows, chunks = written
    first = min(chunk.chunk_start_offset for chunk in chunks)
    start = chunks[1].chunk_start_offset
    twice = data[: start + chunks[1].chunk_length] + data[start:]  # pages of two states
    crc = chunks[0].chunk_start_offset + 9 + 24
    (tmp_path / "a.mcap").write_bytes(data)
    content = take_apart(tmp_path / "a.mcap")
    content.messages = sorted(content.messages, key=lambda message: -message[1])
    other = put_together(content, tmp_path / "b.mcap", chunk_size=20_000).read_bytes()
    middle = len(other) // 2
    flipped = other[:middle] + bytes([other[middle] ^ 1]) + other[middle + 1 :]
    content.messages = [message for message in content.messages for _ in range(2)]
    doubled = put_together(content, tmp_path / "c.mcap").read_bytes()
    found = records.Statistics(0, 3, {3: 2**40}, 1, 2**50, 0, 0, 0, 3)  # that do not add up
    cases = [
        (doubled, {"interrupted"}, True),
        (data[:start] + encoded(found) + data[start:], {"complete"}, True),
        (twice, {"complete"}, True),
        (bytes(first) + data[first:], {"complete"}, True),
        (data[:crc] + bytes(4) + data[crc + 4 :], {"partial"}, True),
        (flipped, {"partial"}, True),
    ]
    for chunk in chunks[1:5]:
        end = chunk.chunk_start_offset + chunk.chunk_length + 100
        cases.append((data[:end], {"interrupted", "partial"}, False))
    for number, (broken, statuses, end_is_known) in enumerate(cases):
        with subtests.test(case=number):
            recovery = recovered(tmp_path, broken)
            check_rows(recovery, rows)
            assert recovery.log.status in statuses
            assert recovery.end_is_known == end_is_known


def test_a_run_that_was_cut_off_is_replayed(tmp_path, monkeypatch):
    """A log of cosim that lost its end, recovered."""
    make_chunks_small(monkeypatch, 2**12)
    whole = cosim.run("academic", set={"scenario.stop": 0.5}, out=tmp_path / "a.mcap")
    data = whole.path.read_bytes()
    recovery = recovered(tmp_path, data[: len(data) * 2 // 3])
    assert recovery.has_scenario
    end = recovery.whole_until_ns / 1e9
    assert 0.0 < end < 0.5
    log = cut(recovery.log.path, None, end, tmp_path / "b.mcap")
    assert log.end_ns == recovery.whole_until_ns
    assert cosim.diff(log, cosim.replay(log)).equal


@pytest.mark.parametrize("seeds", [range(6), pytest.param(range(6, 31), marks=pytest.mark.slow)])
def test_random_damage_loses_no_intact_chunk(tmp_path, written, seeds, subtests):
    """Bytes that are changed, left out, put in between, or zeros, anywhere behind the head."""
    data, rows, chunks = written
    for seed in seeds:
        broken = damaged(data, chunks[0].chunk_start_offset, random.Random(seed))
        (tmp_path / "broken.mcap").write_bytes(broken)
        places = Container(tmp_path / "broken.mcap", find=searched).places
        found = {bytes(broken[span.start : span.stop]) for span in places.chunks}
        with subtests.test(case=seed):
            for chunk in chunks:
                start = chunk.chunk_start_offset
                content = data[start : start + chunk.chunk_length]
                assert (content in found) == (content in broken)
            if found:
                check_rows(recovered(tmp_path, broken), rows)


def damaged(data, first, chance):
    """Return the bytes of a file, damaged at some places from one on."""
    broken = bytearray(data)
    for _ in range(chance.randint(1, 3)):
        start = chance.randrange(first, len(broken))
        length = min(chance.choice([1, 9, 300, 5000, 10_000]), len(broken) - start)
        match chance.choice(["noise", "cut", "insert", "zeros"]):
            case "noise":
                broken[start : start + length] = chance.randbytes(length)
            case "cut":
                del broken[start : start + length]
            case "insert":
                broken[start:start] = chance.randbytes(length)
            case _:
                broken[start : start + length] = bytes(length)
    return broken


def test_without_any_channel_no_row_is_recovered(tmp_path, written):
    """Neither head nor summary."""
    data, _, chunks = written
    first = min(chunk.chunk_start_offset for chunk in chunks)
    last = max(chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks)
    for broken, text in [
        (data[first:last], "no intact channel"),
        (data[:first], "no intact row; run it again"),
        (b"nothing of all that", "no intact channel"),
        (b"", "is empty"),
    ]:
        with pytest.raises(LogError, match=rf"broken\.mcap.*{text}"):
            recovered(tmp_path, broken)
    with pytest.raises(LogError, match=r"missing\.mcap cannot be read"):
        recover(tmp_path / "missing.mcap", tmp_path / "good.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["broken.mcap"]


@pytest.mark.slow
def test_rows_of_a_component_of_many_channels_are_whole_or_lost(tmp_path, monkeypatch):
    """A row that one of its channels has lost cannot be told from none.

    In long flushes the chunks of the channels end at different rows.
    """
    lay = layout(wide=5000)
    rows = table(lay, 150)
    for flush in (2**19, 2**20):
        monkeypatch.setattr(store, "_CHANNEL_BYTES", flush)
        path = tmp_path / f"{flush}.mcap"
        record(path, lay=lay, rows=rows)
        data = bytearray(path.read_bytes())
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        (second,) = [n for n, channel in summary.channels.items() if channel.topic == "/wide.2"]
        own = [c for c in summary.chunk_indexes if second in c.message_index_offsets]
        data[own[0].chunk_start_offset + own[0].chunk_length - 20] ^= 1
        log = open_log(recovered(tmp_path, data).log.path)
        steps = log.time_ns("wide") // STEP_NS
        assert 0 < len(steps) < 151
        assert same_bits(log.rows("wide"), rows[steps, 10:])
        assert len(log.time_ns("plant")) == 151


def test_of_a_part_only_its_own_rows_are_lost(tmp_path, written):
    """Not those before and behind it, which its file never had."""
    data, _, _ = written
    (tmp_path / "a.mcap").write_bytes(data)
    part = cut(tmp_path / "a.mcap", 1.0, 3.0, tmp_path / "b.mcap")
    content = part.path.read_bytes()
    whole = recovered(tmp_path, content)
    assert all(not own.lost for own in whole.rows.values())
    assert (whole.log.status, whole.log.content_hash()) == ("partial", part.content_hash())
    broken = bytearray(content)
    with part.path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    chunk = next(chunk for chunk in chunks if 1 in chunk.message_index_offsets)
    broken[chunk.chunk_start_offset + chunk.chunk_length - 50] ^= 4
    (interval,) = recovered(tmp_path, broken).rows["plant"].lost
    assert interval.first_ns >= 1_000_000_000
    assert interval.last_ns <= 3_000_000_000


def test_of_a_replay_of_a_span_only_its_own_rows_are_lost(tmp_path, monkeypatch):
    """Not those before it, which were computed and never recorded."""
    make_chunks_small(monkeypatch, 2**12)
    cosim.run("academic", set={"scenario.stop": 0.4}, out=tmp_path / "a.mcap")
    span = cosim.replay(tmp_path / "a.mcap", window=(0.2, 0.4), out=tmp_path / "b.mcap")
    content = bytearray(span.path.read_bytes())
    with span.path.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[3]
    content[chunk.chunk_start_offset + chunk.chunk_length - 50] ^= 4
    recovery = recovered(tmp_path, content)
    lost = [interval for own in recovery.rows.values() for interval in own.lost]
    assert min(interval.first_ns for interval in lost) >= 200_000_000
    assert recovery.log.steps == span.steps == 200


def test_a_component_with_a_lost_channel_is_reported_as_lost(tmp_path):
    """Its other channels have no row that is whole; the other components are there."""
    lay = layout(wide=5000)
    rows = table(lay, 50)
    record(tmp_path / "a.mcap", lay=lay, rows=rows)
    data = (tmp_path / "a.mcap").read_bytes()
    assert data.count(b"cosim.columns\x09\x00\x00\x004096:5000") == 2  # head and summary
    recovery = recovered(tmp_path, data.replace(b"4096:5000", b"4096:5001"))
    assert recovery.rows["wide"].count == 0
    assert recovery.rows["wide"].lost == (Interval(0, 50 * STEP_NS, 51),)
    log = open_log(recovery.log.path)
    assert list(log.channels) == ["plant", "identifier"]
    assert same_bits(log.rows("plant"), rows[:, :5])


def test_an_uncompressed_chunk_is_not_taken_for_others(tmp_path):
    """Its messages may look like records; what its CRC covers is skipped as a whole."""
    lay = layout()
    rows = table(lay, 500)
    inner = b"\x06" + (100).to_bytes(8, "little")
    rows[:, 0] = np.frombuffer(inner[1:], "<f8")[0]
    record(tmp_path / "a.mcap", rows=rows, compression="none")
    recovery = recovered(tmp_path, (tmp_path / "a.mcap").read_bytes())
    assert recovery.log.status == "complete"


def test_a_killed_run_is_recovered(tmp_path, flushing):
    """All that a reader sees of its file."""
    scenario = cosim.load("academic").set({"scenario.stop": 1000.0})
    with scenario.start(out=tmp_path / "a.mcap") as run:
        while not open_log(tmp_path / "a.mcap").end_ns:
            run.step(20_000)
        with flushing:
            shutil.copy(tmp_path / "a.mcap", tmp_path / "killed.mcap")
    killed = open_log(tmp_path / "killed.mcap")
    assert killed.status == "unfinished"
    recovery = recover(killed.path, tmp_path / "b.mcap")
    assert recovery.whole_until_ns >= killed.end_ns > 0
    for name, own in recovery.rows.items():
        rows = killed.rows(name)
        assert same_bits(recovery.log.rows(name)[: len(rows)], rows)
        assert all(lost.first_ns > killed.end_ns for lost in own.lost)
    assert recovery.log.status == "interrupted"
    assert recovery.lost_records == 0
    assert cosim.diff(recovery.log, cosim.replay(recovery.log)).equal


def test_a_lost_chunk_of_messages_is_reported(tmp_path, written):
    """All rows are there, and their hash fits: yet it is not the log of the run."""
    data, rows, chunks = written
    (chunk,) = [chunk for chunk in chunks if not {1, 2} & chunk.message_index_offsets.keys()]
    broken = bytearray(data)
    broken[chunk.chunk_start_offset + chunk.chunk_length - 5] ^= 4
    recovery = recovered(tmp_path, broken)
    check_rows(recovery, rows)
    assert all(not own.lost for own in recovery.rows.values())
    assert not recovery.log.messages()
    assert not recovery.has_all_messages
    assert (recovery.log.status, recovery.log.reason) == (
        "interrupted",
        "recovered from broken.mcap",
    )
    assert recovered(tmp_path, data).has_all_messages


def test_lost_metadata_and_attachments_are_counted(tmp_path, written):
    """All rows are there, but not all that says what they are."""
    data, rows, _ = written
    summary = make_reader(BytesIO(data)).get_summary()
    broken = bytearray(data)
    for number, index in enumerate([*summary.attachment_indexes[:1], *summary.metadata_indexes]):
        broken[index.offset + index.length - 5] ^= 4
        recovery = recovered(tmp_path, broken)
        check_rows(recovery, rows)
        assert recovery.lost_records == recovery.to_dict()["lost_records"] == number + 1


def test_a_damaged_file_is_not_replaced_by_what_is_recovered_of_it(tmp_path, written):
    """It is the only one that has what was not."""
    path = tmp_path / "a.mcap"
    path.write_bytes(written[0])
    with pytest.raises(LogError, match="cannot be replaced by it"):
        recover(path, tmp_path / "." / "a.mcap", force=True)
    assert path.read_bytes() == written[0]
