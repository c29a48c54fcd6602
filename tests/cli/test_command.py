"""Commands made of tables of options: their parameters, and how values are read."""

import inspect
import re
from pathlib import Path
from typing import get_args

import pytest
import typer

import cosim
from cosim.cli.app import COMMANDS, main
from cosim.cli.command import Given, command, read_ranges, read_sweep
from cosim.errors import UsageError, shell_language


def parameters(table):
    """Return what a command has: name, default, type, flags or metavar of an argument."""
    made = inspect.signature(command(table)(lambda given: None)).parameters
    found = {}
    for name, parameter in list(made.items())[1:]:  # the context of typer is the first one
        taken, shown = get_args(parameter.annotation)
        spelled = shown.metavar
        if isinstance(shown, typer.models.OptionInfo):
            spelled = (shown.default, *shown.param_decls, shown.metavar)
        default = ... if parameter.default is parameter.empty else parameter.default
        found[name] = (default, taken, spelled)
    return found


def test_a_table_is_read_as_it_is_described():
    """Every form of a key, in the order of the table."""
    assert parameters(
        {
            "--json": "",
            "--quiet -q": "",
            "--dry-run/--no-dry-run : bool = True": "",
            "--out -o PATH : Path": "",
            "--worst : int = 3": "",
            "--set A.B=C : edits": "",
            "--from T : float": "",
            "--component NAME : str = ...": "",
            "log LOG : Path": "",
            "signals [SIGNAL]... : list[str] = None": "",
        }
    ) == {
        "json": (False, bool, ("--json", None)),
        "quiet": (False, bool, ("--quiet", "-q", None)),
        "dry_run": (True, bool, ("--dry-run/--no-dry-run", None)),
        "out": (None, Path | None, ("--out", "-o", "PATH")),
        "worst": (3, int, ("--worst", None)),
        "set": (None, list[str] | None, ("--set", "A.B=C")),
        "from_": (None, float | None, ("--from", "T")),
        "component": (..., str, ("--component", "NAME")),
        "log": (..., Path, "LOG"),
        "signals": (None, list[str] | None, "[SIGNAL]..."),
    }


