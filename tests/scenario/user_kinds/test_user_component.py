"""Components of users' classes, by name or installed: runs, logs, replays, errors."""

import json
import shutil
import sys

import numpy as np
import pytest

import cosim
from cosim.errors import RunError, ScenarioError, UsageError
from cosim.log import open_log
from cosim.report.inspection import describe_log, describe_scenario
from cosim.report.summary import summarize
from cosim.report.tables.catalog import show_catalog, show_kind
from cosim.report.tables.console import print_shown
from cosim.report.verification import verify
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.kinds import user_code
from tests.scenario.refusals import check_refused
from tests.scenario.user_modules import RELAY, THERMOSTAT, one, own_module, write


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a working directory with the thermostat and its relay."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, relay=RELAY)
    (tmp_path / "thermostat.toml").write_text(THERMOSTAT)
    return tmp_path


def forbid_imports(monkeypatch):
    """Let every import of a user's class fail."""

    def refused(*arguments, **options):
        raise AssertionError("a class is imported")

    monkeypatch.setattr(user_code, "load_class", refused)


def source_hash(folder):
    return user_code.load_class("relay:Relay", folder).sources["relay.py"]


def test_a_class_runs_as_a_component_of_a_scenario(folder):
    """The relay holds the room at 20, to its width and what the room moves in two steps of 0.1 s.

    It sees the room at the start of a step and acts at its end; the slopes there are -0.95 and
    0.45 per second. The log names the class and its source; blocks change no bit.
    """
    log = cosim.run("thermostat.toml", out="a.mcap")
    room = log["room.y"][300:]
    assert 19.5 - 0.19 < room.min() < 19.5
    assert 20.5 < room.max() < 20.5 + 0.09
    assert set(np.unique(log["relay.y"])) == {0.0, 1.0}
    code = json.loads(log.metadata["cosim.component.relay"]["metadata"])["code"]
    sources = {"relay.py": source_hash(folder)}
    assert code == {"class": "relay:Relay", "sources": sources, "distribution": None}
    assert log.kinds["relay"] == "python"
    for block in (1, 7):
        assert cosim.diff(log, cosim.run("thermostat.toml", block=block)).equal


def test_what_shows_a_scenario_or_a_log_imports_nothing(folder, monkeypatch):
    """And tells of problems that do not depend on the ports of the class."""
    cosim.run("thermostat.toml", out="a.mcap")
    forbid_imports(monkeypatch)
    assert cosim.load("thermostat.toml").specs["relay"].code == "relay:Relay"
    content = describe_scenario("thermostat.toml")
    rows = {row["signal"]: row for row in content["signals"]}
    assert rows["relay"]["role"] == "ports not known"
    assert content["scenario"]["schedule"] == "not known, as the ports of some components are not"
    assert content["metadata"]["relay"]["class"] == "relay:Relay"
    content = describe_log("a.mcap")
    assert content["metadata"]["relay"]["code"]["class"] == "relay:Relay"
    assert {row["signal"] for row in content["signals"]} >= {"relay.u", "relay.y"}
    (folder / "thermostat.toml").write_text(THERMOSTAT.replace("time_constant", "time"))
    with pytest.raises(ScenarioError, match="'time_constant' is missing"):
        describe_scenario("thermostat.toml")


@pytest.mark.slow
def test_prints_of_a_class_are_not_data_and_a_dry_run_says_what_it_imports(folder, call):
    """Stdout is for data, whatever a module prints."""
    (folder / "relay.py").write_text(f"print('imported')\n{RELAY}")
    code, out, err = call("run", "thermostat.toml", "--out", "a.mcap", "--json")
    json.loads(out)
    assert (code, "imported" in err) == (0, True)
    json.loads(call("replay", "a.mcap", "--allow-code", "--json")[1])
    json.loads(call("check", "thermostat.toml", "--json")[1])
    _, out, _ = call("run", "thermostat.toml", "--dry-run")
    assert "relay: relay:Relay was imported" in out.splitlines()


# --- replays ---


def test_a_replay_takes_the_component_from_the_log(folder, monkeypatch):
    """Wherever its module is by now; the verification says what was not computed, and the way."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    forbid_imports(monkeypatch)
    (folder / "relay.py").unlink()
    again = cosim.replay("a.mcap", out="b.mcap")
    assert cosim.diff(log, again).equal
    assert summarize(again).copied_code == {"relay": "relay:Relay"}
    verification = verify(open_log("a.mcap"), again)
    assert verification.passed
    assert verification.code == ("relay.y",)
    (line,) = [line for line in verification.lines if "not verified" in line]
    assert "relay.y; allow_code=True" in line
    assert not any("relay.y; to compute these too" in line for line in verification.lines)
    assert verify(open_log("b.mcap"), cosim.replay("b.mcap")).code == ("relay.y",)


def test_a_replay_with_allowed_code_computes_it(folder):
    """And its verification covers it, also of the log of another replay."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    cosim.replay("a.mcap", out="b.mcap")
    for path in ("a.mcap", "b.mcap"):
        again = cosim.replay(path, allow_code=True)
        assert summarize(again).copied_code == {}
        verification = verify(open_log(path), again)
        assert verification.passed
        assert verification.copied == ()
        assert "relay.y" in verification.computed
        assert cosim.diff(log, again).equal


