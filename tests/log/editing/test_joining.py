"""A file of a log that was rotated is replayed with those before it."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys

import pytest

import cosim
from cosim.errors import LogError, UsageError
from cosim.log import open_log
from cosim.log.spans import merge, open_joined
from cosim.report.verification import verify
from tests.log.crafting import change_rows, put_together, take_apart

SHORT = {"scenario.stop": 2.0, "identifier.start": 0.5, "regressor.delays": [0.1, 0.2, 0.3]}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Run 2 s into three files, and into one; return the folder of the files and the other log."""
    folder = tmp_path_factory.mktemp("parts")
    last = cosim.run("academic", set=SHORT, out=folder / "run.mcap", rotate="0.8s")
    assert last.path == folder / "run.part3.mcap"
    one = tmp_path_factory.mktemp("one") / "one.mcap"
    return folder, cosim.run("academic", set=SHORT, out=one)


@pytest.fixture
def run(recorded, tmp_path):
    """Return the first path of a copy of the three files."""
    shutil.copytree(recorded[0], tmp_path, dirs_exist_ok=True)
    return tmp_path / "run.mcap"


@pytest.mark.slow
def test_the_merged_parts_have_the_hash_of_the_run_in_one_file(run, recorded, tmp_path):
    """The result is that of the run, too, and so is the replay."""
    check_merged(tmp_path, recorded[1])


@pytest.mark.slow
@pytest.mark.parametrize(("limit", "stop"), [("0.8s", 2.0), ("1MB", 6.0)])
@pytest.mark.parametrize("block", [1, 1000])
def test_parts_have_the_hash_of_their_run_whatever_the_blocks_are(tmp_path, limit, stop, block):
    """For sizes and times."""
    options = {**SHORT, "scenario.stop": stop}
    whole = cosim.run("academic", set=options, out=tmp_path / "one.mcap")
    path = tmp_path / "run.mcap"
    last = cosim.run("academic", set=options, out=path, rotate=limit, block=block)
    assert last.path.name != "run.mcap"
    check_merged(tmp_path, whole)


def check_merged(folder, whole):
    """Check the merged parts of a run against its log in one file."""
    parts = [folder / "run.mcap", *sorted(folder.glob("run.part*.mcap"))]
    merged = merge(parts, folder / "merged.mcap")
    assert merged.status == "complete"
    assert merged.content_hash() == merged.recorded_hash == whole.recorded_hash
    assert merged.results == whole.results
    assert open_log(parts[-1]).results["last"] == whole.results["last"]
    assert verify(merged, cosim.replay(merged)).passed


@pytest.mark.slow
def test_the_last_part_replays_the_run(run, recorded):
    """Bit for bit, and the log says nothing false; it is called by its own path."""
    last = run.with_name("run.part3.mcap")
    again = cosim.replay(last)
    assert cosim.diff(again, recorded[1]).equal
    joined = open_joined(last)
    assert (joined.path, joined.status) == (last, "complete")
    assert verify(joined, again).passed
    assert cosim.diff(cosim.replay(open_log(last)), recorded[1]).equal
    assert open_log(run).status == "partial"


def test_a_part_between_replays_what_is_before_its_end(run):
    """And the first one alone."""
    joined = open_joined(run.with_name("run.part2.mcap"))
    assert (joined.status, joined.reason) == ("partial", "the part from 0.0 s to 1.599 s")
    assert verify(joined, cosim.replay(joined)).passed
    first = open_joined(run)
    assert first.reason == "part 1 of its log, from 0.0 s to 0.799 s"
    assert verify(first, cosim.replay(run)).passed


@pytest.mark.slow
def test_a_part_that_is_missing_is_named(run):
    """So is one of another run."""
    second = run.with_name("run.part2.mcap")
    second.rename(run.with_name("x.mcap"))
    text = r"run\.part3\.mcap is part 3 .*; part 2 is missing: .*run\.part2\.mcap$"
    with pytest.raises(LogError, match=text):
        cosim.replay(run.with_name("run.part3.mcap"))
    cosim.run("closed-loop", set={"scenario.stop": 0.1}, out=second)
    with pytest.raises(LogError, match="not parts of the same run"):
        cosim.replay(run.with_name("run.part3.mcap"))


