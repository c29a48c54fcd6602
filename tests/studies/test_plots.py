"""Pictures of studies: what they show, as matplotlib has it."""

import sys
from dataclasses import replace

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
from tests.studies.made import MadeStudy, saltelli, tolerances

DRAWN = [kind for kind in KINDS if kind not in ("sobol", "search")]
RATE, MASS, SWAP = "observer.filter_rate", "plant.mass", "swap.plant"


def made(columns, keys=(), metrics=("rms",), *, units=None, **layout):
    """Return the results of a study of columns; by default its members were drawn."""
    study = MadeStudy(columns, keys, metrics, units=units)
    layout = layout or {"kind": "random", "samples": len(next(iter(columns.values())))}
    return results_of_study(study, StudyLayout(**layout))


def grid_study(seeds=1, plants=("plain",)):
    """Return a grid over rates, and over plants if there are several; the largest rate fails."""
    rates = np.geomspace(10.0, 1e4, 7)
    numbers = np.arange(seeds * 7 * len(plants))
    rate = rates[numbers // len(plants) % 7]
    columns = {
        RATE: rate,
        SWAP: [plants[number % len(plants)] for number in numbers],
        "rms": pyarrow.array(1.0 / rate + 1e-3 * numbers, mask=rate > 9e3),
        "status": list(np.where(rate > 9e3, "failed", "complete")),
    }
    layout = {"kind": "grid", "seeds": seeds, "grid": 7 * len(plants)}
    return made(columns, [RATE, SWAP], units={RATE: "rad/s", "rms": "m"}, **layout)


RANDOM = tolerances(61)[1]
OF_PLANTS = grid_study(3, ["x/a.fmu", "x/b.fmu"])


@pytest.fixture
def draw(monkeypatch, tmp_path):
    """Return what draws a study: the figure that would be written, and the panels that are seen."""
    from matplotlib.figure import Figure

    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))

    def drawn(results, **options):
        plot_study(results, tmp_path / "a.png", **options)
        figure = figures.pop()
        return figure, [panel for panel in figure.axes if panel.get_visible()]

    return drawn


def words(figure):
    """Return the texts of a figure, each as one line."""
    from matplotlib.text import Text

    return {text.get_text().replace("\n", " ") for text in figure.findobj(Text)}


def named(panel):
    """Return the lines of a panel by their label."""
    return {line.get_label(): line for line in panel.lines}


def check_histogram(panel, values, *_):
    assert sum(bar.get_height() for bar in panel.patches) == len(values)
    assert panel.patches[0].get_x() == pytest.approx(values.min())
    places = [line.get_xdata()[0] for line in panel.lines]
    assert places == pytest.approx([values.mean(), *np.quantile(values, [0.5, 0.05, 0.95])])
    assert [line.get_label() for line in panel.lines[:3]] == ["mean", "median", "5 % and 95 %"]


def check_distribution(panel, values, *_):
    """Half the width of the band of Massart is sqrt(ln(2 / 0.05) / 2 n)."""
    (curve,) = panel.lines
    assert curve.get_xdata().tolist() == [values.min(), *np.sort(values)]
    assert curve.get_ydata() == pytest.approx(np.arange(len(values) + 1) / len(values))
    heights = panel.collections[0].get_paths()[0].vertices[:, 1]
    assert np.abs(heights - np.sqrt(np.log(2 / 0.05) / (2 * len(values)))).min() < 1e-12


def check_convergence(panel, values, *_):
    """Have Student's interval of the mean as a band."""
    counts = np.arange(1, len(values) + 1)
    means, of_all = (named(panel)[name] for name in ("mean of the first", "mean of all"))
    assert means.get_xydata() == pytest.approx(np.stack([counts, np.cumsum(values) / counts], 1))
    assert of_all.get_ydata() == pytest.approx([values.mean()] * 2)
    band = panel.collections[0].get_paths()[0].vertices
    ends = np.sort(band[band[:, 0] == counts[-1], 1])[[0, -1]]
    assert ends == pytest.approx([*stats.ttest_1samp(values, 0.0).confidence_interval()])


