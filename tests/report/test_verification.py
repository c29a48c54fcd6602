"""What a replay proves of its log, and what it does not."""

import json

import numpy as np
import pytest

import cosim
from cosim.cli import main
from cosim.errors import LogError
from cosim.log import open_log
from cosim.log.layout import copy_values, record_dtype
from cosim.report.verification import verify
from tests.log.crafting import put_together, take_apart

COPIED = ("plant.y", "plant.x_a", "plant.x_b")


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    """Record a short run; return its path."""
    path = tmp_path_factory.mktemp("valid") / "a.mcap"
    cosim.run("academic", out=path, set={"scenario.stop": 0.05})
    return path


def scaled(valid, path, columns, factor, *, forged=False):
    """Multiply some columns of the recorded plant, all checksums right; return the path.

    ``forged``: the recorded content hash and the last row are those of the changed rows, too.
    """
    content = take_apart(valid)
    (plant,) = [number for number, channel in content.channels.items() if channel[0] == "/plant"]
    rows = []
    for number, time_ns, sequence, data in content.messages:
        if number == plant:
            size = len(data) // 9
            record = np.zeros(1, record_dtype(size))
            record.view("u1")[-len(data) :] = np.frombuffer(data, "u1")
            values = np.empty((1, size))
            copy_values(record, values)
            values[:, columns] *= factor
            record["short"]["value"] = values
            data = record.tobytes()[-len(data) :]
        rows.append((number, time_ns, sequence, data))
    content.messages = rows
    put_together(content, path)
    if forged:
        found = open_log(path).content_hash()
        for name, items in content.metadata:
            if name == "cosim.result":
                items["content_hash"] = found
        last = cosim.replay(path).results["last"]
        results = {**open_log(path).results, "content_hash": found, "last": last}
        content.attachments = [
            (name, json.dumps(results).encode() if name == "result.json" else data)
            for name, data in content.attachments
        ]
        put_together(content, path)
    return path


@pytest.mark.parametrize(("columns", "factor"), [(slice(3, 5), 2.0), (slice(5, 6), -7.0)])
def test_changed_rows_that_nothing_follows_from_are_found(valid, tmp_path, columns, factor):
    """The replay copies x_a and x_b, so it equals the log; the content hash does not."""
    path = scaled(valid, tmp_path / "b.mcap", columns, factor)
    changed = cosim.diff(open_log(valid), open_log(path))
    assert {row.signal for row in changed.rows if row.status != "equal"} <= {
        "plant.x_a",
        "plant.x_b",
    }
    assert not changed.equal
    verification = verify(open_log(path), cosim.replay(path))
    assert verification.difference.equal
    assert not verification.passed
    assert verification.found_hash != verification.recorded_hash
    assert "the rows are not those that its run recorded" in verification.problems[0]


def test_a_forged_hash_is_not_found_where_nothing_is_computed(valid, tmp_path):
    """What cannot be proven is listed as copied, and not claimed."""
    path = scaled(valid, tmp_path / "b.mcap", slice(5, 6), -7.0, forged=True)
    verification = verify(open_log(path), cosim.replay(path))
    assert verification.passed
    assert verification.copied == COPIED
    assert not set(COPIED) & set(verification.computed)
    assert "not computed, but copied from the log: plant.y, plant.x_a" in verification.lines[-2]
    assert "a log of another run, put in its place as a whole, passes" in verification.lines[-1]
    # y drives the observer: its rows do not follow from a changed y any more
    path = scaled(valid, tmp_path / "c.mcap", slice(2, 3), 2.0, forged=True)
    verification = verify(open_log(path), cosim.replay(path))
    assert not verification.passed
    assert "first: observer.y" in verification.problems[0]


def test_the_command_line_says_what_was_proven(valid, tmp_path, capsys):
    """Exit 0 with the signals computed and copied; exit 1 with both hashes."""
    with pytest.raises(SystemExit) as left:
        main(["replay", str(valid), "--verify", "--json"])
    assert left.value.code in (0, None)
    shown = json.loads(capsys.readouterr().out)
    log = open_log(valid)
    assert shown["content_hash"] == {
        "recorded": log.recorded_hash,
        "found": log.recorded_hash,
        "equal": True,
    }
    assert shown["copied"] == list(COPIED)
    assert sorted(shown["computed"] + shown["copied"]) == sorted(log.signals())
    path = scaled(valid, tmp_path / "b.mcap", slice(3, 5), 2.0)
    with pytest.raises(SystemExit) as left:
        main(["replay", str(path), "--verify"])
    assert left.value.code == 1
    message = f"is {open_log(path).content_hash()}, recorded {log.recorded_hash}"
    assert message in capsys.readouterr().err


def test_only_a_replay_is_verified(valid):
    """A run says nothing of what was copied."""
    with pytest.raises(LogError, match="this is no replay"):
        verify(open_log(valid), open_log(valid))