def test_allowed_code_may_be_changed_in_a_replay(folder):
    """What a run with the change computes; without the code it is refused, with the way out."""
    cosim.run("thermostat.toml", out="a.mcap")
    change = {"relay.width": 0.25}
    with pytest.raises(UsageError, match=r"set\['relay\.width'\]: 'relay' .*allow_code=True"):
        cosim.replay("a.mcap", set=change)
    again = cosim.replay("a.mcap", set=change, allow_code=True)
    assert cosim.diff(again, cosim.run("thermostat.toml", set=change)).equal


def test_who_names_the_class_gets_it_as_it_is_now(folder):
    """Else other code than that of the log is refused, by both hashes."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    recorded = source_hash(folder)
    (folder / "relay.py").write_text(RELAY.replace("u[k, 0] < 0.0", "u[k, 0] > 0.0"))
    with pytest.raises(ScenarioError, match=r"thermostat\.toml:9: components\.relay: ") as error:
        cosim.replay("a.mcap", allow_code=True)
    for part in ("relay.py", source_hash(folder), recorded, "set={'relay.class': 'relay:Relay'}"):
        assert part in str(error.value)
    again = cosim.replay("a.mcap", set={"relay.class": "relay:Relay"})
    assert summarize(again).copied_code == {}
    assert cosim.diff(again, cosim.run("thermostat.toml")).equal
    assert not cosim.diff(again, log).equal


MARK = "from pathlib import Path\nPath('mark').touch()\n"


@pytest.mark.parametrize("changed", ["relay.py", "beside.py"])
def test_other_code_than_that_of_the_log_is_not_run(folder, changed):
    """Its hash is compared before, that of a module beside the class too."""
    texts = {"relay.py": RELAY + "\nimport beside\n", "beside.py": "LEVEL = 1\n"}
    for name, text in texts.items():
        (folder / name).write_text(text)
    cosim.run("thermostat.toml", out="a.mcap")
    (folder / changed).write_text(MARK + texts[changed])
    with pytest.raises(ScenarioError, match=rf"{changed} with the SHA-256"):
        cosim.replay("a.mcap", allow_code=True)
    assert not (folder / "mark").exists()
    cosim.replay("a.mcap", set={"relay.class": "relay:Relay"})
    assert (folder / "mark").exists()


@pytest.mark.parametrize("file", ["far_relay.py", "far_relay/__init__.py"])
def test_another_ordinary_module_than_that_of_the_log_is_not_run(folder, monkeypatch, file):
    """Of a new process, in which it has not been imported."""
    path = folder / "elsewhere" / file
    path.parent.mkdir(parents=True)
    path.write_text(RELAY)
    monkeypatch.syspath_prepend(folder / "elsewhere")
    cosim.run("thermostat.toml", set={"relay.class": "far_relay:Relay"}, out="a.mcap")
    del sys.modules["far_relay"]
    path.write_text(MARK + RELAY)
    with pytest.raises(ScenarioError, match=r"far_relay.*py with the SHA-256"):
        cosim.replay("a.mcap", allow_code=True)
    assert not (folder / "mark").exists()


DESIGNED = """
    import numpy as np
    from cosim.core import Interface, Signal

    class Own:
        interface = Interface(
            (Signal("u"),), (Signal("y"),), feedthrough={"y": ("u",)}, prepares=True
        )

        def prepare(self, h, held, recorded):
            self.gain = recorded.get("gain", np.array([%s * h]))
            return {"gain": self.gain}

        def initialize(self, t, u):
            return self.outputs(t, u)

        def outputs(self, t, u):
            return self.gain * u

        def advance(self, t, h, u):
            return self.gain * u[1:]
"""


def test_a_recorded_design_is_that_of_its_code(tmp_path, monkeypatch):
    """The same code takes it in a replay; other code, named by the caller, makes its own."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, own=DESIGNED % "4.0")
    log = cosim.run(one(tmp_path), out="a.mcap")
    assert log.designs["own"]["gain"].tolist() == [1.0]
    again = cosim.replay("a.mcap", allow_code=True)
    assert verify(open_log("a.mcap"), again).passed
    write(tmp_path, own=DESIGNED % "8.0")
    changed = cosim.replay("a.mcap", set={"own.class": "own:Own"})
    np.testing.assert_array_equal(changed["own.y"], 2.0 * log["own.y"])