def check_line(panel, values, rates, _):
    """Nothing joins members that were drawn."""
    order = np.argsort(rates)
    assert panel.lines[0].get_xydata() == pytest.approx(np.stack([rates, values], 1)[order])
    assert panel.lines[0].get_linestyle() == "None"
    assert not named(panel)["members that failed"].get_clip_on()  # above the frame


def check_map(panel, values, rates, masses):
    (mesh,) = panel.collections
    edges = mesh.get_coordinates()
    bins = [edges[0, :, 0], edges[:, 0, 1]]
    needed = stats.binned_statistic_2d(rates, masses, values, bins=bins).statistic.T
    assert np.ma.filled(mesh.get_array(), np.nan) == pytest.approx(needed, nan_ok=True)


CHECKED = (check_histogram, check_distribution, check_convergence, check_line, check_map)
CHECKS = {check.__name__.removeprefix("check_"): check for check in CHECKED}


@pytest.mark.parametrize("kind", CHECKS)
def test_every_picture_shows_all_members_and_counts_those_it_does_not(kind, draw):
    """Values are those of numpy and scipy; members that failed are marked, or counted."""
    figure, panels = draw(RANDOM, kind=kind)
    for panel, name in zip(panels, ("rms", "settling"), strict=False):
        column = RANDOM.columns.metric(name)
        rows = RANDOM.columns.rows_of(column.numbers)
        keys = [RANDOM.columns.parameters[key][rows] for key in (RATE, MASS)]
        CHECKS[kind](panel, column.values, *keys)
        if kind in ("line", "map"):
            assert len(named(panel)["members that failed"].get_xdata()) == 3
    assert {"56 members, 3 failed, 2 without value", "58 members, 3 failed"} <= words(figure)
    assert any("settling [s]" in text for text in words(figure))


def test_a_scatter_matrix_has_points_histograms_and_rank_correlations(draw):
    """Below the diagonal, on it, and above it those of scipy."""
    figure, panels = draw(RANDOM, kind="scatter")
    title = "tolerances: 61 members, 3 failed, rank correlations above the diagonal"
    assert {title, f"{RATE} [rad/s]", "settling [s]"} <= words(figure)
    matrix = np.reshape(panels, (4, 4))
    counts = [61, 61, 58, 56]  # of both parameters, rms, settling
    for row in range(4):
        assert sum(bar.get_height() for bar in matrix[row, row].patches) == counts[row]
        for column in range(row):
            assert len(matrix[row, column].lines[0].get_xdata()) == counts[row]
        assert not any(panel.lines for panel in matrix[row, row + 1 :])
    assert len(named(matrix[1, 0])["members that failed"].get_xdata()) == 3
    assert [len(panel.lines) for panel in matrix[2, :2]] == [1, 1]
    settling = RANDOM.columns.metric("settling")
    mass = RANDOM.columns.parameters[MASS][RANDOM.columns.rows_of(settling.numbers)]
    expected = stats.spearmanr(mass, settling.values).statistic
    assert [text.get_text() for text in matrix[1, 3].texts] == [f"{expected:+.2f}"]


def test_bars_are_sobol_indices_of_the_closed_form(draw):
    """Of y = 3 p + 2 q: 9/13 and 4/13, the largest first; each has an interval."""
    figure, (panel,) = draw(saltelli()[1])
    bars = [one for one in panel.containers if one.get_label().endswith("order")]
    assert [one.get_label() for one in bars] == ["first order", "total order"]
    for one in bars:
        assert [bar.get_width() for bar in one] == pytest.approx([9 / 13, 4 / 13], abs=0.02)
        assert len(one.errorbar.lines[2][0].get_segments()) == 2
    assert [label.get_text() for label in panel.get_yticklabels()] == ["p", "q"]
    assert panel.yaxis_inverted()
    assert {"255 base points, 1 left out", "share of the variance of y"} <= words(figure)


