"""Processes that write a dataset until they are killed."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal

from cosim.studies import dataset as module
from cosim.studies.dataset import StudyDataset
from tests.studies.outcomes import design, identity, member, outcome

processes = multiprocessing.get_context("forkserver")
processes.set_forkserver_preload([__name__])

WINDOW = 30  # members that are under way at once
CALLS = ["open", "write", "ftruncate", "fsync", "replace", "unlink"]  # that change files


def opened(folder, count, part_size, **options):
    """Open the dataset of a study with parts of a size, or make it."""
    module.PART_SIZE = part_size
    planned = identity(count)
    return StudyDataset.open_or_create(folder, planned, design=design(count), **options)


def complete(dataset, seed, report=lambda number: None, most=10**9):
    """Run what is missing; members end in the order in which workers may end them."""
    chance = random.Random(seed)
    numbers = [number for absent in dataset.missing() for number in absent]
    end = max(len(numbers) - most, 0)
    while len(numbers) > end:
        number = numbers.pop(chance.randrange(min(WINDOW, len(numbers))))
        result = outcome(number, wall_time=chance.random(), worker=str(seed))
        dataset.add(member(number), result)
        report(number)


def write(pipe, folder, count, part_size, seed, cut):
    """Run what is missing, and send the number of each member that was added.

    Parameters
    ----------
    cut : (int, bool) or None
        The number of the call that kills the process, and whether after it; a write is half done.
    """
    if cut is not None:
        _cut(*cut)
    with opened(folder, count, part_size) as dataset:
        complete(dataset, seed, pipe.send)


def begin_anew(pipe, folder, count, part_size, seed, cut):
    """Remove the dataset and begin anew; nothing is added."""
    _cut(*cut)
    opened(folder, count, part_size, new=True).close()


def _cut(number, is_after):
    """Kill this process at a call of the operating system that changes a file."""
    calls = iter(range(number + 1))

    def cutting(call):
        def cut(*arguments):
            if next(calls) < number:
                return call(*arguments)
            if call is write_of_system:
                descriptor, content = arguments
                call(descriptor, content[: len(content) // 2])
            elif is_after:
                call(*arguments)
            os.kill(os.getpid(), signal.SIGKILL)

        return cut

    write_of_system = os.write
    for name in CALLS:
        setattr(os, name, cutting(getattr(os, name)))


def killed(folder, count, part_size, seed, *, cut=None, after=None, target=write):
    """Return the members that a process has added until it was killed, or had them all.

    Parameters
    ----------
    after : int, optional
        It is killed when it has reported so many.
    """
    receiver, sender = processes.Pipe(duplex=False)
    process = processes.Process(target=target, args=(sender, folder, count, part_size, seed, cut))
    process.start()
    sender.close()
    reported = []
    try:
        while True:
            reported.append(receiver.recv())
            if len(reported) == after:
                process.kill()
    except EOFError:
        pass
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return reported, process.exitcode == 0
