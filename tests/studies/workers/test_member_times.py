"""Times of members: when one hangs, and how many wait in the pipe of a worker."""

from cosim.studies.workers.member_times import MemberTimes


def limit_after(*seconds, timeout=None, is_complete=True):
    """Return the limit after members of these times."""
    times = MemberTimes(timeout)
    for value in seconds:
        times.note(value, is_complete=is_complete)
    return times.limit


def test_a_limit_that_is_given_is_kept():
    """Whatever members took."""
    assert limit_after(0.1, 100.0, timeout=3.0) == 3.0


def test_the_limit_is_ten_times_the_longest_of_the_first_ten():
    """And at least a minute; later members change nothing."""
    assert limit_after(0.1, 0.2) == 60.0
    assert limit_after(7.0, 9.0, 8.0) == 90.0
    assert limit_after(*[7.0] * 10, 100.0) == 70.0
    assert limit_after(*[7.0] * 9, 100.0) == 1000.0


def test_members_that_failed_do_not_set_the_limit():
    """They end early; without one that was completed an hour is waited."""
    assert limit_after() == 3600.0
    assert limit_after(0.1, is_complete=False) == 3600.0


def test_a_limit_says_where_it_comes_from():
    """And how to have another one, unless it was given."""
    assert MemberTimes(3.0).origin == ""
    times = MemberTimes(None)
    assert times.origin == ", the limit until a member is completed; set a timeout for another one"
    times.note(0.1, is_complete=True)
    assert times.origin == (
        ", the larger of 60 s and 10 times the longest of the first members; set a timeout for "
        "another one"
    )


def test_short_members_wait_in_numbers_and_long_ones_do_not():
    """At most a quarter of a second of them, as long as they last like the slow ones before."""
    times = MemberTimes(None)
    assert times.ahead == 1
    for _ in range(100):
        times.note(0.01, is_complete=True)
    assert times.ahead == 25
    for _ in range(100):
        times.note(1e-5, is_complete=False)
    assert times.ahead == 256
    times.note(2.0, is_complete=True)
    assert times.ahead == 1
