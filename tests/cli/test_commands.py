"""The command line: exit codes, stdout and stderr, and the cost of its help."""

import contextlib
import dataclasses
import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios

import pytest

import cosim
from cosim.fmi.variable import Variable
from cosim.version import __version__
from tests.fmi.archives import write
from tests.fmi.compiled import compile_fmu
from tests.fmi.descriptions import FMI1, FMI2, FMI3
from tests.fmi.eventful import build
from tests.fmi.rogues import XML

SHORT = ["--stop", "0.1"]
HEAD = '[scenario]\nname = "x"\nstop = 0.2\nstep = 0.1\n'


def test_run_writes_numbered_logs_and_says_where(call, tmp_path):
    """Without --out a run writes logs/<scenario>.mcap, then -2, -3."""
    for name in ("academic.mcap", "academic-2.mcap", "academic-3.mcap"):
        code, out, _ = call("run", "academic", *SHORT)
        assert code == 0
        assert f"logs/{name}" in out
        assert (tmp_path / "logs" / name).is_file()


def test_run_shows_errors_estimates_and_start_time(call):
    """The table carries what a run is for."""
    _, out, _ = call("run", "academic", "--stop", "10", "--out", "a.mcap")
    for text in (
        "observer.x_a",
        "observer.delta",
        "identifier.theta[1]",
        "identification\tfrom 6.461 s",
        "observer 3.4539 s + filter 0.0069 s + longest delay 3 s",
        "wall time",
    ):
        assert text in out
    rows = re.findall(r"theta\[\d\]\t\S+\t± (\S+)\t(\S+)\t(\S+)", out)
    assert len(rows) == 2
    for half_width, truth, error in rows:
        assert abs(float(error)) < float(half_width) < 1e-5 * abs(float(truth))


@pytest.mark.slow
def test_as_printed_says_why_it_does_not_converge(call):
    """The summary names the prior and the information it outweighs."""
    _, out, _ = call("run", "academic-as-printed", "--out", "a.mcap")
    words = " ".join(out.split())
    assert "eigenvalues 0.00176, 0.0052, 0.32, 0.797, 54.9" in words
    assert "the prior 1/P0 = 0.001 is 0.57 of the smallest information eigenvalue" in words


def test_json_is_json_and_complete(call):
    """--json prints one JSON document with the same content."""
    code, out, err = call("run", "academic", *SHORT, "--json", "--profile")
    found = json.loads(out)
    assert (code, err) == (0, "")
    assert found["steps"] == 100
    assert found["values"][0] == {
        "estimate": "identifier.theta[0]",
        "value": None,
        "truth": -0.1,
        "error": None,
    }
    assert set(found["profile"]) >= {"plant", "observer", "recorder and master"}


def test_quiet_prints_nothing(call, monkeypatch):
    """--quiet is quiet, and what it would print is not computed."""
    monkeypatch.setattr("cosim.report.tables.run.summarize", None)
    assert call("run", "academic", *SHORT, "--quiet") == (0, "", "")


def test_quiet_keeps_what_times_and_units_are_taken_for(call, tmp_path):
    """A table whose times have no name or unit, values without a unit beside others; no more."""
    (tmp_path / "x.csv").write_text("a,y\n0,1\n1,1\n2,3\n")
    components = """
    a = { kind = "field-data", path = "x.csv" }
    b = { kind = "constant", value = 1.0, unit = "mm" }
    c = { kind = "gain", K = [[1.0, 0.0], [0.0, 1.0]], unit = { u = "m" } }
    """
    head = 'scenario = { name = "x", stop = 2.0, step = 1.0 }\n[components]'
    connections = '[connections]\n"c.u" = ["a.y", "b.y"]\n'
    (tmp_path / "x.toml").write_text(f"{head}{components}{connections}")
    code, out, err = call("run", "x.toml", "--quiet")
    assert (code, out) == (0, "")
    assert {line.split(":")[1].strip() for line in err.splitlines()} == {"a", "c"}
    (tmp_path / "x.csv").write_text("t [s],y [mm]\n0,1\n1,1\n2,3\n")
    assert call("run", "x.toml", "--quiet") == (0, "", "")


def test_quiet_looks_for_units_in_what_is_said_and_not_in_names(call, tmp_path):
    """Samples that are held for long are no question of units, of whichever component."""
    (tmp_path / "x.csv").write_text("t [s],y\n0,1\n0.1,1\n0.2,1\n0.3,1\n5,2\n")
    (tmp_path / "x.toml").write_text(
        'scenario = { name = "x", stop = 1.0, step = 1.0 }\n[components]\n'
        'unit = { kind = "field-data", path = "x.csv", interpolation = "zero-order" }\n'
    )
    assert call("run", "x.toml", "--quiet") == (0, "", "")


