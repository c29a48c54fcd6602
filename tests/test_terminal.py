"""No command sends a terminal what it would obey, whatever a log, an FMU or a scenario says."""

import io
import os
import pty
import re
import signal
import subprocess
import sys
from contextlib import suppress
from functools import partial

import pytest

import cosim
from cosim.cli import main
from cosim.terminal import show_count, show_members, show_progress
from tests.fmi.archives import write
from tests.log.crafting import put_together, take_apart

OBEYED = re.compile(
    r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028\u2029\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)
ATTACK = "\x1b]0;owned\x07\x1b[2J\u202e\x9b5m"
IN_JSON = "\\u001b]0;owned\\u0007\\u001b[2J\\u202e\\u009b5m"
# XML has no escape, but the other control sequence introducer and the direction of texts
IN_XML = "&#x9b;2J&#x202e;&#x2028;"
FMU = f"""<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="m{IN_XML}"
guid="{IN_XML}" description="{IN_XML}" generationTool="{IN_XML}" author="{IN_XML}">
<CoSimulation modelIdentifier="m{IN_XML}"/><UnitDefinitions><Unit name="{IN_XML}"/>
</UnitDefinitions><ModelVariables><ScalarVariable name="y{IN_XML}" valueReference="0"
causality="output" description="{IN_XML}"><Real unit="{IN_XML}"/></ScalarVariable>
<ScalarVariable name="s{IN_XML}" valueReference="1" causality="parameter" variability="fixed">
<String start="{IN_XML}"/></ScalarVariable></ModelVariables><ModelStructure><Outputs>
<Unknown index="1"/></Outputs></ModelStructure></fmiModelDescription>"""
SCENARIO = f"""
[scenario]
name = "x"
stop = 0.1
step = 0.1
description = "{IN_JSON}"
[components]
"a{IN_JSON}" = {{ kind = "constant", value = 1.0, unit = "{IN_JSON}" }}
b = {{ kind = "constant", value = 1.0, "{IN_JSON}" = 1 }}
c = {{ kind = "{IN_JSON}" }}
d = {{ kind = "expression", y = "{IN_JSON}" }}
e = {{ kind = "fmu", path = "{IN_JSON}.fmu" }}
"""


