"""Which members a study has."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cosim
from cosim.errors import UsageError, shell_language
from cosim.studies.contracts import StudyMember
from cosim.studies.design import plain_values, plan_design
from cosim.studies.study_file import read_study

EMPTY = read_study("academic-noisy")
SCENARIO = cosim.load("academic-noisy")
THETA = {"delta.terms[0].theta": {"uniform": [-0.2, -0.1]}}
DISTRIBUTIONS = [
    {"log-uniform": [1.0, 1e4]},
    {"normal": [1.0, 0.1]},
    {"normal": [1.0, 0.1], "lower": 0.9},
    {"lognormal": [1.0, 0.1]},
    {"triangular": [0.0, 0.2, 1.0]},
    {"exponential": 2.0},
    {"beta": [2.0, 0.5]},
    {"weibull": [1.0, 2.5]},
    {"choice": ["a", 1, [2.0]], "weights": [1, 2, 3]},
]
RATES = {"observer.filter_rate": [100.0, 300.0, 1000.0], "identifier.method": ["a", "b"]}


def planned(**options):
    return plan_design(EMPTY.with_options(**options), SCENARIO)


def of_swaps(folder, *names):
    paths = []
    for name in names:
        path = folder / name
        path.touch()
        paths.append(str(path))
    return paths


def test_a_study_without_variations_is_one_run():
    """That of its scenario."""
    design = planned()
    assert len(design) == 1
    assert design.kind == "grid"
    assert design.names == ()
    assert design.members() == [StudyMember(0)]


def test_the_first_key_of_a_grid_is_the_slowest():
    """As nested loops have it, in the order of the file."""
    design = planned(vary=RATES)
    expected = list(itertools.product(*RATES.values()))
    assert [tuple(member.set.values()) for member in design.members()] == expected
    assert [member.number for member in design.members()] == list(range(6))
    assert design.column("observer.filter_rate").tolist() == [row[0] for row in expected]
    assert design.column("identifier.method") == [row[1] for row in expected]
    assert design.column("observer.filter_rate", 2, 4).tolist() == [300.0, 300.0]
    assert design.member(3) == StudyMember(
        3, {"observer.filter_rate": 300.0, "identifier.method": "b"}
    )


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
    vary = {key: list(map(float, range(1, n + 1))) for key, n in zip(keys, counts, strict=False)}
    options = {"vary": vary}
    if samples:
        options["vary"] = {**vary, **THETA}
        options |= {"samples": samples, "sampling": sampling}
    if seeds:
        options["seeds"] = seeds
    design = planned(**options)
    members = design.members()
    assert len(design) == max(1, samples) * max(1, seeds) * int(np.prod(counts))
    grid = list(itertools.product(*vary.values()))
    thetas, noises = {}, {}
    numbers = itertools.product(range(max(1, samples)), range(max(1, seeds)), range(len(grid)))
    for member, (sample, seed, point) in zip(members, numbers, strict=True):
        values = dict(member.set)
        if samples:
            theta = values.pop("delta.terms[0].theta")
            assert thetas.setdefault(sample, theta) == theta
        if seeds:
            noise = values.pop("sensor.seed")
            assert noises.setdefault((sample, seed), noise) == noise
        assert tuple(values.values()) == grid[point]
    assert len(set(noises.values())) == len(noises)
    for begin, end in itertools.combinations(range(0, len(design) + 1, 5), 2):
        assert design.members(begin, end) == members[begin:end]
        for name in design.names:
            part = plain_values(design.column(name, begin, end))
            assert part == [member.set[name] for member in members[begin:end]]


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(["random", "sobol"]), st.integers(1, 50), st.integers(1, 50))
def test_a_study_of_more_samples_begins_with_the_same_members(sampling, samples, more):
    """Of every distribution, to the bit; their seeds, too; the grid beside them stays the same."""
    vary = {f"x.{number}": table for number, table in enumerate(DISTRIBUTIONS)}
    vary |= {**THETA, "plant.x_a0[0]": {"tolerance": 0.1}, "u.rate": [1.0, 2.0]}
    common = {"vary": vary, "sampling": sampling, "seeds": 2, "seed": 9}
    few = planned(**common, samples=samples)
    many = planned(**common, samples=samples + more)
    assert few.members() == many.members(0, len(few))


def test_more_samples_than_are_computed_at_a_time_begin_with_the_same_ones():
    """They are computed in blocks."""
    vary = {f"x.{number}": table for number, table in enumerate(DISTRIBUTIONS)}
    few = planned(vary=vary, samples=1001)
    many = planned(vary=vary, samples=2**16 + 7)
    assert few.members() == many.members(0, 1001)
    part = many.column("x.3", 2**16 - 5, 2**16 + 7)
    assert (part == many.column("x.3")[2**16 - 5 :]).all()
    assert len(set(many.column("x.3").tolist())) == len(many)


def test_more_seeds_of_a_grid_come_behind_it():
    """Where there are no samples; and so do values of the first key."""
    few = planned(vary=RATES, seeds=2)
    more = planned(vary=RATES, seeds=5)
    assert more.members(0, len(few)) == few.members()
    longer = {**RATES, "observer.filter_rate": [100.0, 300.0, 1000.0, 3000.0]}
    assert planned(vary=longer).members(0, 6) == planned(vary=RATES).members()


def test_seeds_are_of_a_source_and_a_study(tmp_path):
    """Below 2**53, others for another seed of the study, and the same in every case."""
    seeds = planned(seeds=1000).column("sensor.seed")
    assert len(set(seeds.tolist())) == 1000
    assert seeds.min() >= 0
    assert seeds.max() < 2**53
    other = planned(seeds=1000, seed=1).column("sensor.seed")
    assert not (seeds == other).any()
    path = tmp_path / "cases.csv"
    path.write_text("u.rate\n1.0\n2.0\n")
    cases = planned(cases=path, seeds=3).column("sensor.seed")
    assert cases.tolist() == seeds[:3].tolist() * 2


def test_every_source_of_noise_gets_a_seed_of_its_own(tmp_path):
    """Sensors and noisy actions; not what is swapped, nor in a replay what was recorded."""
    path = tmp_path / "mine.toml"
    path.write_text(
        SCENARIO.document.text + '[components.other]\nkind = "noise"\ndeviation = 1.0\nseed = 3\n'
        "[[actions]]\nat = 1.0\nsignal = 'plant.u'\nnoise = 0.1\n"
        "[[actions]]\nat = 2.0\nsignal = 'plant.u'\ndrop = 0.1\n"
        "[[actions]]\nat = 3.0\nsignal = 'plant.u'\ndrop = true\n"
    )
    study = read_study(path)
    scenario = cosim.load(path)
    design = plan_design(study.with_options(seeds=4), scenario)
    assert design.names == ("sensor.seed", "other.seed", "actions.0.seed", "actions.1.seed")
    columns = [design.column(name).tolist() for name in design.names]
    assert len({seed for column in columns for seed in column}) == 16
    swapped = study.with_options(seeds=4, vary={"swap.other": of_swaps(tmp_path, "a.csv")})
    assert "other.seed" not in plan_design(swapped, scenario).names
    (log,) = of_swaps(tmp_path, "a.mcap")
    replays = plan_design(study.with_options(seeds=4, replay=log), scenario)
    assert replays.names == ("recording", "sensor.seed", "other.seed")


def test_saltelli_has_d_plus_two_blocks_with_the_same_noise():
    """Of n members each; the noise of a row is that of its block-mates."""
    vary = {**THETA, "plant.x_a0[0]": {"normal": [1.0, 0.1]}}
    design = planned(vary=vary, sampling="saltelli", samples=8, seeds=2)
    assert design.kind == "saltelli"
    assert design.sampled == tuple(vary)
    assert len(design) == 4 * 8 * 2
    theta = design.column("delta.terms[0].theta").reshape(4, 8, 2)
    assert (theta[:, :, 0] == theta[:, :, 1]).all()
    assert (theta[2, :, 0] == theta[1, :, 0]).all(), "AB_1 has its first column from B"
    assert (theta[3, :, 0] == theta[0, :, 0]).all()
    seeds = design.column("sensor.seed").reshape(4, 16)
    assert (seeds == seeds[0]).all()
    assert len(set(seeds[0].tolist())) == 16


def test_cases_are_members_in_the_order_of_their_rows(tmp_path):
    """An empty cell leaves the scenario's own value; a grid is beside each."""
    path = tmp_path / "cases.csv"
    path.write_text('observer.filter_rate,plant.x_a0\n100.0,\n,"[0.0, 1.0]"\n')
    design = planned(cases=path, vary={"u.rate": [1.0, 2.0]})
    assert design.kind == "cases"
    assert [dict(member.set) for member in design.members()] == [
        {"u.rate": 1.0, "observer.filter_rate": 100.0},
        {"u.rate": 2.0, "observer.filter_rate": 100.0},
        {"u.rate": 1.0, "plant.x_a0": [0.0, 1.0]},
        {"u.rate": 2.0, "plant.x_a0": [0.0, 1.0]},
    ]
    assert design.column("observer.filter_rate") == [100.0, 100.0, None, None]