def test_a_log_that_is_only_named_like_a_part_is_joined_to_none(recorded, tmp_path):
    """Its rows begin with its run."""
    path = shutil.copy(recorded[1].path, tmp_path / "run.part2.mcap")
    assert open_joined(path).recorded_hash == recorded[1].recorded_hash


def test_limits_are_refused_before_the_run(tmp_path, monkeypatch):
    """Where they cannot be met, or there is no log."""
    monkeypatch.chdir(tmp_path)
    for options, text in [
        ({"rotate": "1GB"}, "rotate"),
        ({"rotate": "1kB", "out": "run.mcap"}, "^rotate: expected at least 1MB .*'1kB'"),
        ({"rotate": 1e9, "out": "run.mcap"}, r"^rotate: expected a size in .*1000000000\.0"),
    ]:
        with pytest.raises(UsageError, match=text):
            cosim.run("academic", **options)
    assert list(tmp_path.iterdir()) == []


def changed(path, *, forged=False):
    """Change a value of the plant that nothing is computed from; all checksums are right."""
    content = take_apart(path)

    def change(number, values):
        if number == 50:
            values[-1] *= 2.0

    change_rows(content, "plant", change)
    put_together(content, path)
    if forged:
        found = open_log(path).content_hash()
        for name, items in content.metadata:
            if name == "cosim.result":
                items["content_hash"] = found
        put_together(content, path)


def test_a_changed_row_of_an_earlier_part_is_found(run):
    """A replay copies the row, and would equal it; a merged log would have a hash that fits."""
    changed(run)
    text = r"run\.mcap: .* changed after they were recorded: expected the content hash"
    with pytest.raises(LogError, match=text):
        cosim.replay(run.with_name("run.part2.mcap"))
    parts = [run, run.with_name("run.part2.mcap"), run.with_name("run.part3.mcap")]
    with pytest.raises(LogError, match=text):
        merge(parts, run.with_name("merged.mcap"))


def test_all_parts_have_the_hash_of_their_run(run):
    """A part whose hash was computed anew, too."""
    changed(run, forged=True)
    parts = [run, run.with_name("run.part2.mcap"), run.with_name("run.part3.mcap")]
    with pytest.raises(
        LogError, match=r"run\.mcap .* have all rows of the run, but not its values"
    ):
        merge(parts, run.with_name("merged.mcap"))
    assert not run.with_name("merged.mcap").exists()
    assert merge(parts[:2], run.with_name("two.mcap")).status == "partial"


def test_a_replay_does_not_replace_a_file_of_its_log(run):
    """It reads those before its own, and would remove those behind."""
    files = {path: path.read_bytes() for path in run.parent.iterdir()}
    second = run.with_name("run.part2.mcap")
    third = run.with_name("run.part3.mcap")
    for source, out in [(third, run), (second, second), (second, third)]:
        with pytest.raises(UsageError, match=out.name):
            cosim.replay(source, out=out, force=True)
        assert {path: path.read_bytes() for path in run.parent.iterdir()} == files


@pytest.mark.slow
def test_a_last_part_without_a_hash_is_not_reported_to_have_one(tmp_path):
    """Its run was killed; the hash of what is joined was recorded by no run."""
    code = (
        "import os, signal, sys, cosim\n"
        "from cosim.errors import CosimError\n"
        "def kill(time, end):\n"
        "    try:\n"
        "        steps = cosim.open_log(sys.argv[2]).steps\n"
        "    except CosimError:\n"
        "        return\n"  # it is not there yet, or its rows have moved since it was opened
        "    if steps > 900:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "options = {'rotate': '0.8s', 'flush': 1e-3, 'block': 50}\n"
        "cosim.run('academic', out=sys.argv[1], progress=kill, **options)\n"
    )
    paths = [tmp_path / "run.mcap", tmp_path / "run.part2.mcap"]
    process = subprocess.run([sys.executable, "-c", code, *map(str, paths)], check=False)
    assert process.returncode == -signal.SIGKILL
    last = max(tmp_path.glob("run.part*.mcap"), key=lambda path: int(path.stem[8:]))
    assert open_log(last).status == "unfinished"
    verification = verify(open_joined(last), cosim.replay(last))
    assert verification.passed
    assert "unfinished" in verification.lines[0]
