"""All mistakes of a scenario come in one report: each with its line, each once."""

import re
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

import cosim
from cosim.cli import main
from cosim.errors import CosimError, ScenarioError
from cosim.scenario.building.build import Builder, parse
from cosim.scenario.document.document import Document, find

TEXT = find("academic").text


def report(text):
    """Return the lines of the report about a text."""
    with ExitStack() as resources, pytest.raises(ScenarioError) as caught:
        Builder(parse(Document(text, "x.toml", Path.cwd())), resources).experiment()
    return str(caught.value).splitlines()


def edited(*edits):
    """Return the shipped text with parts replaced."""
    text = TEXT
    for before, after in edits:
        assert before in text
        text = text.replace(before, after)
    return text


def line_of(text, part):
    """Return the number of the first line that has a part."""
    lines = text.splitlines()
    return next(number for number, line in enumerate(lines, start=1) if part in line)


def test_mistakes_of_all_layers_come_together():
    """Keys, kinds, times, values, connections, designs and truths: one line each, no more."""
    extra = '\n[components.w]\nkind = "sinus"\n\n[connections]'
    text = edited(
        ('name = "academic"', 'name = "academic"\ncouplin = "jacobi"'),
        ("stop = 40.0 ", 'stop = "long" '),
        ("amplitude = 1.0", "amplitud = 1.0"),
        ("rate = 1.0  ", 'rate = "1" '),
        ("L = [4.0, 0.0]", "L = [-4.0, 0.0]"),
        ("delays = [1.0, 2.0, 3.0]", "delays = [1.0, 2.0, 3.0005]"),
        ('"observer.y" = "plant.y"', '"observer.y" = "plant.yy"'),
        ('"observer.u" = "u.y"', '"observer.u" = 3'),
        ('"observer.delta" = "delta.y"', '"plant.dleta" = "plant.y"'),
        ("\n[connections]", extra),
    )
    expected = [
        ("couplin =", "scenario.couplin: unknown key 'couplin'; did you mean 'coupling'?"),
        ("stop =", "scenario.stop: expected a number, got 'long'"),
        ("amplitud =", "components.u.amplitud: unknown key"),
        ("rate =", "components.u.rate: expected a number, got '1'"),
        ("[components.observer]", "M - L C is not Hurwitz"),
        ("[components.regressor]", "delays[2]: "),
        ('kind = "sinus"', "components.w.kind: unknown kind 'sinus'"),
        ('"observer.u" = 3', "connections.observer.u: expected a string"),
        ('"plant.dleta"', "truth.plant.dleta: unknown signal 'plant.dleta'"),
    ]
    lines = report(text)
    for part, message in expected:
        place = f"x.toml:{line_of(text, part)}: "
        assert any(line.startswith(place) and message in line for line in lines), (place, lines)
    assert len(lines) == len(expected), lines


SIX_LAYERS = """
[scenario]
name = "six"
stop = 1.0
step = 0.1
couplin = "jacobi"

[components]
a = { kind = "sinus" }
b = { kind = "sine", amplitude = 1.0 }
c = { kind = "constant", value = 1.0, unit = "s" }
x = { kind = "lag", time_constant = 1.0, initial = 0.0, unit = { u = "m", y = "m" } }
d = { kind = "discrete-state-space", A = [[0]], B = [[1]], C = [[1]], D = [[1]], period = 0.1 }
k = { kind = "gain", K = 2.0 }

[connections]
"x.u" = "c.y"
"nobody.u" = "c.y"
"d.u" = "k.y"
"k.u" = "d.y"
"""


def test_a_problem_of_one_layer_hides_none_of_another():
    """A wrong key, an unknown kind, a missing one, a unit, a connection to nothing, a loop."""
    found = [line.split(": ")[:2] for line in report(SIX_LAYERS)]
    assert found == [
        ["x.toml:6", "scenario.couplin"],
        ["x.toml:9", "components.a.kind"],
        ["x.toml:10", "components.b"],
        ["x.toml:17", "connections.x.u"],
        ["x.toml:18", "connections.nobody.u"],
        ["x.toml:16", "connections"],
    ]
    assert "d.y" in report(SIX_LAYERS)[-1]
    assert "algebraic loop" in report(SIX_LAYERS)[-1]