def test_a_replay_in_another_folder_says_where_it_looked(folder, monkeypatch):
    """What the log says of a path is not used: it may come from anywhere."""
    cosim.run("thermostat.toml", out="a.mcap")
    other = folder / "other"
    other.mkdir()
    shutil.copy("a.mcap", other)
    monkeypatch.chdir(other)
    message = rf"thermostat\.toml:11: components\.relay\.class: .*'relay' in {other} "
    with pytest.raises(ScenarioError, match=message):
        cosim.replay("a.mcap", allow_code=True)


# --- what classes do wrong ---

LACKING = """
    from cosim.core import Interface, Signal
    class Own:
        interface = Interface((Signal("u"),), (Signal("y"),))
        def initialize(self, t, u):
            return u
"""
PLACE = r"one\.toml:1[02]: components\.own"
WRONG_MODULES = [
    ("class Own:\n    pass\n", rf"{PLACE}: .*Interface, got None .*Own$"),
    (LACKING, r"type Own; missing: outputs, advance"),
    ("x = 1\n1 / 0\n", rf"{PLACE}\.class: .*ZeroDivisionError: .*/own\.py, line 2\)$"),
    # the string itself is in no file: the line is the one that compiles it
    ("x = 1\neval('int32(float64*)')\n", r"SyntaxError: .*line 1\) \(.*/own\.py, line 2\)$"),
]


NO_CLASS_NAMES = [
    ("own", r"one\.toml:12: components\.own\.class: expected 'package\.module:Class', got 'own'$"),
    ("own.Own", r"got 'own\.Own'; did you mean 'own:Own'\?$"),
    ("own:", r"expected 'package\.module:Class', got 'own:'"),
    ("a/own:Own", r"expected 'package\.module:Class', got 'a/own:Own'"),
]


def test_a_name_of_no_class_is_refused_before_anything_is_imported(tmp_path):
    """At its line."""

    def load(name):
        document = one(tmp_path).document
        parse(Document(document.text.replace("own:Own", name), "one.toml", tmp_path))

    check_refused(NO_CLASS_NAMES, load, ScenarioError)


def test_a_module_without_a_component_is_named_before_the_run(tmp_path):
    """With what it lacks, at its line."""

    def run(text):
        write(tmp_path, own=text)
        cosim.run(one(tmp_path))

    check_refused(WRONG_MODULES, run, ScenarioError)


RAISING = [
    ("constructor", 'raise ValueError("-1")', r"one\.toml:10: .* raised ValueError: -1"),
    ("initialize", "[].pop()", r"'own' stopped at t = 0\.0 s: initialize raised IndexError: pop"),
    ("advance", "t[-1] <= 0.5 or 1 / 0", r"'own' stopped at t = 0\.5 s: advance raised Zero"),
]


@pytest.mark.parametrize(("method", "body", "text"), RAISING)
def test_an_exception_names_component_time_and_line(tmp_path, method, body, text):
    """The user's own exception is the cause, at the line that it left."""
    own_module(tmp_path, **{method: body})
    line = (tmp_path / "own.py").read_text().splitlines().index(f"        {body}") + 1
    pattern = rf"{text}.*own\.py, line {line}\)"
    with pytest.raises((RunError, ScenarioError), match=pattern) as error:
        cosim.run(one(tmp_path), block=1)
    cause = error.value
    while cause.__cause__ is not None:
        cause = cause.__cause__
    assert type(cause) in (ValueError, IndexError, ZeroDivisionError)


# --- kinds of installed packages, by the entry points ``cosim.components`` ---

SCENARIO = THERMOSTAT.replace('kind = "python"\nclass = "relay:Relay"\n', 'kind = "relay"\n')


def install(site, name, entries, version="1.0"):
    """Write the metadata of a distribution with entry points, as an installer does."""
    about = site / f"{name}-{version}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    (about / "entry_points.txt").write_text(f"[cosim.components]\n{entries}\n")
    (about / "top_level.txt").write_text("relay_parts\n")
    (about / "RECORD").write_text("")


@pytest.fixture
def site(tmp_path, monkeypatch):
    """Return a folder on sys.path where a package with a relay is installed."""
    site = tmp_path / "site"
    site.mkdir()
    write(site / "relay_parts", __init__="", thermostats=RELAY)
    install(site, "relay_package", "relay = relay_parts.thermostats:Relay")
    before = set(sys.modules)
    monkeypatch.syspath_prepend(site)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "thermostat.toml").write_text(SCENARIO)
    yield site
    for name in set(sys.modules) - before:
        if name.startswith("relay_parts"):
            del sys.modules[name]