@pytest.fixture
def printed(tmp_path, monkeypatch, capsys):
    """Return all that a command prints; it must not be obeyed."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        with pytest.raises(SystemExit):
            main([str(argument) for argument in arguments])
        output = capsys.readouterr()
        for text in (output.out, output.err):
            assert not OBEYED.search(text), (arguments, OBEYED.search(text))
        return output.out + output.err

    return run


@pytest.mark.parametrize("attack", [ATTACK, pytest.param(IN_JSON, marks=pytest.mark.slow)])
def test_texts_of_logs_are_shown_and_not_obeyed(printed, tmp_path, attack):
    """In every metadata record and channel, raw and as JSON writes it."""
    log = cosim.run("academic", set={"scenario.stop": 0.02}, out=tmp_path / "a.mcap")
    content = take_apart(log.path)
    words = ("academic", "complete", "output", "continuous", "descriptor", '"unit": null')
    changed = 0
    for word in words:
        crafted = take_apart(log.path)
        replacement = f"{word}{attack}" if word.isalpha() else f'"unit": "{attack}"'
        for items in [items for _, items in crafted.metadata] + [
            items for _, _, items in crafted.channels.values()
        ]:
            for key, value in items.items():
                if word in value:
                    items[key] = value.replace(word, replacement)
                    changed += 1
        path = put_together(crafted, tmp_path / "crafted.mcap")
        for command in ("info", "replay"):
            printed(command, path)
        printed("replay", path, "--verify")
        printed("diff", path, log.path)
        printed("plot", path, "plant.y", "-o", tmp_path / "a.svg")
    assert changed > len(words)
    assert content.metadata


def test_texts_of_fmus_are_shown_and_not_obeyed(printed, tmp_path):
    """Names, units, texts and problems."""
    path = write(tmp_path / "m.fmu", [], xml=FMU.encode())
    assert "\\x9b2J\\u202e\\u2028" in printed("info", path)
    assert "\\x9b2J" in printed("check", path)
    printed("linearize", path)
    printed("run", "academic", "--swap", f"plant={path}", "--dry-run")
    printed("run", "academic", "--swap", f"plant={path}")


def test_texts_of_scenarios_are_shown_and_not_obeyed(printed, tmp_path):
    """Keys, values and names in messages, and what comes on the command line."""
    path = tmp_path / "x.toml"
    path.write_text(SCENARIO)
    text = printed("run", path)
    assert "\\x1b]0;owned" in text
    printed("info", path)
    printed("run", f"{ATTACK}.toml")
    printed("run", "academic", "--set", f"plant.{ATTACK}=1")
    printed("run", "academic", "--swap", f"{ATTACK}={ATTACK}")
    printed("list", ATTACK)
    printed(ATTACK)
    (tmp_path / "raw.toml").write_text(f"# {ATTACK}\n{SCENARIO}", encoding="utf-8")
    printed("run", tmp_path / "raw.toml")
    printed("show", tmp_path / "raw.toml")  # into a pipe, which may end in a terminal


@pytest.mark.usefixtures("capsys")
def test_a_message_that_finds_the_terminal_closed_is_lost(tmp_path, monkeypatch):
    """The command ends as it would have: with the exit code of a refused scenario."""
    reader, writer = pty.openpty()
    closed = tmp_path / "closed"
    closing = f"import os\n\nos.close({reader})\nos.mkdir({str(closed)!r})\n"
    (tmp_path / "closing.py").write_text(closing)
    components = '[components.x]\nkind = "python"\nclass = "closing:Missing"\n'
    head = '[scenario]\nname = "x"\nstop = 0.2\nstep = 0.1\n'
    (tmp_path / "x.toml").write_text(head + components)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", open(writer, "w", encoding="utf-8"))  # noqa: SIM115  by main
        try:
            with pytest.raises(SystemExit) as end:
                main(["run", str(tmp_path / "x.toml")])
        finally:
            with suppress(OSError):  # what is still in its buffer
                sys.stderr.close()
    assert end.value.code == 2
    assert closed.is_dir()


def test_a_message_that_finds_its_pipe_closed_is_lost(monkeypatch):
    """The command ends with its own exit code, here that of an unknown scenario."""
    reader, writer = os.pipe()
    os.close(reader)
    with monkeypatch.context() as patch:
        patch.setattr(sys, "stderr", open(writer, "w", encoding="utf-8"))  # noqa: SIM115  by main
        with pytest.raises(SystemExit) as end:
            main(["run", "nothing"])
        with suppress(OSError):  # what is still in its buffer
            sys.stderr.close()
    assert end.value.code == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", ["diff a.mcap a.mcap", "cat a.mcap", "info a.mcap", "list", "show pair", "--help"]
)
def test_a_reader_that_closes_early_ends_a_command_as_its_signal_would(tmp_path, command):
    """The exit code is 128 + SIGPIPE, and so never that of logs that differ; nothing is said."""
    cosim.run("academic", set={"scenario.stop": 0.01}, out=tmp_path / "a.mcap")
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "cosim", *command.split()],
        cwd=tmp_path,
        stdout=writer,
        stderr=subprocess.PIPE,
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")


class Tty(io.StringIO):
    """Text that a terminal would show."""

    def isatty(self):
        return True


SHOWN = [
    (show_progress, [(0.5, 20.0), (2.0, 20.0)], {}, r"t = 2\.00 of 20 s.*\d x real time.*:"),
    (partial(show_count, what="programs solved"), [(41,)], {}, "programs solved: 41"),
    (show_members, [(400, 1000, 0), (410, 1000, 3)], {}, "410 of 1000 members, 3 failed"),
    (show_members, [(2, 5, 0)], {"what": "logs"}, "2 of 5 logs "),
]


@pytest.mark.parametrize(("show", "calls", "options", "text"), SHOWN)
def test_progress_is_shown_on_a_terminal_alone(monkeypatch, show, calls, options, text):
    """In a pipe, a file or beside JSON nothing is written, not even what moves a cursor."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    for stream, hidden in ((Tty(), False), (Tty(), True), (io.StringIO(), False)):
        monkeypatch.setattr(sys, "stderr", stream)
        with show(hidden) as watch:
            if watch is not None:
                for values in calls:
                    watch(*values, **options)
        is_shown = stream.isatty() and not hidden
        assert (watch is not None, bool(stream.getvalue())) == (is_shown, is_shown)
        assert not is_shown or re.search(text, stream.getvalue())
