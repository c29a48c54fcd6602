"""The README is true: its commands run and print what it shows, its Python runs."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from cosim.cli import main

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def blocks(language):
    """Give the fenced blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, flags=re.DOTALL)


def commands():
    """Give every command of the console blocks with the output shown below it."""
    for block in blocks("console"):
        for part in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
            command, _, output = part.partition("\n")
            yield command, output


def comparable(text):
    """Drop what differs from machine to machine: wall time, trailing blanks."""
    lines = [line.rstrip() for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("wall time")]


def test_commands_print_what_the_readme_shows(tmp_path, monkeypatch, capsys):
    """Every shown command runs, in order, in one fresh folder; shown output is the real one."""
    monkeypatch.chdir(tmp_path)
    seen = []
    for command, shown in commands():
        line, _, redirected = command.partition(" > ")
        words = shlex.split(line)
        assert words[0] == "cosim"
        with pytest.raises(SystemExit) as left:
            main(words[1:])
        output = capsys.readouterr()
        expected = (
            1
            if words[1] == "diff" and "--atol" in words
            else 2
            if "observer.filter_rat=500" in words
            else 0
        )
        assert (left.value.code or 0) == expected, (command, output.err)
        if redirected:
            Path(redirected.strip()).write_text(output.out)
        if shown:
            assert comparable(output.out + output.err) == comparable(shown), command
        seen.append(words[1])
    assert {"run", "replay", "export", "show", "info", "diff"} <= set(seen)


@pytest.mark.parametrize("number", range(len(blocks("python"))))
def test_python_runs(number, tmp_path, monkeypatch, capsys):
    """Every Python block runs as it stands."""
    (tmp_path / "logs").mkdir()
    monkeypatch.chdir(tmp_path)
    exec(
        compile(blocks("python")[number], f"README block {number}", "exec"), {"__name__": "readme"}
    )
    printed = capsys.readouterr().out.split()
    if number == 0:
        assert printed[0] == "40.0"
    else:
        # the trapezoid rule: h^2 / 12 max|u''| t = 1e-6 / 12 * 10
        assert abs(float(printed[0]) - (1.0 - np.cos(10.0))) <= 1e-6


def test_a_graph_of_ones_own_takes_less_than_20_lines():
    """From the class to the printed result."""
    lines = (
        blocks("python")[1]
        .split("class Integrator", 1)[1]
        .split("check_component(")[0]
        .strip()
        .splitlines()
    )
    assert len([line for line in lines if line.strip()]) < 20


def test_the_set_up_commands_stand_on_lines_of_their_own():
    """Two lines to paste."""
    lines = [
        line.strip() for line in README.splitlines() if line.strip().startswith("python3 -m venv")
    ]
    assert len(lines) == 2
    assert lines[0].endswith(".venv/bin/cosim run academic")
    assert lines[1].endswith(".venv/bin/python -m pytest")