def test_a_picture_follows_from_the_design(draw):
    """A line of one key, a map of two, else histograms."""
    assert f"tolerances: over {RATE}" in words(draw(grid_study())[0])
    needed = {"a.fmu", "b.fmu", "mean of rms [m]", f"tolerances: over {RATE} and {SWAP}"}
    assert needed <= words(draw(OF_PLANTS)[0])
    assert "tolerances: histograms" in words(draw(made({"rms": [1.0, 2.0]}))[0])


def test_a_second_key_has_a_line_for_each_value(draw):
    """Of one color in all panels; side by side where the first one has names, and not joined."""
    _, (panel,) = draw(OF_PLANTS, kind="line")
    assert {"a.fmu", "b.fmu", "members that failed"} <= set(named(panel))
    assert len(panel.collections) == 2  # bands
    columns = {
        **{"p": ["a", "b"] * 2, "q": [5.0, 5.0, 6.0, 6.0], "rms": [1.0, 2.0, 3.0, 4.0]},
        "last": pyarrow.array([None, None, 3.0, 4.0], "double"),
    }
    study = made(columns, ("p", "q"), ("rms", "last"), units={"q": "kg"}, kind="grid", grid=4)
    figure, (first, second) = draw(study, kind="line")
    assert {"5", "6", "q [kg]"} <= words(figure)
    assert named(second)["6"].get_color() == named(first)["6"].get_color()
    places = [line.get_xdata() for line in first.lines]
    assert places == [pytest.approx([-0.175, 0.825]), pytest.approx([0.175, 1.175])]
    assert {line.get_linestyle() for line in first.lines} == {"None"}
    assert first.get_xlim() == (-0.5, 1.5)


