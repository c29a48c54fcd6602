"""What is found wrong with a design before anything runs."""

import re
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.studies.checking import check_design, is_own_code
from cosim.studies.design import plan_design
from cosim.studies.study_file import load_scenario, read_study

EMPTY = read_study("academic-noisy")
SCENARIO = cosim.load("academic-noisy")
RATE, THETA = "observer.filter_rate", "delta.terms[2].theta"
OTHER = {"u.rate": {"uniform": [1.0, 2.0]}}


def check(study=EMPTY, scenario=SCENARIO, **options):
    return check_design(plan_design(study.with_options(**options), scenario), scenario)


def test_values_that_the_scenario_accepts_pass(tmp_path):
    """Grids, samples, seeds, cases with empty cells."""
    path = tmp_path / "cases.csv"
    path.write_text('observer.filter_rate,plant.x_a0\n,\n100.0,\n,"[0.0, 1.0]"\n')
    check(cases=path, seeds=3, vary={"identifier.method": ["output-error", "least-squares"]})
    rates = {"u.rate": {"log": [1.0, 10.0], "points": 5000}}
    check(vary={"delta.terms[0].theta": {"uniform": [-0.2, -0.1]}, **rates}, samples=10)


@pytest.mark.parametrize(
    ("vary", "options", "message"),
    [
        ({"observer.filter_rat": [1.0]}, {}, r"\Aobserver.filter_rat = 1.0: .*'filter_rate'"),
        ({RATE: [1.0, 2.0, "a"]}, {}, f"{RATE} = 'a': .*'a'"),
        ({THETA: {"uniform": [0.0, 1.0]}}, {"samples": 3}, r"theta = 0\..*: .*'2'.* 0 to 1"),
        (
            {RATE: {"normal": [-10.0, 1.0]}},
            {"samples": 100},
            rf"\A{RATE} = -\S+, drawn from normal \[-10.0, 1.0\] for member 0: .*; so are all \d+",
        ),
        ({**OTHER, RATE: {"uniform": [-2.0, -1.0]}}, {"samples": 1}, rf"\A{RATE} = -.* only draw"),
        ({**OTHER, RATE: {"choice": [1.0, -1.0, 2.0]}}, {"samples": 9}, rf"\A{RATE} = -1.0: "),
        ({"observer.L": [[4.0, 0.0], [-50.0, 0.0]]}, {}, r"L = \[-50.0, 0.0\]: .*Hurwitz"),
        ({"plant": ["a.fmu#cs"]}, {}, r"swap.plant = '.*a.fmu#cs': .*no such file"),
        ({"u.rate": [1.0]}, {"swap": {"plant": "a.fmu"}}, r"\Aswap\['plant'\]: .*a.fmu: no such"),
        ({"plnt": ["a.fmu"]}, {}, r"swap\['plnt'\]: .*'plnt'; did you"),
    ],
)
def test_values_that_the_scenario_refuses_are_refused(vary, options, message):
    """The message has the key, the value and the reason."""
    with pytest.raises(UsageError, match=message):
        check(vary=vary, **options)


def test_members_with_refused_draws_will_fail():
    """They are counted, and named with a way out; the first one may be one of them.

    A normal distribution with its mean at its deviation is below 0 in 15.9 % of all draws; where
    exactly one interval of them is refused, the count is exact.
    """
    vary = {
        "u.rate": {"normal": [1.0, 0.1]},
        RATE: {"normal": [10.0, 10.0]},
        "sensor.noise": {"triangular": [-1e-3, 0.0, 2e-3]},
    }
    for seed in range(40):
        study = EMPTY.with_options(vary=vary, samples=60, seeds=2, seed=seed)
        design = plan_design(study, SCENARIO)
        if design.column(RATE)[0] <= 0.0:
            break
    checked = check_design(design, SCENARIO)
    assert checked.member.set[RATE] > 0.0
    notices = {key: text for key, _, text in (notice.partition(": ") for notice in checked.notices)}
    assert notices.keys() == {RATE, "sensor.noise"}
    rates = design.column(RATE)
    assert notices[RATE].startswith(f"about {np.count_nonzero(rates[::2] <= 0.0)} of 60 draws ")
    assert f" {float(rates[0])!r} of member 0: " in notices[RATE]
    assert "'lower' and 'upper'" in notices[RATE]
    value, number = re.search(r"(-\S+) of member (\d+):", notices["sensor.noise"]).groups()
    assert design.member(int(number)).set["sensor.noise"] == float(value)


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        (
            "identifier.method,u.rate\n" + "output-error,1.0\n" * 9 + "lest-squares,2.0\n",
            [(10, "identifier.method = 'lest-squares': .*'least-squares'")],
        ),
        (f"{RATE}\n1.0\n2.0\n-3.0\n4.0\n", [(3, f"{RATE} = -3.0: ")]),
        ("u.rate\n1.0\nnan\n", [(2, "u.rate = nan: ")]),
        (
            'u.amplitude,u.rate\n1.0,"2,5"\n-,3.5\n3.0,abc\n1,\n2,"[1"\n3,x\n',
            [
                (1, "u.rate = '2,5': .*'2,5'"),
                (2, "u.amplitude = '-': "),
                (3, "u.rate = 'abc': .*'abc'"),
                (5, r"u.rate = '\[1': "),
            ],
        ),
        (
            "u.amplitude,u.rat\na,1.0\nb,2.0\n",
            [
                (1, "u.amplitude = 'a': "),
                (1, "u.rat = 1.0: .*'rat'; "),
                (2, "u.amplitude = 'b': "),
                (2, "u.rat = 2.0: .*'rat'; "),
            ],
        ),
    ],
    ids=["words", "extremes", "nan", "several", "none"],
)
def test_values_of_cases_are_refused_by_their_rows(tmp_path, text, problems):
    """Every word, of numbers the extremes; no key is blamed for another."""
    path = tmp_path / "cases.csv"
    path.write_text(text)
    with pytest.raises(UsageError) as refused:
        check(cases=path)
    lines = sorted(line.partition(", row ")[2] for line in str(refused.value).split("\n"))
    assert len(lines) == len(problems)
    for line, (row, problem) in zip(lines, problems, strict=True):
        assert re.match(f"{row}: {problem}", line), line