def test_set_step_and_stop_reach_the_run(call):
    """--set, --step and --stop change the scenario."""
    call(
        "run",
        "academic",
        "--stop",
        "0.2",
        "--step",
        "0.002",
        "--set",
        "observer.filter_rate=500",
        "--out",
        "a.mcap",
    )
    log = cosim.open_log("a.mcap")
    assert (log.step_ns, log.time("plant")[-1]) == (2_000_000, 0.2)
    assert json.loads(log.metadata["cosim.component.observer"]["table"])["filter_rate"] == 500


def test_an_existing_log_is_refused_with_exit_2(call):
    """Wrong use is exit 2, on stderr, without a traceback."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    code, out, err = call("run", "academic", *SHORT, "--out", "a.mcap")
    assert (code, out) == (2, "")
    assert err == "cosim: a.mcap exists; choose another path, or --force to replace it\n"
    assert call("run", "academic", *SHORT, "--out", "a.mcap", "--force")[0] == 0
    code, _, err = call("run", "academic", *SHORT, "--force")
    assert code == 2
    assert err.count("\n") == 1
    assert "--force" in err
    assert "--out" in err


def test_a_failed_run_is_exit_1_and_leaves_a_valid_log(call, tmp_path):
    """A value that is not finite ends the run; everything before is kept and says so."""
    (tmp_path / "bad.toml").write_text(
        '[scenario]\nname = "bad"\nstop = 1.0\nstep = 0.01\n'
        '[components.u]\nkind = "expression"\ny = "log(0.5 - t)"\n'
    )
    code, _, err = call("run", "bad.toml", "--out", "bad.mcap")
    assert code == 1
    assert err == (
        "cosim: 'u.y' became -inf at t = 0.5 s; everything before is kept\n"
        "cosim: bad.mcap holds the run up to t = 0.49 s\n"
    )
    code, out, _ = call("info", "bad.mcap", "--json")
    assert json.loads(out)["run"]["status"] == "failed"
    text = (tmp_path / "bad.toml").read_text()
    for wrong, reached in (
        ("log(-t)", "has no row of the run"),
        ("log(0.01 - t)", "holds the run up to t = 0.0 s"),
    ):
        (tmp_path / "bad.toml").write_text(text.replace("log(0.5 - t)", wrong))
        _, _, err = call("run", "bad.toml", "--out", "bad.mcap", "--force")
        assert f"cosim: bad.mcap {reached}\n" in err


def test_verify_finds_the_first_difference(call):
    """A log of another scenario fails the check, which names signal, time and both values."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    assert call("replay", "a.mcap", "--verify")[0] == 0
    code, out, err = call("replay", "a.mcap", "--verify", "--set", "observer.x_a0=[0.5, 0.0]")
    assert (code, out) == (1, "")
    assert "first: observer.x_a[0] at t = 0.0 s: log 0.0, replay 0.5" in err


def test_diff_is_exit_1_outside_the_tolerance(call):
    """Exit 1 outside, 0 within; the table names every signal."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    call("run", "academic", *SHORT, "--out", "b.mcap", "--set", "plant.x_a0=[1.0, -1.001]")
    code, out, _ = call("diff", "a.mcap", "b.mcap", "--atol", "1e-6")
    assert code == 1
    assert "plant.x_a" in out
    assert "outside" in out
    assert call("diff", "a.mcap", "b.mcap", "--atol", "10")[0] == 0
    code, out, _ = call("diff", "a.mcap", "b.mcap", "--json")
    assert code == 1
    assert json.loads(out)


def test_diff_compares_only_the_signals_given(call):
    """Elements too; one that is in neither log is named, with the nearest."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    call("run", "academic", *SHORT, "--out", "b.mcap", "--set", "plant.x_a0=[1.0, -1.001]")
    code, out, _ = call("diff", "a.mcap", "b.mcap", "u.y", "delta.y")
    assert code == 0
    assert "plant" not in out
    code, out, _ = call("diff", "a.mcap", "b.mcap", "plant.x_a[1]", "u.y", "--json")
    assert code == 1
    assert [row["signal"] for row in json.loads(out)["signals"]] == ["plant.x_a[1]", "u.y"]
    code, _, err = call("diff", "a.mcap", "b.mcap", "plant.x_c")
    assert code != 0
    assert "'plant' has no signal 'x_c'; did you mean 'x_b'?" in err


