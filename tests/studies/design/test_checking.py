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


def check(**options):
    study = EMPTY.with_options(**options)
    check_design(plan_design(study, SCENARIO), SCENARIO)


def test_values_that_the_scenario_accepts_pass(tmp_path):
    """Grids, samples, seeds, cases with empty cells."""
    path = tmp_path / "cases.csv"
    path.write_text('observer.filter_rate,plant.x_a0\n,\n100.0,\n,"[0.0, 1.0]"\n')
    check(cases=path, seeds=3, vary={"identifier.method": ["output-error", "least-squares"]})
    check(
        vary={
            "delta.terms[0].theta": {"uniform": [-0.2, -0.1]},
            "u.rate": {"log": [1.0, 10.0], "points": 5000},
        },
        samples=10,
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"vary": {"observer.filter_rat": [1.0]}},
            r"\Aobserver.filter_rat = 1.0: unknown key 'filter_rat'; did you mean 'filter_rate'",
        ),
        ({"vary": {"obsrver.L": [1.0]}}, "obsrver.L = 1.0: .*component 'obsrver'"),
        (
            {"vary": {"observer.filter_rate": [1.0, 2.0, "a"]}},
            "observer.filter_rate = 'a': .*'a'",
        ),
        (
            {"vary": {"delta.terms[2].theta": {"uniform": [0.0, 1.0]}}, "samples": 3},
            r"delta.terms\[2\].theta = 0\..*: .*terms has no element '2'; available: 0 to 1",
        ),
        (
            {"vary": {"observer.filter_rate": {"normal": [-10.0, 1.0]}}, "samples": 100},
            r"\Aobserver.filter_rate = -\S+, drawn from normal \[-10.0, 1.0\] for member 0: .*"
            r"positive finite rate .rad/s..*; so are all \d+ draws that were tried",
        ),
        (
            {
                "vary": {
                    "u.rate": {"uniform": [1.0, 2.0]},
                    "observer.filter_rate": {"uniform": [-2.0, -1.0]},
                },
                "samples": 1,
            },
            r"\Aobserver.filter_rate = -\S+, .* for member 0: .*; the only draw is; .*another",
        ),
        (
            {
                "vary": {
                    "u.rate": {"uniform": [1.0, 2.0]},
                    "observer.filter_rate": {"choice": [1.0, -1.0, 2.0]},
                },
                "samples": 9,
            },
            r"\Aobserver.filter_rate = -1.0: .*positive finite rate",
        ),
        (
            {"vary": {"observer.L": [[4.0, 0.0], [-50.0, 0.0]]}},
            r"observer.L = \[-50.0, 0.0\]: .*Hurwitz",
        ),
        (
            {"vary": {"plant": ["a.zip"]}},
            r"swap\['plant'\]: .*'.*a.zip'",
        ),
        (
            {"vary": {"plant": ["a.fmu#cs"]}},
            r"swap.plant = '.*a.fmu#cs': .*a.fmu.*: no such file",
        ),
        (
            {"swap": {"plant": "a.fmu"}, "vary": {"u.rate": [1.0]}},
            r"\Aswap\['plant'\]: .*a.fmu: no such file",
        ),
        ({"vary": {"plnt": ["a.fmu"]}}, r"swap\['plnt'\]: .*component 'plnt'; did you"),
        ({"set": {"observer.x": 1.0}, "vary": {"u.rate": [1.0]}}, r"\Aset\['observer.x'\]: .*unkn"),
    ],
)
def test_values_that_the_scenario_refuses_are_refused(options, message):
    """The message has the key, the value and the reason, once."""
    with pytest.raises(UsageError, match=message):
        check(**options)


@pytest.mark.slow
def test_members_with_refused_draws_will_fail():
    """They are counted, and named with a way out; the first one may be one of them.

    A normal distribution with its mean at its deviation is below 0 in 15.9 % of all draws; where
    exactly one interval of them is refused, the count is exact.
    """
    vary = {
        "u.rate": {"normal": [1.0, 0.1]},
        "observer.filter_rate": {"normal": [10.0, 10.0]},
        "sensor.noise": {"triangular": [-1e-3, 0.0, 2e-3]},
    }
    for seed in range(40):
        study = EMPTY.with_options(vary=vary, samples=60, seeds=2, seed=seed)
        design = plan_design(study, SCENARIO)
        rates = design.column("observer.filter_rate")
        if rates[0] <= 0.0:
            break
    checked = check_design(design, SCENARIO)
    refused = {draws.variation.key: draws for draws in checked.refused}
    assert set(refused) == {"observer.filter_rate", "sensor.noise"}
    draws = refused["observer.filter_rate"]
    assert draws.count == np.count_nonzero(rates[::2] <= 0.0)
    assert draws.number == 0
    assert draws.value == rates[0]
    assert checked.member.set["observer.filter_rate"] > 0.0
    assert str(draws).startswith(
        f"observer.filter_rate: about {draws.count} of 60 draws of normal [10.0, 10.0] are "
        f"invalid, and members that draw them will fail: {float(rates[0])!r} of member 0: "
    )
    assert str(draws).endswith("; truncate the distribution with 'lower' and 'upper'")
    noises = refused["sensor.noise"]
    assert design.member(noises.number).set["sensor.noise"] == noises.value < 0.0