def test_a_column_of_no_component_is_named(tmp_path):
    """Such as one of comments."""
    path = tmp_path / "cases.csv"
    path.write_text("observer.filter_rate,note\n100.0,good\n")
    text = r"cases\.csv', column 'note': no component 'note' to swap, and keys have a dot"
    with pytest.raises(UsageError, match=text):
        planned(cases=path)


def test_swaps_and_recordings_are_varied(tmp_path):
    """Recordings are the slowest of a grid, and sorted."""
    plants = of_swaps(tmp_path, "b.fmu", "a.fmu")
    logs = of_swaps(tmp_path, "field-2.mcap", "field-1.mcap", "odd[1].mcap")
    design = planned(
        vary={"plant": plants, "u.rate": [1.0, 2.0]},
        replay=[str(tmp_path / "field-*.mcap"), logs[2], logs[1]],
    )
    assert design.names == ("recording", "swap.plant", "u.rate")
    assert len(design) == 12
    assert design.column("recording")[::4] == [logs[1], logs[0], logs[2]]
    assert design.member(6) == StudyMember(6, {"u.rate": 1.0}, {"plant": plants[1]}, logs[0])


def test_a_tolerance_is_relative_to_the_own_value(tmp_path):
    """Of the file, of an element, of a model, of a default, of what all members have."""
    path = tmp_path / "mine.toml"
    text = SCENARIO.document.text + '[components.jump]\nkind = "step"\ntime = 5.0\n'
    path.write_text(text)
    own_values = {
        "delta.terms[1].theta": -0.3,
        "plant.x_a0[1]": 8.0,
        "models.academic.A[1][1]": -2.0,
        "sensor.noise": 1e-3,
        "scenario.stop": 40.0,
        "jump.after": 1.0,
    }
    study = read_study(path).with_options(
        vary={key: {"tolerance": 0.1} for key in own_values},
        set={"plant.x_a0": [0.0, 8.0]},
        samples=200,
        sampling="latin-hypercube",
    )
    design = plan_design(study, cosim.load(path))
    assert design.names == tuple(own_values)
    for name, own in own_values.items():
        values = design.column(name)
        # Of 200 parts of the interval the outermost two have a point each.
        assert values.min() == pytest.approx(own - 0.1 * abs(own), rel=2e-3)
        assert values.max() == pytest.approx(own + 0.1 * abs(own), rel=2e-3)


