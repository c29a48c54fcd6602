"""Two workers and a crash, in little time; what is refused before a process is started."""

import math
import platform
import struct

import pytest

from cosim.errors import UsageError
from cosim.studies.contracts import COMPLETE, MemberOutcome
from cosim.studies.workers import member_times
from tests.studies.workers.pools import doing, open_pool, outcomes_of

pytestmark = pytest.mark.usefixtures("worker_processes")


def test_an_outcome_is_carried_exactly():
    """Floats keep their bits, texts their characters, of the member and of its outcome."""
    numbers = [0.1, -0.0, 5e-324, math.pi, math.inf, -math.inf, math.nan]
    metrics = {f"m{index}": number for index, number in enumerate(numbers)}
    metrics |= {"text": 'ä\n"\udcff', "none": None}
    (outcome,) = outcomes_of([doing(7, metrics=metrics)]).values()
    for name, value in metrics.items():
        found = outcome.metrics[name]
        if isinstance(value, float):
            assert struct.pack("d", found) == struct.pack("d", value)
        else:
            assert found == value
    assert outcome.status == COMPLETE
    assert outcome.worker == f"{platform.node()}:{int(outcome.metrics['pid'])}"


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"count": 0}, "^workers: .*got 0"),
        ({"timeout": 0.0}, "^timeout: .*got 0.0"),
        ({"timeout": math.nan}, "^timeout: .*got nan"),
        ({"members_per_worker": -1}, "^members_per_worker: .*got -1"),
    ],
)
def test_wrong_numbers_are_refused(options, match):
    """Before any process is started."""
    with pytest.raises(UsageError, match=match):
        open_pool(**options)


def test_windows_is_refused(monkeypatch):
    """With what is needed."""
    monkeypatch.setattr("sys.platform", "win32")
    with pytest.raises(UsageError, match="got Windows"):
        open_pool()


def test_short_members_wait_in_the_pipe_of_a_worker_up_to_a_number(tmp_path, monkeypatch):
    """Here eight with the one that it runs: as often as four are left, four are given to it.

    The last 30 of 60 wait until the outcome before theirs was handed on, so that the worker has all
    that were taken and are not done.
    """
    monkeypatch.setattr(member_times, "MOST_AHEAD", 8)
    taken = 0

    def members():
        nonlocal taken
        for number in range(60):
            taken += 1
            does = "nothing" if number < 30 else "wait"
            yield doing(number, does, until=str(tmp_path / str(number)))

    had = []
    with open_pool(1) as workers:
        for done, _ in enumerate(workers.run(members()), start=1):
            if done >= 30:
                had.append(taken - done)
                (tmp_path / str(done)).touch()
    assert taken == 60
    assert max(had) == 8


def test_the_worker_of_a_failure_is_named():
    """As that of any other outcome."""
    outcomes = outcomes_of([doing(0, "SIGSEGV"), doing(1, "ValueError")], count=1)
    for outcome in outcomes.values():
        assert isinstance(outcome, MemberOutcome)
        assert outcome.worker.startswith(f"{platform.node()}:")


def test_a_scenario_that_cannot_be_opened_is_one_error():
    """With the text of the scenario's own error."""
    with pytest.raises(UsageError, match=r"^a\.toml: unknown kind 'plnat'$"):
        outcomes_of([doing(number) for number in range(100)], opener="refuse")
