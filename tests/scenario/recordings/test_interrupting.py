"""Signals during a run: what they did before, they do again behind it."""

import signal

import pytest

from cosim.errors import Interrupted
from cosim.interrupts import REASONS
from cosim.scenario.recordings.recording import interruptible


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
    signal.raise_signal(number)
    assert received == [number]


def test_a_second_signal_does_what_it_did_before_and_raises(heard):
    """Also where that is a handler which returns: the run does not go on."""
    number, received = heard
    with pytest.raises(KeyboardInterrupt, match=REASONS[number]):
        run(number, 3)
    assert received == [number]


def test_what_is_ignored_stays_ignored():
    """As in a program that nohup started."""
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with interruptible() as check:
            signal.raise_signal(signal.SIGTERM)
            check()
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)
