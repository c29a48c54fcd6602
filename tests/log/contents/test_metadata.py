"""Metadata of a log: checksums and designs."""

from __future__ import annotations

import json

import pytest

from cosim.log.metadata import add_checksum, decode_design, encode_design, verify_checksum
from tests.log.recordings import plan, same_bits


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
