"""Which members a study has, and points of the unit cube."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

import cosim
from cosim.errors import UsageError, shell_language
from cosim.studies.contracts import StudyMember
from cosim.studies.design import plan_design, unit_points
from cosim.studies.study_file import StudyOptions, read_study

EMPTY = read_study("academic-noisy")
SCENARIO = cosim.load("academic-noisy")
X_A0 = "plant.x_a0"
KEY = "delta.terms[0].theta"
THETA = {KEY: {"uniform": [-0.2, -0.1]}}
GRID = ("observer.filter_rate", "u.rate")


def planned(**options):
    return plan_design(EMPTY.with_options(StudyOptions(**options)), SCENARIO)


def files(folder, *names):
    for name in names:
        (folder / name).touch()
    return [str(folder / name) for name in names]


@given(st.tuples(*[st.integers(1, 3)] * 4), st.sampled_from(["random", "sobol"]))
def test_members_are_numbered_by_sample_seed_and_grid(shape, sampling):
    """The last key of the grid is the fastest; each sample and seed has its own noise."""
    samples, seeds, *counts = shape
    vary = {key: np.linspace(1.0, 2.0, count) for key, count in zip(GRID, counts, strict=True)}
    design = planned(vary=vary | THETA, samples=samples, seeds=seeds, sampling=sampling)
    rate, u_rate, theta, noise = (design.column(name).reshape(shape) for name in design.columns)
    assert (rate == vary[GRID[0]][:, np.newaxis]).all()
    assert (u_rate == vary[GRID[1]]).all()
    assert (theta == theta[:, :1, :1, :1]).all()
    assert (noise == noise[:, :, :1, :1]).all()
    assert (len(np.unique(theta)), len(np.unique(noise))) == (samples, samples * seeds)
    members = design.members()
    for number, member in enumerate(members):
        values = {name: design.column(name)[number] for name in design.columns}
        assert member == design.member(number) == StudyMember(number, values)
    assert design.members(1, 5) == members[1:5]


def test_every_source_of_noise_gets_a_seed_of_its_own(tmp_path):
    """Sensors and noisy actions; not what is swapped, nor in a replay what was recorded."""
    path = tmp_path / "mine.toml"
    actions = "actions = [{{ {0}, noise = 0.1 }}, {{ {0}, drop = 0.1 }}, {{ {0}, drop = true }}]\n"
    other = '[components.other]\nkind = "noise"\ndeviation = 1.0\nseed = 3\n'
    at = "at = 1.0, signal = 'plant.u'"
    path.write_text(actions.format(at) + SCENARIO.document.text + other)
    study, scenario = read_study(path).with_options(StudyOptions(seeds=4)), cosim.load(path)
    design = plan_design(study, scenario)
    assert [*design.columns] == ["sensor.seed", "other.seed", "actions.0.seed", "actions.1.seed"]
    seeds = {seed for name in design.columns for seed in design.column(name).tolist()}
    assert len(seeds) == 16
    assert 0 <= min(seeds) <= max(seeds) < 2**53
    swapped = study.with_options(StudyOptions(vary={"swap.other": files(tmp_path, "a.csv")}))
    assert "other.seed" not in plan_design(swapped, scenario).columns
    replays = plan_design(
        study.with_options(StudyOptions(replay=files(tmp_path, "a.mcap"))), scenario
    )
    assert [*replays.columns] == ["recording", "sensor.seed", "other.seed"]


def test_saltelli_has_d_plus_two_blocks_with_the_same_noise():
    """A, B, and A with each of its columns from B; their rows have the same noise."""
    vary = {**THETA, f"{X_A0}[0]": {"normal": [1.0, 0.1]}}
    design = planned(vary=vary, sampling="saltelli", samples=8, seeds=2)
    a, b, a_with_first, a_with_second = design.column(KEY).reshape(4, 8, 2)
    assert (a[:, 0] == a[:, 1]).all()
    assert (a != b).all()
    assert (a_with_first == b).all()
    assert (a_with_second == a).all()
    seeds = design.column("sensor.seed")
    assert seeds.tolist() == [*dict.fromkeys(seeds[:16].tolist())] * 4


def test_cases_are_members_in_the_order_of_their_rows(tmp_path):
    """An empty cell leaves the scenario's own value; a grid and the same seeds are beside each."""
    path = tmp_path / "cases.csv"
    path.write_text('observer.filter_rate,plant.x_a0\n100.0,\n,"[0.0, 1.0]"\n')
    design = planned(cases=path, vary={"u.rate": [1.0, 2.0]})
    rows = {"observer.filter_rate": 100.0}, {"plant.x_a0": [0.0, 1.0]}
    expected = [{"u.rate": rate, **row} for row in rows for rate in (1.0, 2.0)]
    assert [dict(member.set) for member in design.members()] == expected
    assert design.column("observer.filter_rate").tolist() == [100.0, 100.0, None, None]
    seeds, others = (planned(cases=path, seeds=9, seed=n).column("sensor.seed") for n in (0, 1))
    assert seeds.tolist() == planned(seeds=9).column("sensor.seed").tolist() * 2
    assert not (seeds == others).any()


def test_swaps_and_recordings_are_varied(tmp_path):
    """Recordings are the slowest of a grid, and sorted."""
    plants = files(tmp_path, "b.fmu", "a.fmu")
    logs = files(tmp_path, "field-2.mcap", "field-1.mcap", "odd[1].mcap")
    replay = [str(tmp_path / "field-*.mcap"), logs[2], logs[1]]
    design = planned(vary={"plant": plants, "u.rate": [1.0, 2.0]}, replay=replay)
    assert [*design.columns] == ["recording", "swap.plant", "u.rate"]
    assert design.column("recording")[::4].tolist() == [logs[1], logs[0], logs[2]]
    assert design.member(6) == StudyMember(6, {"u.rate": 1.0}, {"plant": plants[1]}, logs[0])


