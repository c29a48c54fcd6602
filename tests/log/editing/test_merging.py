"""Parts that are merged are the log again; other logs are refused."""

from __future__ import annotations

import pytest

import cosim
from cosim.errors import LogError, UsageError
from cosim.log import open_log
from cosim.log.spans import cut, merge
from tests.log.crafting import put_together, take_apart
from tests.log.recordings import layout, record, same_bits, table


def test_parts_that_are_merged_are_the_log_again(whole, tmp_path):
    """In any order; with the result of the run, whose content hash theirs is."""
    path, _ = whole
    cut(path, None, 0.1234, tmp_path / "b.mcap")
    cut(path, 0.124, 0.7, tmp_path / "c.mcap")
    cut(path, 0.701, None, tmp_path / "d.mcap")
    names = ["c", "d", "b"]
    merged = merge([tmp_path / f"{name}.mcap" for name in names], tmp_path / "e.mcap")
    source = open_log(path)
    assert merged.status == "complete"
    assert merged.content_hash() == merged.recorded_hash == source.recorded_hash
    assert merged.messages() == source.messages()
    assert cosim.diff(merged, source).equal
    assert merged.results == source.results
    two = merge([tmp_path / "d.mcap", tmp_path / "c.mcap"], tmp_path / "f.mcap")
    assert (two.status, two.reason) == ("partial", "the part from 0.124 s to 1.0 s")
    again = merge([tmp_path / "f.mcap", tmp_path / "b.mcap"], tmp_path / "g.mcap")
    assert again.results == source.results


def test_slow_components_may_have_no_row_in_a_part(tmp_path):
    """They go on where they were."""
    rows = table(layout(period=500), 1000)
    record(tmp_path / "a.mcap", lay=layout(period=500), rows=rows)
    bounds = [(None, 0.3), (0.301, 0.4), (0.401, None)]
    parts = []
    for number, (first, last) in enumerate(bounds):
        parts.append(tmp_path / f"{number}.mcap")
        cut(tmp_path / "a.mcap", first, last, parts[-1])
    assert len(open_log(parts[1]).time_ns("identifier")) == 0
    assert merge(parts, tmp_path / "b.mcap").status == "complete"


def test_a_log_whose_run_has_not_ended_is_cut_and_merged(whole, tmp_path):
    """It has no result; its rows say where it ends."""
    path, rows = whole
    content = take_apart(path)
    content.metadata = [item for item in content.metadata if item[0] != "cosim.result"]
    put_together(content, tmp_path / "b.mcap")
    first = cut(tmp_path / "b.mcap", None, 0.4, tmp_path / "c.mcap")
    second = cut(tmp_path / "b.mcap", 0.401, None, tmp_path / "d.mcap")
    assert (first.steps, second.steps) == (400, 1000)
    merged = merge([first.path, second.path], tmp_path / "e.mcap")
    assert (merged.status, merged.steps) == ("partial", 1000)
    assert same_bits(merged["plant.u"], rows[:, 0])


def test_parts_that_do_not_follow_each_other_are_refused(whole, tmp_path):
    """Overlapping ones, and those that leave rows out."""
    path, _ = whole
    cut(path, None, 0.5, tmp_path / "b.mcap")
    cut(path, 0.5, None, tmp_path / "c.mcap")
    cut(path, 0.502, None, tmp_path / "d.mcap")
    with pytest.raises(LogError, match=r"'plant' up to 0\.5 s, .* begins at 0\.5 s: they overlap"):
        merge([tmp_path / "b.mcap", tmp_path / "c.mcap"], tmp_path / "e.mcap")
    with pytest.raises(LogError, match=r"0\.501 s on are missing"):
        merge([tmp_path / "b.mcap", tmp_path / "d.mcap"], tmp_path / "e.mcap")
    with pytest.raises(UsageError, match="at least two logs to merge, got 1"):
        merge([path], tmp_path / "e.mcap")


def test_parts_of_other_runs_are_refused(whole, tmp_path, subtests):
    """What they declare, what was recorded of the run, and how it ended must be the same."""
    path, _ = whole
    cut(path, None, 0.5, tmp_path / "b.mcap")
    for number, (options, text) in enumerate(
        [
            ({"lay": layout(period=10)}, "channels"),
            ({"kinds": {"plant": "lag"}}, "channels"),
            ({"metadata": {"cosim.connections": {"a": "b"}}}, "the metadata 'cosim.connections'"),
            ({"rows": table(layout(), 1000, seed=2)}, "the result of the run"),
        ]
    ):
        other = tmp_path / f"{number}.mcap"
        record(other, steps=1000, **{"lay": options.get("lay", layout()), **options})
        cut(other, 0.501, None, tmp_path / "c.mcap", force=True)
        with (
            subtests.test(case=options),
            pytest.raises(LogError, match=f"same run: .*{text} differs"),
        ):
            merge([tmp_path / "b.mcap", tmp_path / "c.mcap"], tmp_path / "e.mcap")
        assert not (tmp_path / "e.mcap").exists()