def test_a_normal_tolerance_is_cut_at_it():
    """Its deviation is a third of it: 68.3 % of 99.7 % are within a third."""
    vary = {"plant.x_a0[0]": {"tolerance": 0.3, "distribution": "normal"}}
    values = planned(vary=vary, samples=4096, sampling="sobol").column("plant.x_a0[0]")
    assert np.abs(values - 1.0).max() <= 0.3
    assert np.mean(np.abs(values - 1.0) < 0.1) == pytest.approx(0.6827 / 0.9973, abs=2e-3)


def test_a_choice_is_drawn(tmp_path):
    """Also of swaps."""
    plants = of_swaps(tmp_path, "a.fmu", "b.fmu")
    vary = {
        "swap.plant": {"choice": plants, "weights": [1, 3]},
        "sensor.noise": {"choice": [1e-3, 2e-3]},
        "u.kind": {"choice": ["sine"]},
    }
    design = planned(vary=vary, samples=1024, sampling="sobol")
    found = design.column("swap.plant")
    assert found.count(plants[0]) == 256
    assert design.column("sensor.noise").tolist().count(1e-3) == 512
    assert design.column("u.kind") == ["sine"] * 1024
    assert design.member(1023).swap == {"plant": found[1023]}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"vary": THETA},
            r"--samples: .*'delta.terms\[0\].theta'.*got none",
        ),
        (
            {"samples": 10},
            "--samples: nothing is drawn: no key has a distribution, such as { uniform = .*; the "
            "runs of a noise source are --seeds N",
        ),
        ({"sampling": "sobol"}, "--sampling: nothing is drawn: no key has a distribution"),
        (
            {"vary": THETA, "samples": 2, "cases": "x.csv"},
            r"--cases or distributions \('delta.terms\[0\].theta'\)",
        ),
        ({"cases": "x.csv"}, r"file '.*x.csv' cannot be read"),
        ({"replay": "field-*.mcap"}, r"--replay: no file matches '.*field-\*.mcap'"),
        ({"replay": __file__}, r"--replay: .*: expected a log"),
        (
            {"vary": {**THETA, "delta.terms": [[]]}, "samples": 2},
            r"'delta.terms' and 'delta.terms\[0\].theta'",
        ),
        (
            {"vary": {"plant.x_a0": [[0.0, 1.0]]}, "set": {"plant.x_a0[1]": 1.0}},
            r"'plant.x_a0' and 'plant.x_a0\[1\]', got both, varied and set",
        ),
        (
            {"vary": {"sensor.seed": [1, 2]}, "seeds": 2},
            "'sensor.seed' and 'sensor.seed'",
        ),
        (
            {"vary": {"u.rate": {"linear": [1.0, 2.0], "points": 100_000}}, "seeds": 20_000},
            "20000000 members, got 20000 x 100000 = 2000000000",
        ),
        (
            {"vary": {"plant.x_a0": {"tolerance": 0.1}}, "samples": 2},
            r"--vary plant.x_a0: a tolerance is relative to a number; got \[1.0, -1.0\]; name an "
            r"element: plant.x_a0\[0\]",
        ),
        (
            {"vary": {"observer.x_a0[0]": {"tolerance": 0.1}}, "samples": 2},
            "--vary observer.x_a0.0.: a tolerance is relative to the scenario's own value, which "
            "is 0; .*another distribution",
        ),
        (
            {"vary": {"plant.x0": {"tolerance": 0.1}}, "samples": 2},
            "--vary plant.x0: the scenario sets no value that the tolerance could be relative",
        ),
        (
            {"vary": {"u.rate": {"lognormal": [1.0, 1e3]}}, "samples": 20},
            r"--vary u.rate: lognormal of \[1.0, 1000.0\] gives inf",
        ),
    ],
)
def test_options_that_exclude_each_other_are_refused(options, message):
    """One sentence each, in the language of the caller."""
    with shell_language(), pytest.raises(UsageError, match=message):
        planned(**options)


def test_seeds_need_a_source_of_noise():
    """Else all members would be the same."""
    study = read_study("academic").with_options(seeds=3)
    with pytest.raises(UsageError, match="seeds: nothing in the scenario has a seed"):
        plan_design(study, cosim.load("academic"))


def test_a_member_that_is_not_there_is_refused():
    """By its number."""
    with pytest.raises(UsageError, match="no member 6; the study has 6"):
        planned(vary=RATES).member(6)


def test_a_million_members_are_columns():
    """8 bytes a number for what is drawn, and nothing for the grid, the seeds and the members."""
    import tracemalloc

    planned(vary=THETA, samples=2)  # imports
    tracemalloc.start()
    design = planned(
        vary={**THETA, "plant.x_a0[0]": {"uniform": [0.0, 1.0]}, "u.rate": [1.0, 2.0, 3.0]},
        samples=1_000_000,
        seeds=5,
    )
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(design) == 15_000_000
    assert kept < 2 * 8 * 1_000_000 + 2**20
    assert peak < 8 * 8 * 1_000_000
    assert design.member(14_999_999).set["u.rate"] == 3.0
