"""Metadata of a log: checksums, designs, where the run began, and its hashes."""

from __future__ import annotations

import hashlib
import json
import struct

import pytest

from cosim.errors import UnknownSignalError
from cosim.log import open_log
from cosim.log.metadata import (
    add_checksum,
    combine_hashes,
    decode_design,
    encode_design,
    recorded_start_ns,
    verify_checksum,
)
from tests.log.crafting import put_together, take_apart
from tests.log.recordings import STEP_NS, plan, record, same_bits


def test_checksums_cover_name_keys_and_values_of_our_maps_only():
    """Whatever changes in a map of ours is noticed; a map of another tool passes."""
    checked = add_checksum("cosim.run", {"a": "1"})
    assert verify_checksum("cosim.run", checked) == {"a": "1"}
    assert verify_checksum("theirs", {"a": "1"}) == {"a": "1"}
    wrong = {
        "cosim.rum": checked,
        "theirs": checked,
        "cosim.run": {**checked, "a": "2"},
        "cosim.env": {"a": "1"},
    }
    for name, items in wrong.items():
        with pytest.raises(ValueError, match=f"{name!r} is damaged"):
            verify_checksum(name, items)


def test_designs_keep_every_bit():
    """Shape and bits of every array survive the JSON."""
    design = plan().designs["plant"]
    back = decode_design(encode_design(design))
    assert list(back) == list(design)
    for name, array in design.items():
        assert same_bits(back[name], array)


def test_a_design_of_no_shape_is_refused(subtests):
    """Sizes are whole numbers from 0 on, and nothing is guessed."""
    for shape in [[-1], [2, -1], [True], ["1"], 1, None, [1] * 9, [2**40], [[1]]]:
        text = json.dumps({"A": {"shape": shape, "data": "AAAAAAAA8D8="}})
        with subtests.test(case=shape), pytest.raises(ValueError, match=r"shape|reshape"):
            decode_design(text)


def test_the_start_is_read_from_the_record_of_the_run():
    """None where that is nothing, or no time."""
    starts = [
        ({"start_time": "0.25"}, 250_000_000),
        ({"start_time": "0.25", "replay": '{"window": null}'}, 250_000_000),
        ({"start_time": "0.25", "replay": '{"window": [6.1, 7.0]}'}, 6_100_000_000),
        ({"start_time": "0.25", "replay": '{"window": [0.0, 7.0]}'}, 0),
        ({}, None),
        ({"start_time": "soon"}, None),
        ({"start_time": "inf"}, None),
        ({"start_time": "0.0", "replay": "[]"}, None),
        ({"start_time": "0.0", "replay": '{"window": {"a": 1}}'}, None),
        ({"start_time": "0.0", "replay": '{"window": [[]]}'}, None),
        ({"start_time": "0.0", "replay": '{"window": 5}'}, None),
    ]
    found = [(run, recorded_start_ns({"cosim.run": run})) for run, _ in starts]
    assert found == starts
    assert recorded_start_ns({}) is None


def test_the_hash_covers_the_declaration_that_was_recorded(short_log, tmp_path):
    """Whatever the present version would write: a log of an earlier one still has its hash."""
    content = take_apart(short_log)
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
    expected = combine_hashes(components)
    log = open_log(put_together(content, tmp_path / "b.mcap"))
    assert log.content_hash() == expected
    assert log.content_hash() != open_log(short_log).recorded_hash


def test_the_hash_of_a_signal_is_that_of_its_times_and_doubles(tmp_path):
    """As anybody may compute it: SHA-256 of int64 and doubles, little-endian, row by row."""
    rows = record(tmp_path / "a.mcap", steps=40)
    log = open_log(tmp_path / "a.mcap")
    hashes = log.signal_hashes()
    assert list(hashes) == list(log)
    hashes |= log.signal_hashes(["plant.x_a[1]"])
    columns = {"plant.x_a": (1, 2, 1), "plant.x_a[1]": (2, 1, 1), "identifier.y": (5, 3, 5)}
    for name, (first, size, period) in columns.items():
        digest = hashlib.sha256()
        for k in range(0, 41, period):
            digest.update(struct.pack(f"<q{size}d", k * STEP_NS, *rows[k, first : first + size]))
        assert hashes[name] == digest.hexdigest()
    with pytest.raises(UnknownSignalError, match=r"'nothing\.\*'"):
        log.signal_hashes("nothing.*")
