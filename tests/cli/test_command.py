"""Commands made of tables of options: their parameters, and how values are read."""

import inspect
import re

import pytest

import cosim
from cosim.cli.app import COMMANDS
from cosim.cli.command import read_ranges, read_variations
from cosim.errors import UsageError, shell_language


def commands():
    """Return every command by its name, those of ``cosim study`` too."""
    found = {name: COMMANDS[name] for name in COMMANDS if name != "study"}
    inner = COMMANDS["study"].registered_commands
    return found | {f"study {one.name}": one.callback for one in inner}


@pytest.mark.parametrize(
    ("name", "in_python", "of_the_shell"),
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
        ("study run", {"metric": "metrics"}, "dry_run json quiet fail_on assert_"),
        ("tune", {}, "json quiet"),
    ],
)
def test_python_has_what_the_command_line_has(name, in_python, of_the_shell):
    """By the same name, but for what is shown, and what decides the exit code."""
    options = set(inspect.signature(commands()[name]).parameters)
    options -= {"context", *of_the_shell.split()}
    assert len(options) > 10
    known = inspect.signature(getattr(cosim, name.partition(" ")[0])).parameters
    assert {in_python.get(option, option) for option in options} <= known.keys()


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
    read = re.findall(r"\bgiven\.(\w+)", text.replace(".print_shown(", ".json("))
    return [*read, *handed_on]


def test_values_are_toml_where_they_can_be():
    """Those of --set and --vary; ranges of a tuning are linear unless they say otherwise."""
    found = read_variations(["a.x = 1e3, 2", "a.kind=sine,step", "a.L=[[1.0]],[[2.0]]"], "vary")
    assert found == {"a.x": [1e3, 2], "a.kind": ["sine", "step"], "a.L": [[[1.0]], [[2.0]]]}
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
        read_variations(texts, "vary")
