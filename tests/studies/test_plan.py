"""What a study is made of, and the command that runs a member on its own."""

import shlex

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cosim
from cosim.cli.app import main
from cosim.cli.options import read_edits, read_unique_pairs
from cosim.errors import ChangedFileError, DatasetError, RunError, UsageError
from cosim.scenario.document.edits import parse_value
from cosim.scenario.document.swap import port_names
from cosim.studies.checking import check_design
from cosim.studies.contracts import StudyMember
from cosim.studies.design import plan_design
from cosim.studies.plan import RecordedStudy, plan_study, run_command, toml_text
from cosim.studies.study_file import read_study
from tests.scenario.field_recordings import BOTH, LOOP, field_log
from tests.scenario.user_modules import RELAY, THERMOSTAT

EMPTY = read_study("academic-noisy")
TEXTS = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"))
SCALARS = (
    st.floats(allow_nan=False)
    | st.integers(-(2**63), 2**63 - 1)
    | st.booleans()
    | TEXTS
    | st.sampled_from(["true", "1.0", "inf", " a", "a\n", "", "[1]", "'", '"', "1 # c", "\x7f"])
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=6,
)

# --- commands ---


@given(VALUES)
def test_values_are_read_as_they_were(value):
    """By what reads --set; floats to the bit, which their repr has."""
    assert repr(parse_value(toml_text(value).strip())) == repr(value)


@settings(max_examples=50)
@given(st.dictionaries(st.sampled_from(["a.x", "b.y[0]", "c.z[1].w"]), VALUES))
def test_the_edits_of_a_command_are_those_of_the_member(changes):
    """Read by the shell's rules and the readers of the command line."""
    study = EMPTY.with_options(
        set={"scenario.stop": 0.1 + 0.2},
        swap={"u": "it's u.fmu#cs"},
        map={"u.y": "out 1", "plant.x": ["s1", "s2"]},
    )
    member = StudyMember(3, changes, {"plant": "/x y/$a.fmu"})
    words = shlex.split(run_command(member, study))
    assert words[:3] == ["cosim", "run", "academic-noisy"]
    options = {"--set": [], "--swap": [], "--map": []}
    for name, text in zip(words[3::2], words[4::2], strict=True):
        options[name].append(text)
    assert repr(read_edits(options["--set"])) == repr({"scenario.stop": 0.1 + 0.2, **changes})
    swaps = read_unique_pairs(options["--swap"], "swap")
    assert swaps == {**study.settings.swap, "plant": "/x y/$a.fmu"}
    maps = read_unique_pairs(options["--map"], "map")
    names = {port: port_names(text) for port, text in maps.items()}
    assert names == {"u.y": ["out 1"], "plant.x": ["s1", "s2"]}


def test_the_member_of_a_recording_is_a_replay(call, tmp_path):
    """Of the log alone, which has its scenario; one of another tool has that and fields beside."""
    (tmp_path / "loop.toml").write_text(LOOP)
    own, foreign = tmp_path / "field-1.mcap", field_log(tmp_path)
    cosim.run("academic-noisy", set={"scenario.stop": 0.05}, out=own)
    for name, log, maps, key, command in (
        ("academic-noisy", own, {}, "observer.filter_rate", f"{own}"),
        ("loop.toml", foreign, BOTH, "model.time_constant", f"{foreign} --scenario {tmp_path}"),
    ):
        study = read_study(name).with_options(replay=str(log), map=maps, vary={key: [0.25, 0.5]})
        scenario = cosim.load(name)
        design = plan_design(study, scenario)
        check_design(design, scenario)
        line = run_command(design.member(1), study)
        assert line.startswith(f"cosim replay {command}")
        assert call(*shlex.split(line)[1:], "--quiet", "--out", "again.mcap", "--force")[0] == 0
        of = {"scenario": name, "map": maps} if maps else {}
        expected = cosim.replay(log, set={key: 0.5}, **of)
        assert cosim.diff(cosim.open_log(tmp_path / "again.mcap"), expected).equal


# --- a study belongs to the files that its members read: those that it began with ---

TABLE = """
scenario = { name = "x", stop = 1.0, step = 0.1 }
[components]
u = { kind = "table", file = "u.csv" }
s = { kind = "sine", amplitude = 1.0, rate = 1.0 }
"""
METRICS = {"y": "last(u.y)"}


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "x.toml"
    path.write_text(TABLE)
    write_table(tmp_path / "u.csv", 1.0)
    return path


