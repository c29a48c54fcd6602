"""Work in threads comes back in its order, and its errors too."""

import threading

import pytest

from cosim.log.mcap_file.workers import Workers


@pytest.mark.parametrize("count", [0, 1, 2, 3, 50])
def test_results_come_in_the_order_of_the_work(count):
    """Of any number."""
    with Workers() as workers:
        works = ((lambda i=i: i * i) for i in range(count))
        assert list(workers.ahead(works)) == [i * i for i in range(count)]
        assert workers.map(lambda i: i * i, range(count)) == [i * i for i in range(count)]


def test_an_error_comes_in_its_place():
    """What came before it is there."""

    def fail():
        raise ValueError("the third")

    with Workers() as workers:
        results = workers.ahead(iter([int, int, fail, int]))
        assert [next(results), next(results)] == [0, 0]
        with pytest.raises(ValueError, match="the third"):
            next(results)


def test_little_work_starts_no_thread():
    """One piece is done by who asks for it."""
    with Workers() as workers:
        (name,) = workers.ahead(iter([lambda: threading.current_thread().name]))
        assert name == threading.current_thread().name
        assert workers.map(lambda _: threading.current_thread().name, [1]) == [name]


def test_threads_end_with_the_block():
    """Also where not all results were taken."""
    before = threading.active_count()
    with Workers() as workers:
        next(workers.ahead(iter([int] * 10)))
        assert threading.active_count() > before
    assert threading.active_count() == before
