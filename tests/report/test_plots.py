"""Pictures: what they show, read back from the SVG, whose text is text, and from what is drawn."""

import re
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.log import open_log
from cosim.log.diff import diff
from cosim.report.plots import runs
from cosim.report.plots.picture import PictureOptions
from cosim.report.plots.runs import (
    Curve,
    curves_of,
    draw_curves,
    error_curves,
    plot_difference,
    plot_run,
    plot_signals,
    truth_curves,
)
from tests.log.recordings import STEP_NS, layout, record, table
from tests.scenario.refusals import check_refused

pytest.importorskip("matplotlib")

SCENARIO = """
scenario = { name = "lengths", stop = 1.0, step = 0.01 }
[components]
a = { kind = "ramp", slope = 1.0, unit = "m" }
b = { kind = "constant", value = 500.0, unit = "mm" }
c = { kind = "constant", value = [1.0, 2.0], unit = "V" }
d = { kind = "constant", value = [1.0, 2.0], unit = { y = ["mm", "m/s"] } }
e = { kind = "lag", time_constant = 1.0 }
[connections]
"e.u" = "a.y"
"""


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Return two logs of a run without truth."""
    folder = tmp_path_factory.mktemp("logs")
    file = folder / "lengths.toml"
    file.write_text(SCENARIO)
    first = cosim.run(file, out=folder / "first.mcap")
    second = cosim.run(file, out=folder / "second.mcap", set={"a.slope": 2.0})
    return first, second


@pytest.fixture
def out(tmp_path):
    return tmp_path / "a.svg"


def texts(path):
    """Return the texts of an SVG."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", path.read_text(encoding="utf-8"))


def size_of(path):
    """Return width and height of an SVG [cm]."""
    content = path.read_text(encoding="utf-8")
    points = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', content).groups()
    return pytest.approx(tuple(float(length) / 72.0 * 2.54 for length in points), abs=1e-4)


# --- signals ---


def test_every_curve_has_its_name_and_unit(logs, out):
    """What all are of stands on the axis, with the unit, several in a legend; 5 cm a panel."""
    plot_signals(logs[0], ["a.y", "c.y", "a.y, b.y", "d.y"], out)
    shown = texts(out)
    assert shown.count("a.y [m]") == 1
    assert {"c.y[0]", "c.y[1]", "c.y [V]", "a.y", "b.y", "[m]", "t [s]"} <= set(shown)
    assert {"d.y", "d.y[0] [mm]", "d.y[1] [m/s]"} <= set(shown)  # which have no common unit
    assert "[mm]" not in shown
    assert shown.count("t [s]") == 1  # below the lowest panel
    assert size_of(out) == (22.0, 3.0 + 4 * 5.0)


def test_units_of_one_kind_share_an_axis_and_others_do_not(logs, out):
    """The curve in mm is drawn in m, with its band; volts need a panel of their own."""
    from matplotlib.figure import Figure

    panel = Figure().subplots()
    (length,) = curves_of(logs[0], "a.y")
    (width,) = curves_of(logs[0], "b.y")
    band = np.full(101, 100.0)
    draw_curves(panel, [length, Curve("b.y", width.unit, width.times, width.values, band=band)])
    assert panel.lines[1].get_ydata().tolist() == [0.5] * 101
    edges = panel.collections[0].get_paths()[0].vertices[:, 1]
    assert (edges.min(), edges.max()) == pytest.approx((0.4, 0.6))
    with pytest.raises(UsageError, match=r"a\.y in 'm' and c\.y\[0\] in 'V' cannot share an axis"):
        plot_signals(logs[0], ["a.y,c.y[0]"], out)


def test_a_window_a_size_and_a_title_are_as_asked_for(logs, out):
    """The curve is cut one row outside the window; sizes are in cm."""
    options = PictureOptions(size=(12.7, 7.62), start=0.253, stop=0.497, title="A & B")
    plot_signals(logs[0], ["a.y"], out, options)
    assert size_of(out) == (12.7, 7.62)
    assert "A &amp; B" in texts(out)
    for window in (options, PictureOptions(start=0.25, stop=0.5)):
        curve = curves_of(logs[0], "a.y")[0].within(window)
        assert (curve.times[0], curve.times[-1]) == (0.25, 0.5)


NOTHING = [
    ((["a.y"], "a.svg", {"size": (0.0, 5.0)}), "0 x 5 cm"),
    ((["a.y"], "a.svg", {"size": (5.0, float("nan"))}), "5 x nan cm"),
    ((["a.y"], "a.svg", {"start": 2.0, "stop": 1.0}), "stop: .* start = 2 s, got 1 s"),
    ((["a.y"], "a.svg", {"stop": float("inf")}), "stop: .* inf s"),
    ((["a.y"], "a.svg", {"start": 2.0}), r"start, stop: .*0 s to 1 s"),
    ((["a.y"], "a.svg", {"stop": -1.0}), r"start, stop: .*0 s to 1 s"),
    ((["a.y"], "first.mcap/a.png", {}), "cannot be written"),
    ((["a.y"], "a.doc", {}), r"'\.doc'"),
    (([], "a.svg", {}), "signals"),
    (([3], "a.svg", {}), "3"),
    ((["a"], "a.svg", {}), "'a'"),
    (("a.y", "a.svg", {}), "got 'a'"),
]


def test_a_picture_of_nothing_or_to_nowhere_is_refused(logs):
    """Signals, files, sizes and windows: an empty picture says nothing."""

    def draw(case):
        signals, name, options = case
        plot_signals(logs[0], signals, logs[0].path.parent / name, PictureOptions(**options))

    check_refused(NOTHING, draw)


