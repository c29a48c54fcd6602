"""Tables in terminals of any width and in pipes; texts that a terminal would obey."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.report.printable import print_notice, print_text, printable, printable_line
from cosim.report.tables import console

ROWS = [
    {"signal": "observer.delta", "unit": "m/s", "error": "5.44321e-04", "meaning": "one two three"},
    {"signal": "plant.y", "unit": "", "error": "-1", "meaning": "a sentence of several words"},
]


@pytest.fixture
def printed(capsys, monkeypatch):
    """Return a function that prints a section as wide as a terminal; None: a pipe."""

    def printed(width, title, content):
        monkeypatch.setattr(console, "terminal_width", lambda: width)
        console.print_tables(console.section_tables([(title, content)]))
        return capsys.readouterr().out

    return printed


def test_rows_in_a_pipe_are_lines_with_tabs(printed):
    """Neither padded nor wrapped, whatever their length."""
    title, header, *rows = printed(None, "errors", ROWS).splitlines()
    assert (title, header) == ("errors", "signal\tunit\terror\tmeaning")
    assert rows == ["\t".join(row.values()) for row in ROWS]


@pytest.mark.parametrize("width", [200, 80, 48, 43, 42, 20])
def test_a_table_splits_no_word_and_no_number(printed, width):
    """It fits the terminal; where its words do not fit side by side they stand below each other."""
    text = printed(width, "errors", ROWS)
    words = {word for row in ROWS for cell in row.values() for word in cell.split()}
    assert words <= set(text.split())
    assert ("signal  " in text) == (width >= 43)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width


def test_a_long_path_breaks_and_leaves_the_table_as_it_is(printed):
    """Only a word in the last column may, if it is longer than any number."""
    path = "/".join(["folder"] * 20)
    first, *lines = printed(60, "", {"steps": 40000, "log": path}).split("\n")
    assert first.rstrip() == "steps  40000"
    assert "".join(line.removeprefix("log").strip() for line in lines) == path


ATTACK = "\x1b]0;title\x07\x1b[2J\u202eabc\x9b31m\x00\r\udcff\u2028"


@pytest.mark.parametrize("width", [None, 100])
def test_a_terminal_obeys_no_foreign_text(printed, capsys, width):
    """Names, values and titles out of logs and FMUs are shown, not carried out."""
    texts = [printed(width, ATTACK, {ATTACK: ATTACK}), printed(width, "rows", [{ATTACK: ATTACK}])]
    print_text(ATTACK)
    print_notice(ATTACK)
    for text in (*texts, *capsys.readouterr()):
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
    assert not {"\n", "\t"} & set(printable_line(text))
