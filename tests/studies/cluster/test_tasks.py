"""Which members a task has."""

from hypothesis import given
from hypothesis import strategies as st

from cosim.studies.cluster.tasks import MOST_MEMBERS, RemainingTasks
from cosim.studies.dataset import PartLayout


def tasks_of(missing, parts, *, seconds=None, threads=2):
    """Take all tasks, of members that take so long."""
    remaining = RemainingTasks(missing, parts)
    tasks = []
    while remaining:
        task = remaining.take(threads)
        tasks.append(task)
        if seconds is not None:
            remaining.note(len(task.members), seconds * len(task.members))
    assert remaining.count == 0
    return tasks


def numbers_of(tasks):
    """Return the members of tasks."""
    return [number for task in tasks for number in task.members]


@given(
    st.integers(1, 300),
    st.integers(1, 40),
    st.sets(st.integers(0, 300)),
    st.sampled_from([None, 0.0, 1e-3, 0.5, 100.0]),
)
def test_every_missing_member_is_in_one_task(total, size, done, seconds):
    """Whatever is there already; a part is a task only where all of its members are missing."""
    layout = PartLayout(size, (total,))
    missing = [range(n, n + 1) for n in range(total) if n not in done]
    parts = [part for part in layout.parts() if not done & set(part)]
    whole = []  # ranges in order, as a dataset has them
    for one in missing:
        if whole and whole[-1].stop == one.start:
            whole[-1] = range(whole[-1].start, one.stop)
        else:
            whole.append(one)
    tasks = tasks_of(whole, parts, seconds=seconds)
    assert sorted(numbers_of(tasks)) == [n for n in range(total) if n not in done]
    assert all(task.members in parts for task in tasks if task.is_part)


def test_the_first_members_are_given_one_at_a_time():
    """Nothing is known of how long they take."""
    assert {len(task.members) for task in tasks_of([range(9)], [range(9)])} == {1}


def test_quick_parts_are_whole_tasks_until_few_are_left():
    """The last four parts are shared out among two threads, in pieces that get shorter."""
    parts = list(PartLayout(100, (10_000,)).parts())
    tasks = tasks_of([range(10_000)], parts, seconds=0.1)
    whole = [task for task in tasks if task.is_part]
    assert len(whole) == 95  # one is begun before it is known how quick they are, four are left
    pieces = [task.members for task in tasks if not task.is_part and task.members[0] >= 9600]
    assert all(len(members) >= 2 for members in pieces if members.stop % 100)
    assert [len(members) for members in pieces][-3:] == [2, 2, 2]
    assert max(map(len, pieces)) == 50  # an eighth of four parts


def test_the_tasks_of_many_threads_are_not_more_than_a_scheduler_takes():
    """300 threads come to it 100 times a second."""
    tasks = tasks_of([range(10_000)], [], seconds=0.1, threads=300)
    assert {len(task.members) for task in tasks[300:-1]} == {30}


def test_members_of_slow_parts_come_back_every_ten_seconds():
    """So that a worker that dies costs little, and all have work until the end."""
    parts = list(PartLayout(1000, (100_000,)).parts())
    tasks = tasks_of([range(100_000)], parts, seconds=0.5)
    assert not any(task.is_part for task in tasks)
    assert max(len(task.members) for task in tasks) == 20


def test_members_that_cost_nothing_do_not_make_a_message_of_any_length():
    """Pieces of a study that is one part."""
    tasks = tasks_of([range(100_000)], [], seconds=0.0)
    assert max(len(task.members) for task in tasks) == MOST_MEMBERS


def test_a_returned_task_is_the_next_one():
    """A task whose worker went is not left for the end."""
    remaining = RemainingTasks([range(10)], [])
    task = remaining.take(1)
    remaining.give_back(task)
    assert remaining.count == 10
    assert remaining.take(1) == task
