"""A flipped bit or a missing end is harmless or reported: no log is read as another run."""

from __future__ import annotations

import random
import re
import struct
from collections import Counter

import numpy as np
import pytest
from mcap.reader import make_reader

from cosim.core.recorders import EndOfRun
from cosim.errors import LogError
from cosim.log import Attachment, open_log
from cosim.log.background import WaitingMessage
from cosim.log.mcap_records import MAGIC
from cosim.log.messages import encode_log
from tests.log.direct import content, open_store
from tests.log.paged import PagedStream
from tests.log.recordings import (
    STEP_NS,
    layout,
    make_chunks_small,
    plan,
    record,
    table,
)

LONG = [pytest.param(1000, marks=pytest.mark.slow), pytest.param(5000, marks=pytest.mark.campaign)]
USED = rb"(?s)(?:(?!\0{64}).)+"  # all but long rows of zeros


def everything(path):
    """Return all that a log says, as values that can be compared."""
    log = open_log(path)
    rows = {}
    for name in log.channels:
        times = log.time_ns(name)
        rows[name] = (times.tobytes(), log.rows(name).tobytes())
    return (
        rows,
        {name: dict(items) for name, items in log.metadata.items()},
        {name: log.attachment(name) for name in log.attachments},
        [(item.time_ns, item.level, item.source, item.text) for item in log.messages()],
        log.content_hash(),
        dict(log.kinds),
        repr(log.channels),
        {name: repr(design) for name, design in log.designs.items()},
        log.status,
        log.reason,
        log.step_ns,
        log.schedule,
        log.results,
    )


def write(compression):
    """Write a log with messages and attachments; return it as a kill left it, and closed."""
    attachment = Attachment("scenario.toml", "application/toml", b"[scenario]\nstep = 1000.0\n")
    stream = PagedStream()
    log = open_store(
        stream,
        plan(),
        compression=compression,
        metadata={"cosim.component.plant": {"filter_rate": "1000.0"}},
        attachments=[attachment],
    )
    rows = table(layout(), 1000)
    for start, stop in [(0, 100), (100, 110), (110, 800), (800, 810), (810, 811)]:
        time_ns = start * STEP_NS
        text = encode_log(time_ns, "info", "run", f"row {start}")
        log.add(content(rows, start, stop, [WaitingMessage(3, time_ns, text)]))
    killed = bytes(stream.content)
    log.close(EndOfRun("complete", ""), {"rms": 0.25})
    return killed, bytes(stream.content)


@pytest.fixture(scope="module")
def written():
    """Write logs of several chunks and a tail: compressed, as a kill left it and closed; or not."""
    with pytest.MonkeyPatch.context() as patch:
        make_chunks_small(patch, 12_000)
        killed, closed = write("zstd")
        return {"killed": killed, "closed": closed, "uncompressed": write("none")[1]}


def outcome(path, data, truth):
    """Return whether a damaged log is ``reported`` or ``harmless``.

    A log that says something else than what was written fails the test.
    """
    path.write_bytes(data)
    try:
        found = everything(path)
    except LogError:
        return "reported"
    assert found == truth
    return "harmless"


@pytest.mark.fast("100-uncompressed", "100-killed")
@pytest.mark.parametrize("state", ["closed", "killed", "uncompressed"])
@pytest.mark.parametrize("count", [100, *LONG])
def test_a_flipped_bit_is_harmless_or_reported(tmp_path, written, state, count, subtests):
    """Wherever it is, but for the room that holds nothing: in metadata and indexes, too."""
    data = written[state]
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    truth = everything(path)
    used = np.concatenate([np.arange(*match.span()) for match in re.finditer(USED, data)])
    chance = random.Random(count)
    outcomes = Counter()
    for _ in range(count):
        damaged = bytearray(data)
        position = chance.choice(used)
        bit = chance.randrange(8)
        damaged[position] ^= 1 << bit
        with subtests.test(case=f"bit {bit} of byte {position}"):
            outcomes[outcome(path, damaged, truth)] += 1
    assert outcomes["reported"] > count / 4


def test_a_flipped_bit_in_the_header_of_a_killed_log_is_harmless_or_reported(tmp_path, written):
    """No CRC covers its header, which names the tool that wrote it."""
    data = written["killed"]
    path = tmp_path / "a.mcap"
    path.write_bytes(data)
    truth = everything(path)
    (length,) = struct.unpack_from("<Q", data, len(MAGIC) + 1)
    for position in range(len(MAGIC), len(MAGIC) + 9 + length):
        damaged = bytearray(data)
        damaged[position] ^= 0x80
        outcome(path, damaged, truth)


@pytest.mark.parametrize("state", ["closed", "killed"])
@pytest.mark.parametrize("count", [30, pytest.param(500, marks=pytest.mark.campaign)])
def test_a_log_without_its_end_is_reported(tmp_path, written, state, count, subtests):
    """Wherever it is cut."""
    data = written[state]
    path = tmp_path / "a.mcap"
    chance = random.Random(count)
    ends = [match.end() for match in re.finditer(re.escape(MAGIC), data)][:-1]
    for stop in [*ends, *(chance.randrange(len(data)) for _ in range(count))]:
        path.write_bytes(data[:stop])
        with subtests.test(case=f"{stop} of {len(data)} bytes"), pytest.raises(LogError):
            everything(path)


def test_truncated_files_are_refused_with_the_byte(long_log, tmp_path, subtests):
    """What a crash leaves is not called damaged."""
    data = long_log[0].path.read_bytes()
    path = tmp_path / "a.mcap"
    for stop in (0, 10, 28, *(int(len(data) * share) for share in (0.01, 0.3, 0.9, 0.9999))):
        path.write_bytes(data[:stop])
        text = rf"a\.mcap is truncated at byte {stop}: .*: run it again"
        with (
            subtests.test(case=stop),
            pytest.raises(LogError, match=text if stop else "is empty; expected an MCAP file"),
        ):
            open_log(path)


def test_the_error_of_a_truncated_file_names_the_end_of_its_last_whole_chunk(tmp_path, monkeypatch):
    """Up to there it need not be whole: another component may have its last rows before."""
    make_chunks_small(monkeypatch, 5000)
    path = tmp_path / "a.mcap"
    record(path)
    data = path.read_bytes()
    with path.open("rb") as stream:
        first, second = make_reader(stream).get_summary().chunk_indexes[:2]
    end_of_first = first.chunk_start_offset + first.chunk_length
    end_of_second = second.chunk_start_offset + second.chunk_length
    for stop, last in [(end_of_second, second), (end_of_first, first), (end_of_first - 1, None)]:
        path.write_bytes(data[:stop])
        text = "no complete row" if last is None else rf" {last.message_end_time / 1e9} s.* recover"
        with pytest.raises(LogError, match=f"truncated.*{text}"):
            open_log(path)
