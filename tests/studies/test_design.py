"""Which members a study has, and points of the unit cube."""

import itertools
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import cosim
from cosim.errors import UsageError, shell_language
from cosim.studies.contracts import StudyMember
from cosim.studies.design import plan_design, unit_points
from cosim.studies.study_file import read_study

EMPTY = read_study("academic-noisy")
SCENARIO = cosim.load("academic-noisy")
KEY = "delta.terms[0].theta"
THETA = {KEY: {"uniform": [-0.2, -0.1]}}
CHOICE = {"choice": ["a", 1, [2.0]], "weights": [1, 2, 3]}
CUT_NORMAL = {"normal": [1.0, 0.1], "lower": 0.9}
ALL = {"x.1": {"weibull": [1.0, 2.5]}, "x.2": CUT_NORMAL, "x.3": CHOICE, "x.4": {"beta": [2, 1]}}
RATES = {"observer.filter_rate": [100.0, 300.0, 1000.0], "identifier.method": ["a", "b"]}


def planned(**options):
    return plan_design(EMPTY.with_options(**options), SCENARIO)


def files(folder, *names):
    for name in names:
        (folder / name).touch()
    return [str(folder / name) for name in names]


def test_the_first_key_of_a_grid_is_the_slowest():
    """As nested loops have it, in the order of the file; without keys there is one run."""
    assert planned().members() == [StudyMember(0)]
    design = planned(vary=RATES)
    expected = list(itertools.product(*RATES.values()))
    assert [tuple(member.set.values()) for member in design.members()] == expected
    assert [member.number for member in design.members()] == list(range(6))
    assert design.member(3) == StudyMember(3, dict(zip(RATES, expected[3], strict=True)))


@settings(max_examples=40, deadline=None)
@given(
    counts=st.lists(st.integers(1, 3), max_size=2),
    samples=st.integers(0, 4),
    seeds=st.integers(0, 3),
    sampling=st.sampled_from(["random", "sobol", "latin-hypercube"]),
)
def test_members_are_numbered_by_sample_seed_and_grid(counts, samples, seeds, sampling):
    """((sample) * seeds + seed) * grid + index, whatever part of the members is asked for."""
    keys = ["observer.filter_rate", "u.rate"]
    grid = {key: list(map(float, range(1, n + 1))) for key, n in zip(keys, counts, strict=False)}
    options = {"vary": grid, "seeds": seeds or None}
    if samples:
        options |= {"vary": {**grid, **THETA}, "samples": samples, "sampling": sampling}
    design = planned(**options)
    members = design.members()
    points = list(itertools.product(*grid.values()))
    places = list(itertools.product(range(max(1, samples)), range(max(1, seeds)), points))
    thetas, noises = {}, {}
    for member, (sample, seed, point) in zip(members, places, strict=True):
        values = dict(member.set)
        theta, noise = values.pop(KEY, None), values.pop("sensor.seed", None)
        assert (theta is not None, noise is not None) == (samples > 0, seeds > 0)
        assert thetas.setdefault(sample, theta) == theta
        assert noises.setdefault((sample, seed), noise) == noise
        assert tuple(values.values()) == point
    assert len(set(noises.values())) == len(noises) or not seeds
    for begin, end in itertools.combinations(range(0, len(design) + 1, 5), 2):
        assert design.members(begin, end) == members[begin:end]
        for name in design.columns:
            part = design.column(name, begin, end).tolist()
            assert part == [member.set[name] for member in members[begin:end]]


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(["random", "sobol"]), st.integers(1, 50), st.integers(1, 50))
def test_a_study_of_more_samples_begins_with_the_same_members(sampling, samples, more):
    """Of every distribution, to the bit; their seeds, too; the grid beside them stays the same."""
    vary = {**ALL, **THETA, "plant.x_a0[0]": {"tolerance": 0.1}, "u.rate": [1.0, 2.0]}
    few = planned(vary=vary, sampling=sampling, seeds=2, seed=9, samples=samples)
    many = planned(vary=vary, sampling=sampling, seeds=2, seed=9, samples=samples + more)
    assert few.members() == many.members(0, len(few))
    few, many = planned(vary=RATES, seeds=2), planned(vary=RATES, seeds=2 + more)
    assert few.members() == many.members(0, len(few))


