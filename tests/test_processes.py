"""Child processes: what is said of how they end, and what their environment holds."""

import signal

import pytest

from cosim.processes import describe_exit, with_one_thread


@pytest.mark.parametrize(
    ("exit_code", "text"),
    [
        (0, "ends the process with exit code 0"),
        (3, "ends the process with exit code 3"),
        (-signal.SIGSEGV, "crashes: SIGSEGV"),
        (-signal.SIGABRT, "crashes: SIGABRT"),
        (-40, "crashes: signal 40"),
    ],
)
def test_an_end_is_named_by_its_signal_or_its_exit_code(exit_code, text):
    """Also where the signal is one for real time, which has no name."""
    assert describe_exit(exit_code) == text


def test_one_thread_is_the_default_and_not_forced():
    """As many processes as cores would otherwise have the square of that; a choice is kept."""
    environment = with_one_thread({"OMP_NUM_THREADS": "4", "HOME": "/root"})
    assert environment["OMP_NUM_THREADS"] == "4"
    assert environment["HOME"] == "/root"
    assert environment["OPENBLAS_NUM_THREADS"] == "1"
    assert environment["MKL_NUM_THREADS"] == "1"
