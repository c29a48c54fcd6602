"""What a study is made of, and the command that runs a member on its own."""

import re
import shlex
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import cosim
from cosim.cli.app import main
from cosim.cli.command import read_edits, read_unique_pairs
from cosim.errors import RunError, UsageError
from cosim.scenario.document.swaps import port_names
from cosim.studies.checking import check_design
from cosim.studies.contracts import StudyMember
from cosim.studies.plan import RecordedStudy, plan_study, run_command
from cosim.studies.study_file import StudyOptions, read_study
from tests.scenario.field_recordings import BOTH, LOOP, field_log
from tests.scenario.user_modules import RELAY, THERMOSTAT

EMPTY = read_study("academic-noisy")
TEXTS = st.text(st.characters(blacklist_categories=("Cs",), blacklist_characters="\0"))
NUMBERS = st.floats(allow_nan=False) | st.integers(-(2**63), 2**63 - 1) | st.booleans()
LIKE_TOML = ["true", "1.0", "inf", " a", "a\n", "", "[1]", "'", '"', "1 # c", "\x7f"]
VALUES = st.recursive(
    NUMBERS | TEXTS | st.sampled_from(LIKE_TOML),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXTS, inner, max_size=3),
    max_leaves=6,
)

# --- commands ---


@given(st.dictionaries(st.sampled_from(["a.x", "b.y[0]", "c.z[1].w"]), VALUES))
def test_the_edits_of_a_command_are_those_of_the_member(changes):
    """Read by the shell's rules and the readers of the command line; floats to the bit."""
    study = EMPTY.with_options(
        StudyOptions(
            set={"scenario.stop": 0.1 + 0.2},
            swap={"u": "it's u.fmu#cs"},
            map={"u.y": "out 1", "plant.x": ["s1", "s2"]},
        )
    )
    words = shlex.split(run_command(StudyMember(3, changes, {"plant": "/x y/$a.fmu"}), study))
    assert words[:3] == ["cosim", "run", "academic-noisy"]
    options = {"--set": [], "--swap": [], "--map": []}
    for name, text in zip(words[3::2], words[4::2], strict=True):
        options[name].append(text)
    assert repr(read_edits(options["--set"])) == repr({"scenario.stop": 0.1 + 0.2, **changes})
    swaps = read_unique_pairs(options["--swap"], "swap")
    assert swaps == {**study.settings.swap, "plant": "/x y/$a.fmu"}
    maps = read_unique_pairs(options["--map"], "map").items()
    names = {port: port_names(text) for port, text in maps}
    assert names == {"u.y": ["out 1"], "plant.x": ["s1", "s2"]}


def test_the_member_of_a_recording_is_a_replay(call, tmp_path):
    """Of the log alone, which has its scenario; one of another tool has that and fields beside."""
    (tmp_path / "loop.toml").write_text(LOOP)
    log = field_log(tmp_path)
    key = "model.time_constant"
    study = read_study("loop.toml").with_options(
        StudyOptions(replay=str(log), map=BOTH, vary={key: [0.25]})
    )
    line = run_command(plan_study(study).design.member(0), study)
    assert line.startswith(f"cosim replay {log} --scenario {tmp_path}")
    assert call(*shlex.split(line)[1:], "--quiet", "--out", "own.mcap")[0] == 0
    expected = cosim.replay(log, scenario="loop.toml", map=BOTH, set={key: 0.25})
    assert cosim.diff(cosim.open_log("own.mcap"), expected).equal
    command = run_command(StudyMember(0, {"a.x": 1.0}, recording="own.mcap"), EMPTY)
    assert command == "cosim replay own.mcap --set a.x=1.0"


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

    study = read_study(scenario).with_options(
        StudyOptions(metrics=METRICS, vary={"s.rate": [1.0, 2.0]})
    )
    monkeypatch.setattr("cosim.studies.plan.check_design", checked)
    with pytest.raises(RunError, match=r"u\.csv has changed"):
        plan_study(study)
    monkeypatch.undo()
    table.unlink()
    with pytest.raises(UsageError, match=r"\A\S*x.toml:4: components.u: .*u.csv.*\Z"):
        plan_study(study)


def test_every_varied_file_belongs_to_the_study(scenario, tmp_path, monkeypatch):
    """Also those that no member is built with when the study is planned."""
    monkeypatch.setattr("cosim.studies.checking.MOST_INSPECTED", 1)
    logs = [str(tmp_path / f"{number}.mcap") for number in range(2)]
    tables = [str(tmp_path / f"{number}.csv") for number in range(2)]
    for log, table in zip(logs, tables, strict=True):
        cosim.run(scenario, out=log)
        write_table(Path(table), 1.0)

    def digests(**options):
        study = read_study(scenario).with_options(StudyOptions(metrics=METRICS, **options))
        return plan_study(study).identity({}).digests

    before = digests(vary={"u.file": tables})
    write_table(Path(tables[1]), 7.0)
    changed = digests(vary={"u.file": tables}).items() ^ before.items()
    assert {name for name, _ in changed} == {"table 1.csv"}
    names = digests(replay=logs).keys()
    assert {"log 0.mcap", "log 1.mcap"} <= names
    assert "table u.csv" not in names  # a replay has it from its log


def test_empty_cells_are_told(scenario, tmp_path):
    """A row of commas may be a mistake."""
    (tmp_path / "c.csv").write_text("s.amplitude,s.rate\n1,2\n,\n,3\n")
    study = read_study(scenario).with_options(
        StudyOptions(metrics=METRICS, cases=tmp_path / "c.csv")
    )
    [notice] = plan_study(study).notices
    assert re.search(r"c.csv': 3 empty cells, .* own value; all empty is row 2\Z", notice)


def test_the_modules_of_users_belong_to_the_study(tmp_path):
    """By their classes, wherever they are; of the scenario what it says, not its comments."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text(RELAY)
    study = read_study(tmp_path / "x.toml").with_options(StudyOptions(metrics={"y": "max(room.y)"}))
    before = plan_study(study)
    assert str(tmp_path / "relay.py") in before.files  # those in this folder can be sent
    (tmp_path / "relay.py").write_text(RELAY + "\n")
    (tmp_path / "x.toml").write_text(f"# warm\n{THERMOSTAT}")
    changed = plan_study(study).identity({}).digests.items() ^ before.identity({}).digests.items()
    assert {name for name, _ in changed} == {"code of relay:Relay"}


def test_a_member_that_cannot_be_built_is_no_silence(tmp_path, capsys):
    """The study goes on, as that costs the member only; the dataset says what is not known."""
    (tmp_path / "x.toml").write_text(THERMOSTAT)
    (tmp_path / "relay.py").write_text("raise GeneratorExit\n" + RELAY)
    place = tmp_path / "out"
    with pytest.warns(cosim.CosimWarning, match="member 0 could not be built .*GeneratorExit"):
        study = cosim.study(tmp_path / "x.toml", metrics={"y": "max(room.y)"}, out=place, workers=1)
    assert "GeneratorExit" in study.failures[0]
    [warning] = RecordedStudy.read(study.text).warnings
    with pytest.raises(SystemExit):
        main(["study", "show", str(place)])
    assert f"warning: {warning}" in capsys.readouterr().err
