"""``cosim cat`` and ``cosim convert``."""

import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from cosim.log import McapRecorder
from tests.log.recordings import blocks, layout, plan, record, table


def test_cat_prints_the_rows_that_are_chosen(call, tmp_path):
    """With the header; times are exact."""
    rows = record(tmp_path / "a.mcap", steps=20)
    code, out, err = call("cat", "a.mcap", "--signals", "plant.n,plant.u", "--from", "0.008")
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "t [s],plant.n,plant.u [m/s]"
    assert lines[1] == f"0.008,{float(rows[8, 4])!r},{float(rows[8, 0])!r}"
    assert [line.split(",")[0] for line in lines[1:]] == [
        *("0.008", "0.009", "0.01", "0.011", "0.012", "0.013", "0.014", "0.015"),
        *("0.016", "0.017", "0.018", "0.019", "0.02"),
    ]
    repeated = call("cat", "a.mcap", "--signals", "plant.n", "--signals", "plant.u", "--to", "0")
    assert repeated[1].splitlines()[1] == f"0.0,{float(rows[0, 4])!r},{float(rows[0, 0])!r}"


def test_cat_prints_json_lines(call, tmp_path):
    """One object a row."""
    record(tmp_path / "a.mcap", steps=5)
    code, out, _ = call("cat", "a.mcap", "--signals", "plant.u", "--format", "jsonl")
    assert code == 0
    assert len(out.splitlines()) == 6


@pytest.mark.slow
def test_a_reader_that_has_enough_ends_cat_without_a_word(tmp_path):
    """As behind ``| head -1``; the rows do not fit into the pipe."""
    record(tmp_path / "a.mcap", steps=20_000)
    command = [sys.executable, "-m", "cosim", "cat", str(tmp_path / "a.mcap")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline().startswith(b"t [s],plant.u")
        process.stdout.close()
        messages = process.stderr.read()
        process.wait(60)
    assert (process.returncode, messages) == (141, b"")


@pytest.mark.slow
def test_a_log_is_followed_until_its_run_ends(tmp_path):
    """Each flush is printed while the run goes on, and the whole is what ``cat`` prints later."""
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "cosim", "cat", str(path), "--follow"]
    run = list(blocks(table(layout(), 40), 20))
    with McapRecorder(path, flush=1e-3) as recorder:
        recorder.begin(plan())
        recorder.write(*run[0])
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        lines = [process.stdout.readline() for _ in range(22)]
        recorder.write(*run[1])
        lines.append(process.stdout.readline())
    with process:
        lines += process.stdout.readlines()
        assert (process.wait(60), process.stderr.read()) == (0, b"")
    later = subprocess.run(command[:-1], check=True, capture_output=True).stdout
    assert b"".join(lines) == later


@pytest.mark.slow
def test_an_interrupt_ends_following_without_a_word(tmp_path):
    """With the exit code of Ctrl-C."""
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "cosim", "cat", str(path), "--follow"]
    with McapRecorder(path, flush=1e-3) as recorder:
        recorder.begin(plan())
        recorder.write(*next(blocks(table(layout(), 20), 20)))
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout.readline().startswith(b"t [s]")
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, b"")


@pytest.mark.slow
def test_a_closed_pipe_ends_following_without_a_word(tmp_path):
    """At the next row."""
    path = tmp_path / "a.mcap"
    command = [sys.executable, "-m", "cosim", "cat", str(path), "--follow"]
    with McapRecorder(path, flush=1e-3) as recorder:
        recorder.begin(plan())
        run = list(blocks(table(layout(), 40), 20))
        recorder.write(*run[0])
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert process.stdout.readline().startswith(b"t [s]")
        process.stdout.close()
        recorder.write(*run[1])
        err = process.stderr.read()
        assert process.wait(60) == 141
    process.stderr.close()
    assert err == b""


def test_wrong_use_exits_with_2(call, tmp_path):
    """One line on stderr, nothing on stdout."""
    record(tmp_path / "a.mcap", steps=5)
    for options, text in [
        (("cat", "a.mcap", "--format", "xml"), "--format: .*'xml'; available: csv, jsonl"),
        (("cat", "a.mcap", "--signals", "plant.v"), "'plant' has no signal 'v'"),
        (("cat", "a.mcap", "--from", "nan"), "--from: .*nan"),
        (("cat", "b.mcap"), r"b\.mcap cannot be read"),
        (("cat", "b.mcap", "--follow"), r"b\.mcap cannot be read"),
        (("convert", "a.mcap", "a.txt"), r"'\.txt'"),
        (
            ("convert", "a.mcap", "a.npz", "--from", "2", "--to", "1"),
            r"--from = 2\.0 s .*--to = 1\.0 s",
        ),
    ]:
        code, out, err = call(*options)
        assert (code, out) == (2, "")
        assert re.search(text, err)
        assert err.count("\n") == 1


def test_convert_names_the_file_and_keeps_one_that_exists(call, tmp_path):
    """Unless --force is given."""
    rows = record(tmp_path / "a.mcap", steps=5)
    assert call("convert", "a.mcap", "a.npz", "--signals", "plant.*") == (0, "a.npz\n", "")
    with np.load("a.npz") as read:
        assert "identifier.y" not in read
        assert np.array_equal(read["plant.n"], rows[:, 4], equal_nan=True)
    code, _, err = call("convert", "a.mcap", "a.npz")
    assert code == 2
    assert err == "cosim: a.npz exists; choose another path, or --force to replace it\n"
    assert call("convert", "a.mcap", "a.npz", "--force")[0] == 0
