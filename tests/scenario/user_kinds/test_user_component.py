"""A component of a user's class in a scenario: its run, its log, its replay, its errors."""

import json
import re
import shutil
import sys

import numpy as np
import pytest

import cosim
from cosim.errors import NonFiniteError, RunError, ScenarioError, UsageError
from cosim.log import open_log
from cosim.report.inspection import describe_log, describe_scenario
from cosim.report.summary import summarize
from cosim.report.verification import verify
from cosim.scenario.building.build import parse
from cosim.scenario.document.document import Document
from cosim.scenario.kinds import user_code
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


@pytest.fixture
def no_import(monkeypatch):
    forbid_imports(monkeypatch)


def test_a_class_runs_as_a_component_of_a_scenario(folder):
    """The relay holds the room at 20, to its width and what the room moves in two steps of 0.1 s.

    It sees the room at the start of a step and acts at its end; the slopes there are -0.95 and
    0.45 per second.
    """
    run = cosim.run("thermostat.toml")
    room = run["room.y"][300:]
    assert 19.5 - 0.19 < room.min() < 19.5
    assert 20.5 < room.max() < 20.5 + 0.09
    assert set(np.unique(run["relay.y"])) == {0.0, 1.0}


def test_the_size_of_a_block_changes_no_bit(folder, tmp_path):
    """In a loop with compiled components, and in a cascade behind them."""
    runs = [cosim.run("thermostat.toml", block=block) for block in (1, 7, 1000)]
    own_module(tmp_path)
    cascades = [cosim.run(one(tmp_path), block=block) for block in (1, 3, 1000)]
    for first, *others in (runs, cascades):
        for other in others:
            assert cosim.diff(first, other).equal


def test_the_log_names_class_and_source(folder):
    log = cosim.run("thermostat.toml", out="a.mcap")
    code = json.loads(log.metadata["cosim.component.relay"]["metadata"])["code"]
    source = user_code.load_class("relay:Relay", folder).sources["relay.py"]
    assert code == {
        "class": "relay:Relay",
        "sources": {"relay.py": source},
        "distribution": None,
    }
    assert log.kinds["relay"] == "python"


# --- what shows a scenario or a log, and runs nothing ---


def test_info_shows_the_class_and_imports_nothing(folder, no_import):
    content = describe_scenario("thermostat.toml")
    rows = {row["signal"]: row for row in content["signals"]}
    assert rows["relay"]["role"] == "ports not known"
    assert rows["room.y"]["size"] == 1
    assert content["scenario"]["schedule"] == "not known, as the ports of some components are not"
    assert content["connections"][0] == {
        "to": "room.u",
        "from": "relay.y",
        "map": "15.0 v + 10.0",
        "unit": None,
        "conversion": None,
    }
    assert content["metadata"]["relay"]["class"] == "relay:Relay"
    assert "'cosim run SCENARIO --dry-run' imports it" in content["metadata"]["relay"]["ports"]


def test_info_of_a_log_shows_the_class_and_imports_nothing(folder, monkeypatch):
    cosim.run("thermostat.toml", out="a.mcap")
    forbid_imports(monkeypatch)
    content = describe_log("a.mcap")
    assert content["metadata"]["relay"]["code"]["class"] == "relay:Relay"
    assert {row["signal"] for row in content["signals"]} >= {"relay.u", "relay.y"}


def test_info_tells_of_other_problems_all_the_same(folder, no_import):
    """Those that do not depend on the ports of the class."""
    text = THERMOSTAT.replace("time_constant", "time")
    (folder / "thermostat.toml").write_text(text)
    with pytest.raises(ScenarioError) as error:
        describe_scenario("thermostat.toml")
    assert "'time_constant' is missing" in str(error.value)


def test_load_imports_nothing(folder, no_import):
    """Only what builds the components does."""
    assert cosim.load("thermostat.toml").specs["relay"].code == "relay:Relay"


@pytest.mark.slow
def test_a_dry_run_says_what_it_imports(folder, call):
    with (folder / "relay.py").open("a") as file:
        file.write("\nprint('relay is imported')\n")
    code, out, err = call("run", "thermostat.toml", "--dry-run")
    assert code == 0, err
    assert "relay: relay:Relay was imported" in out.splitlines()
    assert "dry run: no problems found" in out
    code, out, _ = call("run", "--help")
    help_text = " ".join(out.split())
    assert "Python classes are loaded and initialized" in help_text


