"""Work in threads comes back in its order, and its errors too."""

import threading
from contextlib import closing

import pytest

from cosim.log.chunks import AHEAD, Workers


def test_results_come_in_the_order_of_the_work():
    """Of any number."""
    with closing(Workers()) as workers:
        for count in (0, 1, 2, 3, 50):
            works = ((lambda i=i: i * i) for i in range(count))
            assert list(workers.ahead(works)) == [i * i for i in range(count)]
            assert workers.map(lambda i: i * i, range(count)) == [i * i for i in range(count)]


def test_the_consumer_runs_jobs_instead_of_waiting():
    """The only thread is held by the first one, which ends when others have been done."""
    others_are_done = threading.Event()
    names = []

    def first():
        assert others_are_done.wait(60)

    def other():
        names.append(threading.current_thread().name)
        others_are_done.set()

    with closing(Workers(1)) as workers:
        begun = threading.Event()
        held = workers.start(lambda: (begun.set(), first()))
        assert begun.wait(60)
        assert len(list(workers.ahead(iter([other] * 6)))) == 6
        held.result()
    assert threading.current_thread().name in names


def test_a_job_starts_only_when_earlier_results_are_released():
    """So ``AHEAD`` of them may share as many pieces of memory in turn."""
    taken = []

    def works():
        for number in range(20):
            taken.append(number)
            yield lambda number=number: number

    with closing(Workers()) as workers:
        for result in workers.ahead(works()):
            assert len(taken) <= result + AHEAD


def test_an_error_comes_in_its_place():
    """What came before it is there."""

    def fail():
        raise ValueError("the third")

    with closing(Workers()) as workers:
        results = workers.ahead(iter([int, int, fail, int]))
        assert [next(results), next(results)] == [0, 0]
        with pytest.raises(ValueError, match="the third"):
            next(results)


def test_little_work_starts_no_thread():
    """One piece is done by who asks for it."""
    with closing(Workers()) as workers:
        (name,) = workers.ahead(iter([lambda: threading.current_thread().name]))
        assert name == threading.current_thread().name
        assert workers.map(lambda _: threading.current_thread().name, [1]) == [name]


def test_threads_end_with_the_block():
    """Also where not all results were taken."""
    before = threading.active_count()
    with closing(Workers()) as workers:
        next(workers.ahead(iter([int] * 10)))
        assert threading.active_count() > before
    assert threading.active_count() == before