def test_seeds_are_of_a_source_and_a_study(tmp_path):
    """Below 2**53, others for another seed of the study, and the same in every case."""
    seeds = planned(seeds=1000).column("sensor.seed")
    assert len(set(seeds.tolist())) == 1000
    assert 0 <= seeds.min() <= seeds.max() < 2**53
    assert not (planned(seeds=1000, seed=1).column("sensor.seed") == seeds).any()
    path = tmp_path / "cases.csv"
    path.write_text("u.rate\n1.0\n2.0\n")
    cases = planned(cases=path, seeds=3).column("sensor.seed")
    assert cases.tolist() == seeds[:3].tolist() * 2
    study = read_study("academic").with_options(seeds=3)
    with pytest.raises(UsageError, match="seeds: nothing in the scenario has a seed"):
        plan_design(study, cosim.load("academic"))


def test_every_source_of_noise_gets_a_seed_of_its_own(tmp_path):
    """Sensors and noisy actions; not what is swapped, nor in a replay what was recorded."""
    path = tmp_path / "mine.toml"
    actions = "".join(
        f"[[actions]]\nat = 1.0\nsignal = 'plant.u'\n{what}\n"
        for what in ("noise = 0.1", "drop = 0.1", "drop = true")
    )
    other = '[components.other]\nkind = "noise"\ndeviation = 1.0\nseed = 3\n'
    path.write_text(SCENARIO.document.text + other + actions)
    study, scenario = read_study(path).with_options(seeds=4), cosim.load(path)
    design = plan_design(study, scenario)
    assert [*design.columns] == ["sensor.seed", "other.seed", "actions.0.seed", "actions.1.seed"]
    columns = [design.column(name).tolist() for name in design.columns]
    assert len({seed for column in columns for seed in column}) == 16
    swapped = study.with_options(vary={"swap.other": files(tmp_path, "a.csv")})
    assert "other.seed" not in plan_design(swapped, scenario).columns
    replays = plan_design(study.with_options(replay=files(tmp_path, "a.mcap")), scenario)
    assert [*replays.columns] == ["recording", "sensor.seed", "other.seed"]


def test_saltelli_has_d_plus_two_blocks_with_the_same_noise():
    """A, B, and A with each of its columns from B; their rows have the same noise."""
    vary = {**THETA, "plant.x_a0[0]": {"normal": [1.0, 0.1]}}
    design = planned(vary=vary, sampling="saltelli", samples=8, seeds=2)
    assert (design.layout.kind, design.layout.parameters) == ("saltelli", tuple(vary))
    a, b, a_with_first, a_with_second = design.column(KEY).reshape(4, 8, 2)
    assert (a[:, 0] == a[:, 1]).all()
    assert (a_with_first == b).all()
    assert (a_with_second == a).all()
    seeds = design.column("sensor.seed").reshape(4, 16)
    assert (seeds == seeds[0]).all()
    assert len(set(seeds[0].tolist())) == 16


def test_cases_are_members_in_the_order_of_their_rows(tmp_path):
    """An empty cell leaves the scenario's own value; a grid is beside each."""
    path = tmp_path / "cases.csv"
    path.write_text('observer.filter_rate,plant.x_a0\n100.0,\n,"[0.0, 1.0]"\n')
    design = planned(cases=path, vary={"u.rate": [1.0, 2.0]})
    assert [dict(member.set) for member in design.members()] == [
        {"u.rate": 1.0, "observer.filter_rate": 100.0},
        {"u.rate": 2.0, "observer.filter_rate": 100.0},
        {"u.rate": 1.0, "plant.x_a0": [0.0, 1.0]},
        {"u.rate": 2.0, "plant.x_a0": [0.0, 1.0]},
    ]
    assert design.column("observer.filter_rate").tolist() == [100.0, 100.0, None, None]


def test_swaps_and_recordings_are_varied(tmp_path):
    """Recordings are the slowest of a grid, and sorted."""
    plants = files(tmp_path, "b.fmu", "a.fmu")
    logs = files(tmp_path, "field-2.mcap", "field-1.mcap", "odd[1].mcap")
    replay = [str(tmp_path / "field-*.mcap"), logs[2], logs[1]]
    design = planned(vary={"plant": plants, "u.rate": [1.0, 2.0]}, replay=replay)
    assert [*design.columns] == ["recording", "swap.plant", "u.rate"]
    assert design.column("recording")[::4].tolist() == [logs[1], logs[0], logs[2]]
    assert design.member(6) == StudyMember(6, {"u.rate": 1.0}, {"plant": plants[1]}, logs[0])


