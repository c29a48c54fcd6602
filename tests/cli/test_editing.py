"""``cosim cut``, ``cosim merge`` and ``cosim recover``."""

import json
import re

import pytest
from mcap.reader import make_reader

from cosim.log import open_log
from tests.log.recordings import record


@pytest.fixture
def log(tmp_path):
    """Write a log of 20 s; return its path."""
    record(tmp_path / "a.mcap", steps=20_000)
    return tmp_path / "a.mcap"


@pytest.mark.usefixtures("log")
def test_parts_are_cut_and_merged_again(call):
    """Each says what it is."""
    shown = call("cut", "a.mcap", "--to", "7.5", "-o", "b.mcap")
    assert shown == (0, "b.mcap: partial, the part from 0.0 s to 7.5 s\n", "")
    shown = call("cut", "a.mcap", "--from", "7.501", "--out", "c.mcap")
    assert shown == (0, "c.mcap: partial, the part from 7.501 s to 20.0 s\n", "")
    code, out, _ = call("info", "c.mcap")
    assert code == 0
    assert "partial" in out
    assert call("merge", "b.mcap", "c.mcap", "-o", "d.mcap") == (0, "d.mcap: complete\n", "")
    assert call("diff", "a.mcap", "d.mcap")[0] == 0
    assert call("hash", "d.mcap")[0] == 0


def test_lost_rows_are_shown(call, log):
    """By component, with their times, as a table or JSON."""
    with log.open("rb") as stream:
        chunk = make_reader(stream).get_summary().chunk_indexes[1]
    data = bytearray(log.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 30] ^= 1
    (log.parent / "broken.mcap").write_bytes(data)
    code, out, err = call("recover", "broken.mcap", "-o", "good.mcap")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "component\trows\tlost"
    assert lines[-1] == "good.mcap: partial, recovered from broken.mcap"
    assert "the scenario is lost: the log can be read, but not replayed" in lines
    assert open_log("good.mcap").status == "partial"
    shown = json.loads(call("recover", "broken.mcap", "-o", "b.mcap", "--json")[1])
    lost = [own["lost"] for own in shown["components"].values() if own["lost"]]
    first = lost[0][0]
    assert f"{first['rows']} from {first['from']} s to {first['to']} s" in out
    assert shown["status"] == "partial"
    assert call("recover", "broken.mcap", "-o", "good.mcap")[0] == 2
    assert call("recover", "broken.mcap", "-o", "good.mcap", "--force")[0] == 0


def test_lost_scenarios_and_messages_are_shown(call, log):
    """Without statistics nothing says how many messages there were; a late part is not replayed."""
    data = log.read_bytes()
    (log.parent / "b.mcap").write_bytes(data[: len(data) * 3 // 4])
    _, out, _ = call("recover", "b.mcap", "-o", "good.mcap")
    assert "messages, events or substeps are lost, too, or their number is unknown" in out
    call("run", "academic", "--stop", "0.2", "--out", "run.mcap")
    call("cut", "run.mcap", "--from", "0.1", "-o", "late.mcap")
    code, out, _ = call("recover", "late.mcap", "-o", "saved.mcap")
    assert code == 0
    assert "can be replayed" not in out


def test_a_truncated_log_names_the_command(call, log):
    """Which says what it cannot know."""
    data = log.read_bytes()
    (log.parent / "b.mcap").write_bytes(data[: len(data) * 3 // 4])
    code, _, err = call("info", "b.mcap")
    assert code == 2
    assert "'cosim recover'" in err
    code, out, _ = call("recover", "b.mcap", "-o", "c.mcap")
    assert code == 0
    assert "are lost, too: the file has no end" in out
    assert call("info", "c.mcap")[0] == 0


@pytest.mark.usefixtures("log")
def test_wrong_use_exits_with_2(call):
    """One line each."""
    for options, text in [
        (("cut", "a.mcap", "-o", "b.mcap"), "--from, --to"),
        (
            ("cut", "a.mcap", "--from", "3", "--to", "2", "-o", "b.mcap"),
            r"--from = 3\.0 s .*--to = 2\.0 s",
        ),
        (("cut", "a.mcap", "--from", "30", "-o", "b.mcap"), r"a\.mcap from 30 s: no rows"),
        (("merge", "a.mcap", "-o", "b.mcap"), "two logs.*got 1"),
        (("merge", "a.mcap", "a.mcap", "-o", "b.mcap"), "they overlap"),
        (("recover", "c.mcap", "-o", "b.mcap"), r"c\.mcap cannot be read"),
    ]:
        code, out, err = call(*options)
        assert (code, out) == (2, ""), options
        assert re.search(text, err)
        assert err.count("\n") == 1