def test_code_of_others_is_not_run_here(tmp_path, monkeypatch):
    """It is for the processes of the members; the schema is checked all the same."""
    (tmp_path / "mine.py").write_text("raise SystemExit('this is run')\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "mine.toml"
    path.write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n[components]\n'
        'own = { kind = "python", class = "mine:Own", gain = 1.0 }\n'
        'u = { kind = "constant", value = 1.0 }\n'
    )
    study, scenario = read_study(path), cosim.load(path)
    assert not is_own_code(scenario)
    check(study, scenario, vary={"own.gain": [1.0, 2.0]})
    with pytest.raises(UsageError, match=r"u.valu = 1.0: .*'valu'; did you mean"):
        check(study, scenario, vary={"u.valu": [1.0, 2.0]})


@pytest.mark.parametrize(
    ("name", "table"),
    [
        ("plant", {"kind": "fmu", "path": "x.FMU"}),
        ("observer", {"model": {"fmu": "x.fmu", "disturbance": "d"}}),
    ],
)
def test_fmus_are_code_of_others(name, table):
    """Also those that an observer is designed from."""
    assert is_own_code(SCENARIO)
    tables = SCENARIO.tree["components"]
    tree = {**SCENARIO.tree, "components": {**tables, name: {**tables[name], **table}}}
    assert not is_own_code(replace(SCENARIO, tree=tree))


# --- replays ---


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of the scenario, and one of another."""
    folder = tmp_path_factory.mktemp("logs")
    for name, scenario in (("a-1", SCENARIO), ("a-2", SCENARIO), ("b", "closed-loop")):
        cosim.run(scenario, set={"scenario.stop": 0.05}, out=folder / f"{name}.mcap")
    (folder / "c.mcap").write_bytes(b"no log")
    return folder


def test_values_that_a_replay_accepts_pass(logs):
    """Of every log, with every value; code of users is not run to check it."""
    replay = str(logs / "a-*.mcap")
    check(replay=replay, vary={RATE: [100.0, 300.0]}, seeds=2, set={"identifier.period": 0.05})
    study = EMPTY.with_options(replay=replay, vary={"plant.x_a0[0]": [2.0]})
    check_design(plan_design(study, SCENARIO), SCENARIO, allow_code=True)


@pytest.mark.parametrize(
    ("vary", "replay", "message"),
    [
        ({"plant.x_a0[0]": [2.0]}, "a-*.mcap", r"\Aplant.x_a0\[0\] = 2.0: 'plant' .*recording"),
        ({"scenario.step": [0.01]}, "a-*.mcap", "scenario.step = 0.01: .*recorded"),
        ({"sensor.noise": [0.01]}, ["a-1.mcap", "b.mcap"], r"\A/.*b.mcap: .*'closed-loop'"),
        ({"u.rate": [1.0]}, "c.mcap", r"\A/.*c.mcap is not an MCAP file"),
    ],
)
def test_values_that_a_replay_refuses_are_refused(logs, monkeypatch, vary, replay, message):
    """Before any of them."""
    monkeypatch.chdir(logs)
    with pytest.raises(UsageError, match=message):
        check(vary=vary, replay=replay)


def test_a_scenario_that_has_changed_since_its_log_is_refused(logs, tmp_path):
    """Its replay would run what it was; the log itself says so, and takes edits of its run."""
    text = SCENARIO.document.text
    path = tmp_path / "now.toml"
    path.write_text(text.replace("filter_rate = 1e3", "filter_rate = 500.0"))
    log = str(logs / "a-1.mcap")
    with pytest.raises(UsageError, match=rf"now.toml is now: .*components.{RATE}; a replay"):
        check(read_study(path), cosim.load(path), replay=log)
    path.write_text(f"# the same\n{text}[study]\nsamples = 3\n")
    check(scenario=cosim.load(path), replay=log)
    of_log = read_study(log)
    scenario = load_scenario(log)
    check(of_log, scenario, replay=str(logs / "a-*.mcap"))
    with pytest.raises(UsageError, match=r"b.mcap: .*'closed-loop'.*'academic-noisy'"):
        check(of_log, scenario, replay=[log, str(logs / "b.mcap")])
