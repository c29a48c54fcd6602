"""What comes from outside: wrong paths, wrong arguments, logs larger than memory."""

from __future__ import annotations

import hashlib
import json
import os
import struct
import subprocess
import sys
from time import process_time

import numpy as np
import pytest
from mcap.reader import make_reader

import cosim
from cosim.core.contracts import Block
from cosim.core.port import Port
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import CosimError, LogError, UsageError
from cosim.log import McapRecorder, open_log
from cosim.log.comparison.diff import diff
from cosim.log.contents.content import combine_hashes
from cosim.log.contents.metadata import decode_design
from cosim.log.mcap_file.compression import MOST_BYTES
from cosim.log.reading import container as log_container
from cosim.log.reading import reader as log_reader
from cosim.log.reading import rows as log_rows
from cosim.report.plots import plot_signals
from tests.log.recordings import STEP_NS, blocks, layout, plan, record, same_bits

BAD_PATHS = ["x" * 260 + ".mcap", "a\0b.mcap", 3, None, b"\xff.mcap", "\udcff\ud800.mcap"]


@pytest.fixture
def path(tmp_path):
    """Record a short run; return its path."""
    record(tmp_path / "a.mcap", steps=20)
    return tmp_path / "a.mcap"


@pytest.mark.parametrize("bad", BAD_PATHS, ids=["long", "NUL", "int", "None", "bytes", "surrogate"])
def test_what_can_be_no_path_is_refused(bad, path):
    """By everything that reads or writes a log, before anything else is done."""
    calls = [
        lambda: open_log(bad),
        lambda: McapRecorder(bad),
        lambda: cosim.replay(bad),
        lambda: cosim.diff(open_log(path), bad),
    ]
    if bad is not None:
        calls.append(lambda: cosim.run("academic", out=bad, set={"scenario.stop": 0.01}))
    if isinstance(bad, str):
        calls.append(lambda: cosim.load(bad))
    for call in calls:
        with pytest.raises(CosimError):
            call()


def test_only_a_regular_file_is_a_log(tmp_path):
    """A pipe is not waited for, a device not read, a folder named."""
    os.mkfifo(tmp_path / "pipe.mcap")
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "zero.mcap").symlink_to("/dev/zero")
    for name, kind in (("pipe", "a pipe"), ("folder", "a folder"), ("zero", "a device")):
        with pytest.raises(LogError, match=rf"{name}\.mcap cannot be read: it is {kind}, not a"):
            open_log(tmp_path / f"{name}.mcap")


@pytest.mark.parametrize(
    "misuse",
    [
        lambda log: log[3],
        lambda log: log[None],
        lambda log: log[["plant.u", 3]],
        lambda log: log[[]],
        lambda log: log[{"plant.u"}],
        lambda log: log.rows(3),
        lambda log: log.rows(["plant"]),
        lambda log: log.time(3),
        lambda log: log.time_ns(None),
        lambda log: log.load("plant", 3),
        lambda log: log.attachment(3),
        lambda log: list(log.blocks(3)),
        lambda log: diff(log, str(log.path)),
        lambda log: diff(None, log),
        lambda log: diff(log, log, signals=[3]),
        lambda log: diff(log, log, signals="plant"),
        lambda log: diff(log, log, atol="x"),
        lambda log: diff(log, log, atol=-1.0),
        lambda log: diff(log, log, rtol=float("nan")),
    ],
)
def test_wrong_arguments_are_named(path, misuse):
    """A LogError or UsageError that says what was found, and no error of Python's own."""
    with pytest.raises(UsageError, match=r"found|needed|no (component|attachment)"):
        misuse(open_log(path))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324])
def test_a_picture_of_any_values_is_drawn_or_refused(tmp_path, value):
    """Where an axis cannot hold them, the signal is named."""
    rows = np.zeros((21, layout().width))
    rows[5:9] = value
    rows[9:12] = -value
    record(tmp_path / "a.mcap", rows=rows)
    log = open_log(tmp_path / "a.mcap")
    if abs(value) == 1e308:
        with pytest.raises(UsageError, match=r"plant\.u: found 1e\+308, too large to be drawn"):
            plot_signals(log, ["plant.u"], tmp_path / "a.png")
    else:
        plot_signals(log, ["plant.u"], tmp_path / "a.png")
        assert (tmp_path / "a.png").stat().st_size > 0


