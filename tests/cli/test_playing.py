"""play, and runs that are shown: what viewers get from a process of its own, and how it ends."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest

import cosim
from cosim.log.contents.viewer_layout import LAYOUT_FILE
from tests.live.viewer import Viewer, fields

MAIN = "from cosim.cli import main; main()"
URL = re.compile(r"ws://127\.0\.0\.1:\d+")


@pytest.fixture
def start(tmp_path):
    """Start cosim in a process of its own, which Ctrl-C reaches."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with contextlib.ExitStack() as processes:

        def start(*arguments):
            process = subprocess.Popen(
                [sys.executable, "-c", MAIN, *map(str, arguments)],
                cwd=tmp_path,
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


@pytest.fixture
def log(tmp_path):
    """Record two seconds of the shipped example."""
    scenario = cosim.load("academic").set({"scenario.stop": 2.0})
    return cosim.run(scenario, out=tmp_path / "a.mcap")


def url_in(line):
    """Return the address in a line that a command has printed."""
    match = URL.search(line)
    assert match, line
    return match[0]


@pytest.mark.slow
def test_play_sends_a_log_to_a_viewer_bit_for_bit(start, log):
    """It begins when the viewer has subscribed, and ends with how late it was."""
    process = start("play", "a.mcap", "--port", 0, "--speed", 20, "--wait")
    line = process.stdout.readline()
    assert line.endswith(": a.mcap, 20 x the wall clock\n")
    with Viewer(url_in(line)) as viewer:
        viewer.subscribe(*(f"/{name}" for name in log.channels))
        found = viewer.messages({f"/{name}": len(log.time_ns(name)) for name in log.channels})
        out, err = process.communicate(timeout=60)
    for name in log.channels:
        values = np.array([fields(message) for _, message in found[f"/{name}"]])
        assert values.tobytes() == log.rows(name).tobytes()
    assert (process.returncode, err) == (0, "")
    # 2 s at 20 times the wall clock, in windows of 10 ms, behind the first row
    assert re.fullmatch(r"20 x the wall clock; .*late in (\d+ of )?10 blocks.*\n", out)


@pytest.mark.slow
def test_a_loop_ends_with_ctrl_c(start, log):
    """As other commands do; it still says how late it was."""
    process = start("play", "a.mcap", "plant", "--port", 0, "--speed", 100, "--loop")
    with Viewer(url_in(process.stdout.readline())) as viewer:
        viewer.subscribe("/plant")
        found = viewer.messages({"/plant": 3 * 2001})["/plant"]
        assert sorted(viewer.channels) == ["/cosim/log", "/plant"]
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "cosim: interrupted by the user\n"
    assert out.startswith("100 x the wall clock; ")
    times = [time_ns for time_ns, _ in found]
    assert sum(np.diff(times) < 0) >= 2


@pytest.mark.slow
def test_waiting_for_a_viewer_ends_with_ctrl_c(start, log):
    """Nothing was played."""
    process = start("play", "a.mcap", "--port", 0, "--wait")
    process.stdout.readline()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "cosim: interrupted by the user\n")
    assert out == "1 x the wall clock; never late in 0 blocks\n"


@pytest.mark.slow
def test_a_run_is_shown_while_it_goes_on(start, tmp_path):
    """What arrives is in the log that is written beside it."""
    options = ("--stop", 100, "--realtime", 1, "--live", "--port", 0, "--show", "plant.y")
    process = start("run", "academic", "--out", "b.mcap", *options)
    with Viewer(url_in(process.stderr.readline())) as viewer:
        viewer.subscribe("/plant")
        found = viewer.messages({"/plant": 50})["/plant"]
        assert not {"/u", "/observer"} & viewer.channels.keys()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    log = cosim.open_log(tmp_path / "b.mcap")
    rows = dict(zip(log.time_ns("plant").tolist(), log.rows("plant").tolist(), strict=True))
    for time_ns, message in found:
        assert fields(message) == rows[time_ns]


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [("play", "a.mcap"), ("run", "academic", "--stop", "0.01", "--live")]
)
def test_a_port_in_use_is_one_clear_error(call, log, command):
    """In the language of the shell; nothing has run."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        code, out, err = call(*command, "--port", port)
    assert (code, out) == (2, "")
    assert err == (
        f"cosim: --port: cannot listen on 127.0.0.1:{port}: Address already in use; "
        "choose another port, or 0 for any free one\n"
    )


@pytest.mark.fast("command0")
@pytest.mark.parametrize(
    "command", [("play", "a.mcap"), ("run", "academic", "--stop", "0.01", "--live")]
)
def test_a_missing_sdk_is_one_clear_error(call, log, monkeypatch, command):
    """It names the extra."""
    monkeypatch.setitem(sys.modules, "foxglove", None)
    code, out, err = call(*command, "--port", 0)
    assert (code, out) == (2, "")
    assert "not installed: pip install 'cosim[live]'" in err
    assert len(err.splitlines()) == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--port", "0", "--speed", "0"), r"--speed: .*0\.0"),
        (("--port", "70000"), "--port: .*70000"),
        (("--port", "0", "plant.z"), r"a\.mcap has no 'plant\.z': 'plant' has no signal 'z'"),
        (("--port", "0", "--layout", "a.mcap"), r"--layout a\.mcap: exists; choose another path"),
        (("--port", "0", "--layout", "none/x.json"), r"none/x\.json: No such file or directory"),
    ],
)
def test_wrong_options_of_play(call, log, arguments, text):
    """One line that says what is needed."""
    code, _, err = call("play", "a.mcap", *arguments)
    assert code in (1, 2)
    assert re.search(text, err)
    assert len(err.splitlines()) == 1


@pytest.mark.slow
def test_play_writes_the_layout_for_viewers(call, log):
    """That of the log, to import."""
    code, _, _ = call("play", "a.mcap", "--port", 0, "--speed", 100, "--layout", "x.json")
    assert code == 0
    with open("x.json", encoding="utf-8") as file:
        assert json.load(file) == json.loads(log.attachment(LAYOUT_FILE))