def test_every_word_of_cases_is_checked(tmp_path):
    """Also the last one; of numbers the extremes."""
    path = tmp_path / "cases.csv"
    path.write_text("identifier.method,u.rate\n" + "output-error,1.0\n" * 9 + "lest-squares,2.0\n")
    message = "identifier.method = 'lest-squares': .*did you mean 'least-squares'"
    with pytest.raises(UsageError, match=message):
        check(cases=path)
    path.write_text("observer.filter_rate\n1.0\n2.0\n-3.0\n4.0\n")
    with pytest.raises(UsageError, match=r"filter_rate = -3.0: .*positive"):
        check(cases=path)


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
    scenario = cosim.load(path)
    assert not is_own_code(scenario)
    study = read_study(path).with_options(vary={"own.gain": [1.0, 2.0]})
    check_design(plan_design(study, scenario), scenario)
    wrong = read_study(path).with_options(vary={"u.valu": [1.0, 2.0]})
    with pytest.raises(UsageError, match=r"u.valu = 1.0: .*unknown key 'valu'; did you mean"):
        check_design(plan_design(wrong, scenario), scenario)


@pytest.mark.parametrize(
    "changes",
    [
        {"plant.kind": "fmu", "plant.path": "x.fmu"},
        {"plant.kind": "fmu", "plant.path": "x.FMU"},
        {"observer.model": {"fmu": "x.fmu", "disturbance": "d"}},
    ],
)
def test_fmus_are_code_of_others(changes):
    """Also those that an observer is designed from."""
    assert is_own_code(SCENARIO)
    tables = {**SCENARIO.tree["components"]}
    for key, value in changes.items():
        component, _, name = key.partition(".")
        tables[component] = {**tables[component], name: value}
    tree = {**SCENARIO.tree, "components": tables}
    assert not is_own_code(replace(SCENARIO, tree=tree))


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of the scenario, and one of another."""
    folder = tmp_path_factory.mktemp("logs")
    end = {"scenario.stop": 0.05}
    for name, scenario in (("a-1", SCENARIO), ("a-2", SCENARIO), ("b", "closed-loop")):
        cosim.run(scenario, set=end, out=folder / f"{name}.mcap")
    (folder / "c.mcap").write_bytes(b"no log")
    (folder / "c.csv").touch()
    return folder


@pytest.mark.slow
def test_values_that_a_replay_accepts_pass(logs):
    """Of every log, with every value."""
    vary = {"observer.filter_rate": [100.0, 300.0]}
    check(replay=str(logs / "a-*.mcap"), vary=vary, seeds=2, set={"identifier.period": 0.05})
    check(replay=str(logs / "a-*.mcap"))


@pytest.mark.fast(
    "options0-\\\\Aplant.x_a0\\\\[0\\\\] = 2.0: 'plant' is taken from the recording",
    "options1-scenario.step = 0.01: .*expected the recorded",
    "options3-\\\\A/.*b.mcap: the log is of 'closed-loop', and the study is of 'academic-noisy'",
    "options4-\\\\A/.*c.mcap is not an MCAP file",
    "options5-\\\\A/.*c.mcap is not an MCAP file",
)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"replay": "a-*.mcap", "vary": {"plant.x_a0[0]": [2.0]}},
            r"\Aplant.x_a0\[0\] = 2.0: 'plant' is taken from the recording",
        ),
        (
            {"replay": "a-*.mcap", "vary": {"scenario.step": [0.01]}},
            "scenario.step = 0.01: .*expected the recorded",
        ),
        (
            {"replay": ["a-1.mcap", "b.mcap"], "vary": {"sensor.noise": [0.01]}},
            r"\A/.*b.mcap: the log is of 'closed-loop', and the study is of "
            "'academic-noisy'; .*use a log of this scenario, or run cosim.study on",
        ),
        (
            {"replay": "b.mcap", "swap": {"u": "c.csv"}},
            r"\A/.*b.mcap: the log is of 'closed-loop', and the study is of 'academic-noisy'",
        ),
        ({"replay": ["a-1.mcap", "c.mcap"]}, r"\A/.*c.mcap is not an MCAP file"),
        ({"replay": "c.mcap", "vary": {"u.rate": [1.0]}}, r"\A/.*c.mcap is not an MCAP file"),
    ],
)
def test_values_that_a_replay_refuses_are_refused(logs, monkeypatch, options, message):
    """Before any of them."""
    monkeypatch.chdir(logs)
    with pytest.raises(UsageError, match=message):
        check(**options)


def test_a_scenario_that_has_changed_since_its_log_is_refused(logs, tmp_path):
    """Its replay would run what it was; the log itself says so, and takes edits of its run."""
    text = SCENARIO.document.text
    path = tmp_path / "now.toml"
    path.write_text(text.replace("filter_rate = 1e3", "filter_rate = 500.0"))
    assert path.read_text() != text
    log = str(logs / "a-1.mcap")
    study = read_study(path).with_options(replay=log)
    scenario = cosim.load(path)
    message = (
        "the log is of another 'academic-noisy' than .*now.toml is now: they differ in "
        "components.observer.filter_rate; a replay runs the scenario of its log"
    )
    with pytest.raises(UsageError, match=message):
        check_design(plan_design(study, scenario), scenario)
    path.write_text(f"# the same\n{text}[study]\nsamples = 3\n")
    scenario = cosim.load(path)
    check_design(plan_design(EMPTY.with_options(replay=log), scenario), scenario)
    of_log = read_study(logs / "b.mcap")
    scenario = load_scenario(of_log.scenario)
    check_design(plan_design(of_log, scenario), scenario)


def test_code_of_users_is_not_run_to_check_a_replay(logs):
    """Where it may be run at all, it is run in the processes of the members."""
    study = EMPTY.with_options(replay=str(logs / "a-1.mcap"), vary={"plant.x_a0[0]": [2.0]})
    design = plan_design(study, SCENARIO)
    check_design(design, SCENARIO, allow_code=True)


def test_every_key_of_a_table_of_cases_is_refused_at_once_by_its_rows(tmp_path):
    """Also where the first row is wrong; a key is not blamed for another."""
    path = tmp_path / "cases.csv"
    path.write_text('u.amplitude,u.rate\n1.0,"2,5"\n-,3.5\n3.0,abc\n1,\n2,"[1"\n3,x\n')
    with pytest.raises(UsageError) as refused:
        check(cases=path)
    rate, amplitude = [], []
    for line in str(refused.value).split("\n"):
        place, _, problem = line.partition(": ")
        row = place.removeprefix(f"file {str(path)!r}, row ")
        (rate if problem.startswith("u.rate = ") else amplitude).append((row, problem))
    assert [row for row, _ in rate] == ["1", "3", "5"]
    for (_, problem), value in zip(rate, ("'2,5'", "'abc'", "'[1'"), strict=True):
        assert re.match(rf"u\.rate = {re.escape(value)}: .*{re.escape(value)}", problem)
    [(row, problem)] = amplitude
    assert row == "2"
    assert problem.startswith("u.amplitude = '-': ")


def test_keys_of_which_no_value_is_taken_are_refused_alone(tmp_path):
    path = tmp_path / "cases.csv"
    path.write_text("u.amplitude,u.rat\na,1.0\nb,2.0\n")
    with pytest.raises(UsageError) as refused:
        check(cases=path)
    problems = [line.split(", row ")[1] for line in str(refused.value).split("\n")]
    assert problems[0].startswith("1: u.amplitude = 'a': ")
    assert problems[1].startswith("2: u.amplitude = 'b': ")
    assert [problem[:35] for problem in problems[2:]] == [
        "1: u.rat = 1.0: unknown key 'rat'; ",
        "2: u.rat = 2.0: unknown key 'rat'; ",
    ]


def test_a_number_that_is_none_is_named_by_its_row(tmp_path):
    path = tmp_path / "cases.csv"
    path.write_text("u.rate\n1.0\nnan\n")
    with pytest.raises(UsageError, match=r"row 2: u.rate = nan: .*nan"):
        check(cases=path)


def test_the_logs_of_a_study_of_a_log_are_of_its_scenario(logs):
    """Whatever was set in their runs."""
    study = read_study(logs / "a-1.mcap")
    scenario = load_scenario(study.scenario)
    same = study.with_options(replay=str(logs / "a-*.mcap"))
    check_design(plan_design(same, scenario), scenario)
    other = study.with_options(replay=[str(logs / "a-1.mcap"), str(logs / "b.mcap")])
    with pytest.raises(UsageError, match=r"b.mcap: the log is of 'closed-loop', and the study is"):
        check_design(plan_design(other, scenario), scenario)
