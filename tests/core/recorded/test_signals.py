"""A finished run is a mapping of its signals, in memory and from file alike."""

import numpy as np
import pytest

from cosim.core.port import Port
from cosim.errors import LogError, UnknownSignalError

SHORT = {"scenario.stop": 0.1}


def test_a_run_is_a_mapping_of_its_signals(recorded):
    """Names in the order of the row, arrays by name, elements of a signal as well."""
    assert list(recorded) == list(recorded.signals)
    assert len(recorded) == len(list(recorded.items())) == 24
    assert "u.y" in recorded
    assert "plant.x_a[1]" in recorded
    assert Port.parse("plant.x_a") in recorded
    for other in ("plant.x_c", "plant.x_a[2]", "plant", "", 3, None, ["u.y"]):
        assert other not in recorded
    assert recorded["plant.x_a[1]"].tobytes() == recorded["plant.x_a"][:, 1].tobytes()
    assert len(recorded["u.y"]) == 101
    for name, values in recorded.items():
        assert values.shape[0] == len(recorded.time(name))
        assert not values.flags.writeable
        assert values.tobytes() == recorded[name].tobytes()


def test_an_unrecorded_signal_is_a_key_error_with_the_nearest_names(recorded):
    """So that ``get`` and ``except KeyError`` work as for every mapping."""
    assert recorded.get("plant.x_c") is None
    assert recorded.get("u.y") is not None
    with pytest.raises(KeyError) as error:
        recorded["plant.x"]
    assert isinstance(error.value, UnknownSignalError)
    assert isinstance(error.value, LogError)
    assert "'plant' has no signal 'x'; did you mean 'x_b'" in str(error.value)


@pytest.mark.parametrize("key", [3, None, [], {"u.y"}, slice(None), [3]])
def test_only_names_of_signals_are_taken(recorded, key):
    """Also in a list."""
    with pytest.raises(LogError, match=r"a signal name, or a list of names, got "):
        recorded[key]


def test_the_repr_of_a_run_describes_it(recorded, in_memory):
    """Where it is, how it ended, how long it is."""
    text = "complete, 100 steps to 0.1 s, 24 signals of 6 components>"
    assert repr(recorded).endswith(text)
    where = "the run" if recorded is in_memory else str(recorded.path)
    assert repr(recorded).startswith(f"<{where}: ")


def test_a_notebook_shows_a_table_of_signals(recorded):
    """Every signal in a row; names are escaped."""
    page = recorded._repr_html_()
    assert page.count("<tr>") == 1 + len(recorded)
    assert "<td>plant.x_a</td><td>2</td>" in page
    assert f"<td>{recorded.signals['observer.delta'].description}</td></tr>" in page
    assert recorded.signals["observer.delta"].description


def test_both_have_the_same_signals_times_and_messages(in_memory, from_file):
    """Equality of values is asked for by name; ``==`` compares identity."""
    assert list(in_memory) == list(from_file)
    assert in_memory != from_file
    assert in_memory == in_memory
    assert len({in_memory, from_file}) == 2
    for name in in_memory:
        assert np.array_equal(in_memory.time(name), from_file.time(name))
    assert in_memory.messages() == from_file.messages()
    for values in (in_memory.results, from_file.results):
        assert values["last"]["plant.y"] == in_memory["plant.y"][-1]