def test_a_misspelt_key_hides_no_wrong_connection_of_its_component():
    """The component is taken as it was probably meant: one round for both."""
    wrong = [("amplitude = 1.0", "amplitud = 1.0"), ('"plant.u" = "u.y"', '"plant.u" = "u.yy"')]
    lines = report(edited(*wrong))
    assert len(lines) == 2
    assert "components.u.amplitud" in lines[0]
    assert "connections.plant.u" in lines[1]
    assert "did you mean 'y'" in lines[1]


def test_what_rests_on_a_component_that_is_not_built_is_told_all_the_same():
    """Of a part of a scenario: the observer, whose design the regressor reads, is not in it."""
    text = edited(("L = [4.0, 0.0]", "L = [-4.0, 0.0]"))
    whole = parse(Document(text, "x.toml", Path.cwd()))
    part = replace(whole, specs={n: s for n, s in whole.specs.items() if n != "observer"})
    with ExitStack() as resources:
        problems = Builder(part, resources, beside=whole).problems
    assert problems[0][0] == ("components", "regressor")
    assert "Hurwitz" in problems[0][1]


def test_a_path_of_windows_in_double_quotes_names_the_way_out():
    """A backslash begins an escape there, which may be none (U) or mean something else (t)."""
    head = '[scenario]\nname = "x"\nstop = 1.0\nstep = 0.5\n[components.a]\nkind = "field-data"\n'
    for path in (r"C:\Users\me.csv", r"C:\temp\me.csv"):
        (line,) = report(f'{head}path = "{path}"\n')
        assert line.startswith(("x.toml:7: ", "x.toml:5: "))
        assert "single quotes" in line
    for other in ("path = x.csv", "path = 'x.csv'", 'path = "x.csv"'):
        assert "single quotes" not in report(f"{head}{other}\n")[0]


def test_a_file_without_settings_names_the_table():
    """As it is written, with what it has."""
    (line,) = report('[components.u]\nkind = "constant"\nvalue = 1.0\n')
    assert "[scenario]" in line
    assert "step" in line


# --- the language of the caller ---


@pytest.fixture
def message(tmp_path, monkeypatch, capsys):
    """Return a function that calls a wrong command in a fresh folder, and returns what it says."""
    monkeypatch.chdir(tmp_path)

    def message(*arguments):
        with pytest.raises(SystemExit):
            main(list(arguments))
        return " ".join(capsys.readouterr().err.split())

    return message


def test_a_message_does_not_speak_of_options_in_python(message):
    """The same mistakes in both languages."""
    end = {"scenario.stop": 0.01}
    cosim.run("academic", out="a.mcap", set=end)
    cases = [
        ({"out": "a.mcap", "set": end}, ["--out", "a.mcap", "--stop", "0.01"]),
        ({"set": {"observer.x": 1}}, ["--set", "observer.x=1"]),
        ({"swap": {"plnt": "x.fmu"}}, ["--swap", "plnt=x.fmu"]),
        ({"map": {"plant.y": "out"}}, ["--map", "plant.y=out"]),
    ]
    for arguments, options in cases:
        with pytest.raises(CosimError) as caught:
            cosim.run("academic", **arguments)
        assert "--" not in str(caught.value)
        said = message("run", "academic", *options)
        assert "--" in said
        assert "['" not in said


FILES_OF_OTHER_TYPES = {
    "run a.mcap": r"a scenario \(\.toml\).*'cosim replay'",
    "run a.fmu": r"a scenario \(\.toml\).*'cosim info'",
    "run .": r"a scenario.*folder",
    "replay a.toml": r"a log \(\.mcap\).*'cosim run'",
    "replay a.fmu": r"a log \(\.mcap\).*'cosim info'",
    "replay academic": r"a log \(\.mcap\).*'cosim run'",
    "diff a.toml a.mcap": r"a log \(\.mcap\)",
    "check a.mcap": r"an FMU \(\.fmu\).*'cosim info'",
    "linearize academic": r"an FMU \(\.fmu\).*'cosim info'",
    "export a.fmu --component x --out b.fmu": r"a scenario \(\.toml\)",
    "show a.mcap": r"a scenario \(\.toml\)",
}


def test_a_file_of_another_type_is_refused_with_the_way_out(message, tmp_path, subtests):
    """By every command that takes a file."""
    for name in ("a.mcap", "a.fmu", "a.toml"):
        (tmp_path / name).write_text("")
    for command, pattern in FILES_OF_OTHER_TYPES.items():
        with subtests.test(command=command):
            assert re.search(pattern, message(*command.split()))