@pytest.mark.slow
def test_prints_of_a_class_are_not_data(folder, call):
    """At its import and in its steps; stdout is for data."""
    (folder / "relay.py").write_text(
        "print('imported')\n"
        + RELAY.replace("self.on = False", "print('initialized')\n        self.on = False")
    )
    for arguments in (
        ["run", "thermostat.toml", "--out", "a.mcap"],
        ["run", "thermostat.toml", "--dry-run"],
        ["replay", "a.mcap", "--allow-code"],
        ["check", "thermostat.toml"],
    ):
        code, out, err = call(*arguments, "--json")
        assert code == 0, err
        json.loads(out)
    code, _, err = call("run", "thermostat.toml", "--out", "b.mcap")
    assert "initialized" in err.splitlines()


def test_commands_say_whether_they_run_code(call):
    _, out, _ = call("info", "--help")
    assert "Runs no code of FMUs or user classes." in " ".join(out.split())
    _, out, _ = call("check", "--help")
    assert "Python classes imported, which runs their code" in " ".join(out.split())


# --- replays ---


def test_a_replay_takes_the_component_from_the_log(folder, monkeypatch):
    """Wherever its module is, and whatever it is by now."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    forbid_imports(monkeypatch)
    (folder / "relay.py").unlink()
    again = cosim.replay("a.mcap")
    assert cosim.diff(log, again).equal
    assert summarize(again).copied_code == {"relay": "relay:Relay"}
    verification = verify(open_log("a.mcap"), again)
    assert verification.passed
    assert verification.code == ("relay.y",)
    (line,) = [line for line in verification.lines if "not verified" in line]
    assert re.search("relay\\.y; allow_code=True", line)
    assert not any("relay.y; to compute these too" in line for line in verification.lines)


def test_a_replay_with_allowed_code_computes_it(folder):
    """And its verification covers it: a changed row of the component is found."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    again = cosim.replay("a.mcap", allow_code=True)
    assert summarize(again).copied_code == {}
    verification = verify(open_log("a.mcap"), again)
    assert verification.passed
    assert verification.copied == ()
    assert "relay.y" in verification.computed
    assert cosim.diff(log, again).equal


def test_allowed_code_may_be_changed_in_a_replay(folder):
    """What a run with the change computes; without the code it is refused, with the way out."""
    cosim.run("thermostat.toml", out="a.mcap")
    with pytest.raises(UsageError) as error:
        cosim.replay("a.mcap", set={"relay.width": 0.25})
    assert str(error.value).startswith("set['relay.width']: 'relay' ")
    assert "allow_code=True" in str(error.value)
    again = cosim.replay("a.mcap", set={"relay.width": 0.25}, allow_code=True)
    assert cosim.diff(again, cosim.run("thermostat.toml", set={"relay.width": 0.25})).equal


def test_other_code_than_that_of_the_log_is_refused(folder):
    """By both hashes; who names the class gets it as it is now."""
    log = cosim.run("thermostat.toml", out="a.mcap")
    recorded = user_code.load_class("relay:Relay", folder).sources["relay.py"]
    (folder / "relay.py").write_text(RELAY.replace("u[k, 0] < 0.0", "u[k, 0] > 0.0"))
    found = user_code.load_class("relay:Relay", folder).sources["relay.py"]
    with pytest.raises(ScenarioError, match=r"thermostat\.toml:9: components\.relay: ") as error:
        cosim.replay("a.mcap", allow_code=True)
    for part in ("relay.py", found, recorded, "set={'relay.class': 'relay:Relay'}"):
        assert part in str(error.value)
    again = cosim.replay("a.mcap", set={"relay.class": "relay:Relay"})
    assert summarize(again).copied_code == {}
    assert cosim.diff(again, cosim.run("thermostat.toml")).equal
    assert not cosim.diff(again, log).equal


def test_the_log_of_a_replay_still_names_the_code(folder):
    """So that it can be replayed in both ways, too."""
    cosim.run("thermostat.toml", out="a.mcap")
    cosim.replay("a.mcap", out="b.mcap")
    assert verify(open_log("b.mcap"), cosim.replay("b.mcap")).code == ("relay.y",)
    assert verify(open_log("b.mcap"), cosim.replay("b.mcap", allow_code=True)).passed


def test_a_module_beside_the_class_counts_as_its_code(folder):
    """The hash of the class's own file is not all."""
    (folder / "relay.py").write_text(RELAY + "\nfrom beside import LEVEL\n")
    (folder / "beside.py").write_text("LEVEL = 1\n")
    cosim.run("thermostat.toml", out="a.mcap")
    (folder / "beside.py").write_text("LEVEL = 2\n")
    with pytest.raises(ScenarioError, match=r"beside\.py with the SHA-256"):
        cosim.replay("a.mcap", allow_code=True)


