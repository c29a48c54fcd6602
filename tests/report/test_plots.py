"""Pictures: what they show, read back from the SVG, whose text is text."""

import re
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.report.plots import PictureOptions, plot_run, plot_signals

pytest.importorskip("matplotlib")

SCENARIO = """
[scenario]
name = "lengths"
stop = 1.0
step = 0.01
[components]
a = { kind = "ramp", slope = 1.0, unit = "m" }
b = { kind = "constant", value = 500.0, unit = "mm" }
c = { kind = "constant", value = [1.0, 2.0], unit = "V" }
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return two logs of a run without truth."""
    folder = tmp_path_factory.mktemp("logs")
    file = folder / "lengths.toml"
    file.write_text(SCENARIO)
    first = cosim.run(file, out=folder / "first.mcap")
    second = cosim.run(file, out=folder / "second.mcap", set={"a.slope": 2.0})
    return first, second


@pytest.fixture(scope="module")
def academic():
    return cosim.run("academic", set={"scenario.stop": 8.0, "scenario.step": 0.01})


def texts(path):
    """Return the texts of an SVG."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", path.read_text(encoding="utf-8"))


def size_of(path):
    """Return width and height of an SVG [cm]."""
    content = path.read_text(encoding="utf-8")
    points = re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', content).groups()
    return tuple(float(length) / 72.0 * 2.54 for length in points)


def test_every_curve_has_its_name_and_unit(runs, tmp_path):
    """What all are of stands on the axis, with the unit, several in a legend; 5 cm a panel."""
    plot_signals(runs[0], ["a.y", "c.y", "a.y, b.y"], tmp_path / "a.svg")
    shown = texts(tmp_path / "a.svg")
    assert shown.count("a.y [m]") == 1
    assert {"c.y[0]", "c.y[1]", "c.y [V]", "a.y", "b.y", "[m]", "t [s]"} <= set(shown)
    assert "[mm]" not in shown
    assert size_of(tmp_path / "a.svg") == pytest.approx((22.0, 3.0 + 3 * 5.0), abs=1e-4)


def test_units_of_one_kind_share_an_axis_and_others_do_not(runs, tmp_path):
    """The curve in mm is drawn in m; volts need a panel of their own."""
    from cosim.report.plots.curves import curves_of, draw_curves

    lines = []

    class Panel:
        def plot(self, times, values, **style):
            lines.append(values)

        def set_ylabel(self, text):
            assert text == "[m]"

        def get_legend_handles_labels(self):
            return [], []

        def legend(self, handles, labels, **options):
            pass

    options = PictureOptions()
    curves = [*curves_of(runs[0], "a.y", options), *curves_of(runs[0], "b.y", options)]
    draw_curves(Panel(), curves, styles=[{}, {}])
    assert lines[1].tolist() == [0.5] * 101
    with pytest.raises(UsageError, match=r"a\.y in 'm' and c\.y\[0\] in 'V' cannot share an axis"):
        plot_signals(runs[0], ["a.y,c.y[0]"], tmp_path / "b.svg")


def test_elements_of_different_units_have_them_in_their_names(tmp_path):
    """They are one signal, which the axis names, and have no common unit."""
    (tmp_path / "a.toml").write_text("""
        scenario = { name = "a", stop = 0.1, step = 0.1 }
        components.a = { kind = "constant", value = [1.0, 2.0], unit = { y = ["mm", "m/s"] } }
    """)
    run = cosim.run(tmp_path / "a.toml")
    plot_signals(run, ["a.y"], tmp_path / "a.svg")
    assert {"a.y", "a.y[0] [mm]", "a.y[1] [m/s]"} <= set(texts(tmp_path / "a.svg"))
    plot_signals(run, ["a.y[1]"], tmp_path / "b.svg")
    assert "a.y[1] [m/s]" in texts(tmp_path / "b.svg")


def test_several_logs_share_a_panel(runs, tmp_path):
    """The axis says which signal it is, each curve from which log, by its folder if need be."""
    plot_signals(runs, ["a.y", "c.y"], tmp_path / "a.svg")
    shown = set(texts(tmp_path / "a.svg"))
    assert {"a.y [m]", "a.y (first)", "a.y (second)", "c.y [V]", "c.y[1] (second)"} <= shown
    plot_signals([runs[0], runs[0]], ["a.y"], tmp_path / "b.svg")
    assert texts(tmp_path / "b.svg").count(f"a.y ({runs[0].path})") == 2


def test_many_panels_stand_side_by_side(runs, tmp_path):
    """At most four in a column: a picture fits a screen; the lowest of each column has the time."""
    plot_signals(runs[0], ["a.y"] * 4, tmp_path / "a.svg")
    assert size_of(tmp_path / "a.svg") == pytest.approx((22.0, 3.0 + 4 * 5.0), abs=1e-4)
    assert texts(tmp_path / "a.svg").count("t [s]") == 1
    plot_signals(runs[0], ["a.y"] * 5, tmp_path / "a.svg")
    assert size_of(tmp_path / "a.svg") == pytest.approx((32.0, 3.0 + 3 * 6.0), abs=1e-4)
    assert [texts(tmp_path / "a.svg").count(text) for text in ("t [s]", "a.y [m]", "0.2")] == [
        2,
        5,
        2 + 5,  # on both axes of time, and on all of values
    ]


def test_a_window_a_size_and_a_title_are_as_asked_for(runs, tmp_path):
    """The curve is cut one row outside the window; sizes are in cm."""
    options = PictureOptions(size=(12.7, 7.62), start=0.25, stop=0.5, title="A & B")
    plot_signals(runs[0], ["a.y"], tmp_path / "a.svg", options)
    assert size_of(tmp_path / "a.svg") == pytest.approx((12.7, 7.62), abs=1e-9)
    assert "A &amp; B" in texts(tmp_path / "a.svg")
    from cosim.report.plots.curves import curves_of

    (curve,) = curves_of(runs[0], "a.y", options)
    assert (curve.times[0], curve.times[-1]) == (0.25, 0.5)
    between = PictureOptions(start=0.253, stop=0.497)
    (curve,) = curves_of(runs[0], "a.y", between)
    assert (curve.times[0], curve.times[-1]) == (0.25, 0.5)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"size": (0.0, 5.0)}, "got 0 x 5 cm"),
        ({"size": (5.0, float("nan"))}, "got 5 x nan cm"),
        ({"start": 2.0, "stop": 1.0}, "stop: expected a time after start = 2 s, got 1 s"),
        ({"stop": float("inf")}, "stop: expected a finite number, got inf s"),
    ],
)
def test_a_wrong_size_or_window_is_refused(options, text):
    """Before anything is drawn."""
    with pytest.raises(UsageError, match=re.escape(text)):
        PictureOptions(**options)


@pytest.mark.parametrize("window", [{"start": 2.0}, {"stop": -1.0}])
def test_a_window_without_rows_is_refused(runs, tmp_path, window):
    """An empty picture says nothing; the message names the times that there are."""
    with pytest.raises(UsageError, match=r"start, stop: .*0 s to 1 s"):
        plot_signals(runs[0], ["a.y"], tmp_path / "a.svg", PictureOptions(**window))


def test_the_standard_picture_shows_estimates_truth_and_errors(academic, tmp_path):
    """A panel of errors for each estimate; the errors are those of the summary."""
    from cosim.report.plots.estimates import error_curves

    plot_run(academic, tmp_path / "a.svg")
    shown = texts(tmp_path / "a.svg")
    assert {"academic", "errors", "error of observer.delta", "identifier.theta[1]"} <= set(shown)
    # wider for its two columns, a row each for x, delta and theta
    assert size_of(tmp_path / "a.svg") == pytest.approx((32.0, 3.0 + 3 * 6.0), abs=1e-4)
    (error,) = error_curves(academic, "observer.delta", "delta.y", PictureOptions())
    assert np.array_equal(error.values, academic["observer.delta"] - academic["delta.y"])
    first, second = error_curves(academic, "identifier.theta", [-0.1, -0.3], PictureOptions())
    theta = academic["identifier.theta"]
    assert np.array_equal(second.values, theta[:, 1] + 0.3, equal_nan=True)
    assert np.array_equal(first.values, theta[:, 0] + 0.1, equal_nan=True)


@pytest.mark.slow
def test_a_run_without_truth_has_a_picture_of_its_outputs(runs, tmp_path):
    """A panel for each; where there are many, the title says how many are shown."""
    plot_run(runs[0], tmp_path / "a.svg")
    assert {"a.y [m]", "b.y [mm]", "c.y[0]", "lengths"} <= set(texts(tmp_path / "a.svg"))
    many = tmp_path / "many.toml"
    lines = [f'c{i} = {{ kind = "constant", value = 1.0 }}' for i in range(20)]
    many.write_text(SCENARIO.partition("a =")[0] + "\n".join(lines))
    plot_run(cosim.run(many), tmp_path / "b.svg")
    assert "lengths: the first 12 of 20 outputs" in texts(tmp_path / "b.svg")


def test_every_format_is_written(runs, tmp_path):
    """PDF keeps text in fonts, too."""
    for suffix, begin in ((".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml")):
        path = tmp_path / f"a{suffix}"
        plot_signals(runs[0], ["a.y"], path)
        assert path.read_bytes().startswith(begin)


def test_a_picture_that_is_interrupted_leaves_the_one_before(runs, tmp_path, monkeypatch):
    """Ctrl-C while it is drawn."""
    path = tmp_path / "a.png"
    path.write_bytes(b"before")

    def interrupted(figure, target, **options):
        with open(target, "wb") if isinstance(target, str | Path) else nullcontext(target) as file:
            file.write(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", interrupted)
    with pytest.raises(KeyboardInterrupt):
        plot_signals(runs[0], ["a.y"], path)
    assert path.read_bytes() == b"before"


def test_states_are_shown_of_components_that_have_no_other_outputs(tmp_path):
    """A lag's y is its state; an observer's state beside its outputs would be too much."""
    text = (
        '[scenario]\nname = "lags"\nstop = 1.0\nstep = 0.1\n[components]\n'
        's = { kind = "step", time = 0.5, before = 0.0, after = 1.0 }\n'
        'a = { kind = "lag", time_constant = 1.0 }\n'
        '[connections]\n"a.u" = "s.y"\n'
    )
    (tmp_path / "lags.toml").write_text(text)
    plot_run(cosim.run(tmp_path / "lags.toml"), tmp_path / "a.svg")
    assert {"s.y", "a.y"} <= set(texts(tmp_path / "a.svg"))


def test_a_legend_of_many_curves_fits_its_panel(tmp_path, recwarn):
    """The first are named, and how many there are."""
    scenario = tmp_path / "many.toml"
    components = [f'c{i} = {{ kind = "constant", value = {i}.0 }}' for i in range(60)]
    lines = ['[scenario]\nname = "many"\nstop = 1.0\nstep = 0.1\n[components]', *components]
    scenario.write_text("\n".join(lines))
    names = ",".join(f"c{i}.y" for i in range(60))
    plot_signals([cosim.run(scenario, out=tmp_path / "m.mcap")], [names], tmp_path / "a.svg")
    shown = texts(tmp_path / "a.svg")
    assert "the first 24 of 60" in shown
    assert ("c23.y" in shown, "c24.y" in shown) == (True, False)
    assert not recwarn.list


def test_a_method_far_beyond_most_does_not_hide_the_others():
    """It leaves the panel; curves of one size, one alone and one without a value all stay."""
    from cosim.report.plots.comparison import near_most
    from cosim.report.plots.curves import Curve
    from cosim.units import Unit

    t = np.linspace(0.0, 1.0, 50)
    curves = []
    for size in (1.0, 2.0, 0.5, 1e3, np.nan):
        curves.append(Curve("theta", Unit(None), t, size * np.sin(9.0 * t)))
    shown = near_most(curves[:4])
    assert [id(curve) for curve in shown] == [id(curve) for curve in curves[:3]]
    assert len(near_most(curves[3:4])) == 1
    assert len(near_most(curves[4:])) == 1
