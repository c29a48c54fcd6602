"""What is found wrong with a design before anything runs."""

import re
from dataclasses import replace

import numpy as np
import pytest

import cosim
from cosim.errors import UsageError
from cosim.studies.checking import check_design, is_own_code
from cosim.studies.contracts import StudyMember
from cosim.studies.design import plan_design
from cosim.studies.members import MemberSources, OpenedSubject
from cosim.studies.study_file import load_scenario, read_study
from cosim.studies.workers import LocalExecutor

EMPTY = read_study("academic-noisy")
SCENARIO = cosim.load("academic-noisy")
RATE = "observer.filter_rate"
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
        (
            {RATE: {"normal": [-10.0, 1.0]}},
            {"samples": 100},
            rf"\Aall 50 samples .*, such as member 0: {RATE} = -.*positive",
        ),
        ({**OTHER, RATE: {"choice": [1.0, -1.0, 2.0]}}, {"samples": 9}, rf"\A{RATE} = -1.0: "),
        ({"observer.L": [[4.0, 0.0], [-50.0, 0.0]]}, {}, r"L = \[-50.0, 0.0\]: .*Hurwitz"),
        ({"plant": ["a.fmu#cs"]}, {}, r"swap.plant = '.*a.fmu#cs': .*no such file"),
    ],
)
def test_values_that_the_scenario_refuses_are_refused(vary, options, message):
    """The message has the key, the value and the reason."""
    with pytest.raises(UsageError, match=message):
        check(vary=vary, **options)


@pytest.mark.slow
def test_members_with_refused_draws_will_fail():
    """Their share is told, of all samples or of fifty, and one is named with its key."""
    vary = {
        "u.rate": {"normal": [1.0, 0.1]},
        RATE: {"normal": [10.0, 10.0]},
        "sensor.noise": {"triangular": [-1e-3, 0.0, 2e-3]},
    }
    for samples in (20, 200):
        study = EMPTY.with_options(vary=vary, samples=samples, seeds=2)
        design = plan_design(study, SCENARIO)
        checked = check_design(design, SCENARIO)
        assert checked.trial == StudyMember(0, {"sensor.seed": design.member(0).set["sensor.seed"]})
        [notice] = checked.notices
        is_wrong = (design.column(RATE) <= 0.0) | (design.column("sensor.noise") < 0.0)
        tried = np.unique(np.linspace(0, samples - 1, 50).astype(int))
        assert notice.startswith(f"{is_wrong[::2][tried].sum()} of {len(tried)} samples ")
        number, key, value = re.search(r"member (\d+): (\S+) = (-\S+): ", notice).groups()
        assert design.member(int(number)).set[key] == float(value)
    [notice] = check(vary={RATE: {"normal": [10.0, 3.5]}}, samples=1000).notices
    assert notice.startswith("fewer than 1 of 50 samples that were tried, of 1000, ")


@pytest.mark.parametrize(
    ("text", "problems"),
    [
        (f"{RATE}\n1.0\n2.0\n-3.0\n4.0\n", [(3, f"{RATE} = -3.0: ")]),
        ("u.rate\n1.0\nnan\n", [(2, "u.rate = nan: ")]),
        ("u.rate,note\n1.0,good\n", [(1, "swap.note = '.*good': .*'note'")]),
        (
            'u.amplitude,u.rate\n1.0,"2,5"\n-,3.5\n3.0,abc\n1,\n2,"[1"\n',
            [
                (1, "u.rate = '2,5': .*'2,5'"),
                (2, "u.amplitude = '-': "),
                (3, "u.rate = 'abc': .*'abc'"),
                (5, r"u.rate = '\[1': "),
            ],
        ),
        (
            "u.amplitude,u.rat\na,1.0\n",
            [(1, "u.amplitude = 'a': "), (1, "u.rat = 1.0: .*'rat'; ")],
        ),
    ],
    ids=["extremes", "nan", "swap", "several", "two"],
)
def test_values_of_cases_are_refused_by_their_rows(tmp_path, text, problems):
    """Every word, of numbers the extremes; no key is blamed for another."""
    path = tmp_path / "cases.csv"
    path.write_text(text)
    with pytest.raises(UsageError) as refused:
        check(cases=path)
    lines = sorted(line.partition(", row ")[2] for line in str(refused.value).split("\n"))
    for line, (row, problem) in zip(lines, problems, strict=True):
        assert re.match(f"{row}: {problem}", line), line