@pytest.mark.parametrize("changed", ["relay.py", "beside.py"])
def test_other_code_than_that_of_the_log_is_not_run(folder, changed):
    """Its hash is compared before: to allow code is to allow that of the log."""
    texts = {"relay.py": RELAY + "\nimport beside\n", "beside.py": "LEVEL = 1\n"}
    for name, text in texts.items():
        (folder / name).write_text(text)
    cosim.run("thermostat.toml", out="a.mcap")
    mark = "from pathlib import Path\nPath('mark').touch()\n"
    (folder / changed).write_text(mark + texts[changed])
    with pytest.raises(ScenarioError, match=rf"{changed} with the SHA-256"):
        cosim.replay("a.mcap", allow_code=True)
    assert not (folder / "mark").exists()
    cosim.replay("a.mcap", set={"relay.class": "relay:Relay"})
    assert (folder / "mark").exists()


@pytest.mark.parametrize("is_package", [False, True])
def test_another_ordinary_module_than_that_of_the_log_is_not_run(folder, monkeypatch, is_package):
    """Of a new process, in which it has not been imported."""
    elsewhere = folder / "elsewhere"
    home = elsewhere / "far_relay" if is_package else elsewhere
    home.mkdir(parents=True)
    file = home / ("__init__.py" if is_package else "far_relay.py")
    file.write_text(RELAY)
    monkeypatch.syspath_prepend(elsewhere)
    changes = {"relay.class": "far_relay:Relay"}
    cosim.run("thermostat.toml", set=changes, out="a.mcap")
    del sys.modules["far_relay"]
    file.write_text("from pathlib import Path\nPath('mark').touch()\n" + RELAY)
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


def test_scenarios_in_two_folders_have_their_own_classes(tmp_path):
    """With modules of one name, run in turns."""
    for factor in ("2.0", "3.0"):
        write(tmp_path / factor)
        own_module(tmp_path / factor, advance=f"return {factor} * u[1:]")
    scenarios = {factor: one(tmp_path / factor) for factor in ("2.0", "3.0")}
    for factor in ("2.0", "3.0", "2.0"):
        assert cosim.run(scenarios[factor])["own.y"][-1] == float(factor)


def test_a_unit_of_the_table_is_that_of_the_output(tmp_path):
    own_module(tmp_path)
    log = cosim.run(one(tmp_path, 'unit = "N"'))
    assert log.channels["own"].by_name["y"].unit == "N"


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


def test_the_command_replays_with_and_without_the_code(folder, call):
    call("run", "thermostat.toml", "--out", "a.mcap", "--quiet")
    code, out, _ = call("replay", "a.mcap")
    assert code == 0
    (line,) = [line for line in out.splitlines() if line.startswith("relay\t")]
    assert "replayed from the log; --allow-code runs relay:Relay" in line
    code, out, _ = call("replay", "a.mcap", "--allow-code")
    assert "from the log" not in out
    code, out, _ = call("replay", "a.mcap", "--verify")
    assert code == 0
    assert re.search("not verified.*: relay\\.y; --allow-code", out)
    code, out, _ = call("replay", "a.mcap", "--verify", "--allow-code")
    assert code == 0
    assert "not verified" not in out
    (folder / "relay.py").write_text(RELAY + "\n")
    code, _, err = call("replay", "a.mcap", "--verify", "--allow-code")
    assert code == 2
    assert "--set relay.class=relay:Relay" in err


# --- what classes do wrong ---


def test_a_class_that_is_no_component_is_named_before_the_run(tmp_path):
    """With what it lacks, at its line."""
    write(tmp_path, own="class Own:\n    pass\n")
    message = r"one\.toml:10: components\.own: .*Interface, got None .*Own$"
    with pytest.raises(ScenarioError, match=message):
        cosim.run(one(tmp_path))
    write(
        tmp_path,
        own="""
            from cosim.core import Interface, Signal
            class Own:
                interface = Interface((Signal("u"),), (Signal("y"),))
                def initialize(self, t, u):
                    return u
        """,
    )
    with pytest.raises(ScenarioError, match=r"type Own; missing: outputs, advance"):
        cosim.run(one(tmp_path))


def test_an_import_error_carries_its_traceback(tmp_path):
    """The user's own exception is the cause, with the lines that led to it."""
    write(tmp_path, own="def ratio():\n    return 1 / 0\nratio()\n")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path))
    assert str(error.value) == (
        "one.toml:12: components.own.class: 'own' cannot be imported: ZeroDivisionError: division "
        f"by zero ({tmp_path}/own.py, line 2)"
    )
    assert "ratio" in functions_of(cause(error.value, ZeroDivisionError))