@pytest.mark.parametrize("signals", [[], [3], ["plant"], "plant.u"])
def test_a_picture_of_no_signals_is_refused(path, signals):
    """As is a path that none can be written to."""
    with pytest.raises(UsageError):
        plot_signals(open_log(path), signals, path.with_suffix(".png"))
    with pytest.raises(UsageError, match="cannot be written"):
        plot_signals(open_log(path), ["plant.u"], path / "x.png")


def test_a_port_and_ports_name_signals_too(path):
    """As texts do."""
    log = open_log(path)
    port = Port("plant", "x_a")
    assert same_bits(log[port], log["plant.x_a"])
    assert same_bits(log[[port, "plant.u"]], log[["plant.x_a", "plant.u"]])


def many(count):
    """Return the layout of many components."""
    channels = []
    for i in range(count):
        interface = Interface((), (Signal("y", 2),))
        channels.append(Channel(f"c{i}", interface, 2 * i))
    return Layout(tuple(channels))


@pytest.fixture
def passes(monkeypatch):
    """Return a list with an entry for each pass over a file."""
    passes = []
    read_blocks = log_container.Container.blocks

    def counted(self, *channel_ids, **window):
        passes.append(self)
        return read_blocks(self, *channel_ids, **window)

    monkeypatch.setattr(log_container.Container, "blocks", counted)
    return passes


def test_small_components_need_one_pass(tmp_path, passes):
    """Whichever is asked for first."""
    record(tmp_path / "a.mcap", steps=5, lay=many(300))
    log = open_log(tmp_path / "a.mcap")
    for name in ("c7.y", "c299.y", "c0.y"):
        assert len(log[name]) == 6
    assert len(passes) == 1


def test_many_components_need_few_passes(tmp_path, monkeypatch, passes):
    """The hash needs one; to ask for one component after another needs few."""
    monkeypatch.setattr(log_rows, "_ALWAYS_AHEAD", 0)
    lay = many(300)
    rows = record(tmp_path / "a.mcap", steps=5, lay=lay)
    log = open_log(tmp_path / "a.mcap")
    log.content_hash()
    assert len(passes) == 1
    for i in range(300):
        assert same_bits(log[f"c{i}.y"], rows[:, 2 * i : 2 * i + 2])
    assert len(passes) <= 1 + 3  # 1 + 64 + 4096 components
    passes.clear()
    backwards = open_log(tmp_path / "a.mcap")
    for name in reversed(backwards.signals):
        assert len(backwards[name]) == 6
    assert len(passes) <= 20


def test_many_components_have_no_more_pieces_than_few(tmp_path):
    """A piece is what a chunk has of a component: it costs the same, however few rows it has.

    Of 2000 components a step takes 98 kB: chunks of 1 MiB would have 11 rows of each, in 6 pieces.
    """
    record(tmp_path / "a.mcap", steps=60, size=60, lay=many(2000))
    with (tmp_path / "a.mcap").open("rb") as stream:
        assert make_reader(stream).get_summary().statistics.chunk_count <= 2


def reading_costs(path, count):
    """Return the processor time for each component: to hash it, to read it."""
    hashed = open_log(path)
    log = open_log(path)
    began = process_time()
    hashed.content_hash()
    between = process_time()
    for name in log.channels:
        log.rows(name)
    return np.diff([began, between, process_time()]) / count


@pytest.mark.usefixtures("frozen_heap")
def test_the_cost_to_read_a_component_does_not_grow(tmp_path):
    """As a ratio within one run; the smallest counts, as another process can only add time."""
    small = tmp_path / "small.mcap"
    large = tmp_path / "large.mcap"
    record(small, steps=100, size=100, lay=many(100))
    record(large, steps=100, size=100, lay=many(1000))
    ratios = np.full(2, np.inf)
    for _ in range(5):
        base = np.min([reading_costs(small, 100) for _ in range(2)], axis=0)
        ratios = np.minimum(ratios, reading_costs(large, 1000) / base)
        if (ratios <= 1.5).all():
            return
    raise AssertionError(f"a component costs {ratios} times as much to hash and to read")


def test_designs_are_decoded_once(tmp_path, monkeypatch):
    """However often they are asked for."""
    record(tmp_path / "a.mcap", steps=5)
    decoded = []
    decode = log_reader.decode_design

    def counted(text):
        decoded.append(text)
        return decode(text)

    monkeypatch.setattr(log_reader, "decode_design", counted)
    log = open_log(tmp_path / "a.mcap")
    for _ in range(3):
        assert log.designs["plant"]
    assert len(decoded) == 2