def test_the_values_of_a_row_are_checked_together(tmp_path):
    """Each of these steps fits its own end alone."""
    text = 'scenario = { name = "x", stop = 1.0, step = 0.1 }\n[components]\n'
    (tmp_path / "x.toml").write_text(text + 'u = { kind = "constant", value = 1.0 }\n')
    path = tmp_path / "cases.csv"
    path.write_text("scenario.step,scenario.stop\n0.3,0.9\n0.4,0.8\n")
    study, scenario = read_study(tmp_path / "x.toml"), cosim.load(tmp_path / "x.toml")
    check(study, scenario, cases=path)
    path.write_text("scenario.step,scenario.stop\n0.3,0.9\n0.4,0.9\n")
    with pytest.raises(UsageError, match=r"row 2: scenario.step = 0.4: .*\n.*scenario.stop = 0.9"):
        check(study, scenario, cases=path)


def test_code_of_others_is_run_in_a_worker(tmp_path, monkeypatch):
    """Of the first member, and the first with each text; the schema is checked of all."""
    (tmp_path / "mine.py").write_text("raise SystemExit('this is run')\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "mine.toml"
    path.write_text(
        'scenario = { name = "x", stop = 1.0, step = 0.1 }\n[components]\n'
        'own = { kind = "python", class = "mine:Own", gain = 1.0 }\n'
        'u = { kind = "constant", value = 1.0 }\n'
    )
    run = []

    def in_worker(_, members, function):
        run.extend(members)
        return [(member, MemberSources()) for member in members]

    monkeypatch.setattr(LocalExecutor, "run", in_worker)
    study, scenario = read_study(path), cosim.load(path)
    check(study, scenario, vary={"own.gain": [1.0, 2.0], "own.mode": ["a", "b", "c"]})
    assert [member.number for member in run] == [0, 1, 2]
    with pytest.raises(UsageError, match=r"u.valu = 1.0: .*'valu'; did you mean"):
        check(study, scenario, vary={"u.valu": [1.0, 2.0]})


def test_fmus_are_code_of_others():
    """Also those that an observer is designed from."""
    assert is_own_code(SCENARIO)
    tables = SCENARIO.tree["components"]
    fmu = {"kind": "fmu", "path": "x.FMU"}
    model = {**tables["observer"], "model": {"fmu": "x.fmu", "disturbance": "d"}}
    for changed in ({"plant": fmu}, {"observer": model}):
        tree = {**SCENARIO.tree, "components": {**tables, **changed}}
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


@pytest.mark.parametrize(
    ("vary", "replay", "message"),
    [
        ({"plant.x_a0[0]": [2.0]}, "a-*.mcap", r"\Aplant.x_a0\[0\] = 2.0: 'plant' .*recording"),
        ({"sensor.noise": [0.01]}, ["a-1.mcap", "b.mcap"], r"\A/.*b.mcap: .*'closed-loop'"),
        ({"u.rate": [1.0]}, "c.mcap", r"\A/.*c.mcap is not an MCAP file"),
    ],
)
def test_values_that_a_replay_refuses_are_refused(logs, monkeypatch, vary, replay, message):
    """Before any of them runs; others are not. What a log has in it is never run for that."""
    monkeypatch.chdir(logs)
    built = []

    def inspect(opened, member):
        built.append(member.recording)
        return inspected(opened, member)

    inspected = OpenedSubject.inspect
    monkeypatch.setattr(OpenedSubject, "inspect", inspect)
    check(replay="a-*.mcap", vary={RATE: [100.0, 300.0]}, set={"identifier.period": 0.05})
    with pytest.raises(UsageError, match=message):
        check(vary=vary, replay=replay)
    assert None not in built


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
