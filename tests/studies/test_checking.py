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
from cosim.studies.study_file import StudyOptions, load_scenario, read_study
from cosim.studies.workers import LocalExecutor
from tests.studies.deeds import SCENARIO as CONSTANT

EMPTY = read_study("academic-noisy")
SCENARIO = cosim.load("academic-noisy")
RATE = "observer.filter_rate"
OTHER = {"u.rate": {"uniform": [1.0, 2.0]}}


def check(study=EMPTY, scenario=SCENARIO, **options):
    return check_design(
        plan_design(study.with_options(StudyOptions(**options)), scenario), scenario
    )


@pytest.fixture
def small(tmp_path):
    """Return the study of a scenario that is built at once, and the scenario."""
    path = tmp_path / "x.toml"
    lag = 'a = { kind = "lag", time_constant = 1.0 }\n[connections]\n"a.u" = "u.y"\n'
    path.write_text(CONSTANT + lag)
    return read_study(path), cosim.load(path)


def test_values_that_the_scenario_accepts_pass(small, tmp_path):
    """Grids, samples, seeds, cases with empty cells and with values that fit each other."""
    path = tmp_path / "cases.csv"
    path.write_text('observer.filter_rate,plant.x_a0\n,\n100.0,\n,"[0.0, 1.0]"\n')
    check(cases=path, seeds=3, vary={"identifier.method": ["output-error", "least-squares"]})
    check(vary={**OTHER, RATE: [10.0, 20.0]}, samples=10)
    path.write_text("scenario.step,scenario.stop\n0.3,0.9\n0.4,0.8\n")
    check(*small, cases=path)
    wrong = small[1].document.text.replace("time_constant = 1.0", "time_constant = -1.0")
    (tmp_path / "x.toml").write_text(wrong)  # a value that is drawn in its place is right
    drawn = {"a.time_constant": {"uniform": [1.0, 2.0]}}
    check(read_study(tmp_path / "x.toml"), cosim.load(tmp_path / "x.toml"), vary=drawn, samples=2)


@pytest.mark.parametrize(
    ("vary", "message"),
    [
        ({"observer.filter_rat": [1.0]}, r"\Aobserver.filter_rat = 1.0: .*'filter_rate'"),
        ({RATE: [1.0, 2.0, "a"]}, f"{RATE} = 'a': .*'a'"),
        ({**OTHER, RATE: {"choice": [1.0, -1.0, 2.0]}}, rf"\A{RATE} = -1.0: "),
        ({"observer.L": [[4.0, 0.0], [-50.0, 0.0]]}, r"L = \[-50.0, 0.0\]: .*Hurwitz"),
        ({"plant": ["a.fmu#cs"]}, r"swap.plant = '.*a.fmu#cs': .*no such file"),
    ],
)
def test_values_that_the_scenario_refuses_are_refused(vary, message):
    """The message has the key, the value and the reason."""
    with pytest.raises(UsageError, match=message):
        check(vary=vary, samples=9 if OTHER.items() <= vary.items() else None)


def test_of_many_numbers_the_extremes_are_checked(small):
    """Almost all of these steps do not fit the end."""
    with pytest.raises(UsageError, match=r"\Ascenario.step = 0.7: [^\n]*\Z"):
        check(*small, vary={"scenario.step": {"linear": [0.1, 0.7], "points": 3000}})


def test_members_with_refused_draws_will_fail(small):
    """Their share is told, of all samples or of fifty, and one is named with its key."""
    study, scenario = small
    key = "a.time_constant"
    for samples in (20, 200):
        vary = {"u.value": {"normal": [1.0, 0.1]}, key: {"normal": [10.0, 10.0]}}
        design = plan_design(study.with_options(StudyOptions(vary=vary, samples=samples)), scenario)
        checked = check_design(design, scenario)
        assert checked.trial == StudyMember(0)
        [notice] = checked.notices
        tried = np.unique(np.linspace(0, samples - 1, 50).astype(int))
        count = (design.column(key)[tried] <= 0.0).sum()
        assert notice.startswith(f"{count} of {len(tried)} samples ")
        number, value = re.search(rf"member (\d+): {key} = (-\S+): ", notice).groups()
        assert design.member(int(number)).set[key] == float(value)
    [notice] = check(*small, vary={key: {"normal": [10.0, 3.5]}}, samples=1000).notices
    assert notice.startswith("fewer than 1 of 50 samples that were tried, of 1000, ")
    with pytest.raises(UsageError, match=rf"\Aall 50 samples .* member 0: {key} = -.*got -"):
        check(*small, vary={key: {"normal": [-9.0, 1.0]}}, samples=100)


@pytest.mark.parametrize(
    "rows",  # behind " !", the keys that a row is refused for
    [
        "a.time_constant\n1.0\n2.0\n-3.0 !a.time_constant\n4.0\n",
        "u.value\n1.0\nnan !u.value\n",
        "u.value,note\n1.0,good !swap.note\n",
        'u.value,a.initial\n1.0,"2,5" !a.initial\n-,3.5 !u.value\n1,\n2,"[1" !a.initial\n',
        "u.value,a.initia\na,1.0 !a.initia !u.value\n",
        "scenario.step,scenario.stop\n0.3,0.9\n0.4,0.9 !scenario.step !scenario.stop\n",
    ],
)
def test_values_of_cases_are_refused_by_their_rows(small, tmp_path, rows):
    """Every word, of numbers the extremes, what does not go together; no key for another."""
    (tmp_path / "cases.csv").write_text(re.sub(r" !\S+", "", rows))
    with pytest.raises(UsageError) as refused:
        check(*small, cases=tmp_path / "cases.csv")
    found = re.findall(r", row (\d+): (\S+) = ", str(refused.value))
    lines = enumerate(rows.splitlines())
    expected = [(str(row), key) for row, line in lines for key in re.findall(r" !(\S+)", line)]
    assert sorted(found) == expected


def test_code_of_others_is_run_in_a_worker(tmp_path, monkeypatch):
    """Of the first member, and the first with each text; the schema is checked of all."""
    (tmp_path / "mine.py").write_text("raise SystemExit('this is run')\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "x.toml"
    path.write_text(CONSTANT + 'own = { kind = "python", class = "mine:Own" }\n')
    study, scenario = read_study(path), cosim.load(path)
    run = []

    def in_worker(_, members, function):
        run.extend(members)
        return [(member, MemberSources()) for member in members]

    monkeypatch.setattr(LocalExecutor, "run", in_worker)
    check(study, scenario, vary={"own.gain": [1.0, 2.0], "own.mode": ["a", "b", "c"]})
    assert [member.number for member in run] == [0, 1, 2]
    with pytest.raises(UsageError, match=r"u.valu = 1.0: .*'valu'; did you mean"):
        check(study, scenario, vary={"u.valu": [1.0, 2.0]})


def test_fmus_are_code_of_others():
    """Also those that an observer is designed from."""
    assert is_own_code(SCENARIO)
    tables = SCENARIO.tree["components"]
    model = {**tables["observer"], "model": {"fmu": "x.fmu", "disturbance": "d"}}
    for changed in ({"plant": {"kind": "fmu", "path": "x.FMU"}}, {"observer": model}):
        assert not is_own_code(replace(SCENARIO, tree={"components": {**tables, **changed}}))


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
    of_log, scenario = read_study(log), load_scenario(log)
    check(of_log, scenario, replay=str(logs / "a-*.mcap"))
    with pytest.raises(UsageError, match=r"b.mcap: .*'closed-loop'.*'academic-noisy'"):
        check(of_log, scenario, replay=[log, str(logs / "b.mcap")])
