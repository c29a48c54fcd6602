"""Pictures of studies: what they show, as matplotlib has it."""

import sys

import numpy as np
import pyarrow
import pytest
from scipy import stats

from cosim.errors import UsageError
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import StudyLayout, results_of_study
from cosim.studies.panels import Scale, is_logarithmic
from cosim.studies.plots import KINDS, plot_study
from cosim.studies.search import Search
from tests.studies.made import MadeStudy, saltelli_study, tolerances

DRAWN = [kind for kind in KINDS if kind not in ("sobol", "search")]


def made(columns, keys=(), metrics=("rms",), *, units=None, **layout):
    """Return the results of a study of columns; by default its members were drawn."""
    study = MadeStudy(columns, keys, metrics, units=units)
    layout = layout or {"kind": "random", "samples": len(next(iter(columns.values())))}
    return results_of_study(study, StudyLayout(**layout))


def grid_study(seeds=1, plants=("plain",)):
    """Return a grid over rates, and over plants if there are several; the largest rate fails."""
    rates = np.geomspace(10.0, 1e4, 7)
    numbers = np.arange(seeds * len(rates) * len(plants))
    rate = rates[numbers // len(plants) % len(rates)]
    columns = {
        "observer.filter_rate": rate,
        "swap.plant": [plants[number % len(plants)] for number in numbers],
        "rms": pyarrow.array(1.0 / rate + 1e-3 * numbers, mask=rate > 9e3),
        "status": list(np.where(rate > 9e3, "failed", "complete")),
    }
    keys = ["observer.filter_rate", "swap.plant"]
    units = {"observer.filter_rate": "rad/s", "rms": "m"}
    return made(columns, keys, units=units, kind="grid", seeds=seeds, grid=7 * len(plants))


RANDOM = tolerances(61)[1]


@pytest.fixture
def draw(monkeypatch, tmp_path):
    """Return what draws a study: the figure that would be written, and the panels that are seen."""
    from matplotlib.figure import Figure

    def drawn(results, **options):
        figures = []
        with monkeypatch.context() as patch:
            patch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
            plot_study(results, tmp_path / "a.png", **options)
        (figure,) = figures
        return figure, [panel for panel in figure.axes if panel.get_visible()]

    return drawn


def words(figure):
    """Return the texts of a figure, each as one line."""
    from matplotlib.text import Text

    return [text.get_text().replace("\n", " ") for text in figure.findobj(Text)]


def named(panel):
    """Return the lines of a panel by their label."""
    return {line.get_label(): line for line in panel.lines}


@pytest.mark.parametrize("kind", DRAWN)
def test_every_picture_shows_all_members_and_counts_those_it_does_not(kind, draw):
    """Values are those of numpy and scipy; members that failed are marked, or counted."""
    study = RANDOM
    figure, panels = draw(study, kind=kind)
    shown = words(figure)
    if kind == "scatter":
        check_scatter(study, np.reshape(panels, (4, 4)))
        title = "tolerances: 61 members, 3 failed, rank correlations above the diagonal"
        assert {title, "observer.filter_rate [rad/s]", "settling [s]"} <= set(shown)
        return
    for panel, name in zip(panels, ("rms", "settling"), strict=False):
        column = study.columns.metric(name)
        rows = study.columns.rows_of(column.numbers)
        keys = {key: values[rows] for key, values in study.columns.parameters.items()}
        CHECKS[kind](panel, column.values, keys)
    assert {"56 members, 3 failed, 2 without value", "58 members, 3 failed"} <= set(shown)
    assert any("settling [s]" in text for text in shown)
    assert ("members that failed" in shown) is (kind in ("line", "map"))


def check_histogram(panel, values, _):
    assert sum(bar.get_height() for bar in panel.patches) == len(values)
    assert panel.patches[0].get_x() == pytest.approx(values.min())
    places = [line.get_xdata()[0] for line in panel.lines]
    assert places == pytest.approx([values.mean(), *np.quantile(values, [0.5, 0.05, 0.95])])
    assert [line.get_label() for line in panel.lines[:3]] == ["mean", "median", "5 % and 95 %"]


def check_distribution(panel, values, _):
    """Half the width of the band of Massart is sqrt(ln(2 / 0.05) / 2 n)."""
    (curve,) = panel.lines
    assert curve.get_xdata().tolist() == [values.min(), *np.sort(values)]
    assert curve.get_ydata() == pytest.approx(np.arange(len(values) + 1) / len(values))
    heights = panel.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (0.0, 1.0)
    assert np.abs(heights - np.sqrt(np.log(2 / 0.05) / (2 * len(values)))).min() < 1e-12


def check_convergence(panel, values, _):
    """Have Student's interval of the mean as a band."""
    counts = np.arange(1, len(values) + 1)
    lines = named(panel)
    assert lines["mean of the first"].get_xdata() == pytest.approx(counts)
    assert lines["mean of the first"].get_ydata() == pytest.approx(np.cumsum(values) / counts)
    assert lines["mean of all"].get_ydata() == pytest.approx([values.mean()] * 2)
    band = panel.collections[0].get_paths()[0].vertices
    ends = np.sort(band[band[:, 0] == counts[-1], 1])[[0, -1]]
    half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
    assert ends == pytest.approx([values.mean() - half, values.mean() + half])


def check_line(panel, values, keys):
    """Nothing joins members that were drawn."""
    order = np.argsort(keys["observer.filter_rate"])
    assert panel.lines[0].get_xdata() == pytest.approx(keys["observer.filter_rate"][order])
    assert panel.lines[0].get_ydata() == pytest.approx(values[order])
    assert panel.lines[0].get_linestyle() == "None"
    failed = named(panel)["members that failed"]
    assert len(failed.get_xdata()) == 3
    assert not failed.get_clip_on()  # above the frame


def check_map(panel, values, keys):
    (mesh,) = panel.collections
    edges = mesh.get_coordinates()
    bins = [edges[0, :, 0], edges[:, 0, 1]]
    places = [keys[key] for key in ("observer.filter_rate", "plant.mass")]
    needed = stats.binned_statistic_2d(*places, values, bins=bins).statistic.T
    assert np.ma.filled(mesh.get_array(), np.nan) == pytest.approx(needed, nan_ok=True)
    assert len(named(panel)["members that failed"].get_xdata()) == 3


CHECKS = {
    "histogram": check_histogram,
    "distribution": check_distribution,
    "convergence": check_convergence,
    "line": check_line,
    "map": check_map,
}


def check_scatter(study, matrix):
    """Points below the diagonal, histograms on it, above it rank correlations of scipy."""
    counts = [61, 61, 58, 56]  # of both parameters, rms, settling
    for row in range(4):
        assert sum(bar.get_height() for bar in matrix[row, row].patches) == counts[row]
        for column in range(row):
            assert len(matrix[row, column].lines[0].get_xdata()) == counts[row]
        assert not any(panel.lines for panel in matrix[row, row + 1 :])
    assert len(named(matrix[1, 0])["members that failed"].get_xdata()) == 3
    assert [len(panel.lines) for panel in matrix[2, :2]] == [1, 1]
    settling = study.columns.metric("settling")
    mass = study.columns.parameters["plant.mass"][study.columns.rows_of(settling.numbers)]
    expected = stats.spearmanr(mass, settling.values).statistic
    assert [text.get_text() for text in matrix[1, 3].texts] == [f"{expected:+.2f}"]


def test_bars_are_sobol_indices_of_the_closed_form(draw):
    """Of y = 3 p + 2 q: 9/13 and 4/13, the largest first; each has an interval."""
    figure, (panel,) = draw(saltelli_study())
    bars = [one for one in panel.containers if one.get_label().endswith("order")]
    assert [one.get_label() for one in bars] == ["first order", "total order"]
    for one in bars:
        assert [bar.get_width() for bar in one] == pytest.approx([9 / 13, 4 / 13], abs=0.02)
        assert len(one.errorbar.lines[2][0].get_segments()) == 2
    assert [label.get_text() for label in panel.get_yticklabels()] == ["p", "q"]
    assert panel.yaxis_inverted()
    assert {"255 base points, 1 left out", "share of the variance of y"} <= set(words(figure))


def test_a_picture_follows_from_the_design(draw):
    """A line of one key, a map of two, else histograms."""
    assert "tolerances: over observer.filter_rate" in words(draw(grid_study())[0])
    shown = words(draw(grid_study(3, ["x/a.fmu", "x/b.fmu"]))[0])
    assert {"a.fmu", "b.fmu", "mean of rms [m]", "no value", "members that failed"} <= set(shown)
    assert "tolerances: over observer.filter_rate and swap.plant" in shown
    assert "tolerances: histograms" in words(draw(RANDOM)[0])


def test_a_second_key_has_a_line_for_each_value(draw):
    """Of one color in all panels; side by side where the first one has names, and not joined."""
    study = grid_study(3, ["x/a.fmu", "x/b.fmu"])
    figure, (panel,) = draw(study, kind="line")
    assert {"swap.plant", "a.fmu", "b.fmu"} <= set(words(figure))
    assert len(panel.collections) == 2  # bands
    assert named(panel)["members that failed"].get_xdata() == pytest.approx([1e4])
    columns = {
        **{"p": ["a", "b"] * 2, "q": [5.0, 5.0, 6.0, 6.0], "rms": [1.0, 2.0, 3.0, 4.0]},
        "last": pyarrow.array([None, None, 3.0, 4.0], "double"),
    }
    study = made(columns, ("p", "q"), ("rms", "last"), units={"q": "kg"}, kind="grid", grid=4)
    figure, (first, second) = draw(study, kind="line")
    assert named(second)["6"].get_color() == named(first)["6"].get_color()
    places = {"5": [-0.175, 0.825], "6": [0.175, 1.175]}
    for name, line in named(first).items():
        assert line.get_xdata() == pytest.approx(places[name])
        assert line.get_linestyle() == "None"
    assert first.get_xlim() == (-0.5, 1.5)
    assert {"5", "6", "q [kg]"} <= set(words(figure))


def test_many_values_of_a_key_are_put_together(draw, tmp_path):
    """Medians of bins with 20 members each, cells of grid points; pictures of many take no room."""
    key = np.random.default_rng(0).uniform(0.0, 1.0, 400)
    _, (panel,) = draw(made({"p": key, "rms": key}, ("p",)), kind="line")
    median = panel.lines[0]
    assert median.get_xdata() == pytest.approx(np.median(np.sort(key).reshape(20, 20), axis=1))
    assert median.get_ydata() == pytest.approx(median.get_xdata())
    numbers = np.arange(6000)
    columns = {"p": numbers % 3.0, "q": numbers // 3 % 2.0, "rms": np.sqrt(numbers)}
    study = made(columns, ("p", "q"), kind="grid", seeds=1000, grid=6)
    (mesh,) = draw(study, kind="scatter")[0].axes[3].collections
    assert mesh.get_coordinates()[0, :, 0].tolist() == [-0.5, 0.5, 1.5, 2.5]
    assert mesh.get_array().tolist() == [[1000.0] * 3] * 2
    many = tolerances(20_000)[1]
    many.columns.failed[::2] = True
    figure, _ = draw(many, kind="line")
    assert "300 of the 10002 members that failed" in words(figure)
    plot_study(many, tmp_path / "a.svg", kind="distribution", metrics=["rms"])
    assert (tmp_path / "a.svg").stat().st_size < 5e5


NONE, HUGE = made({"rms": np.full(3, np.nan)}), made({"rms": np.full(3, 1e305)})
REFUSED = [
    (RANDOM, {"kind": "histgram"}, r"plot kind 'histgram'; did you mean 'histogram'"),
    (RANDOM, {"metrics": ["rsm"]}, r"the study has no metric 'rsm'; did you mean 'rms'"),
    (RANDOM, {"metrics": ["verdict"]}, r"metric 'verdict': .*numbers.*texts"),
    (RANDOM, {"keys": ["plant.mas"]}, r"does not vary 'plant.mas'; did you mean 'plant.mass'"),
    (RANDOM, {"kind": "search"}, r"'search': .*got a planned one"),
    (RANDOM, {"kind": "sobol"}, r"Sobol indices: .*'saltelli'.*got 'random'"),
    (RANDOM, {"kind": "map", "keys": ["plant.mass"]}, r"'map': expected 2 .*got 1 varied key"),
    (NONE, {}, r"no member has a value of any metric"),
    (NONE, {"metrics": ["rms"]}, r"no member has a value of 'rms'"),
    (HUGE, {}, r"rms: 1e\+305 is too large"),
    (grid_study(), {"kind": "convergence"}, r"the mean of 'rms' does not converge"),
    (made({"rms": [0.3]}), {"kind": "scatter"}, r"'scatter': .*at least 2 .*got 1"),
]


def test_a_picture_that_cannot_be_drawn_says_why(tmp_path):
    """Nothing is written."""
    for study, options, message in REFUSED:
        with pytest.raises(UsageError, match=message):
            plot_study(study, tmp_path / "a.svg", **options)
    assert not (tmp_path / "a.svg").exists()


def test_without_matplotlib_a_picture_names_the_way_out(monkeypatch, tmp_path):
    """Before the study is looked at."""
    for name in [name for name in sys.modules if name.startswith("matplotlib.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match=r"matplotlib, .*not installed: pip install matplo"):
        plot_study(grid_study(), tmp_path / "a.svg", kind="no kind")


@pytest.mark.parametrize("maximize", [False, True])
def test_the_picture_of_a_tuning_shows_best_member_and_failures(maximize, draw):
    """The best so far goes from the first value to the last member; other pictures show others."""
    objective = np.array([np.nan, 3.0, 5.0, 2.0, 2.0, 4.0, np.inf])
    columns = {"gain": np.arange(7.0), "objective": objective, "samples": np.full(7, 9.0)}
    status = ["failed", *["complete"] * 6]
    study = made({**columns, "status": status}, ("gain",), ("objective", "samples"))
    search = Search(
        "objective", "rms(a.y)", maximize, method="cobyqa", members=9, starts=4, seed=1, keys=()
    )
    figure, (panel,) = draw(study, search=search)
    best = named(panel)["best so far"]
    assert best.get_xdata().tolist() == [1, 2, 3, 4, 5, 6]
    assert best.get_ydata().tolist() == ([3, *[5] * 5] if maximize else [3, 3, *[2] * 4])
    failed = named(panel)["members that failed, or have no finite value"]
    assert failed.get_xdata().tolist() == [0, 6]
    goal = f"cobyqa, {'maximize' if maximize else 'minimize'} rms(a.y)"
    shown = {f"tolerances: {goal}; 7 members of at most 7", "5 members, 1 failed, 1 infinite"}
    assert shown | {f"best: member {2 if maximize else 3}", "member"} <= set(words(figure))
    for options in ({"metrics": ["samples"]}, {"keys": ["gain"]}):
        assert "tolerances: histograms" in words(draw(study, search=search, **options)[0])
        with pytest.raises(UsageError, match=r"'objective' alone, got '(samples|gain)'"):
            draw(study, search=search, kind="search", **options)


@pytest.mark.parametrize("kind", DRAWN)
def test_equal_values_of_any_size_are_drawn(kind, draw):
    """Without a spread there is no width of a bin, a band or an axis; two are always in order."""
    columns = {"p": [1e-12, 2e-12], "q": [3e12, 4e12], "rms": np.full(2, 5.0)}
    figure, panels = draw(made(columns, ("p", "q")), kind=kind)
    assert all(np.ptp(panel.get_xlim()) > 0.0 for panel in panels)
    assert "+1.00" not in words(figure)


def test_values_far_off_do_not_hide_the_others(draw):
    """They are counted instead, and a mean far off does not move the axis."""
    values = np.concatenate([np.random.default_rng(0).normal(size=500), [1e9, -1e3]])
    figure, (panel,) = draw(made({"rms": values}))
    assert "502 members, 2 outside of the axis" in words(figure)
    assert panel.get_xlim()[1] < 10.0


def test_an_axis_is_logarithmic_where_values_are_spread_so(draw):
    """Nine of ten over a factor of 10, and more even so; one of a search near zero linearly."""
    for values, needed in (
        (np.exp(np.random.default_rng(0).uniform(0.0, 6.0, 200)), True),
        (np.array([1.0, *[2.0] * 100, 3.0, 1e6]), False),
        (np.array([10.0, 30.0, 100.0, 300.0]), True),
        (np.linspace(0.1, 10.0, 50), False),
        (np.arange(0.0, 11.0), False),
    ):
        assert is_logarithmic(values) is needed
    search = Search("rms", "a", False, "b", members=4, starts=1, seed=1, keys=())
    for objective, scale in (([1.0, 2.0, -4.0], "linear"), ([-1.0, -10.0, -1e9], "symlog")):
        _, (panel,) = draw(made({"rms": np.array(objective)}), search=search)
        assert panel.get_yscale() == scale


def test_names_stand_where_values_are_none_and_cells_hold_their_centers():
    """Of paths the last part, if these differ; in the logarithm where the axis is."""
    scale = Scale.of(np.array(["x/the_pump_of_version_7.fmu", "y/b.fmu", "y/b.fmu"], object))
    assert scale.positions.tolist() == [0.0, 1.0, 1.0]
    assert scale.names == ("the_pump_of_\nversion_7.fmu", "b.fmu")
    assert Scale.of(np.array(["x/a.fmu", "y/a.fmu"], object)).names == ("x/a.fmu", "y/a.fmu")
    assert Scale(np.array([1.0, 2.0, 4.0, np.nan])).edges(5, 5).tolist() == [0.5, 1.5, 3.0, 5.0]
    edges = Scale(np.array([1.0, 100.0, 1e4])).edges(5, 5)
    assert edges == pytest.approx([0.1, 10.0, 1e3, 1e5])


def test_parameters_without_a_number_have_no_place(draw):
    """Cases have empty cells, lists of any length, and infinity."""
    bound = np.arange(1.0, 13.0)
    bound[4] = np.inf
    columns = {
        "rate": pyarrow.array(np.geomspace(1.0, 1e3, 12), mask=np.arange(12) == 2),
        **{"bound": bound, "gains": [[1.0, 2.0], [3.0], []] * 4, "rms": np.arange(1.0, 13.0)},
    }
    study = made(columns, ("rate", "bound", "gains"))
    figure, (panel,) = draw(study, kind="line")
    note = "; 1 member without a finite rate; 1 member without a finite bound"
    assert f"tolerances: over rate{note}" in words(figure)
    assert panel.lines[0].get_ydata().tolist() == [1, 2, 4, *range(6, 13)]
    _, (panel, _) = draw(study, kind="map", keys=["gains", "bound"])
    names = [label.get_text() for label in panel.get_xticklabels()]
    assert names == ["[1.0, 2.0]", "[3.0]", "[]"]
    matrix = np.reshape(draw(study, kind="scatter")[1], (4, 4))
    bars = [sum(bar.get_height() for bar in panel.patches) for panel in matrix.diagonal()]
    assert bars == [11, 11, 12, 12]  # rate, bound, gains, rms


LONG = "subsystem_of_the_{}_actuator.hydraulic_cylinder.initial_pressure_of_the_chamber"


@pytest.mark.parametrize("kind", DRAWN)
def test_no_text_is_cut_off(kind, draw):
    """Titles, legends and the names of axes are broken into lines that fit."""
    study, keys = long_names()
    keys = keys[:2] if kind == "line" else keys[1:]
    options = PictureOptions(title="a name as those of large projects are " * 3)
    figure, panels = draw(study, kind=kind, keys=keys, options=options)
    figure.set_dpi(150)  # as it is written
    figure.draw_without_rendering()
    shown = [figure._suptitle]
    for legend in figure.legends:
        shown += [*legend.get_texts(), legend.get_title()]
    for panel in panels:
        shown += [panel.xaxis.label, panel.yaxis.label, panel.title]
    for text in shown:
        if text.get_text():
            (x0, y0), (x1, y1) = text.get_window_extent().get_points()
            assert -2.0 < x0 < x1 < figure.bbox.width + 2.0, text.get_text()
            assert -2.0 < y0 < y1 < figure.bbox.height + 2.0, text.get_text()


def long_names():
    """Return a study whose keys, plants and metrics have names as long as those of projects."""
    points = np.random.default_rng(3).uniform(1e5, 2e5, (2, 60))
    keys = (LONG.format("left"), LONG.format("right"), "swap.plant")
    plants = [f"plants/{side}_pump_of_version_2026.fmu" for side in "abc"] * 20
    metric = "root_mean_square_of_the_difference_between_estimated_and_true_disturbance"
    columns = dict(zip(keys, (points[0], points[1].round(-5), plants), strict=True))
    columns |= {metric: points[0] / points[1], "status": ["complete"] * 58 + ["failed"] * 2}
    return made(columns, keys, (metric,), units={keys[0]: "Pa", metric: "kg.m2.s-3.A-1"}), keys


def test_a_size_without_room_is_an_error(tmp_path):
    """Not a picture whose panels have no size."""
    study, keys = long_names()
    options = PictureOptions(size=(6.0, 6.0))
    with pytest.raises(UsageError, match=r"size: .*6 x 6 cm"):
        plot_study(study, tmp_path / "b.png", kind="map", keys=keys[1:], options=options)
    assert not (tmp_path / "b.png").exists()