def test_an_entry_point_makes_a_kind(site):
    """The same run as by its class; the log names package and version."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    code = json.loads(log.metadata["cosim.component.relay"]["metadata"])["code"]
    assert code["class"] == "relay_parts.thermostats:Relay"
    assert set(code["sources"]) == {"relay_parts/thermostats.py"}
    assert code["distribution"] == "relay_package 1.0"
    by_class = cosim.run(
        "thermostat.toml",
        set={"relay.kind": "python", "relay.class": "relay_parts.thermostats:Relay"},
    )
    assert cosim.diff(log, by_class).equal


def test_nothing_is_imported_to_list_or_show_it(site, capsys):
    print_shown(show_catalog(), as_json=True)
    entry = {"kind": "relay", "class_name": "relay_parts.thermostats:Relay"}
    entry |= {"distribution": "relay_package 1.0", "refused": None}
    assert json.loads(capsys.readouterr().out)["installed"] == [entry]
    print_shown(show_kind("relay"), as_json=False)
    text = capsys.readouterr().out
    assert "relay: relay_parts.thermostats:Relay, of relay_package 1.0" in text
    assert "parameters: those of its constructor; nothing is imported here" in text
    metadata = describe_scenario("thermostat.toml")["metadata"]
    assert metadata["relay"]["class"] == "relay_parts.thermostats:Relay"
    assert not [name for name in sys.modules if name.startswith("relay_parts")]


def test_a_log_replays_where_the_package_is_not_installed(site, monkeypatch):
    """From the recording; with allowed code the package is needed."""
    cosim.run("thermostat.toml", out="a.mcap")
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path != str(site)])
    again = cosim.replay("a.mcap", out="b.mcap")
    assert verify(open_log("a.mcap"), again).passed
    assert verify(open_log("b.mcap"), cosim.replay("b.mcap")).passed
    message = r"thermostat\.toml:9: components\.relay: .*'relay'.*'cosim\.components'"
    with pytest.raises(ScenarioError, match=message):
        cosim.replay("a.mcap", allow_code=True)


def test_another_version_of_the_package_is_not_the_code_of_the_log(site):
    """Its other modules may be others, which the hash of the class's module does not tell."""
    cosim.run("thermostat.toml", out="a.mcap")
    assert verify(open_log("a.mcap"), cosim.replay("a.mcap", allow_code=True)).passed
    about = site / "relay_package-1.0.dist-info"
    for file in list(about.iterdir()):
        file.unlink()
    about.rmdir()
    install(site, "relay_package", "relay = relay_parts.thermostats:Relay", version="1.1")
    with pytest.raises(ScenarioError, match=r"got relay_package 1\.1; .*relay_package 1\.0"):
        cosim.replay("a.mcap", allow_code=True)


@pytest.mark.parametrize(
    ("package", "entry", "reason"),
    [
        ("gains", "gain = relay_parts.thermostats:Relay", "'gain' is a kind of cosim"),
        ("nameless", "nobody = relay_parts.thermostats", "expected 'package.module:Class', got"),
        ("other", "relay = relay_parts.thermostats:Relay", "'relay' is declared more than once"),
    ],
)
def test_an_entry_point_that_makes_no_kind_is_listed_with_the_reason(
    site, capsys, package, entry, reason
):
    """The name of a shipped kind stays with it: what is installed does not change a file."""
    install(site, package, entry)
    print_shown(show_catalog(), as_json=False)
    lines = capsys.readouterr().out.splitlines()
    (line,) = [line for line in lines if f"\t{package} 1.0" in line]
    assert f"refused: {reason}" in line
    print_shown(show_kind("gain"), as_json=False)
    assert "relay_parts" not in capsys.readouterr().out


def test_a_scenario_cannot_use_a_doubtful_entry_point(site):
    """One without a class, and one that two packages declare: with both, and the way out."""
    install(site, "nameless", "nobody = relay_parts.thermostats")
    with pytest.raises(ScenarioError, match=r"got 'relay_parts\.thermostats'"):
        cosim.run("thermostat.toml", set={"relay": {"kind": "nobody"}})
    install(site, "other", "relay = relay_parts.thermostats:Relay", version="2.0")
    with pytest.raises(ScenarioError, match=r"'relay' is declared 2 times.*kind = .pyt") as error:
        cosim.run("thermostat.toml")
    assert "other 2.0" in str(error.value)
    assert "relay_package 1.0" in str(error.value)