@pytest.mark.parametrize(
    ("function", "in_python", "of_the_shell"),
    [
        (
            "run",
            {"no_verdicts": "verdicts"},
            "plot json quiet host port allow_host show fail_on assert_ dry_run",
        ),
        (
            "replay",
            {"no_verdicts": "verdicts", "component": "components", "from_": "window"},
            "verify to vary plot json quiet fail_on assert_",
        ),
        ("study", {"metric": "metrics"}, "dry_run json quiet fail_on assert_"),
        ("tune", {}, "json quiet"),
    ],
)
def test_python_has_what_the_command_line_has(function, in_python, of_the_shell):
    """By the same name, but for what is shown, and what decides the exit code."""
    entry = COMMANDS[function]
    if function == "study":
        entry = next(one.callback for one in entry.registered_commands if one.name == "run")
    options = set(inspect.signature(entry).parameters) - {"context", *of_the_shell.split()}
    assert len(options) > 10
    known = set(inspect.signature(getattr(cosim, function)).parameters)
    assert {in_python.get(name, name) for name in options} <= known


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("run academic --dry-run --certify", "--dry-run .* --certify"),
        ("run academic --dry-run --find-step a.y=1", "--dry-run .* --find-step"),
        ("run academic --dry-run --fail-on warning", "--dry-run .* --fail-on"),
        ("run academic --dry-run --assert rms(a.y)<1", "--dry-run .* --assert"),
        ("run academic --find-step a.y=1 --step 0.1", "--find-step .* --step"),
        ("run academic --force", "--force .* --out"),
        ("run academic --rotate 1h --plot a.png", "--plot .* --rotate"),
        ("run academic --rotate 1h --profile", "--profile .* --rotate"),
        ("run academic --host ::1", "--host .* --live"),
        ("run academic --port 0", "--port .* --live"),
        ("run academic --allow-host a", "--allow-host .* --live"),
        ("run academic --show plant", "--show .* --live"),
        ("run academic --stop 1 --set scenario.stop=2", "--stop .* --set scenario.stop"),
        ("run academic --step 1 --set scenario.step=2", "--step .* --set scenario.step"),
        ("run academic --no-verdicts --set scenario.verdicts=false", "--no-verdicts .* --set"),
        ("replay a.mcap --verify --stop 1", "--verify .* --stop$"),
        ("replay a.mcap --verify --vary a.b=1", "--verify .* --vary"),
        ("replay a.mcap --plot a.png --vary a.b=1", "--plot .* --vary"),
        ("replay a.mcap --fail-on warning --vary a.b=1", "--fail-on .* --vary"),
        ("replay a.mcap --assert rms(a.y)<1 --vary a.b=1", "--assert .* --vary"),
        ("replay a.mcap --assert rms(a.y)<1 --from 0", "--assert .* --from"),
        ("replay a.mcap --assert rms(a.y)<1 --to 1", "--assert .* --to"),
        ("study academic --dry-run --fail-on warning", "--dry-run .* --fail-on"),
        ("study academic --dry-run --assert rms(a.y)<1", "--dry-run .* --assert"),
        ("study academic --dry-run --scheduler tcp://a:1", "--dry-run .* --scheduler"),
        ("study academic --stop 1 --set scenario.stop=2", "--stop .* --set scenario.stop"),
        ("tune academic --quiet", "--quiet .* --out or --json"),
        ("tune academic --json --stop 1 --set scenario.stop=2", "--stop .* --set scenario.stop"),
        ("info academic --out a.png", "--out .* --graph"),
        ("linearize a.fmu --toml --json", "--toml .* --json"),
        ("linearize a.fmu --disturbance d", "--disturbance .* --toml"),
    ],
)
def test_options_that_do_not_go_together_are_refused(line, named, tmp_path, monkeypatch, capsys):
    """Before anything is read or written, in one line with both names; exit code 2."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    out, err = capsys.readouterr()
    assert (ended.value.code, out, err.count("\n")) == (2, "", 1)
    assert re.search(f"^cosim: {named}", err)
    assert not list(tmp_path.iterdir())


def commands():
    """Return every command by its name, those of ``cosim study`` too."""
    found = {name: COMMANDS[name] for name in COMMANDS if name != "study"}
    inner = COMMANDS["study"].registered_commands
    return found | {f"study {one.name}": one.callback for one in inner}


@pytest.mark.parametrize("name", commands())
def test_a_command_uses_its_options_and_no_others(name):
    """By what its function reads and hands on, or the functions that it gives all of them."""
    made = commands()[name]
    options = set(inspect.signature(made).parameters) - {"context", "stop", "step"}
    own = inspect.getsource(made.__wrapped__)
    module = inspect.getmodule(made)
    for constant in re.findall(r"only\((\w+)\)", own):
        own += f'only("{getattr(module, constant)}")'
    helpers = [
        value
        for value in vars(module).values()
        if inspect.isfunction(value) and "given" in inspect.signature(value).parameters
    ]
    called = [inspect.getsource(one) for one in helpers if re.search(rf"\b{one.__name__}\(", own)]
    reads = [set(_names(text)) - {"only", "arguments"} for text in (own, "".join(called))]
    assert reads[0] <= options
    assert options <= reads[0] | reads[1]


def _names(text):
    """Return the options that a text reads or hands on."""
    handed_on = " ".join(re.findall(r'only\("([^"]*)"\)', text)).split()
    return [*re.findall(r"\bgiven\.(\w+)", text), *handed_on]


def test_some_values_are_handed_on():
    """By name, and no others."""
    assert Given(a=1, b=2, c=3).only("a c") == {"a": 1, "c": 3}


def test_values_are_toml_where_they_can_be():
    """As those of --set."""
    found = read_sweep(["a.x = 1e3, 2", "a.kind=sine,step", "a.L=[[1.0]],[[2.0]]"], "vary")
    assert found == {"a.x": [1e3, 2], "a.kind": ["sine", "step"], "a.L": [[[1.0]], [[2.0]]]}


def test_ranges_have_bounds_or_values():
    """Linear unless they say otherwise; ``[a.fmu,b.fmu]`` are plants."""
    found = read_ranges(["a.x=0:1", "a.y=log:1:2", "a.z=linear:1:2", "a=[a.fmu,b.fmu]"], "vary")
    assert found == {
        "a.x": {"linear": [0.0, 1.0]},
        "a.y": {"log": [1.0, 2.0]},
        "a.z": {"linear": [1.0, 2.0]},
        "a": ["a.fmu", "b.fmu"],
    }


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["a.x"], r"--vary 'a\.x': .*no '='"),
        (["a.x=1,,2"], r"--vary a\.x: .*'1,,2'"),
        (["a.x="], r"--vary a\.x: .*''"),
        (["a.x=1", "a.x=2"], r"--vary a\.x: .*given 2 times"),
        (["a.x=" + 200 * "[" + 200 * "]"], r"--vary a\.x: .*nested"),
    ],
)
def test_wrong_values_are_refused(texts, message):
    """The message names the key."""
    with shell_language(), pytest.raises(UsageError, match=message):
        read_sweep(texts, "vary")
