"""Pictures of studies: what they show, read back from the SVG, whose text is text."""

import re
import sys
from dataclasses import replace

import numpy as np
import pyarrow
import pytest
from scipy import stats

from cosim.errors import UsageError
from cosim.report.plots.picture import PictureOptions
from cosim.studies.layout import StudyLayout, results_of_study
from cosim.studies.plan import RecordedSearch
from cosim.studies.plots import KINDS, plot_study
from cosim.studies.plots.heat_map import cell_means
from cosim.studies.plots.scales import (
    Scale,
    cell_edges,
    even_edges,
    is_logarithmic,
    short_names,
    zero_width,
)
from cosim.studies.plots.search_history import best_so_far
from tests.studies.made import MadeStudy, saltelli_study, tolerances

DRAWN = ["histogram", "distribution", "convergence", "line", "map", "scatter"]


def texts(path):
    """Return the texts of an SVG."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", path.read_text(encoding="utf-8"))


def grid_study(seeds=1, *, plants=None):
    """Return a grid over rates, and over plants if there are some; the largest rate fails."""
    rates = np.geomspace(10.0, 1e4, 7)
    names = ["plain"] if plants is None else plants
    numbers = np.arange(seeds * len(rates) * len(names))
    rate = rates[numbers // len(names) % len(rates)]
    plant = [names[number % len(names)] for number in numbers]
    status = np.where(rate > 9e3, "failed", "complete")
    rms = pyarrow.array(1.0 / rate + 1e-3 * numbers, mask=rate > 9e3)
    columns = {"observer.filter_rate": rate, "rms": rms, "status": list(status)}
    keys = ["observer.filter_rate"]
    if plants is not None:
        keys.append("swap.plant")
        columns["swap.plant"] = plant
    study = MadeStudy(columns, keys, ("rms",), units={"observer.filter_rate": "rad/s", "rms": "m"})
    layout = StudyLayout("grid", seeds=seeds, grid=len(rates) * len(names))
    return results_of_study(study, layout)


@pytest.fixture
def figures(monkeypatch):
    """Return the figures that would be written, as matplotlib has them."""
    from matplotlib.figure import Figure

    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    return drawn


def words(figure):
    """Return the texts of a figure, each as one line."""
    from matplotlib.text import Text

    texts = [text.get_text().replace("\n", " ") for text in figure.findobj(Text)]
    return [text for text in texts if text]


def panels_of(figures):
    """Return the panels of the only figure that are seen."""
    (figure,) = figures
    return [panel for panel in figure.axes if panel.get_visible()]


def named(panel):
    """Return the lines of a panel by their label."""
    return {line.get_label(): line for line in panel.lines}


def values_of(results, name):
    """Return the values of a metric, of the members that have one."""
    return results.columns.metric(name).values


def test_a_histogram_has_every_member_and_the_figures_of_all(figures, tmp_path):
    """Bars are members; lines the mean, and the quantiles of numpy."""
    _, results = tolerances(61)
    plot_study(results, tmp_path / "a.svg", kind="histogram")
    for panel, name in zip(panels_of(figures), ("rms", "settling"), strict=True):
        values = values_of(results, name)
        assert sum(bar.get_height() for bar in panel.patches) == len(values)
        assert panel.patches[0].get_x() == pytest.approx(values.min())
        lines = [line.get_xdata()[0] for line in panel.lines]
        expected = [values.mean(), *np.quantile(values, [0.5, 0.05, 0.95])]
        assert lines == pytest.approx(expected)
        labels = [line.get_label() for line in panel.lines]
        assert labels[:3] == ["mean", "median", "5 % and 95 %"]


def test_a_distribution_is_the_share_of_members_in_the_band_of_massart(figures, tmp_path):
    """Half the width of the band is sqrt(ln(2 / 0.05) / 2 n)."""
    _, results = tolerances(61)
    plot_study(results, tmp_path / "a.svg", kind="distribution")
    for panel, name in zip(panels_of(figures), ("rms", "settling"), strict=True):
        values = np.sort(values_of(results, name))
        (curve,) = panel.lines
        assert curve.get_xdata().tolist() == [values[0], *values]
        assert curve.get_ydata() == pytest.approx(np.arange(len(values) + 1) / len(values))
        assert curve.get_drawstyle() == "steps-post"
        (band,) = panel.collections
        heights = band.get_paths()[0].vertices[:, 1]
        reach = np.sqrt(np.log(2 / 0.05) / (2 * len(values)))
        assert heights.min() == 0.0
        assert heights.max() == 1.0
        assert np.abs(heights - reach).min() < 1e-12  # where the share is 0


def test_convergence_is_the_mean_of_the_first_members(figures, tmp_path):
    """To the mean of all, which has a line of its own."""
    _, results = tolerances(61)
    plot_study(results, tmp_path / "a.svg", kind="convergence")
    for panel, name in zip(panels_of(figures), ("rms", "settling"), strict=True):
        values = values_of(results, name)
        counts = np.arange(1, len(values) + 1)
        lines = named(panel)
        assert lines["mean of the first"].get_xdata() == pytest.approx(counts)
        assert lines["mean of the first"].get_ydata() == pytest.approx(np.cumsum(values) / counts)
        assert lines["mean of all"].get_ydata() == pytest.approx([values.mean()] * 2)
        (band,) = panel.collections
        last = band.get_paths()[0].vertices
        ends = last[last[:, 0] == counts[-1], 1]
        half = stats.t.ppf(0.975, len(values) - 1) * stats.sem(values)
        assert [ends.min(), ends.max()] == pytest.approx(
            [values.mean() - half, values.mean() + half]
        )


def test_a_line_has_each_member_at_its_key(figures, tmp_path):
    """Members that failed are marked at theirs; nothing joins members that were drawn."""
    study, results = tolerances(61)
    plot_study(results, tmp_path / "a.svg", kind="line")
    rates = study.table(["observer.filter_rate"])[0].to_numpy()
    for panel, name in zip(panels_of(figures), ("rms", "settling"), strict=True):
        lines = named(panel)
        rows = results.columns.metric(name).numbers
        order = np.argsort(rates[rows])
        assert lines["members"].get_xdata() == pytest.approx(rates[rows][order])
        assert lines["members"].get_ydata() == pytest.approx(values_of(results, name)[order])
        assert lines["members"].get_linestyle() == "None"
        failed = lines["members that failed"].get_xdata()
        assert failed == pytest.approx(np.sort(rates[[3, 17, 40]]))


def test_a_map_has_the_mean_of_each_cell(figures, tmp_path):
    """All members are in one cell; those that failed are marked once in each."""
    _, results = tolerances(61)
    plot_study(results, tmp_path / "a.svg", kind="map")
    seen = panels_of(figures)
    panels, bars = seen[:2], seen[2:]
    assert len(bars) == 2
    for panel, name in zip(panels, ("rms", "settling"), strict=True):
        (mesh,) = panel.collections
        means = np.ma.filled(mesh.get_array(), np.nan)
        values = values_of(results, name)
        assert np.nanmax(means) <= values.max()
        assert np.nanmin(means) >= values.min()
        edges = mesh.get_coordinates()
        assert edges.shape == (means.shape[0] + 1, means.shape[1] + 1, 2)
        assert 1 <= len(named(panel)["members that failed"].get_xdata()) <= 3


@pytest.mark.slow
def test_a_scatter_matrix_has_points_below_and_histograms_on_the_diagonal(figures, tmp_path):
    """Above it rank correlations, those of scipy; failed members where both are parameters."""
    study, results = tolerances(61)
    plot_study(results, tmp_path / "a.svg", kind="scatter")
    matrix = np.reshape(panels_of(figures), (4, 4))
    counts = [61, 61, 58, 56]  # of both parameters, rms, settling
    for row in range(4):
        assert sum(bar.get_height() for bar in matrix[row, row].patches) == counts[row]
        for column in range(row):
            (points,) = [line for line in matrix[row, column].lines if line.get_marker() == "."]
            assert len(points.get_xdata()) == counts[row]
        assert not any(panel.lines for panel in matrix[row, row + 1 :])
    assert matrix[1, 0].lines[1].get_label() == "members that failed"
    assert len(matrix[1, 0].lines[1].get_xdata()) == 3
    assert [len(panel.lines) for panel in matrix[2, :2]] == [1, 1]
    (figure,) = figures
    assert {"observer.filter_rate [rad/s]", "settling [s]"} <= set(words(figure))
    assert "tolerances: 61 members, 3 failed, rank correlations above the diagonal" in words(figure)
    table = study.table(["plant.mass", "settling"]).to_pandas().dropna()
    expected = stats.spearmanr(table["plant.mass"], table["settling"]).statistic
    assert f"{expected:+.2f}" in [text.get_text() for text in matrix[1, 3].texts]


def test_bars_are_sobol_indices_of_the_closed_form(figures, tmp_path):
    """Of y = 3 p + 2 q: 9/13 and 4/13, the largest first; each has an interval."""
    plot_study(saltelli_study(), tmp_path / "a.svg")
    (panel,) = panels_of(figures)
    first, total = panel.containers[0], panel.containers[2]
    assert (first.get_label(), total.get_label()) == ("first order", "total order")
    for bars in (first, total):
        assert [bar.get_width() for bar in bars] == pytest.approx([9 / 13, 4 / 13], abs=0.02)
    assert [label.get_text() for label in panel.get_yticklabels()] == ["p", "q"]
    assert panel.yaxis_inverted()
    for errors in (panel.containers[1], panel.containers[3]):
        _, _, (reaches,) = errors.lines
        assert len(reaches.get_segments()) == 2


@pytest.mark.slow
@pytest.mark.parametrize("kind", DRAWN)
def test_the_picture_of_many_members_takes_little_room(kind, tmp_path):
    """Many members are put together."""
    _, results = tolerances(20_000)
    plot_study(results, tmp_path / "a.svg", kind=kind)
    assert (tmp_path / "a.svg").stat().st_size < 3e6


@pytest.mark.fast("histogram", "distribution")
@pytest.mark.parametrize("kind", DRAWN[:-1])
def test_every_picture_names_metrics_units_and_what_it_does_not_show(kind, tmp_path):
    """Failed members, and those without a value, are counted in the picture."""
    plot_study(tolerances(61)[1], tmp_path / "a.svg", kind=kind)
    shown = " ".join(texts(tmp_path / "a.svg"))
    assert "settling [s]" in shown
    assert "3 failed" in shown
    assert "2 without value" in shown
    assert "tolerances" in shown
    assert "verdict" not in shown
    if kind in ("line", "map"):
        assert "observer.filter_rate [rad/s]" in shown
        assert "members that failed" in shown


@pytest.mark.slow
def test_a_picture_follows_from_the_design(figures, tmp_path):
    """A line of one key, a map of two, bars of Sobol indices, else histograms."""
    studies = {
        "line": grid_study(),
        "map": grid_study(plants=["x/a.fmu", "x/b.fmu"]),
        "sobol": saltelli_study(),
        "histogram": tolerances()[1],
    }
    shown = {}
    for kind, study in studies.items():
        plot_study(study, tmp_path / "a.svg")
        shown[kind] = words(figures[-1])
    assert "tolerances: over observer.filter_rate" in shown["line"]
    assert "tolerances: over observer.filter_rate and swap.plant" in shown["map"]
    in_map = {"a.fmu", "b.fmu", "rms [m]", "no value", "members that failed"}
    assert in_map <= set(shown["map"])
    in_bars = {"p", "q", "first order", "total order", "share of the variance of y"}
    assert in_bars <= set(shown["sobol"])
    assert "255 base points, 1 left out" in shown["sobol"]
    assert "tolerances: histograms" in shown["histogram"]


def test_each_value_of_a_second_key_has_a_line(tmp_path):
    """Named in the legend, under the key, and what the bands are."""
    study = grid_study(seeds=3, plants=["x/a.fmu", "x/b.fmu"])
    keys = ("observer.filter_rate", "swap.plant")
    plot_study(study, tmp_path / "a.svg", kind="line", keys=keys)
    shown = texts(tmp_path / "a.svg")
    assert {"swap.plant", "a.fmu", "b.fmu", "5 % to 95 % of the members"} <= set(shown)


def test_metrics_and_title_can_be_chosen(tmp_path):
    """And the size, as of other pictures."""
    options = PictureOptions(title="mine $x$", size=(10.0, 8.0))
    plot_study(tolerances()[1], tmp_path / "a.svg", metrics=["rms"], options=options)
    shown = texts(tmp_path / "a.svg")
    assert "rms" in shown
    assert "settling [s]" not in shown
    assert 'width="283.4' in (tmp_path / "a.svg").read_text()  # 10 cm [points]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "histgram"}, r"plot kind 'histgram'; did you mean 'histogram'"),
        ({"metrics": ["rsm"]}, r"the study has no metric 'rsm'; did you mean 'rms'"),
        ({"metrics": ["verdict"]}, r"metric 'verdict': .*numbers.*texts"),
        (
            {"keys": ["plant.mas"]},
            r"the study does not vary 'plant.mas'; did you mean 'plant.mass'",
        ),
        ({"kind": "search"}, r"'search': .*got a planned one"),
        ({"kind": "sobol"}, r"Sobol indices: .*'saltelli'.*got 'random'"),
        (
            {"kind": "map", "keys": ["plant.mass"]},
            r"kind 'map': expected 2 .*got 1 varied key",
        ),
    ],
)
def test_a_picture_that_cannot_be_drawn_says_why(options, message, tmp_path):
    """Nothing is written."""
    with pytest.raises(UsageError, match=message):
        plot_study(tolerances()[1], tmp_path / "a.svg", **options)
    assert not (tmp_path / "a.svg").exists()


def test_without_matplotlib_every_picture_names_the_way_out(monkeypatch, tmp_path):
    """Whatever part of it would draw the picture, and before the study is looked at."""
    results = grid_study(plants=["plain", "fmu"])
    for name in list(sys.modules):
        if name.startswith("matplotlib."):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for kind in (*KINDS, "no kind"):
        with pytest.raises(UsageError, match=r"matplotlib, .*not installed: pip install matplo"):
            plot_study(results, tmp_path / "a.svg", kind=kind)


def tuning(maximize=False):
    """Return a tuning whose first and last members failed, and its search."""
    objective = np.array([np.nan, 3.0, 5.0, 2.0, 2.0, 4.0, np.nan])
    status = ["complete" if np.isfinite(value) else "failed" for value in objective]
    columns = {"gain": np.arange(7.0), "objective": objective, "samples": np.full(7, 9.0)}
    columns["status"] = status
    study = MadeStudy(columns, ("gain",), ("objective", "samples"), planned=9)
    search = RecordedSearch(
        "objective",
        "rms(a.y)",
        maximize=maximize,
        method="cobyqa",
        members=9,
        starts=4,
        seed=1,
        keys=(),
    )
    return results_of_study(study, StudyLayout("cases", samples=9)), search


@pytest.mark.parametrize("maximize", [False, True])
def test_the_picture_of_a_tuning_names_goal_best_member_and_failures(maximize, tmp_path):
    results, search = tuning(maximize)
    plot_study(results, tmp_path / "a.svg", search=search)
    shown = texts(tmp_path / "a.svg")
    goal = "maximize" if maximize else "minimize"
    title = f"tolerances: cobyqa, {goal} rms(a.y); 7 members of at most 9"
    assert title in " ".join(shown)
    assert {"member", "objective", "members that failed", "best so far"} <= set(shown)
    assert f"best: member {2 if maximize else 3}" in shown
    assert "5 members, 2 failed" in shown


@pytest.mark.parametrize("maximize", [False, True])
def test_the_best_so_far_begins_at_the_first_value_and_goes_to_the_last_member(maximize):
    results, _ = tuning()
    numbers, best = best_so_far(results.columns.metric("objective"), 6, maximize=maximize)
    assert numbers.tolist() == [1, 2, 3, 4, 5, 6]
    assert best.tolist() == ([3, 5, 5, 5, 5, 5] if maximize else [3, 3, 2, 2, 2, 2])


def test_a_search_marks_members_without_a_value_too(tmp_path):
    """Whether they failed, have none, or an infinite one."""
    objective = np.array([1.0, 2.0, np.inf, 3.0])
    study = MadeStudy({"gain": np.arange(4.0), "objective": objective}, ("gain",), ("objective",))
    results = results_of_study(study, StudyLayout("cases", samples=4))
    plot_study(results, tmp_path / "a.svg", search=tuning()[1])
    shown = texts(tmp_path / "a.svg")
    assert "members that failed, or have no finite value" in shown
    assert "3 members, 1 infinite" in shown


@pytest.mark.parametrize(
    ("values", "width"),
    [
        ([1.0, 2.0, 3.0, -4.0], None),
        ([0.0, 0.0, 0.0, 1.0], None),
        ([0.0, 1.0, 10.0, 1e9], 1.45),
        ([-1.0, -10.0, -1e9, np.nan], -1.9),
        ([1.0, 1.0 + 1e-12, 1.0], None),
    ],
)
def test_an_axis_is_linear_near_zero_where_values_are_spread_widely(values, width):
    """The width is the 5 % quantile of their sizes; signs do not matter."""
    found = zero_width(np.array(values))
    assert found == (None if width is None else pytest.approx(abs(width), rel=0.4))


def test_other_pictures_of_a_tuning_show_other_metrics_and_keys(figures, tmp_path):
    """They are drawn where these are named; a picture of the search refuses them."""
    results, search = tuning()
    for options in ({"kind": "histogram"}, {"metrics": ["samples"]}, {"keys": ["gain"]}):
        plot_study(results, tmp_path / "a.svg", search=search, **options)
        assert "tolerances: histograms" in words(figures[-1])
    for options, message in [
        ({"metrics": ["samples"]}, r"objective 'objective', got the metric 'samples'"),
        ({"keys": ["gain"]}, r"expected no key, got 'gain'"),
    ]:
        with pytest.raises(UsageError, match=message):
            plot_study(results, tmp_path / "b.svg", search=search, kind="search", **options)


def test_a_study_without_values_has_no_picture(tmp_path):
    """Nor is a number drawn that no axis can show; the mean of a grid does not converge."""
    none = MadeStudy({"rms": np.full(3, np.nan)}, (), ("rms",))
    layout = StudyLayout("random", samples=3)
    with pytest.raises(UsageError, match=r"no metric of the study has a value, so there is noth"):
        plot_study(results_of_study(none, layout), tmp_path / "a.svg")
    with pytest.raises(UsageError, match=r"metric 'rms': no member has a value"):
        plot_study(results_of_study(none, layout), tmp_path / "a.svg", metrics=["rms"])
    huge = MadeStudy({"rms": np.full(3, 1e305)}, (), ("rms",))
    with pytest.raises(UsageError, match=r"rms: 1e\+305 is too large"):
        plot_study(results_of_study(huge, layout), tmp_path / "a.svg")
    with pytest.raises(UsageError, match=r"the mean of 'rms' does not converge"):
        plot_study(grid_study(), tmp_path / "a.svg", kind="convergence")


WITHOUT_SPREAD = {
    "histogram": lambda panels: sum(bar.get_height() for bar in panels[0].patches) == 2,
    "distribution": lambda panels: panels[0].lines[0].get_xdata().tolist() == [5.0, 5.0, 5.0],
    "convergence": lambda panels: panels[0].lines[0].get_ydata().tolist() == [5.0, 5.0],
    "line": lambda panels: [line.get_ydata().tolist() for line in panels[0].lines] == [[5.0]] * 2,
    "map": lambda panels: panels[0].collections[0].get_array().compressed().tolist() == [5.0, 5.0],
    "scatter": lambda panels: panels[6].lines[0].get_ydata().tolist() == [5.0, 5.0],
}


@pytest.mark.parametrize("kind", DRAWN)
def test_equal_values_and_single_members_are_drawn(kind, figures, tmp_path):
    """Without a spread there is no width of a bin, a band or an axis."""
    columns = {"p": np.array([1.0, 2.0]), "q": np.array([3.0, 4.0]), "rms": np.array([5.0, 5.0])}
    study = MadeStudy(columns, ("p", "q"), ("rms",))
    results = results_of_study(study, StudyLayout("random", samples=2))
    plot_study(results, tmp_path / "a.svg", kind=kind)
    panels = panels_of(figures)
    assert WITHOUT_SPREAD[kind](panels)
    assert all(np.ptp(panel.get_xlim()) > 0.0 for panel in panels)


def test_values_far_off_do_not_hide_the_others(tmp_path):
    """They are counted instead."""
    values = np.concatenate([np.random.default_rng(0).normal(size=500), [1e9, -1e9]])
    study = MadeStudy({"rms": values}, (), ("rms",))
    plot_study(results_of_study(study, StudyLayout("random", samples=502)), tmp_path / "a.svg")
    assert "502 members, 2 outside of the axis" in texts(tmp_path / "a.svg")


def test_an_axis_is_logarithmic_where_values_are_spread_so():
    """By one factor, or over a factor of 30 of nine of ten values."""
    assert is_logarithmic(np.geomspace(1.0, 8.0, 4))
    assert not is_logarithmic(np.linspace(1.0, 8.0, 4))
    assert not is_logarithmic(np.array([1.0, 10.0]))
    assert not is_logarithmic(np.geomspace(1.0, 8.0, 4) - 1.0)
    assert is_logarithmic(np.exp(np.random.default_rng(0).uniform(0.0, 6.0, 200)))
    assert not is_logarithmic(np.array([1.0, *[2.0] * 100, 3.0, 1e6]))


def test_names_stand_where_values_are_none():
    """Of paths the last part, if these differ."""
    scale = Scale.of(np.array(["x/a.fmu", "y/b.fmu", "x/a.fmu"], object))
    assert scale.positions.tolist() == [0.0, 1.0, 0.0]
    assert scale.names == ("a.fmu", "b.fmu")
    assert short_names(["x/a.fmu", "y/a.fmu"]) == ["x/a.fmu", "y/a.fmu"]
    assert short_names(["left_pump_of_version_7.fmu"]) == ["...f_version_7.fmu"]
    heads = short_names(["left_pump_of_version_7.fmu", "right_pump_of_version_7.fmu"])
    assert heads == ["left_pump..._7.fmu", "right_pum..._7.fmu"]
    assert Scale.of(np.array([True, False], object)).names == ("True", "False")


def test_cells_hold_their_centers():
    """Halfway between neighbors, in the logarithm where the axis is."""
    assert cell_edges(np.array([1.0, 2.0, 4.0]), logarithmic=False).tolist() == [0.5, 1.5, 3.0, 5.0]
    edges = cell_edges(np.array([1.0, 100.0]), logarithmic=True)
    assert edges == pytest.approx([0.1, 10.0, 1000.0])
    assert even_edges(np.array([1.0, 16.0]), 2, logarithmic=True) == pytest.approx([1.0, 4.0, 16.0])
    places = [np.array([0.0, 0.4, 1.9, 2.0]), np.array([0.0, 0.0, 1.0, 1.0])]
    means, counts = cell_means(
        np.array([1.0, 3.0, 5.0, 8.0]),
        places,
        [np.array([0.0, 1.0, 2.0]), np.array([-1.0, 0.5, 2])],
    )
    assert counts.tolist() == [[2, 0], [0, 2]]
    assert means[0, 0] == 2.0
    assert means[1, 1] == 6.5
    assert np.isnan(means[0, 1])


def test_every_kind_is_described():
    """For the command line."""
    assert set(DRAWN) | {"sobol", "search"} == set(KINDS)


def test_nothing_is_drawn_between_names(figures, tmp_path):
    """Each plant has a bar and a point: a line between two plants would say something."""
    study = grid_study(seeds=3, plants=["x/a.fmu", "x/b.fmu"])
    plot_study(study, tmp_path / "a.svg", kind="line", keys=["swap.plant"])
    (panel,) = figures[0].axes
    assert all(line.get_linestyle() == "None" for line in panel.lines)
    assert panel.get_xlim() == (-0.5, 1.5)


def test_bars_of_several_lines_stand_side_by_side(figures, tmp_path):
    """Within the room of their name: one behind the other they could not be told apart."""
    study = grid_study(seeds=3, plants=["x/a.fmu", "x/b.fmu"])
    keys = ["swap.plant", "observer.filter_rate"]
    chosen = study.columns.parameters["observer.filter_rate"] < 50.0
    few = replace(study, columns=study.columns.only(chosen))
    plot_study(few, tmp_path / "a.svg", kind="line", keys=keys)
    (panel,) = figures[0].axes
    medians = [line.get_xdata() for line in panel.lines if line.get_label()[0] != "_"]
    assert np.ravel(medians) == pytest.approx([-0.175, 0.825, 0.175, 1.175])


def test_cells_of_a_scatter_matrix_show_the_points_of_a_grid(figures, tmp_path):
    """Of many members at few values: each cell reaches halfway to the next."""
    numbers = np.arange(6000)
    columns = {"p": numbers % 3.0, "q": numbers // 3 % 2.0, "y": np.sqrt(numbers)}
    study = MadeStudy(columns, ("p", "q"), ("y",))
    plot_study(
        results_of_study(study, StudyLayout("grid", seeds=1000, grid=6)),
        tmp_path / "a.svg",
        kind="scatter",
    )
    (mesh,) = figures[0].axes[3].collections
    assert mesh.get_coordinates()[0, :, 0].tolist() == [-0.5, 0.5, 1.5, 2.5]
    assert mesh.get_array().tolist() == [[1000.0] * 3] * 2
    assert mesh.to_rgba(mesh.get_array())[0, 0, :3].max() < 0.6  # dark


LONG = "subsystem_of_the_{}_actuator.hydraulic_cylinder.initial_pressure_of_the_chamber"


def long_names(kind):
    """Return a study whose name, keys, plants and metrics are as long as those of projects are."""
    rng = np.random.default_rng(3)
    left, right = LONG.format("left"), LONG.format("right")
    plants = np.array([f"plants/{side}_pump_of_version_2026.fmu" for side in ("a", "b", "c")])
    metric = "root_mean_square_of_the_difference_between_estimated_and_true_disturbance"
    points = rng.uniform(1e5, 2e5, (2, 60))
    columns = {
        left: points[0],
        right: points[1].round(-5),
        "swap.plant": list(plants[rng.integers(0, 3, 60)]),
        metric: points[0] / points[1],
        "status": ["complete"] * 58 + ["failed"] * 2,
    }
    units = {left: "Pa", right: "Pa", metric: "kg.m2.s-3.A-1"}
    study = MadeStudy(columns, (left, right, "swap.plant"), (metric,), units=units)
    study.name = "a study with a name as those of engineers in large projects are, version 7"
    keys = {"line": (left, right), "map": ("swap.plant", left)}.get(kind, ())
    return results_of_study(study, StudyLayout("random", samples=60)), keys


@pytest.mark.fast("map-None", "line-size6")
@pytest.mark.parametrize(
    ("kind", "size"),
    [
        *((kind, None) for kind in DRAWN),
        ("line", (9.0, 11.0)),
    ],
)
def test_no_text_is_cut_off(kind, size, figures, tmp_path):
    """Titles, legends and the names of axes are broken into lines that fit."""
    results, keys = long_names(kind)
    options = PictureOptions(size=size)
    plot_study(results, tmp_path / "a.png", kind=kind, keys=keys, options=options)
    (figure,) = figures
    figure.set_dpi(150)  # as it is written
    figure.draw_without_rendering()
    shown = [figure._suptitle]
    for legend in figure.legends:
        shown += [*legend.get_texts(), legend.get_title()]
    for panel in figure.axes:
        shown += [panel.xaxis.label, panel.yaxis.label, panel.title]
    inside = figure.bbox.padded(2.0)
    for text in shown:
        extent = text.get_window_extent()
        is_inside = inside.contains(extent.x0, extent.y0) and inside.contains(extent.x1, extent.y1)
        assert is_inside or not text.get_text(), text.get_text()


def test_a_picture_without_room_for_its_names_is_an_error(tmp_path):
    """Not one whose panels have no size."""
    results, keys = long_names("map")
    options = PictureOptions(size=(6.0, 6.0))
    with pytest.raises(UsageError, match=r"size: .*6 x 6 cm"):
        plot_study(results, tmp_path / "a.png", kind="map", keys=keys, options=options)
    assert not (tmp_path / "a.png").exists()


def test_failed_members_are_marked_where_no_values_are(figures, tmp_path):
    """Above the frame of a line; in a color that no line has."""
    study = grid_study(seeds=3, plants=["x/a.fmu", "x/b.fmu"])
    plot_study(study, tmp_path / "a.svg", kind="line")
    (panel,) = figures[0].axes
    (marks,) = [line for line in panel.lines if line.get_label() == "members that failed"]
    (place,) = marks.get_xdata()
    assert place == pytest.approx(1e4)
    assert panel.transAxes.inverted().transform(marks.get_window_extent())[0, 1] > 0.99
    assert not marks.get_clip_on()
    others = [line.get_color() for line in panel.lines if line is not marks]
    assert marks.get_color() not in others


def test_a_line_has_one_color_in_all_panels(figures, tmp_path):
    """Also where a metric has no value on the first line; and the legend names all lines."""
    columns = {
        "p": [1.0, 2.0, 1.0, 2.0],
        "q": [5.0, 5.0, 6.0, 6.0],
        "rms": [1.0, 2.0, 3.0, 4.0],
        "last": pyarrow.array([None, None, 3.0, 4.0], "double"),
    }
    study = MadeStudy(columns, ("p", "q"), ("rms", "last"), units={"q": "kg"})
    plot_study(
        results_of_study(study, StudyLayout("grid", grid=4)), tmp_path / "a.svg", kind="line"
    )
    first, second = figures[0].axes
    colors = {line.get_label(): line.get_color() for line in first.lines}
    assert {line.get_label(): line.get_color() for line in second.lines} == {"6": colors["6"]}
    assert {"5", "6", "q [kg]"} <= set(words(figures[0]))


def test_the_median_of_a_drawn_key_is_that_of_each_bin(figures, tmp_path):
    """Steps from the smallest to the largest value, and no band that the key itself makes."""
    key = np.random.default_rng(0).uniform(0.0, 1.0, 400)
    study = MadeStudy({"p": key, "rms": key}, ("p",), ("rms",))
    results = results_of_study(study, StudyLayout("random", samples=400))
    plot_study(results, tmp_path / "a.svg", kind="line")
    (panel,) = figures[0].axes
    (steps,) = panel.patches
    values, edges, _ = steps.get_data()
    assert edges[[0, -1]].tolist() == [key.min(), key.max()]
    groups = np.split(np.sort(key), 20)
    assert values == pytest.approx([np.median(group) for group in groups])
    assert not panel.collections


def test_few_members_have_no_rank_correlation_in_a_scatter_matrix(tmp_path):
    """Two are always in order."""
    columns = {"p": np.array([1.0, 2.0]), "q": np.array([3.0, 4.0]), "rms": np.array([5.0, 6.0])}
    study = MadeStudy(columns, ("p", "q"), ("rms",))
    results = results_of_study(study, StudyLayout("random", samples=2))
    plot_study(results, tmp_path / "a.svg", kind="scatter")
    shown = " ".join(texts(tmp_path / "a.svg"))
    assert "too few members for rank correlations" in shown
    assert "+1.00" not in shown


def test_one_member_is_one(tmp_path):
    """And its mean is drawn."""
    study = MadeStudy({"rms": np.array([0.3])}, (), ("rms",))
    results = results_of_study(study, StudyLayout("random", samples=1))
    plot_study(results, tmp_path / "a.svg", kind="convergence")
    assert "1 member" in texts(tmp_path / "a.svg")
    with pytest.raises(UsageError, match=r"'scatter': .*at least 2 .*got 1"):
        plot_study(results, tmp_path / "a.svg", kind="scatter")


def test_a_key_that_was_chosen_by_factors_has_a_logarithmic_axis():
    """10, 30, 100; a metric with such values does not."""
    assert Scale.of(np.array([10.0, 30.0, 100.0, 300.0])).logarithmic
    assert Scale.of(np.exp(np.random.default_rng(0).uniform(0.0, 2.3, 200))).logarithmic
    assert not Scale.of(np.random.default_rng(0).uniform(1.0, 10.0, 200)).logarithmic
    assert not Scale.of(np.arange(1.0, 11.0)).logarithmic
    assert not Scale.of(np.array([1.0, 2.0, 3.0])).logarithmic


def test_a_mean_far_off_does_not_move_the_axis_of_a_histogram(figures, tmp_path):
    """As one of values far off, which are counted instead."""
    values = np.concatenate([np.random.default_rng(0).normal(size=500), [1e9]])
    study = MadeStudy({"rms": values}, (), ("rms",))
    plot_study(results_of_study(study, StudyLayout("random", samples=501)), tmp_path / "a.svg")
    assert figures[0].axes[0].get_xlim()[1] < 10.0


@pytest.mark.slow
def test_a_scatter_matrix_of_very_many_members_takes_little_room(tmp_path):
    """Its cells are dots, not paths, and some of the failed members are marked."""
    _, results = tolerances(100_000)
    results.columns.failed[::2] = True
    plot_study(results, tmp_path / "a.svg", kind="scatter")
    assert (tmp_path / "a.svg").stat().st_size < 1e6
    assert "300 of the 50002 members that failed" in " ".join(texts(tmp_path / "a.svg"))


@pytest.mark.slow
def test_parameters_without_a_number_have_no_place(figures, tmp_path):
    """Cases have empty cells, lists of any length, and infinity."""
    count = 12
    rate = pyarrow.array(np.geomspace(1.0, 1e3, count), mask=np.arange(count) == 2)
    bound = np.arange(1.0, count + 1.0)
    bound[4] = np.inf
    lists = [[1.0, 2.0], [3.0], []] * (count // 3)
    columns = {"rate": rate, "bound": bound, "gains": lists, "rms": np.arange(1.0, count + 1.0)}
    status = ["complete"] * (count - 1) + ["failed"]
    study = MadeStudy({**columns, "status": status}, ("rate", "bound", "gains"), ("rms",))
    results = results_of_study(study, StudyLayout("random", samples=count))

    def drawn(kind, *keys):
        plot_study(results, tmp_path / "a.svg", kind=kind, keys=keys)
        return figures[-1]

    line = drawn("line")
    note = "; 1 member without a finite rate; 1 member without a finite bound"
    assert f"tolerances: over rate{note}" in " ".join(words(line))
    placed = [number for number in range(count - 1) if number not in (2, 4)]
    (points,) = [line for line in line.axes[0].lines if line.get_label() == "members"]
    assert points.get_xdata() == pytest.approx(np.geomspace(1.0, 1e3, count)[placed])
    assert points.get_ydata() == pytest.approx(np.array(placed) + 1.0)
    for kind in ("line", "map"):
        figure = drawn(kind, "gains", "bound")
        assert "1 member without a finite bound" in " ".join(words(figure))
        names = [label.get_text() for label in figure.axes[0].get_xticklabels()]
        assert sorted(names) == ["[1.0, 2.0]", "[3.0]", "[]"]
    matrix = np.reshape(drawn("scatter").axes, (4, 4))
    counts = [count - 1, count - 1, count, count - 1]  # rate, bound, gains, rms
    for row in range(4):
        assert sum(bar.get_height() for bar in matrix[row, row].patches) == counts[row]
