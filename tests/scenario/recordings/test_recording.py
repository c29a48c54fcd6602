"""What a run that ends early says of its log."""

from signal import SIGINT, raise_signal

import pytest

import cosim
from cosim.errors import Interrupted

SETTINGS = {"scenario.stop": 0.02}


def interrupted(path, act):
    """Return the notes on a run that an interrupt ends after its first block, and an action."""

    def progress(time, end):
        act()
        raise_signal(SIGINT)

    with pytest.raises(Interrupted) as raised:
        cosim.run("academic", out=path, set=SETTINGS, progress=progress, block=10)
    return getattr(raised.value, "__notes__", [])


def test_the_error_says_how_far_the_log_goes(tmp_path):
    """The last step is that of the last block."""
    path = tmp_path / "a.mcap"
    assert interrupted(path, lambda: None) == [f"{path} holds the run up to t = 0.01 s"]
    assert cosim.open_log(path).end_ns == 10_000_000


@pytest.mark.parametrize("replaced", [False, True])
def test_the_error_says_nothing_of_a_log_that_is_not_at_its_path(tmp_path, replaced):
    """It was removed meanwhile, or another one is there now."""
    path = tmp_path / "a.mcap"

    def displace():
        path.unlink()
        if replaced:
            path.write_bytes(b"of another run")

    assert interrupted(path, displace) == []
