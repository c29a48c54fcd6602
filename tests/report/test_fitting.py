"""Texts that fit a picture: where they are broken, and numbers at the axes."""

from itertools import combinations

import numpy as np
import pytest

from cosim.report.plots.fitting import broken
from cosim.report.plots.picture import Picture, PictureOptions


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


@pytest.mark.parametrize(
    ("scale", "low", "high", "fewest"),
    [
        ("log", 0.011, 0.08, 3),  # 3e-2 and 4e-2 would be on each other
        ("log", 1.0, 1.5, 3),  # a number for every tenth
        ("log", 0.5, 5e4, 5),
        ("linear", 4.00001, 4.00002, 2),
        ("linear", 1.7e9 + 0.01, 1.7e9 + 0.02, 2),
    ],
)
def test_numbers_at_axes_are_whole_and_apart(tmp_path, scale, low, high, fewest):
    """None runs into another, and none is to be added to another beside the axis."""
    pytest.importorskip("matplotlib")
    picture = Picture(1, PictureOptions(size=(14.0, 9.0)), shares_time=False)
    panel = picture.panels[0]
    values = np.linspace(low, high, 20)
    draw = panel.loglog if scale == "log" else panel.plot
    draw(values, values)
    picture.save(tmp_path / "a.png")
    panel.figure.draw_without_rendering()  # at its own resolution again
    for axis in (panel.xaxis, panel.yaxis):
        assert "+" not in axis.get_offset_text().get_text()
        shown = [*axis.get_majorticklabels(), *axis.get_minorticklabels()]
        seen = [label.get_window_extent() for label in shown if label.get_text()]
        assert len(seen) >= fewest
        assert not [pair for pair in combinations(seen, 2) if pair[0].overlaps(pair[1])]
