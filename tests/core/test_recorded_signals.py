"""A finished run is a mapping of its signals, which names, elements and patterns choose."""

from __future__ import annotations

import numpy as np
import pytest

from cosim.core.port import Port
from cosim.core.recorded.selection import matches, select_signals, selected_columns, split_names
from cosim.core.recorded.signals import warning_texts
from cosim.core.recorders import Memory
from cosim.core.recording import Plan
from cosim.core.signals import Channel, Interface, Layout, Signal
from cosim.errors import LogError, UnknownSignalError, UsageError

PLANT = Interface(
    (Signal("u"),),
    (Signal("x_a", 2), Signal("der(x)"), Signal("x[1]"), Signal("x[2]"), Signal("m[1,2]")),
)
OTHER = Interface((), (Signal("x_a", 3), Signal("delta"), Signal("a.b.y")))
CHANNELS = {"plant": Channel("plant", PLANT, 0), "observer": Channel("observer", OTHER, 7)}
ALL = [f"{name}.{signal.name}" for name, own in CHANNELS.items() for signal in own.signals]


def chosen(*patterns):
    return list(select_signals(CHANNELS, patterns, source="the run"))


def elements(*patterns):
    selection = select_signals(CHANNELS, patterns, source="the run")
    return [(column.name, column.column) for column in selected_columns(selection)]


def test_none_chooses_all():
    """In their order, and a single text is one name."""
    assert list(select_signals(CHANNELS, None, source="")) == ALL
    assert list(select_signals(CHANNELS, "plant.u", source="")) == ["plant.u"]


@pytest.mark.parametrize(
    ("pattern", "names"),
    [
        ("plant.*", ALL[:6]),
        ("*", ALL),
        ("*.x_a", ["plant.x_a", "observer.x_a"]),
        ("*.delta", ["observer.delta"]),
        ("observer.*y", ["observer.a.b.y"]),
        ("plant.x[*]", ["plant.x[1]", "plant.x[2]"]),
        ("plant.x[?]", ["plant.x[1]", "plant.x[2]"]),
        ("plant.der(*)", ["plant.der(x)"]),
        ("*.x_a[1]", ["plant.x_a[1]", "observer.x_a[1]"]),
        ("*.x_a[0:2]", ["plant.x_a[0:2]", "observer.x_a[0:2]"]),
        ("plant.x_a[1]", ["plant.x_a[1]"]),
        ("plant.x[1]", ["plant.x[1]"]),
    ],
)
def test_patterns_match_whole_names(pattern, names):
    """Brackets, dots and parentheses are characters as any other; a real name comes first."""
    assert chosen(pattern) == names


def test_each_signal_is_chosen_once():
    """Where two patterns choose it, the first decides its place; so for elements."""
    assert chosen("observer.delta", "*.delta", "plant.u") == ["observer.delta", "plant.u"]
    assert elements("plant.x_a[1]", "plant.x_a", "plant.u") == [
        ("plant.x_a[1]", 2),
        ("plant.x_a[0]", 1),
        ("plant.u", 0),
    ]
    assert elements("observer.x_a[1:3]") == [("observer.x_a[1]", 1), ("observer.x_a[2]", 2)]


def test_two_columns_of_one_name_are_refused():
    """A table could not tell them apart."""
    interface = Interface((), (Signal("x", 2), Signal("x[0]")))
    channels = {"a": Channel("a", interface, 0)}
    with pytest.raises(UsageError, match=r"'a\.x\[0\]'.*2 columns; choose one"):
        selected_columns(select_signals(channels, None, source=""))
    assert len(selected_columns(select_signals(channels, "a.x", source=""))) == 2


def test_a_pattern_that_matches_nothing_is_refused():
    """With the nearest name."""
    with pytest.raises(
        UnknownSignalError, match=r"no signal matches 'plnt\.\*'; did you mean 'plant\.u'"
    ):
        chosen("plant.u", "plnt.*")
    with pytest.raises(UnknownSignalError, match="did you mean 'x_a'"):
        chosen("plant.x_b")
    with pytest.raises(LogError, match=r"'plant\.x_a' has 2 elements, numbered from 0"):
        chosen("*.x_a[2]")
    with pytest.raises(UnknownSignalError, match=r"port.*'plant'"):
        chosen("plant")