@pytest.mark.parametrize("values", [[np.nan, np.inf, -np.inf], [5e-324, -5e-324], [1e308, -1e308]])
def test_a_picture_of_any_values_is_drawn_or_refused(tmp_path, out, values):
    """Where an axis cannot hold them, the signal is named."""
    rows = np.zeros((21, layout().width))
    for number, value in enumerate(values):
        rows[5 + 3 * number : 8 + 3 * number] = value
    record(tmp_path / "a.mcap", rows=rows)
    draw = partial(plot_signals, open_log(tmp_path / "a.mcap"), ["plant.u"], out)
    if values[0] == 1e308:
        with pytest.raises(UsageError, match=r"plant\.u: .*1e\+308"):
            draw()
        return
    draw()
    assert out.stat().st_size > 0


@pytest.mark.parametrize(
    ("suffix", "begin"), [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")]
)
def test_every_format_is_written(logs, out, suffix, begin):
    size = PictureOptions(size=(5.0, 5.0))
    plot_signals(logs[0], ["b.y"], out.with_suffix(suffix), size)
    assert out.with_suffix(suffix).read_bytes().startswith(begin)


def test_a_picture_that_is_interrupted_leaves_the_one_before(logs, out, monkeypatch):
    """Ctrl-C while it is drawn."""
    out.write_bytes(b"before")

    def interrupted(figure, target, **options):
        with open(target, "wb") if isinstance(target, str | Path) else nullcontext(target) as file:
            file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", interrupted)
    with pytest.raises(KeyboardInterrupt):
        plot_signals(logs[0], ["a.y"], out)
    assert out.read_bytes() == b"before"


# --- runs ---


def test_the_standard_picture_shows_estimates_truth_and_errors(out):
    """A panel of errors for each estimate; the errors are those of the summary."""
    run = cosim.run("academic", set={"scenario.stop": 8.0, "scenario.step": 0.02})
    plot_run(run, out)
    expected = {"academic", "errors", "error of observer.delta", "identifier.theta[1]"}
    assert expected <= set(texts(out))
    assert size_of(out) == (32.0, 3.0 + 3 * 6.0)  # a row each for x, delta and theta
    (error,) = error_curves(run, "observer.delta")
    assert np.array_equal(error.values, run["observer.delta"] - run["delta.y"])
    errors = error_curves(run, "identifier.theta")
    for curve, values, true in zip(errors, run["identifier.theta"].T, (-0.1, -0.3), strict=True):
        assert np.array_equal(curve.values, values - true, equal_nan=True)
    truth = [(one.values.tolist(), len(one.times)) for one in truth_curves(run, "identifier.theta")]
    assert truth == [([-0.1], 0), ([-0.3], 0)]  # which are drawn over the whole axis


# --- differences ---


@pytest.fixture
def rows():
    """Return rows of numbers."""
    return np.nan_to_num(table(layout(), 100), posinf=1.0, neginf=-1.0)


@pytest.fixture
def draw(tmp_path, rows, out, monkeypatch):
    """Return a function that draws the difference to other rows: lines of panels, and texts."""

    def draw(changed, **options):
        record(tmp_path / "first.mcap", rows=rows)
        record(tmp_path / "second.mcap", rows=changed)
        both = open_log(tmp_path / "first.mcap"), open_log(tmp_path / "second.mcap")
        panels = []

        def keep(panel, *given):
            draw_curves(panel, *given)
            panels.append(list(panel.lines))

        monkeypatch.setattr(runs, "draw_curves", keep)
        plot_difference(diff(*both, **options), both, out)
        both_runs, (apart,) = panels
        return *both_runs, apart, set(texts(out))

    return draw


@pytest.mark.parametrize("interpolate", [False, True])
def test_both_curves_and_their_difference_are_drawn(rows, draw, interpolate):
    """Of the element that is farthest apart, by the names of the runs, with the tolerance."""
    changed = rows.copy()
    changed[40:, 2] += 0.5
    first, second, apart, shown = draw(changed, tol={"plant.*": 0.1}, interpolate=interpolate)
    assert np.array_equal(first.get_ydata(), rows[:, 2])
    assert np.array_equal(second.get_ydata(), changed[:, 2])
    assert np.array_equal(apart.get_ydata(), changed[:, 2] - rows[:, 2])
    assert np.array_equal(apart.get_xdata(), np.arange(101) * STEP_NS / 1e9)
    assert {line.get_drawstyle() for line in (first, second, apart)} == {"default"}
    expected = {"plant.x_a[1] (first)", "plant.x_a[1] (second)", "tolerance", "first outside"}
    assert expected | {"plant.x_a[1]: largest |a - b| = 0.5"} <= shown


def test_a_discrete_signal_and_its_difference_hold_between_rows(rows, draw):
    """They are drawn as steps, such as n of the plant; runs of other lengths with their own rows.

    Their difference is drawn at the instants that both have.
    """
    changed = rows[:51].copy()
    changed[40:, 4] += 2.0
    first, second, apart, _ = draw(changed)
    assert {line.get_drawstyle() for line in (first, second, apart)} == {"steps-post"}
    assert [len(line.get_xdata()) for line in (first, second, apart)] == [101, 51, 51]
    assert np.array_equal(apart.get_ydata(), changed[:, 4] - rows[:51, 4])


def test_a_number_beside_none_is_drawn_where_it_is(rows, draw):
    """The difference is infinite there; the element is the first that is outside."""
    changed = rows.copy()
    changed[30, 2] = np.nan
    rows[20, 1] = changed[20, 1] = np.inf
    assert "plant.x_a[1]: largest |a - b| = inf" in draw(changed)[-1]