CHILD = """
import resource, sys
from cosim.log import open_log
from cosim.log.comparison.diff import diff
from cosim.report.inspection import describe_log
path, small = sys.argv[1:]
def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
for log in (open_log(small), open_log(small)):
    log.content_hash(); diff(log, log, rtol=0.1); describe_log(small)
before = peak()
log = open_log(path)
log.content_hash()
after_hash = peak()
assert diff(log, open_log(path), rtol=0.1).equal
after_diff = peak()
describe_log(path)
print(after_hash - before, after_diff - before, peak() - before)
"""


def test_a_log_may_be_larger_than_memory(tmp_path):
    """Hash, diff and info of 70 MB of rows, in less than 0.7 MB, take less than a quarter of it.

    The rows of a chunk of 1 MiB are there a few times, as records, values and differences.
    """
    lay = Layout((Channel("c", Interface((), (Signal("y", 800),)), 0),))
    big = tmp_path / "big.mcap"
    rows = np.zeros((1001, 800))
    with McapRecorder(big) as recorder:
        recorder.begin(plan(lay))
        for k in range(11):
            for block, signals in blocks(rows, 1000):
                first = k * 1000
                times = block.time_ns + first * STEP_NS
                shifted = type(block)(first, times, times / 1e9, block.h)
                recorder.write(shifted, signals)
    record(tmp_path / "small.mcap", steps=50, lay=lay)
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(big), str(tmp_path / "small.mcap")],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    size = 11_000 * 800 * 8
    assert big.stat().st_size < size / 100
    for grown in map(int, done.stdout.split()):
        assert grown < size / 4


def test_rows_out_of_order_are_sorted_within_limits(path, tmp_path, monkeypatch):
    """As another tool may write them; without a limit a small file could fill the memory."""
    from tests.log.crafting import put_together, take_apart

    content = take_apart(path)
    content.messages.reverse()
    turned = put_together(content, tmp_path / "b.mcap")
    assert open_log(turned).content_hash() == open_log(path).content_hash()
    monkeypatch.setattr(log_rows, "_MOST_SORTED", 100)
    with pytest.raises(LogError, match=r"not in order of time, and .* bytes are too many"):
        open_log(turned).content_hash()
    assert open_log(path).content_hash() == open_log(path).recorded_hash