def test_a_tolerance_is_relative_to_the_own_value(tmp_path):
    """Of the file, of an element, of a model, of a default, of what all members have."""
    path = tmp_path / "mine.toml"
    path.write_text(SCENARIO.document.text + '[components.jump]\nkind = "step"\ntime = 5.0\n')
    own = {"delta.terms[1].theta": -0.3, "plant.x_a0[1]": 8.0, "models.academic.A[1][1]": -2.0}
    own |= {"scenario.stop": 40.0, "jump.after": 1.0}
    vary = {key: {"tolerance": 0.1} for key in own}
    study = read_study(path).with_options(vary=vary, set={"plant.x_a0": [0.0, 8.0]})
    study = study.with_options(samples=200, sampling="latin-hypercube")
    design = plan_design(study, cosim.load(path))
    for name, value in own.items():
        found, width = design.column(name), 0.1 * abs(value)
        # Of 200 parts of the interval the outermost two have a point each.
        assert [found.min(), found.max()] == pytest.approx([value - width, value + width], rel=2e-3)


X_A0 = "plant.x_a0"


@pytest.mark.parametrize(
    ("vary", "options", "message"),
    [
        (THETA, {}, rf"--samples: .*{KEY[:11]}"),
        ({}, {"samples": 10}, "--samples: .*--seeds"),
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


def test_a_million_members_are_columns():
    """8 bytes a number for what is drawn and for seeds, nothing for the grid and the members."""
    planned(vary=THETA, samples=2)  # imports
    vary = {**THETA, "plant.x_a0[0]": {"uniform": [0.0, 1.0]}, "u.rate": [1.0, 2.0, 3.0]}
    tracemalloc.start()
    design = planned(vary=vary, samples=1_000_000, seeds=5)
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert kept < (2 + 5) * 8 * 1_000_000 + 2**20
    assert peak < (2 + 2 * 5 + 3) * 8 * 1_000_000
    assert design.member(14_999_999).set["u.rate"] == 3.0


# --- points of the unit cube ---

KEYS = ("a.x", "b.y[0]", "c.z")
METHODS = ("random", "latin-hypercube", "sobol", "saltelli")


@pytest.mark.parametrize("method", METHODS)
def test_points_follow_from_the_seed_alone(method):
    """They are the same again, others with another seed, and inside of the cube."""
    points = unit_points(method, KEYS, 64, seed=5)
    assert (points == unit_points(method, KEYS, 64, seed=5)).all()
    assert not (points == unit_points(method, KEYS, 64, seed=6)).any()
    assert 0.0 < points.min() < points.max() < 1.0
    more = unit_points(method, KEYS, 128, seed=5)[:, :64]  # of Saltelli's, its first matrix
    assert (more == points[:, :64]).all() == (method != "latin-hypercube")


@pytest.mark.parametrize("method", METHODS[:3])
def test_points_are_uniform_and_uncorrelated(method):
    """A Kolmogorov-Smirnov test of each key, and correlations within 5/sqrt(n)."""
    points = unit_points(method, KEYS, 4096, seed=3)
    assert min(stats.kstest(column, "uniform").pvalue for column in points) > 1e-4
    assert np.abs(np.corrcoef(points) - np.eye(3)).max() < 5 / 64
    alone = unit_points(method, KEYS[2:], 4096, seed=3)[0]
    assert (alone == points[2]).all() == (method == "random"), "a key has a stream of its own"


@pytest.mark.parametrize("method", METHODS[1:3])
@pytest.mark.parametrize("n", [1, 2, 16, 1024])
def test_each_part_of_an_axis_has_one_point(method, n):
    """2**m points of a Sobol sequence are a (t, m, s)-net, whose projections are (0, m, 1)."""
    for column in unit_points(method, KEYS, n, seed=2):
        assert sorted(np.floor(column * n).astype(int).tolist()) == list(range(n))
