"""Texts that fit a picture: where they are broken."""

import pytest

from cosim.report.plots.fitting import broken


@pytest.mark.parametrize(
    ("text", "count", "lines"),
    [
        ("over plant.mass and rate", 40, ["over plant.mass and rate"]),
        ("over plant.mass and rate", 16, ["over plant.mass", "and rate"]),
        ("plant.filter_rate [rad/s]", 14, ["plant.filter_", "rate [rad/s]"]),
        ("a.very_long_name", 6, ["a.", "very_", "long_", "name"]),
        ("abcdefghij", 4, ["abcd", "efgh", "ij"]),
        ("one\ntwo words", 4, ["one", "two", "word", "s"]),
        ("ends  ", 4, ["ends"]),
        ("", 4, [""]),
    ],
)
def test_a_text_is_broken_after_blanks_and_names_after_their_parts(text, count, lines):
    """No line is longer, and nothing is lost but blanks."""
    assert broken(text, count).split("\n") == lines