def test_rows_out_of_order_are_sorted_however_they_are_asked_for(path, tmp_path, monkeypatch):
    """Times, a signal, a part in some time; of components with many rows, too."""
    from tests.log.crafting import put_together, take_apart

    content = take_apart(path)
    content.messages.reverse()
    turned = put_together(content, tmp_path / "b.mcap", chunk_size=5000)
    whole = open_log(path)
    begin, end = (whole.t[number] for number in (len(whole.t) // 3, len(whole.t) // 2))
    for kept in (log_rows._MOST_KEPT, 0):
        monkeypatch.setattr(log_rows, "_MOST_KEPT", kept)
        log = open_log(turned)
        assert same_bits(log.t, whole.t)
        assert same_bits(log["plant.x_a"], whole["plant.x_a"])
        assert same_bits(np.vstack([rows for _, rows in log.blocks("plant")]), whole.rows("plant"))
        part = open_log(turned).window(begin, end)
        assert same_bits(part["plant.x_a"], whole.window(begin, end)["plant.x_a"])
        assert same_bits(part.t, whole.t[(whole.t >= begin) & (whole.t <= end)])


@pytest.mark.parametrize("rtol", [0.0, 0.5])
def test_a_diff_in_pieces_is_the_diff_as_a_whole(tmp_path, monkeypatch, rtol):
    """Chunks of two runs end at other instants, and some instants only one of them has."""
    rows = record(tmp_path / "a.mcap", steps=700)
    changed = rows.copy()
    changed[311:, 2] += 1.0
    record(tmp_path / "b.mcap", rows=changed[:650])
    a = tmp_path / "a.mcap"
    b = tmp_path / "b.mcap"
    whole = diff(open_log(a), open_log(b), rtol=rtol)
    monkeypatch.setattr(log_rows, "_MOST_AHEAD", 0)
    monkeypatch.setattr("cosim.log.reading.stream._ROWS", 37)
    assert diff(open_log(a), open_log(b), rtol=rtol) == whole
    assert json.dumps(whole.to_dict())
    assert diff(open_log(a), open_log(a)).equal


def test_a_component_of_many_channels_is_streamed(tmp_path, monkeypatch):
    """Its parts are joined as they come."""
    lay = layout(wide=9000)
    record(tmp_path / "a.mcap", steps=30, lay=lay)
    log = open_log(tmp_path / "a.mcap")
    assert log.content_hash() == log.recorded_hash
    monkeypatch.setattr(log_rows, "_MOST_AHEAD", 0)
    streamed = [rows for _, rows in open_log(tmp_path / "a.mcap").blocks("wide")]
    assert same_bits(np.concatenate(streamed), log.rows("wide"))


def test_a_time_beyond_63_bits_is_damage(path, tmp_path):
    """It would be negative; by streaming and by reading."""
    from tests.log.crafting import put_together, take_apart

    content = take_apart(path)
    number, _, sequence, data = content.messages[-1]
    content.messages[-1] = (number, 2**63, sequence, data)
    log = open_log(put_together(content, tmp_path / "b.mcap"))
    for read in (log.content_hash, log.load):
        with pytest.raises(LogError, match=rf"a time beyond {2**63 - 1} ns"):
            read()


def test_both_limits_of_a_jump_are_streamed(tmp_path, monkeypatch):
    """Rows of one instant are in order, wherever a piece of the rows ends."""
    times = np.array([0, 1, 1, 1, 2, 3, 3], dtype=np.int64) * STEP_NS
    lay = Layout((Channel("c", Interface((), (Signal("y"),)), 0),))
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        recorder.begin(plan(lay))
        recorder.write(Block(0, times, times / 1e9, STEP_NS / 1e9), np.arange(7.0)[:, np.newaxis])
    whole = diff(open_log(tmp_path / "a.mcap"), open_log(tmp_path / "a.mcap"))
    for size in (1, 2, 3):
        monkeypatch.setattr("cosim.log.reading.stream._ROWS", size)
        monkeypatch.setattr(log_rows, "_MOST_AHEAD", 0)
        log = open_log(tmp_path / "a.mcap")
        assert log.content_hash() == log.recorded_hash
        assert diff(log, open_log(tmp_path / "a.mcap")) == whole
        assert whole.rows[0].rows == (7, 7, 7)


def test_a_channel_with_fewer_rows_than_another_is_damage(tmp_path):
    """Also where no summary counts them, and the rows are read in pieces."""
    from tests.log.crafting import put_together, take_apart

    record(tmp_path / "a.mcap", steps=5, lay=layout(wide=5000))
    content = take_apart(tmp_path / "a.mcap")
    (last,) = [number for number, channel in content.channels.items() if channel[0] == "/wide.2"]
    position = max(i for i, message in enumerate(content.messages) if message[0] == last)
    del content.messages[position]
    put_together(content, tmp_path / "b.mcap", use_statistics=False)
    log = open_log(tmp_path / "b.mcap")
    with pytest.raises(LogError, match="different numbers of rows"):
        log.content_hash()
    with pytest.raises(LogError, match="rows at different times"):
        log.rows("wide")


def test_channels_with_rows_at_other_times_are_damage(tmp_path):
    """A component has its rows at one time, in all its channels."""
    from tests.log.crafting import put_together, take_apart

    record(tmp_path / "a.mcap", steps=5, lay=layout(wide=5000))
    content = take_apart(tmp_path / "a.mcap")
    (last,) = [number for number, channel in content.channels.items() if channel[0] == "/wide.2"]
    position = max(i for i, message in enumerate(content.messages) if message[0] == last)
    number, time_ns, sequence, data = content.messages[position]
    content.messages[position] = (number, time_ns + 10**6, sequence, data)
    log = open_log(put_together(content, tmp_path / "b.mcap"))
    for read in (log.content_hash, lambda: log.rows("wide")):
        with pytest.raises(LogError, match="have rows at different times"):
            read()


MAGIC = b"\x89MCAP0\r\n"


def sparse(path, opcode, content, length):
    """Write an MCAP file with one record of some length, most of it a hole."""
    with path.open("wb") as stream:
        stream.write(MAGIC + struct.pack("<BQ", 1, 8) + bytes(8))  # Header
        stream.write(struct.pack("<BQ", opcode, length) + content)
        stream.seek(length - len(content), os.SEEK_CUR)
        stream.write(struct.pack("<BQI", 15, 4, 0) + struct.pack("<BQQQI", 2, 20, 0, 0, 0))
        stream.write(MAGIC)


@pytest.mark.parametrize(
    ("opcode", "content"),
    [
        (12, b""),  # Metadata
        (6, struct.pack("<QQQIIQ", 0, 0, 100, 0, 0, 2**40 - 40)),  # Chunk
        (5, bytes(22)),  # Message outside chunks
    ],
)
def test_a_record_of_any_length_is_refused_unread(tmp_path, opcode, content):
    """A sparse file has any length, and takes no room on the disk."""
    sparse(tmp_path / "a.mcap", opcode, content, 2**40)
    with pytest.raises(LogError, match=rf"of \d+ bytes, at most {MOST_BYTES} are read"):
        open_log(tmp_path / "a.mcap")


@pytest.mark.parametrize("start", [8, 2**40])
def test_a_summary_elsewhere_is_damage(path, start):
    """It stands between the end of the data and the footer."""
    data = bytearray(path.read_bytes())
    data[-28:-8] = struct.pack("<QQI", start, 0, 0)
    path.write_bytes(data)
    with pytest.raises(LogError, match=f"the summary is said to begin at byte {start}"):
        open_log(path)


def test_room_is_made_for_rows_that_can_be_there(path):
    """Not for those that a summary counts; a log without a result says no number of steps."""
    from tests.log.crafting import put_together, take_apart

    content = take_apart(path)
    content.metadata = [record for record in content.metadata if record[0] != "cosim.result"]
    put_together(content, path)
    with path.open("rb") as stream:
        counts = make_reader(stream).get_summary().statistics.channel_message_counts
    data = bytearray(path.read_bytes())
    found = struct.pack("<HQHQ", 1, counts[1], 2, counts[2])
    assert data.count(found) == 1
    data[data.index(found) + 2 : data.index(found) + 10] = struct.pack("<Q", 2**50)
    data[-12:-8] = bytes(4)  # no CRC of the summary
    path.write_bytes(data)
    log = open_log(path)
    for read in (log.load, log.content_hash):
        with pytest.raises(LogError, match=f"rows of 'plant' found, its summary says {2**50}"):
            read()


def test_a_flip_in_messages_outside_chunks_is_found(path, tmp_path):
    """By the CRC of all data, where its writer gave one."""
    from tests.log.crafting import put_together, take_apart

    content = take_apart(path)
    copy = put_together(content, tmp_path / "b.mcap", use_chunking=False, enable_data_crcs=True)
    assert open_log(copy).content_hash() == open_log(path).recorded_hash
    data = bytearray(copy.read_bytes())
    position = data.index(content.messages[5][3]) + 4  # inside of a double
    data[position] ^= 1
    copy.write_bytes(data)
    with pytest.raises(LogError, match="the CRC of the data does not match"):
        open_log(copy)


@pytest.mark.parametrize("shape", [[-1], [2, -1], [True], ["1"], 1, None, [1] * 9, [2**40], [[1]]])
def test_a_design_of_no_shape_is_refused(shape):
    """Sizes are whole numbers from 0 on, and nothing is guessed."""
    text = json.dumps({"A": {"shape": shape, "data": "AAAAAAAA8D8="}})
    with pytest.raises(ValueError, match=r"shape|reshape"):
        decode_design(text)


def test_the_hash_covers_the_declaration_that_was_recorded(path, tmp_path):
    """Whatever the present version would write: a log of an earlier one still has its hash."""
    from tests.log.crafting import put_together, take_apart

    content = take_apart(path)
    for _, _, items in content.channels.values():
        if items:
            signals = json.loads(items["cosim.signals"])
            for signal in signals:
                del signal["type"]  # as if it had been added later, with this default
            items["cosim.signals"] = json.dumps(signals, separators=(",", ":"))
    components = []
    for number, (_, _, items) in content.channels.items():
        if items:
            digest = hashlib.sha256()
            for channel, time_ns, _, data in content.messages:
                if channel == number:
                    digest.update(struct.pack("<q", time_ns))
                    digest.update(b"".join(data[i + 1 : i + 9] for i in range(0, len(data), 9)))
            declared = items["cosim.signals"]
            components.append((items["cosim.component"], declared, digest.hexdigest()))
    needed = combine_hashes(components)
    log = open_log(put_together(content, tmp_path / "b.mcap"))
    assert log.content_hash() == needed
    assert log.content_hash() != open_log(path).recorded_hash


@pytest.mark.usefixtures("frozen_heap")
def test_kinds_are_known_at_the_cost_of_a_look_up(tmp_path):
    """However many components there are: each of them is asked for."""
    record(tmp_path / "a.mcap", steps=5, lay=many(1000))
    log = open_log(tmp_path / "a.mcap")
    began = process_time()
    kinds = dict(log.kinds)
    once = process_time() - began
    began = process_time()
    assert [log.kinds[name] for name in log.channels] == list(kinds.values())
    assert process_time() - began < 100.0 * max(once, 1e-4)