def test_info_of_a_log_a_scenario_and_an_fmu(call):
    """info shows what each contains, as tables and as JSON."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    call("export", "academic", "--component", "plant", "--out", "plant.fmu")
    for what, text in (
        ("a.mcap", "content hash"),
        ("closed-loop", "gauss-seidel controller plant observer"),
        ("plant.fmu", "der(x_a[0])"),
    ):
        code, out, _ = call("info", what)
        assert code == 0
        assert text in " ".join(out.split())
        assert json.loads(call("info", what, "--json")[1])


def test_info_and_diff_show_overrides(call):
    """How many there are, the first of them, and where two logs first differ in them."""
    for name, value in (("a", 0.3), ("b", 0.4)):
        loaded = cosim.load("academic").set({"scenario.stop": 0.1})
        with loaded.start(out=f"{name}.mcap") as sim:
            for _ in range(6):
                sim.step()
                sim["plant.u"] = value
                sim.step()
                sim.release("plant.u")
    _, out, _ = call("info", "a.mcap")
    out = " ".join(out.split())
    assert "by overrides: override 6, follow " in out
    assert "overrides t signal cause values 0.001 plant.u override 0.3 0.002 plant.u release" in out
    assert "more overrides not shown 2" in out
    content = json.loads(call("info", "a.mcap", "--json")[1])
    assert len(content["overrides"]) == 10
    assert call("diff", "a.mcap", "a.mcap")[0] == 0
    code, out, _ = call("diff", "a.mcap", "b.mcap", "plant.u")
    assert code == 1
    assert (
        "events: 12 in a, 12 in b: 6 of 12 jumps differ; first plant.u at "
        "0.001 s: override 0.3, override 0.4"
    ) in " ".join(out.split())
    code, out, _ = call("diff", "a.mcap", "b.mcap", "plant.u", "--atol", "0.2")
    assert code == 0
    assert "12 in b: within the tolerance" in " ".join(out.split())
    assert "12 in b: equal" in " ".join(call("diff", "a.mcap", "a.mcap", "plant.u")[1].split())
    assert "events" not in call("diff", "a.mcap", "b.mcap", "plant.delta")[1]


def test_info_of_fmus_of_every_version(call, tmp_path):
    """Text has units in SI, ranges, items, sizes, states and dependencies.

    JSON has every field.
    """
    for number, xml in enumerate((FMI1.replace("{implementation}", ""), FMI2, FMI3), 1):
        write(tmp_path / f"{number}.fmu", [], xml=xml.encode())
    texts = [call("info", f"{number}.fmu")[1] for number in (1, 2, 3)]
    one, two, three = (" ".join(text.split()) for text in texts)
    for text in (
        "N 1.0 kg.m.s-2",
        "u input continuous Float64 N 1 -1..2",
        "z output continuous Float64 unknown",
        "v output continuous Float64 nothing",
        "1 off, 2 on",
        "n states 2",
        "exchange identifier one",
    ):
        assert text in one
    for text in (
        "degC 1.0 K + 273.15",
        "kN 1000.0 kg.m.s-2",
        "approx 1.5 state",
        "-3 off, 7 on",
        "0..50 u, x",
        "der x u, x",
        "initial dependencies",
        "rise unknown",
        "x u",
        "default step 0.01",
    ):
        assert text in two
    for text in (
        "Float64[n][2] mm 6 x 0.5",
        "second input continuous Float64[n][2] mm 6 x 0.5 alias u",
        "Float32[n] u, x",
        "clocks tick",
        "fixed step 0.5, event mode, early return",
        "String[2] a b c",
    ):
        assert text in three
    found = json.loads(call("info", "3.fmu", "--json")[1])
    variables = {variable["name"]: variable for variable in found["variables"]}
    assert set(variables["u"]) == {field.name for field in dataclasses.fields(Variable)}
    assert (variables["u"]["start"], variables["u"]["dimensions"], variables["u"]["maximum"]) == (
        [0.5] * 6,
        ["n", 2],
        None,
    )
    assert found["units"]["mm"]["factor"] == 0.001
    assert (found["dependencies"]["y"], found["initial_dependencies"]["dx"]) == (["u", "x"], None)
    assert found["capabilities"]["cs"]["interpolates_inputs"]


@pytest.mark.slow
def test_check_reports_every_problem_and_exits_1_at_an_error(call, tmp_path):
    """A good FMU, one with warnings, one with errors, no file; JSON says the same."""
    call("export", "academic", "--component", "plant", "--out", "plant.fmu")
    assert call("check", "plant.fmu") == (0, "plant.fmu: no problems found\n", "")
    write(tmp_path / "x.fmu", [], xml=FMI3.replace('start="1 2 3"', 'start="1 2"').encode())
    code, out, _ = call("check", "x.fmu")
    assert code == 1
    assert "error: XML: variable 'x': has 2 start values for 3 elements\n" in out
    assert "warning: initial unknowns: not listed: mode\n" in out
    assert out.endswith("x.fmu: 2 errors, 1 warning\n")
    code, out, _ = call("check", "x.fmu", "--json")
    found = json.loads(out)
    assert (code, found["errors"], found["warnings"]) == (1, 2, 1)
    assert {
        "level": "error",
        "where": "XML",
        "text": "variable 'x': has 2 start values for 3 elements",
    } in found["findings"]
    assert call("check", "no.fmu") == (2, "", "cosim: no.fmu: there is no such file\n")


def test_plot_writes_pictures(call, tmp_path):
    """Of the format asked for, with the names of what is drawn; others are refused."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    assert call("plot", "a.mcap", "observer.delta", "plant.x_a", "--out", "two.svg") == (
        0,
        "two.svg\n",
        "",
    )
    drawn = (tmp_path / "two.svg").read_text(encoding="utf-8")
    assert "<svg" in drawn[:1000]
    assert "observer.delta" in drawn
    assert "plant.x_a" in drawn
    code, _, err = call("plot", "a.mcap", "observer.delta", "--out", "two.xyz")
    assert code == 2
    assert "two.xyz" in err
    assert call("plot", "a.mcap", "observer.dleta", "--out", "x.png")[0] == 2


