"""Tables in terminals of any width and in pipes; texts that a terminal would obey."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.report.printable import printable, printable_line
from cosim.report.tables import console

ROWS = [
    {"signal": "observer.delta", "unit": "m/s", "error": "5.44321e-04", "meaning": "one two three"},
    {"signal": "plant.y", "unit": "", "error": "-1", "meaning": "a sentence of several words"},
]


def printed(capsys, monkeypatch, width):
    monkeypatch.setattr(console, "terminal_width", lambda: width)
    console.print_section("errors", ROWS)
    return capsys.readouterr().out


def test_rows_in_a_pipe_are_lines_with_tabs(capsys, monkeypatch):
    """Neither padded nor wrapped, whatever their length."""
    lines = printed(capsys, monkeypatch, None).splitlines()
    assert lines[0] == "errors"
    assert lines[1] == "signal\tunit\terror\tmeaning"
    assert lines[2:] == ["\t".join(row.values()) for row in ROWS]


@pytest.mark.parametrize("width", [200, 80, 60, 48, 43, 42, 20])
def test_a_table_splits_no_word_and_no_number(capsys, monkeypatch, width):
    """It fits the terminal; where its words do not fit side by side they stand below each other."""
    text = printed(capsys, monkeypatch, width)
    words = {word for row in ROWS for cell in row.values() for word in cell.split()}
    assert words <= set(text.split())
    assert ("signal  " in text) == (width >= 43)
    widest = max(len(line.rstrip()) for line in text.splitlines())
    assert widest <= width


def test_a_long_path_breaks_and_leaves_the_table_as_it_is(capsys, monkeypatch):
    """Only a word in the last column may, if it is longer than any number."""
    monkeypatch.setattr(console, "terminal_width", lambda: 60)
    path = "/".join(["folder"] * 20)
    console.print_section("", {"steps": 40000, "log": path})
    lines = capsys.readouterr().out.split("\n")
    assert lines[0].rstrip() == "steps  40000"
    assert "".join(line.removeprefix("log").strip() for line in lines[1:]) == path


ATTACK = "\x1b]0;title\x07\x1b[2J\u202eabc\x9b31m\x00\r\udcff\u2028"


def test_a_terminal_obeys_no_foreign_text(capsys, monkeypatch):
    """Names, values and titles out of logs and FMUs are shown, not carried out."""
    for width in (None, 100):
        monkeypatch.setattr(console, "terminal_width", lambda width=width: width)
        console.print_section(ATTACK, {ATTACK: ATTACK})
        console.print_section("rows", [{ATTACK: ATTACK}])
        console.print_line(ATTACK)
        console.print_line(ATTACK, error=True)
        output = capsys.readouterr()
        for text in (output.out, output.err):
            assert r"\x1b]0;title\x07\x1b[2J\u202eabc\x9b31m\x00\r\udcff\u2028" in text
            assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u202e\ud800-\udfff]", text)


@given(st.text(st.characters()))
def test_printable_keeps_what_is_harmless(text):
    """Twice is once; what remains is printable, a line feed or a tab."""
    shown = printable(text)
    assert printable(shown) == shown
    if text.isprintable():
        assert shown == text
    shown.encode("utf-8")
    assert "\n" not in printable_line(text)
    assert "\t" not in printable_line(text)