def write_table(path, value):
    path.write_text(f"t,y\n0,{value}\n1,{value}\n")


def test_a_file_that_changes_while_a_study_is_planned_is_named(scenario, monkeypatch):
    """Nothing has begun that could go on; and of one that is missing no varied key is blamed."""
    table = scenario.with_name("u.csv")

    def checked(*given):
        write_table(table, 2.0)
        return check_design(*given)

    study = read_study(scenario).with_options(metrics=METRICS, vary={"s.rate": [1.0, 2.0]})
    monkeypatch.setattr("cosim.studies.plan.check_design", checked)
    with pytest.raises(RunError, match=r"u\.csv has changed"):
        plan_study(study)
    monkeypatch.undo()
    table.unlink()
    with pytest.raises(UsageError, match=r"\A\S*x.toml:4: components.u: .*u.csv.*\Z"):
        plan_study(study)


@pytest.mark.slow
def test_a_study_stops_where_a_file_changes(scenario, tmp_path):
    """What is recorded is of the file as it was; put back, the study goes on."""
    table = tmp_path / "u.csv"
    given = {
        "vary": {"s.amplitude": {"linear": [0.0, 1.0], "points": 200}},
        "metrics": METRICS,
        "out": tmp_path / "out",
        "workers": 1,
    }
    with pytest.raises(ChangedFileError, match=r"u\.csv has changed since this study began"):
        cosim.study(scenario, **given, progress=lambda *_: write_table(table, 2.0))
    assert 0 < len(cosim.open_study(tmp_path / "out")) < 200
    with pytest.raises(DatasetError, match=r"table u\.csv changed"):
        cosim.study(scenario, **given)
    write_table(table, 1.0)
    done = cosim.study(scenario, **given)
    assert done.table().column("y").to_pylist() == [1.0] * 200


def test_every_varied_file_belongs_to_the_study(scenario, tmp_path, monkeypatch):
    """Also those that no member is built with when the study is planned."""
    monkeypatch.setattr("cosim.studies.checking.MOST_INSPECTED", 1)
    tables = [tmp_path / f"{number}.csv" for number in range(3)]
    logs = [tmp_path / f"{number}.mcap" for number in range(3)]
    for number, table in enumerate(tables):
        write_table(table, float(number))
    for log in logs:
        cosim.run(scenario, out=log)

    def digests(**options):
        study = read_study(scenario).with_options(metrics=METRICS, **options)
        return plan_study(study).identity({}).digests

    vary = {"u.file": list(map(str, tables))}
    before = digests(vary=vary)
    write_table(tables[2], 7.0)
    assert {name for name, _ in digests(vary=vary).items() ^ before.items()} == {"table 2.csv"}
    names = digests(replay=list(map(str, logs))).keys()
    assert {f"log {log.name}" for log in logs} <= names
    assert "table u.csv" not in names  # a replay has it from its log


def test_the_modules_of_users_belong_to_the_study(tmp_path):
    """By their classes, wherever they are; those in the scenario's folder can be sent."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text(RELAY)
    study = read_study(tmp_path / "x.toml").with_options(metrics={"y": "max(room.y)"})
    before = plan_study(study)
    assert str(tmp_path / "relay.py") in before.files
    (tmp_path / "relay.py").write_text(RELAY + "\n")
    changed = plan_study(study).identity({}).digests.items() ^ before.identity({}).digests.items()
    assert {name for name, _ in changed} == {"code of relay:Relay"}


@pytest.mark.slow
@pytest.mark.usefixtures("worker_processes")
def test_a_member_that_cannot_be_built_is_no_silence(tmp_path, capsys):
    """The study goes on, as that costs the member only; the dataset says what is not known."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text("import os\nos._exit(3)\n" + RELAY)
    place = tmp_path / "out"
    run = ["study", str(tmp_path / "x.toml"), "--metric", "y=max(room.y)", "--out", str(place)]
    for arguments, code in ((run, 1), (["study", "show", str(place)], 0)):
        with pytest.raises(SystemExit) as caught:
            main(arguments)
        assert caught.value.code == code
        [warning] = RecordedStudy.read(cosim.open_study(place).text).warnings
        assert "member 0 could not be built" in warning
        assert "exit code 3" in warning
        assert capsys.readouterr().err.count(f"warning: {warning}") == 1