@pytest.mark.parametrize(
    ("patterns", "text"),
    [
        ([], "signals: expected at least one, or None for all, got an empty list"),
        ([3], r"names.*3"),
    ],
)
def test_only_lists_of_names_are_taken(patterns, text):
    """An empty one is no way to say all."""
    with pytest.raises(UsageError, match=text):
        select_signals(CHANNELS, patterns, source="")


def test_names_are_split_at_commas_outside_brackets():
    """An element of a matrix has one inside."""
    assert split_names("plant.y, plant.m[1,2],a.b") == ["plant.y", "plant.m[1,2]", "a.b"]
    assert chosen(*split_names("plant.m[1,2],plant.u")) == ["plant.m[1,2]", "plant.u"]


def test_a_name_matches_itself_and_patterns_of_it():
    """As a whole, in the case in which it is written, over lines too."""
    assert matches("plant.*", "plant.y")
    assert matches("plant.y", "plant.y")
    assert matches("*", "a\nb")
    assert not matches("plant.*", "other.plant.y")
    assert not matches("plant.Y", "plant.y")
    assert not matches("plant.?", "plant.yy")
    assert not matches("plant[xy].a", "plantx.a")


# --- a run in memory and from file alike ---


SHORT = {"scenario.stop": 0.1}


def test_a_run_is_a_mapping_of_its_signals(recorded):
    """Names in the order of the row, arrays by name, elements of a signal as well."""
    assert list(recorded) == list(recorded.signals)
    assert recorded.signals["plant.x_a"].size == 2
    assert recorded.signals["plant.x_a"].role == "state"
    with pytest.raises(TypeError):
        recorded.signals["plant.x_a"] = None
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
    page, _, _ = recorded._repr_html_().partition("</table>")
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


def with_warnings(*entries):
    """Return a run that has recorded some, and one message of each."""
    run = Memory()
    run.plan = Plan(Layout(()), 10**6, {}, {}, ())
    for entry in entries:
        run.message(*entry)
    return run


def test_a_run_counts_its_warnings_and_lists_each_once():
    """A component's errors are among them; how the run ended is not: that says its status."""
    slow = (3, "warning", "pump", "too slow")
    bad = (4, "error", "valve", "leaks")
    later = (5, "warning", "pump", "too slow")
    run = with_warnings(slow, (3, "info", "pump", "on"), bad, later, (9, "error", "run", "NaN"))
    assert run.warnings == [slow, bad]
    assert ", 2 warnings>" in repr(run)
    assert ", 2 warnings</caption>" in run._repr_html_()
    assert "warning" not in repr(with_warnings())


def test_of_very_many_warnings_the_first_of_each_source_are_shown():
    """An FMU that says the time in each of them is one of many sources."""
    said = [(k, "warning", "pump", f"too slow at {k} s") for k in range(30)]
    texts = warning_texts(with_warnings(*said, (7, "warning", "valve", "leaks")).warnings)
    assert texts[:2] == ["pump: too slow at 0 s", "pump: too slow at 1 s"]
    assert texts[20:] == ["pump: 10 more warnings", "valve: leaks"]


@pytest.mark.parametrize("wrong", [3, [3], [[0, "warning", "pump"]], [["0", "warning", "a", "b"]]])
def test_recorded_warnings_of_another_shape_are_an_error(wrong):
    """Of a file that somebody wrote by hand; it is shown in a notebook all the same."""
    run = with_warnings()
    run.result({"warnings": wrong})
    with pytest.raises(LogError, match=r"the run: warnings .*\[time_ns, level, source, text\]"):
        _ = run.warnings
    assert ", warnings that cannot be read>" in repr(run)