def test_a_syntax_error_of_a_string_has_the_line_that_compiles_it(tmp_path):
    """As of an annotation; the string itself is in no file."""
    write(tmp_path, own="x = 1\neval('int32(float64*)')\n")
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path))
    assert "SyntaxError: invalid syntax (<string>, line 1)" in str(error.value)
    assert str(error.value).endswith(f"({tmp_path}/own.py, line 2)")


def test_a_constructor_that_raises_is_named_with_its_line(tmp_path):
    own_module(tmp_path, constructor='raise ValueError("width: found -1")')
    with pytest.raises(ScenarioError) as error:
        cosim.run(one(tmp_path))
    assert str(error.value) == (
        "one.toml:10: components.own: the constructor of 'own:Own' raised ValueError: width: found "
        f"-1 ({tmp_path}/own.py, line 11)"
    )
    assert "__init__" in functions_of(cause(error.value, ValueError))


def cause(error, kind):
    """Return the first error of a type among the causes of an error."""
    while error is not None and type(error) is not kind:
        error = error.__cause__
    return error


def functions_of(error):
    """Return the functions in the traceback of an error."""
    names = []
    trace = error.__traceback__
    while trace is not None:
        names.append(trace.tb_frame.f_code.co_name)
        trace = trace.tb_next
    return names


def failed_run(folder, **bodies):
    """Run the component with these bodies of its methods; return the error of the run."""
    own_module(folder, **bodies)
    with pytest.raises(RunError) as error:
        cosim.run(one(folder), block=1)
    return error.value


def test_an_exception_in_a_step_names_component_time_and_line(tmp_path):
    error = failed_run(tmp_path, advance="t[-1] <= 0.5 or 1 / 0")
    assert str(error) == (
        "'own' stopped at t = 0.5 s: advance raised ZeroDivisionError: division by zero "
        f"({tmp_path}/own.py, line 22)"
    )
    assert "advance" in functions_of(cause(error, ZeroDivisionError))


def test_an_exception_in_initialize_names_component_time_and_line(tmp_path):
    error = failed_run(tmp_path, initialize="[].pop()")
    assert str(error) == (
        "'own' stopped at t = 0.0 s: initialize raised IndexError: pop from empty list "
        f"({tmp_path}/own.py, line 14)"
    )
    assert "initialize" in functions_of(cause(error, IndexError))


def test_a_result_of_another_shape_or_type_is_named(tmp_path):
    """Beside the shape that is expected."""
    results = {
        "1.0": r"float\b.*\(1, 1\)",
        "np.zeros(3)": r"float64.*\(3,\).*\(1, 1\)",
        "np.zeros((4, 2))": r"float64.*\(4, 2\).*\(1, 1\)",
        "np.zeros((1, 1), int)": r"int64.*\(1, 1\).*\(1, 1\)",
        "None": r"NoneType.*\(1, 1\)",
    }
    mismatches = []
    for value, pattern in results.items():
        text = str(failed_run(tmp_path, advance=f"return {value}"))
        if not re.match(rf"'own' stopped at t = 0\.0 s: advance .*{pattern}", text):
            mismatches.append(f"{value}: expected {pattern}, got {text}")
    assert mismatches == []


def test_a_value_that_is_not_finite_is_named_at_its_time(tmp_path):
    own_module(tmp_path, advance="return np.where(t[1:, np.newaxis] > 0.6, np.nan, u[1:])")
    with pytest.raises(NonFiniteError) as error:
        cosim.run(one(tmp_path))
    assert str(error.value) == ("'own.y' became nan at t = 0.75 s; everything before is kept")


def test_inputs_cannot_be_changed(tmp_path):
    """Neither u nor t: they are rows of the run, which others read."""
    changes = [
        ("initialize", "u[0] = 1.0", 14),
        ("outputs", "u += 1.0", 18),
        ("advance", "u[0] = 1.0", 22),
        ("advance", "t[0] = 1.0", 22),
        ("advance", "u.sort(axis=0)", 22),
    ]
    mismatches = []
    for method, body, line in changes:
        text = str(failed_run(tmp_path, **{method: body}))
        begin = f"'own' stopped at t = 0.0 s: {method} raised ValueError: "
        place = f" ({tmp_path}/own.py, line {line}); "
        if not text.startswith(begin) or "read-only" not in text or place not in text:
            mismatches.append(f"{method}: {body}: {text}")
    assert mismatches == []


def test_a_name_of_a_class_is_checked_with_the_file():
    text = THERMOSTAT.replace("relay:Relay", "relay.Relay")
    with pytest.raises(ScenarioError) as error:
        parse(Document(text, "thermostat.toml", None))
    assert "thermostat.toml:11: components.relay.class: " in str(error.value)
    assert "got 'relay.Relay'" in str(error.value)
