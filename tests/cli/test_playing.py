"""play, and runs that are shown: what viewers get from a process of its own, and how it ends."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys

import numpy as np
import pytest

import cosim
from cosim.log.viewer_layout import LAYOUT_FILE
from tests.live.viewer import Viewer, fields

MAIN = "from cosim.cli import main; main()"


@pytest.fixture
def start(files):
    """Start cosim in a process of its own, which Ctrl-C reaches."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with contextlib.ExitStack() as processes:

        def start(*arguments):
            process = subprocess.Popen(
                [sys.executable, "-c", MAIN, *map(str, arguments)],
                cwd=files,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )
            processes.enter_context(process)
            processes.callback(process.kill)
            return process

        yield start
    signal.signal(signal.SIGINT, before)


def url_in(line):
    """Return the address in a line that a command has printed."""
    match = re.search(r"ws://127\.0\.0\.1:\d+", line)
    assert match, line
    return match[0]


@pytest.mark.slow
def test_play_sends_a_log_to_a_viewer_bit_for_bit(start, files):
    """It begins when the viewer has subscribed; Ctrl-C ends the loop, with how late it was."""
    log = cosim.open_log(files / "a.mcap")
    options = ("--port", 0, "--speed", 2, "--wait", "--loop", "--layout", "x.json")
    process = start("play", "a.mcap", *options)
    line = process.stdout.readline()
    assert line.endswith(": a.mcap, 2 x the wall clock\n")
    with Viewer(url_in(line)) as viewer:
        viewer.subscribe(*(f"/{name}" for name in log.channels))
        counts = {f"/{name}": 2 * len(log.time_ns(name)) for name in log.channels}
        found = viewer.messages(counts)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    for name in log.channels:
        values = np.array([fields(message) for _, message in found[f"/{name}"]])
        rows = log.rows(name)
        assert values[: len(rows)].tobytes() == rows.tobytes()
        assert values[len(rows) : 2 * len(rows)].tobytes() == rows.tobytes()
    assert (process.returncode, err) == (130, "cosim: interrupted by the user\n")
    assert re.fullmatch(r"2 x the wall clock; .* blocks.*\n", out)
    assert json.loads((files / "x.json").read_text()) == json.loads(log.attachment(LAYOUT_FILE))


@pytest.mark.slow
def test_a_run_is_shown_while_it_goes_on(start, files):
    """What arrives is in the log that is written beside it."""
    options = ("--stop", 100, "--realtime", 1, "--live", "--port", 0, "--show", "plant.y")
    process = start("run", "academic", "--out", "c.mcap", *options)
    with Viewer(url_in(process.stderr.readline())) as viewer:
        viewer.subscribe("/plant")
        found = viewer.messages({"/plant": 50})["/plant"]
        assert not {"/u", "/observer"} & viewer.channels.keys()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    log = cosim.open_log(files / "c.mcap")
    rows = dict(zip(log.time_ns("plant").tolist(), log.rows("plant").tolist(), strict=True))
    for time_ns, message in found:
        assert fields(message) == rows[time_ns]
