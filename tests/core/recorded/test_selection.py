"""Signals are chosen by names, elements and patterns."""

import pytest

from cosim.core.recorded.selection import matches, select_signals, selected_columns, split_names
from cosim.core.signals import Channel, Interface, Signal
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