def test_many_values_of_a_key_are_put_together(draw):
    """Medians of bins with 20 members each, cells of grid points; of many failures some marks."""
    key = np.random.default_rng(0).uniform(0.0, 1.0, 400)
    _, (panel,) = draw(made({"p": key, "rms": key}, ("p",)), kind="line")
    median = panel.lines[0]
    assert median.get_xdata() == pytest.approx(np.median(np.sort(key).reshape(20, 20), axis=1))
    assert median.get_ydata() == pytest.approx(median.get_xdata())
    numbers = np.arange(6000)
    columns = {"p": numbers % 3.0, "q": numbers // 3 % 2.0, "rms": np.sqrt(numbers)}
    figure, _ = draw(made(columns, ("p", "q"), kind="grid", seeds=1000, grid=6), kind="scatter")
    assert figure.axes[3].collections[0].get_array().tolist() == [[1000.0] * 3] * 2
    many = tolerances(20_000)[1]
    many.columns.failed[::2] = True
    assert "300 of the 10002 members that failed" in words(draw(many, kind="line")[0])


NONE, HUGE = made({"rms": np.full(3, np.nan)}), made({"rms": np.full(3, 1e305)})
REFUSED = [
    (RANDOM, {"kind": "histgram"}, r"plot kind 'histgram'; did you mean 'histogram'"),
    (RANDOM, {"metrics": ["rsm"]}, r"the study has no metric 'rsm'; did you mean 'rms'"),
    (RANDOM, {"keys": ["plant.mas"]}, r"does not vary 'plant.mas'; did you mean 'plant.mass'"),
    (RANDOM, {"kind": "search"}, r"'search': .*got a planned one"),
    (RANDOM, {"kind": "map", "keys": [MASS]}, r"'map': expected 2 .*got 1 varied key"),
    (NONE, {}, r"no member has a value of any metric"),
    (HUGE, {}, r"rms: 1e\+305 is too large"),
    (grid_study(), {"kind": "convergence"}, r"the mean of 'rms' does not converge"),
    (made({"rms": [0.3]}), {"kind": "scatter"}, r"'scatter': .*at least 2 .*got 1"),
    (RANDOM, {"options": PictureOptions(size=(4.0, 3.0))}, r"size: .*4 x 3 cm"),
]


def test_a_picture_that_cannot_be_drawn_says_why(tmp_path, monkeypatch):
    """Nothing is written; without matplotlib there is none of whatever."""
    for study, options, message in REFUSED:
        with pytest.raises(UsageError, match=message):
            plot_study(study, tmp_path / "a.svg", **options)
    for name in [name for name in sys.modules if name.startswith("matplotlib.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match=r"matplotlib, .*not installed: pip install matplo"):
        plot_study(RANDOM, tmp_path / "a.svg", kind="no kind")
    assert not (tmp_path / "a.svg").exists()


SEARCH = Search("objective", "rms(a.y)", False, "cobyqa", members=9, starts=4, seed=1, keys=())


@pytest.mark.parametrize("maximize", [False, True])
def test_the_picture_of_a_tuning_shows_best_member_and_failures(maximize, draw):
    """The best so far goes from the first value to the last member; other pictures show others."""
    objective = np.array([np.nan, 3.0, 5.0, 2.0, 2.0, 4.0, np.inf])
    columns = {"gain": np.arange(7.0), "objective": objective, "samples": np.full(7, 9.0)}
    columns["status"] = ["failed", *["complete"] * 6]
    study = made(columns, ("gain",), ("objective", "samples"))
    search = replace(SEARCH, maximize=maximize)
    figure, (panel,) = draw(study, search=search)
    best = named(panel)["best so far"]
    of_best = [3, 5, 5, 5, 5, 5] if maximize else [3, 3, 2, 2, 2, 2]
    assert best.get_xydata().tolist() == [[k + 1, value] for k, value in enumerate(of_best)]
    failed = named(panel)["members that failed, or have no finite value"]
    assert failed.get_xdata().tolist() == [0, 6]
    goal = f"tolerances: cobyqa, {'maximize' if maximize else 'minimize'} rms(a.y)"
    number = f"best: member {2 if maximize else 3}"
    shown = {f"{goal}; 7 members of at most 7", "5 members, 1 failed, 1 infinite", number}
    assert shown <= words(figure)
    assert "tolerances: histograms" in words(draw(study, search=search, metrics=["samples"])[0])
    for options in ({"metrics": ["samples"]}, {"keys": ["gain"]}):
        with pytest.raises(UsageError, match=r"'objective' alone, got '(samples|gain)'"):
            draw(study, search=search, kind="search", **options)


@pytest.mark.parametrize("kind", DRAWN)
def test_equal_values_of_any_size_are_drawn(kind, draw):
    """Without a spread there is no width of a bin, a band or an axis; two are always in order."""
    columns = {"p": [1e-12, 2e-12], "q": [3e12, 4e12], "rms": np.full(2, 5.0)}
    figure, panels = draw(made(columns, ("p", "q")), kind=kind)
    assert all(np.ptp(panel.get_xlim()) > 0.0 for panel in panels)
    assert "+1.00" not in words(figure)


def test_an_axis_is_logarithmic_where_values_are_spread_so(draw):
    """Nine of ten over a factor of 10, and more even so; one of a search near zero linearly.

    Values far off are counted, and do not hide the others, and neither does their mean.
    """
    for values, needed in (
        (np.exp(np.random.default_rng(0).uniform(0.0, 6.0, 200)), True),
        (np.array([1.0, *[2.0] * 100, 3.0, 1e6]), False),
        (np.array([10.0, 30.0, 100.0, 300.0]), True),
        (np.linspace(0.1, 10.0, 50), False),
        (np.arange(0.0, 11.0), False),
    ):
        assert is_logarithmic(values) is needed
    for objective, scale in (([1.0, 2.0, -4.0], "linear"), ([-1.0, -10.0, -1e9], "symlog")):
        study = made({"objective": np.array(objective)}, (), ("objective",))
        assert draw(study, search=SEARCH)[1][0].get_yscale() == scale
    values = np.concatenate([np.random.default_rng(0).normal(size=500), [1e9, -1e3]])
    figure, (panel,) = draw(made({"rms": values}))
    assert "502 members, 2 outside of the axis" in words(figure)
    assert named(panel)["mean"].get_xdata()[0] == values.mean() > panel.get_xlim()[1]


def test_names_stand_where_values_are_none_and_cells_hold_their_centers():
    """Of paths the last part, if these differ; in the logarithm where the axis is."""
    scale = Scale.of(np.array(["x/the_pump_of_version_7.fmu", "y/b.fmu", "y/b.fmu"], object))
    assert scale.positions.tolist() == [0.0, 1.0, 1.0]
    assert scale.names == ("the_pump_of_\nversion_7.fmu", "b.fmu")
    assert Scale.of(np.array(["x/a.fmu", "y/a.fmu"], object)).names == ("x/a.fmu", "y/a.fmu")
    assert Scale.of(np.array([[1.0, 2.0], [3.0]], object)).names == ("[1.0, 2.0]", "[3.0]")
    assert len(Scale.of(np.array([*"abcdefgh"], object)).edges(5, 5)) == 9
    assert Scale(np.array([1.0, 2.0, 4.0, np.nan])).edges(5, 5).tolist() == [0.5, 1.5, 3.0, 5.0]
    edges = Scale(np.array([1.0, 100.0, 1e4])).edges(5, 5)
    assert edges == pytest.approx([0.1, 10.0, 1e3, 1e5])


def test_parameters_without_a_number_have_no_place(draw):
    """Cases have empty cells, and infinity."""
    rate, bound = np.geomspace(1.0, 1e3, 12), np.arange(1.0, 13.0)
    rate[2], bound[4] = np.nan, np.inf
    study = made({"rate": rate, "bound": bound, "rms": np.arange(1.0, 13.0)}, ("rate", "bound"))
    figure, (panel,) = draw(study, kind="line")
    note = "; 1 member without a finite rate; 1 member without a finite bound"
    assert f"tolerances: over rate{note}" in words(figure)
    assert panel.lines[0].get_ydata().tolist() == [1, 2, 4, *range(6, 13)]


LONG = "subsystem_of_the_{}_actuator.hydraulic_cylinder.initial_pressure_of_the_chamber"
METRIC = "root_mean_square_of_the_difference_between_estimated_and_true_disturbance"


@pytest.mark.parametrize("kind", ["histogram", "line", "map", "scatter"])
def test_no_text_is_cut_off(kind, draw):
    """Titles, legends and the names of axes are broken into lines that fit."""
    points = np.random.default_rng(3).uniform(1e5, 2e5, (2, 60))
    keys = (LONG.format("left"), LONG.format("right"), SWAP)
    plants = [f"plants/{side}_pump_of_version_2026.fmu" for side in "abc"] * 20
    columns = dict(zip(keys, (points[0], points[1].round(-5), plants), strict=True))
    columns |= {METRIC: points[0] / points[1], "status": ["complete"] * 58 + ["failed"] * 2}
    study = made(columns, keys, (METRIC,), units={keys[0]: "Pa", METRIC: "kg.m2.s-3.A-1"})
    keys = keys[:2] if kind == "line" else keys[1:]
    options = PictureOptions(title="a name as those of large projects are " * 3)
    figure, panels = draw(study, kind=kind, keys=keys, options=options)
    figure.set_dpi(150)  # as it is written
    figure.draw_without_rendering()
    shown = [figure._suptitle, *(text for legend in figure.legends for text in legend.get_texts())]
    for panel in panels:
        shown += [panel.xaxis.label, panel.yaxis.label, panel.title]
    for text in shown:
        if text.get_text():
            (x0, y0), (x1, y1) = text.get_window_extent().get_points()
            assert -2.0 < x0 < x1 < figure.bbox.width + 2.0, text.get_text()
            assert -2.0 < y0 < y1 < figure.bbox.height + 2.0, text.get_text()
