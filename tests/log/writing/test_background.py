"""The thread that writes rows: in particular those of a block that is still being computed."""

import threading

import numpy as np

from cosim.core.clock import Clock
from cosim.log.background import BackgroundWriter

CLOCK = Clock(stop=100.0, step=1.0)


def test_rows_of_a_block_under_way_are_written_once():
    """After the flush interval those that are completed; when the block is written, the others."""
    written = []
    grown = threading.Event()

    def add(content):
        written.extend(zip(content.steps.tolist(), content.values[:, 0].tolist(), strict=True))
        if len(written) == 31:
            grown.set()

    writer = BackgroundWriter(add, capacity=25, width=1, interval=0.01)
    first = CLOCK.block_at(0, 10)
    second = CLOCK.block_at(10, 40)
    values = np.arange(51.0).reshape(-1, 1)
    writer.follow(lambda: (second.part(0, 20), values[10:31]))
    writer.write(first, values[:11], 0)
    try:
        assert grown.wait(10.0)  # more than a buffer holds
        writer.write(second, values[10:], 1)
    finally:
        rest = writer.close()
    add(rest)
    assert written == [(k, float(k)) for k in range(51)]


def test_rows_are_in_order_however_a_buffer_is_handed_over():
    """The run fills the next buffer while the thread looks at what is under way."""
    written = []
    count = 3000
    values = np.arange(10.0 * count + 1).reshape(-1, 1)
    under_way = [CLOCK.block_at(0, 0), values[:1]]
    writer = BackgroundWriter(
        lambda content: written.extend(content.steps.tolist()),
        capacity=7,
        width=1,
        interval=0.0,
    )
    writer.follow(lambda: tuple(under_way))
    writer.write(*under_way, 0)
    for number in range(count):
        block = CLOCK.block_at(10 * number, 10)
        under_way[:] = block, values[10 * number : 10 * number + 11]
        writer.write(block, values[10 * number : 10 * number + 11], 1)
    rest = writer.close()
    if rest is not None:
        written += rest.steps.tolist()
    assert written == list(range(10 * count + 1))
