"""Message paths, by which viewers find the elements of signals."""

from __future__ import annotations

import numpy as np

from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.log.messages import message_paths
from tests.log.contents.viewing import decoded, parsed
from tests.log.recordings import record


def test_a_message_path_leads_to_the_column_of_its_element(tmp_path):
    """Whatever the names of components and signals, and where a component is split."""
    outputs = (Signal("x[1]"), Signal("x_1"), Signal("x", 2), Signal("der(x)"))
    wide = Interface((Signal("π"),), (Signal("y", 4100),))
    first = Channel('odd "name" \\', Interface((), outputs), 0)
    second = Channel("wide-2", wide, first.columns.stop)
    rows = record(tmp_path / "a.mcap", steps=40, size=7, lay=Layout((first, second)))
    values = decoded(tmp_path / "a.mcap")
    paths = message_paths(first) + message_paths(second)
    assert len(set(paths)) == rows.shape[1]
    for column in (*range(8), 4000, 4097, 4103, 4104):
        found = np.array(values[parsed(paths[column])])
        assert found.tobytes() == rows[:, column].tobytes()
