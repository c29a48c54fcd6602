"""How long members may take that run again: the end of a log may take longer than the run."""

from dataclasses import replace

from cosim.studies.dataset import StudyDataset
from cosim.studies.running.time_limits import limit_again, limits_with_log
from cosim.studies.workers.member_times import UNTIL_TIMED
from tests.studies.dataset.outcomes import add, identity, member, outcome


def test_members_that_failed_have_their_time_and_the_others_much_more(tmp_path):
    """One that hangs again does not wait for an hour, and no log is cut short."""
    with StudyDataset.open_or_create(tmp_path, identity(30)) as dataset:
        add(dataset, range(20))
        assert limit_again(dataset, None) == limit_again(dataset, 5.0) == 60.0
        assert limit_again(dataset, 100.0) == 100.0
        numbers = [2, 3, 4, 10]
        assert list(limits_with_log(dataset, numbers, 5.0)) == [
            ([3, 10], 5.0),
            ([2, 4], UNTIL_TIMED),
        ]
        assert list(limits_with_log(dataset, [3], None)) == [([3], 60.0)]
        dataset.add(member(20), outcome(20, wall_time=30.0))
        dataset.add(member(24), outcome(24, wall_time=500.0))  # it failed
        assert list(limits_with_log(dataset, [3], None)) == [([3], 5000.0)]


def test_members_that_hung_have_their_time_and_do_not_lengthen_that_of_others(tmp_path):
    """They are waited for as long as before, not ten times."""
    with StudyDataset.open_or_create(tmp_path, identity(3)) as dataset:
        dataset.add(member(0), outcome(0, wall_time=1.0))
        hung = replace(outcome(1), status="failed", reason="hangs: ...", wall_time=400.0)
        dataset.add(member(1), hung)
        assert limit_again(dataset, None) == 400.0
        assert list(limits_with_log(dataset, [1], None)) == [([1], 400.0)]
