"""What a run records beside its rows, and what its log holds where signals end it."""

import json
import signal

import pytest

import cosim
from cosim.errors import Interrupted
from cosim.interrupts import REASONS
from cosim.log.viewer_layout import LAYOUT_FILE
from cosim.scenario.document.document import shipped
from cosim.scenario.recordings.recording import interruptible
from tests.log.viewing import curves, decoded, leaves, parsed

SETTINGS = {"scenario.stop": 0.02}


@pytest.fixture(params=REASONS, ids=lambda number: signal.Signals(number).name)
def heard(request):
    """Listen to one of the signals; return its number and what was heard."""
    received = []
    before = signal.signal(request.param, lambda number, frame: received.append(number))
    yield request.param, received
    signal.signal(request.param, before)


def run(number, presses):
    """Run a block in which a signal comes once or several times."""
    with interruptible() as check:
        check()
        for _ in range(presses):
            signal.raise_signal(number)
        check()


def test_a_program_hears_its_signals_again_behind_a_run(heard):
    """Not the first one within, which ends the run: the check says so after the block."""
    number, received = heard
    handler = signal.getsignal(number)
    with pytest.raises(Interrupted, match=REASONS[number]) as raised:
        run(number, 1)
    assert raised.value.exit_code == 128 + number
    assert received == []
    assert signal.getsignal(number) is handler
    with pytest.raises(KeyboardInterrupt, match=REASONS[number]):
        run(number, 3)  # a second one does what it did before, and ends the run at once
    assert received == [number]


def test_what_is_ignored_stays_ignored():
    """As in a program that nohup started."""
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        run(signal.SIGTERM, 1)
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize("is_replaced", [False, True])
def test_the_error_says_how_far_the_log_goes(tmp_path, is_replaced):
    """The last step is that of the last block; nothing of a log that is not at its path."""
    path = tmp_path / "a.mcap"

    def progress(time, end):
        if is_replaced:
            path.unlink()
            path.write_bytes(b"of another run")
        signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted) as raised:
        cosim.run("academic", out=path, set=SETTINGS, progress=progress, block=10)
    notes = [] if is_replaced else [f"{path} holds the run up to t = 0.01 s"]
    assert getattr(raised.value, "__notes__", []) == notes
    assert is_replaced or cosim.open_log(path).end_ns == 10_000_000


@pytest.mark.fast("pair", "academic")
@pytest.mark.parametrize("name", shipped())
def test_every_path_of_the_layout_leads_to_values_of_its_log(name, tmp_path):
    """Topic and field are in the decoded messages."""
    log = cosim.run(name, out=tmp_path / "a.mcap", set={"scenario.stop": 0.1})
    layout = json.loads(log.attachment(LAYOUT_FILE))
    values = decoded(tmp_path / "a.mcap")
    paths, _ = curves(layout)
    assert paths
    assert all(len(values[parsed(path)]) >= 1 for path in paths)
    assert sorted(leaves(layout["layout"])) == sorted(layout["configById"])