def test_draws_are_of_their_tolerance_or_choice(tmp_path):
    """The scenario's own value is of the file, an element, a model, a default, or set for all."""
    path = tmp_path / "mine.toml"
    path.write_text(SCENARIO.document.text + '[components.jump]\nkind = "step"\ntime = 5.0\n')
    own = {"delta.terms[1].theta": -0.3, f"{X_A0}[1]": 8.0, "models.academic.A[1][1]": -2.0}
    own |= {"scenario.stop": 40.0, "jump.after": 1.0}
    study = read_study(path).with_options(
        StudyOptions(
            vary={key: {"tolerance": 0.1} for key in own}
            | {"identifier.method": {"choice": ["a", 1]}},
            set={X_A0: [0.0, 8.0]},
            samples=200,
            sampling="latin-hypercube",
        )
    )
    design = plan_design(study, cosim.load(path))
    for name, value in own.items():
        found, width = design.column(name), 0.1 * abs(value)
        # Of 200 parts of the interval the outermost two have a point each.
        assert [found.min(), found.max()] == pytest.approx([value - width, value + width], rel=2e-3)
    assert [*map(design.column("identifier.method").tolist().count, ("a", 1))] == [100, 100]


@pytest.mark.parametrize(
    ("vary", "options", "message"),
    [
        (THETA, {}, rf"--samples: .*{KEY[:11]}"),
        ({}, {"replay": "field-*.mcap"}, r"--replay\b.*'.*field-\*.mcap'"),
        ({X_A0: [[0.0]]}, {"set": {f"{X_A0}[1]": 1.0}}, rf"'{X_A0}' .*'{X_A0}\[1\]' .*set"),
        ({"sensor.seed": [1, 2]}, {"seeds": 2}, r"'sensor.seed' .*varied.*seeds"),
        ({"u.rate": {"linear": [1, 2], "points": 100_000}}, {"seeds": 20_000}, "20000 x 100000 ="),
        (THETA, {"sampling": "saltelli", "samples": 100}, "--samples: .*100; .*64 or 128"),
        ({X_A0: {"tolerance": 0.1}}, {"samples": 2}, rf"--vary {X_A0}: .*{X_A0}\[0\]"),
        ({"observer.x_a0[0]": {"tolerance": 0.1}}, {"samples": 2}, "--vary observer.x_a0.* is 0"),
        ({"u.rate": {"lognormal": [1.0, 1e3]}}, {"samples": 20}, "--vary u.rate: lognormal .* inf"),
    ],
)
def test_options_that_exclude_each_other_are_refused(vary, options, message):
    """In the language of the caller."""
    with shell_language(), pytest.raises(UsageError, match=message):
        planned(vary=vary, **options)


def test_many_members_are_columns():
    """8 bytes a number for what is drawn and for seeds, nothing for the grid and the members."""
    planned(vary=THETA, samples=2)  # imports
    vary = {**THETA, f"{X_A0}[0]": {"uniform": [0.0, 1.0]}, "u.rate": [1.0, 2.0, 3.0]}
    tracemalloc.start()
    design = planned(vary=vary, samples=200_000, seeds=5)
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(design) == 3_000_000
    assert kept < (2 + 5) * 8 * 200_000 + 2**20
    assert peak < (2 + 2 * 5 + 3) * 8 * 200_000


# --- points of the unit cube ---

KEYS = ("a.x", "b.y[0]", "c.z")
METHODS = ("random", "latin-hypercube", "sobol", "saltelli")


@pytest.mark.parametrize("method", METHODS)
def test_points_follow_from_the_seed_alone(method):
    """They are inside of the cube, and of another size others only where they must be."""
    points, again = (unit_points(method, KEYS, 64, seed=5) for _ in range(2))
    assert (points == again).all()
    assert not (points == unit_points(method, KEYS, 64, seed=6)).any()
    assert 0.0 < points.min() < points.max() < 1.0
    more = unit_points(method, KEYS, 128, seed=5)[:, :64]  # of Saltelli's, its first matrix
    assert (more == points[:, :64]).all() == (method != "latin-hypercube")


@pytest.mark.parametrize("method", METHODS[:3])
def test_points_are_uniform_and_uncorrelated(method):
    """A Kolmogorov-Smirnov test of each key, and correlations within 5/sqrt(n).

    But for random ones, each of n parts of an axis has one point: 2**m points of a Sobol sequence
    are a (t, m, s)-net, whose projections are (0, m, 1).
    """
    points = unit_points(method, KEYS, 4096, seed=3)
    assert min(stats.kstest(column, "uniform").pvalue for column in points) > 1e-4
    assert np.abs(np.corrcoef(points) - np.eye(3)).max() < 5 / 64
    few = unit_points(method, KEYS, 50, seed=3)
    assert (few == points[:, :50]).all() == (method != "latin-hypercube")
    alone = unit_points(method, KEYS[2:], 4096, seed=3)[0]
    assert (alone == points[2]).all() == (method == "random"), "a key has a stream of its own"
    for n in (2, 16, 1024) if method != "random" else ():
        parts = np.sort(np.floor(unit_points(method, KEYS, n, seed=2) * n))
        assert (parts == np.arange(n)).all()