def test_the_version_is_that_of_the_package(call):
    """And nothing else."""
    assert call("--version") == (0, f"cosim {__version__}\n", "")


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("2", "2")])
def test_linear_algebra_has_one_thread_unless_the_environment_has_another_number(
    given, expected, monkeypatch
):
    """It is set before numpy is imported, which would not see it later."""
    from cosim.__main__ import main

    monkeypatch.setenv("OPENBLAS_NUM_THREADS", given or "")
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    monkeypatch.setattr("sys.argv", ["cosim", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert os.environ["OPENBLAS_NUM_THREADS"] == expected


def test_an_export_has_a_place_by_default(call, tmp_path):
    """It is not replaced unless that is asked for."""
    arguments = ("export", "academic", "--component", "plant")
    path = "fmus/academic-plant.fmu"
    code, out, _ = call(*arguments)
    assert code == 0
    assert out.startswith(f"{path}: FMI 2.0")
    assert (tmp_path / path).is_file()
    code, _, err = call(*arguments)
    assert code == 2
    assert f"{path} exists" in err
    assert call(*arguments, "--force")[0] == 0


def test_list_names_scenarios_and_kinds_with_their_parameters(call):
    """Everything that can stand in a scenario is listed."""
    code, out, _ = call("list", "--json")
    found = json.loads(out)
    assert code == 0
    assert set(found["scenarios"]) == {
        "academic",
        "academic-as-printed",
        "academic-noisy",
        "closed-loop",
        "compensation",
        "pair",
    }
    parameters = found["kinds"]["unknown-input-observer"]["parameters"]
    filter_rate, L = parameters["filter_rate"], parameters["L"]
    assert (filter_rate["required"], filter_rate["default"]) == (False, None)
    assert filter_rate["description"].startswith("rate of the derivative filter [rad/s]")
    assert (L["required"], L["default"]) == (False, None)
    assert found["kinds"]["descriptor"]["parameters"]["solver"]["default"] == "exact"
    table = call("list")[1]
    for text in ("closed-loop", "model, [L], [poles]", "[solver]", "cosim list KIND"):
        assert text in table


def test_list_explains_the_parameters_of_a_kind(call):
    """Each with its default, its meaning and its unit, keys of inner tables too."""
    code, out, _ = call("list", "identifier")
    assert code == 0
    assert out.startswith("identifier: Identification of theta by output error")
    rows = {line.split()[0]: line for line in out.splitlines()[2:]}
    assert re.match(r"P0\toptional\tleast-squares: .*P\(0\) = P0 I", rows["P0"])
    assert re.match(r"start\.epsilon_filter\trequired\t.*in \(0, 1\)", rows["start.epsilon_filter"])
    assert re.search(r"^time\t\"t\"\tcolumn of the times", call("list", "table")[1], re.M)
    kind = json.loads(call("list", "step", "--json")[1])
    assert kind["parameters"]["time"]["description"] == "time of the jump [s]"
    assert kind["parameters"]["after"]["default"] == 1.0
    code, out, err = call("list", "tabel")
    assert (code, out) == (2, "")
    assert "unknown kind 'tabel'; did you mean 'table'?" in err


def test_without_matplotlib_a_plot_names_the_way_out(call, tmp_path, monkeypatch):
    """Before anything is run for it."""
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, _, err = call("run", "academic", "--out", "a.mcap", "--plot", "a.png")
    assert code == 2
    assert "pip install -e '.[plot]'" in err
    assert not (tmp_path / "a.mcap").exists()


def test_show_gives_a_scenario_to_start_from(call, tmp_path):
    """cosim show academic > mine.toml && cosim run mine.toml."""
    _, out, _ = call("show", "academic")
    (tmp_path / "mine.toml").write_text(out)
    assert call("run", "mine.toml", *SHORT, "--quiet")[0] == 0


def test_export_refuses_what_cannot_be_an_fmu(call):
    """The message says what can be exported."""
    code, _, err = call("export", "academic", "--component", "delta", "--out", "i.fmu")
    assert code == 2
    assert (
        "'delta' is of kind 'disturbance', which cannot be exported; available: "
        "sum, gain, product, limit, switch, lag, integrator, transfer-function, delay, controller, "
        "discrete-state-space, pid, descriptor, unknown-input-observer, regressor, identifier\n"
    ) in err
    code, _, err = call("export", "academic", "--component", "plnt", "--out", "i.fmu")
    assert "there is no component 'plnt'; did you mean 'plant'?" in err


@pytest.mark.parametrize(
    ("make", "pattern"),
    [
        (lambda path: path.write_bytes(b"no log"), "is not an MCAP file"),
        (lambda path: path.write_bytes(b""), "is not an MCAP file"),
        (lambda path: path.write_bytes(path.read_bytes()[:-400]), "truncated"),
    ],
)
def test_a_log_that_is_none_is_refused(call, tmp_path, make, pattern):
    """No MCAP, empty, truncated: exit 2 with the reason, for every command that reads logs."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    make(tmp_path / "a.mcap")
    for command in (
        ["replay", "a.mcap"],
        ["info", "a.mcap"],
        ["diff", "a.mcap", "a.mcap"],
        ["plot", "a.mcap", "u.y", "-o", "x.png"],
    ):
        code, _, err = call(*command)
        assert code == 2
        assert pattern in err


def run_python(code, *arguments):
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    ).stdout


@pytest.mark.slow
def test_help_imports_neither_numpy_nor_fmpy():
    """Asking for help costs no scientific stack."""
    code = (
        "import sys\nfrom cosim.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "names = ('numpy', 'fmpy', 'scipy', 'mcap', 'pydantic')\n"
        "print([name for name in names if name in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert "Usage" in done.stdout
    assert done.stderr.strip() == "[]"


@pytest.mark.slow
def test_a_run_without_fmus_does_not_import_fmpy(tmp_path):
    """An FMU library is paid for where there is an FMU."""
    code = (
        "import sys, cosim\ncosim.run('academic', set={'scenario.stop': 0.01}, out=sys.argv[1])\n"
        "names = ('fmpy', 'matplotlib', 'scipy.signal', 'scipy.integrate')\n"
        "print([name for name in names if name in sys.modules])\n"
    )
    assert run_python(code, str(tmp_path / "a.mcap")).strip() == "[]"


@pytest.mark.slow
def test_progress_shows_time_speed_and_time_left_on_a_terminal(tmp_path):
    """On a terminal the bar stands on stderr while the run goes on, and is gone at the end."""
    reader, writer = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "cosim",
        "run",
        "closed-loop",
        "--stop",
        "20",
        "--out",
        str(tmp_path / "a.mcap"),
    ]
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120"}
    seen = b""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=writer, env=environment
    ) as process:
        os.close(writer)
        with contextlib.suppress(OSError):  # the terminal is closed when the process ends
            while chunk := os.read(reader, 4096):
                seen += chunk
        out, _ = process.communicate(timeout=60)
    os.close(reader)
    assert process.returncode == 0
    text = seen.decode(errors="replace")
    assert re.search(r"t = \d+\.\d\d of 20 s", text)
    assert re.search(r"\d x real time", text)
    assert re.search(r"\d:\d\d:\d\d", text)
    assert b"real time" in out  # the table, on stdout, has no bar in it
    assert b"\x1b[" not in out


def test_progress_is_gone_where_stderr_is_no_terminal(call):
    """Nothing but messages reaches a stderr that is a file."""
    assert call("run", "academic", *SHORT)[2] == ""


def test_a_picture_that_cannot_be_drawn_is_refused_before_the_run(call, tmp_path):
    """No run and no log for an ending that is none of a picture."""
    code, _, err = call("run", "academic", *SHORT, "--plot", "run.xyz")
    assert code == 2
    assert re.search(r"run\.xyz: .*'\.xyz'", err)
    assert not (tmp_path / "logs").exists()


@pytest.mark.slow
def test_elements_can_be_plotted(call, tmp_path):
    """x_a[1] is one line of two, x_a[0:2] is both; a wrong element is refused."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    signals = ["plant.x_a[1]", "plant.x_a[0:2]", "identifier.theta"]
    assert call("plot", "a.mcap", *signals, "--out", "x.svg")[0] == 0
    drawn = (tmp_path / "x.svg").read_text(encoding="utf-8")
    for name in ("plant.x_a[0]", "plant.x_a[1]", "identifier.theta[1]"):
        assert name in drawn
    code, _, err = call("plot", "a.mcap", "plant.x_a[2]", "--out", "y.png")
    assert code == 2
    assert "'plant.x_a[2]': 'plant.x_a' has 2 elements, numbered from 0" in err


def test_replay_stops_and_plots_like_run(call, monkeypatch):
    """--stop and --plot mean the same."""
    drawn = []
    monkeypatch.setattr(
        "cosim.report.plots.runs.plot_run", lambda run, out: drawn.append((run, out))
    )
    call("run", "academic", *SHORT, "--out", "a.mcap", "--plot", "run.png")
    code, out, _ = call("replay", "a.mcap", "--stop", "0.05", "--plot", "again.png")
    assert code == 0
    assert "0.05 s in 50 steps" in out
    assert [(run.steps, str(out)) for run, out in drawn] == [(100, "run.png"), (50, "again.png")]


def test_without_truth_the_last_values_are_shown(call, tmp_path):
    """A scenario without [truth] ends with what its outputs ended with."""
    (tmp_path / "u.toml").write_text(
        '[scenario]\nname = "u"\nstop = 1.0\nstep = 0.1\n'
        '[components.u]\nkind = "ramp"\nslope = 2.0\n'
    )
    _, out, _ = call("run", "u.toml", "--out", "u.mcap")
    assert re.search(r"^u\.y\t2$", out, re.M)
    assert json.loads(call("run", "u.toml", "--json")[1])["last"] == {"u.y": 2.0}
    assert json.loads(call("run", "academic", *SHORT, "--json")[1])["last"] == {}, "there is truth"


def test_a_run_that_an_fmu_ends_says_why(call, tmp_path):
    """The FMU requests the end at 0.325 s, so the last row is that of 0.3 s.

    The reason is in the table, in JSON, in the log and in a run in memory.
    """
    plant = f'[components.plant]\nkind = "fmu"\npath = "{build("ENDS")}"\nstart = {{ p = 0.325 }}\n'
    zero = '[components.zero]\nkind = "constant"\nvalue = 0.0\n'
    connections = '[connections]\n"plant.u" = "zero.y"\n"plant.d" = "zero.y"\n'
    head = HEAD.replace("0.2", "1.0")
    (tmp_path / "x.toml").write_text(head + plant + zero + connections)
    reason = "'plant' stopped at t = 0.3 s: the FMU requests the end of the run"
    code, out, err = call("run", "x.toml", "--out", "x.mcap")
    assert (code, err.count("\n")) == (0, 1)  # its warning
    words = " ".join(out.split())
    assert "x: 0.3 s in 3 steps" in words
    assert f"stop reason {reason}" in words
    assert f"stop reason {reason}" in " ".join(call("info", "x.mcap")[1].split())
    found = json.loads(call("run", "x.toml", "--json")[1])
    recordings = (cosim.open_log("x.mcap"), cosim.run("x.toml"))
    for status in (
        (found["status"], found["reason"]),
        *((one.status, one.reason) for one in recordings),
    ):
        assert status == ("complete", reason)


@pytest.fixture
def printing(tmp_path):
    """Write a scenario of three steps with an FMU that prints a line in each."""
    compile_fmu(tmp_path / "rogue.fmu", XML, "rogue2.c", defines=("ROGUE=PRINTS",))
    components = (
        '[components.p]\nkind = "fmu"\npath = "rogue.fmu"\n'
        '[components.one]\nkind = "constant"\nvalue = 1.0\n'
    )
    path = tmp_path / "x.toml"
    path.write_text(f'{HEAD.replace("0.2", "0.3")}{components}[connections]\n"p.u" = "one.y"\n')
    return [
        sys.executable,
        "-m",
        "cosim",
        "run",
        str(path),
        "--force",
        "--out",
        str(tmp_path / "x.mcap"),
    ]


NOISE = "a line that nobody asked for\n" * 3


@pytest.mark.slow
def test_the_output_of_an_fmu_does_not_reach_the_data(printing, tmp_path):
    """It goes to stderr; stdout is ours, as a pipe and as a file."""
    piped = subprocess.run([*printing, "--json"], capture_output=True, text=True, check=True)
    with open(tmp_path / "out.json", "w+") as stream:
        filed = subprocess.run(
            [*printing, "--json"], stdout=stream, stderr=subprocess.PIPE, text=True, check=True
        )
    for out, err in (
        (piped.stdout, piped.stderr),
        ((tmp_path / "out.json").read_text(), filed.stderr),
    ):
        assert json.loads(out)["steps"] == 3
        assert NOISE in err


@pytest.mark.slow
def test_a_table_on_a_terminal_has_no_foreign_lines_in_it(printing):
    """It is still a terminal to what prints the table, which is as wide as that."""
    reader, writer = pty.openpty()
    fcntl.ioctl(writer, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 60, 0, 0))
    environment = {
        key: value for key, value in os.environ.items() if key not in ("COLUMNS", "NO_COLOR")
    } | {"TERM": "xterm"}
    with subprocess.Popen(
        printing, stdin=writer, stdout=writer, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        os.close(writer)
        seen = b""
        with contextlib.suppress(OSError):  # the terminal is closed when the process ends
            while chunk := os.read(reader, 4096):
                seen += chunk
        _, err = process.communicate(timeout=60)
    os.close(reader)
    assert process.returncode == 0
    assert NOISE in err
    assert b"\x1b[1mx: 0.3 s in 3 steps" in seen
    assert b"nobody" not in seen
    assert max(map(len, seen.decode().splitlines())) <= 60 + len("\x1b[1m\x1b[0m")


def test_a_constant_may_be_true(call, tmp_path):
    """A boolean signal, carried as 1.0."""
    (tmp_path / "x.toml").write_text(f'{HEAD}[components.x]\nkind = "constant"\nvalue = true\n')
    assert call("run", "x.toml", "--out", "x.mcap", "--quiet") == (0, "", "")
    log = cosim.open_log("x.mcap")
    assert log["x.y"].tolist() == [1.0, 1.0, 1.0]
    assert log.channels["x"].interface.outputs[0].type == "boolean"


def test_an_output_that_cannot_be_written_is_one_line(call, tmp_path):
    """A folder where a file should be: no traceback."""
    (tmp_path / "folder.fmu").mkdir()
    code, _, err = call(
        "export", "academic", "--component", "plant", "--out", "folder.fmu", "--force"
    )
    assert code == 2
    assert err.startswith("cosim: folder.fmu cannot be written: ")
    assert not list(tmp_path.glob(".*.part"))


def test_a_working_folder_that_is_gone_is_named(call, tmp_path, monkeypatch):
    """Of a shipped scenario, and beside a path that leads nowhere without it."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    for command in (["run", "pair"], ["info", "a.mcap"]):
        code, _, err = call(*command)
        assert code in (1, 2)
        assert "working folder" in err


@pytest.mark.slow
def test_a_full_disk_is_one_line():
    """No traceback."""
    with open("/dev/full", "w") as stream:
        command = [sys.executable, "-m", "cosim", "list"]
        environment = {**os.environ, "PYTHONUNBUFFERED": ""}
        done = subprocess.run(
            command, stdout=stream, stderr=subprocess.PIPE, text=True, check=False, env=environment
        )
    assert (done.returncode, done.stderr) == (2, "cosim: output: No space left on device\n")


@pytest.mark.slow
def test_a_sampled_controller_is_exported_for_co_simulation_only(call):
    """A discrete component would be another one as a continuous FMU; the message says so."""
    code, out, _ = call(
        "export",
        "closed-loop",
        "--component",
        "controller",
        "--set",
        "controller.period=0.1",
        "--out",
        "c.fmu",
    )
    assert code == 0
    assert "c.fmu: FMI 2.0, co-simulation, binary for" in out
    assert "co-simulation only: a sampled controller" in out
    code, out, _ = call(
        "export", "closed-loop", "--component", "controller", "--fmi", "3", "--out", "d.fmu"
    )
    assert "d.fmu: FMI 3.0, model exchange and co-simulation, binary for" in out


def test_verify_compares_the_whole_log(call):
    """A shorter replay is no verification."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    code, _, err = call("replay", "a.mcap", "--verify", "--stop", "0.05")
    assert (code, err) == (2, "cosim: --verify compares the whole log; omit --stop\n")


def test_a_refused_run_leaves_the_old_log_as_it_was(call, tmp_path):
    """--force replaces a log by a run, not by a refusal: exit 2 means that nothing was done."""
    call("run", "academic", *SHORT, "--out", "a.mcap")
    before = (tmp_path / "a.mcap").read_bytes()
    head = '[scenario]\nname = "x"\nstop = 1.0\nstep = 0.1\n'
    loop = '[components.x]\nkind = "gain"\nK = 1.0\n[connections]\n"x.u" = "x.y"\n'
    chase = (
        '[components.x]\nkind = "lag"\ntime_constant = 1.0\n'
        '[connections]\n"x.u" = { from = "x.y", offset = 1.0 }\n'
    )
    (tmp_path / "loop.toml").write_text(head + loop)
    (tmp_path / "chase.toml").write_text(head + chase)
    for arguments in (["loop.toml"], ["chase.toml"], ["academic", "--plot", "x.xyz"]):
        assert call("run", *arguments, "--out", "a.mcap", "--force")[0] == 2, arguments
        assert (tmp_path / "a.mcap").read_bytes() == before
    assert not list(tmp_path.glob(".a*"))


def test_linearize_prints_matrices_poles_and_gain(call, tmp_path):
    """The reduced plant (28): A, its poles -1.5 +- 0.866i, the static gain -4/3 and 2/3.

    Tables and JSON have the same numbers.
    """
    call("export", "academic", "--component", "plant", "--out", "plant.fmu")
    code, out, err = call("linearize", "plant.fmu", "--output", "y", "--set", "x_a[0]=0.5")
    assert (code, err) == (0, "")
    words = " ".join(out.split())
    assert "der(x_a[0]) -1 1 der(x_a[1]) -1 -2 B" in words
    assert "D - C A^-1 B u delta y -1.33333 0.666667" in words
    assert "static gain D - C A^-1 B" in out.splitlines()
    assert "academic_plant at t = 0 s" in out.splitlines()
    assert "poles -1.5-0.866025j, -1.5+0.866025j method directional derivatives" in words
    code, out, _ = call(
        "linearize",
        "plant.fmu",
        "--input",
        "delta",
        "--output",
        "y",
        "--differences",
        "--at",
        "2",
        "--json",
    )
    found = json.loads(out)
    assert (code, found["t"], found["inputs"], found["made"]["delta"]) == (
        0,
        2.0,
        ["delta"],
        "central differences",
    )
    assert found["static_gain"][0] == pytest.approx([2.0 / 3.0], rel=1e-9)


@pytest.mark.slow
def test_linearize_says_where_there_is_no_gain(call, tmp_path):
    """An integrator."""
    (tmp_path / "i.toml").write_text(
        '[scenario]\nname = "i"\nstop = 0.1\nstep = 0.01\n'
        '[components.u]\nkind = "constant"\nvalue = 1.0\n'
        '[components.c]\nkind = "controller"\nA = [[0.0]]\nB = [[1.0]]\nC = [[2.0]]\n'
        '[connections]\n"c.u" = "u.y"\n'
    )
    call("export", "i.toml", "--component", "c", "--out", "i.fmu")
    assert "static gain none, as A is singular" in " ".join(call("linearize", "i.fmu")[1].split())


def test_linearize_prints_a_table_for_a_scenario(call):
    """Ready for [models]; notes go to stderr."""
    call("export", "academic", "--component", "plant", "--out", "plant.fmu")
    code, out, _ = call(
        "linearize", "plant.fmu", "--output", "y", "--toml", "--disturbance", "delta"
    )
    assert code == 0
    assert "[models.academic_plant]" in out
    assert "Bd = [[1.0], [0.0]]\n" in out
    assert "Du = [[-1.0]]\n" in out
    assert "Dd" not in out
    code, out, _ = call("linearize", "plant.fmu", "--output", "y", "--toml")
    assert code == 0
    assert "Bu = [[-1.0, 1.0], [1.0, 0.0]]" in out


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--disturbance", "delta"], "--disturbance NAME goes with --toml"),
        (["--toml", "--json", "--disturbance", "delta"], "--toml and --json: give one of them"),
        (["--set", "u=fast"], "start value of 'u': .*'fast'"),
        (["--set", "=3"], "--set '=3': .*no name"),
        (["--set", "u"], "--set 'u': .*no '='"),
        (["--input", "w"], "no input 'w'.*: u, delta"),
    ],
)
def test_linearize_refuses_what_it_cannot_do(call, options, text):
    """One message, exit 2."""
    call("export", "academic", "--component", "plant", "--out", "plant.fmu")
    code, _, err = call("linearize", "plant.fmu", *options)
    assert code == 2
    assert re.search(text, err)


def test_the_overview_cuts_no_sentence_short(call):
    """On a terminal of 80 columns each command is described in one line."""
    code, out, _ = call("--help")
    assert code == 0
    assert "export     Export a component as an FMU, C source and binary." in out
    assert "..." not in out.partition("Commands:")[2]


@pytest.mark.parametrize("name", ["stop", "step"])
def test_an_option_and_set_for_the_same_key_are_refused(call, name):
    """Neither wins in silence."""
    code, _, err = call("run", "academic", f"--{name}", "1", "--set", f"scenario.{name}=0.5")
    assert code == 2
    assert f"--{name} and --set scenario.{name}" in err
