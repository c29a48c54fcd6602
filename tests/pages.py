"""README and its pages as programs: what a page shows is run from top to bottom, in one folder.

A block below a paragraph that ends with "as `name.toml`:" is that file. Any other block of Python
runs, and a block of text directly below it is what it prints. The commands of a console block run
in order, each with its output below it; a command that fails says so: ``# exit code 1``.

``python -m tests.pages [PAGE ...]`` writes the output that is shown anew.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from cosim.cli import main
from cosim.report.tables import console

ROOT = Path(__file__).parent.parent
PATHS = {path.stem: path for path in [ROOT / "README.md", *sorted((ROOT / ".readme").glob("*.md"))]}
WIDTH = 100  # of a terminal
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
FILE = re.compile(r"\bas\s+`([\w-]+\.\w+)`[^`]*:\s*$")
EXIT_CODE = re.compile(r"\s+# exit code (\d+)$")


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes
    ----------
    language : str
    text : str
    start, end : int
        Where its text stands in the page.
    file : str or None
        The file that the paragraph above says it is.
    """

    language: str
    text: str
    start: int
    end: int
    file: str | None


@dataclass(frozen=True)
class Shown:
    """What a page shows beside what was printed.

    Attributes
    ----------
    source : str
        The command, or the first line of the Python block.
    shown, printed : str
    code : int or None
        The exit code of a command that is not the one that the page says.
    """

    source: str
    shown: str
    printed: str
    code: int | None = None

    @property
    def right(self) -> bool:
        """Return whether the page says the truth; a command may show nothing."""
        same = not self.shown or comparable(self.shown) == comparable(self.printed)
        return same and self.code is None


def blocks(text: str) -> list[Block]:
    """Return the fenced blocks of a page in their order."""
    found = []
    for match in BLOCK.finditer(text):
        file = FILE.search(text[: match.start()].rstrip())
        language, content = match.groups()
        name = None if file is None else file.group(1)
        found.append(Block(language, content, match.start(2), match.end(2), name))
    return found


def commands(block: Block) -> Iterator[tuple[str, str]]:
    """Yield the commands of a console block, each with the output below it."""
    for part in re.split(r"^\$ ", block.text, flags=re.MULTILINE)[1:]:
        command, _, output = part.partition("\n")
        yield command, output


def comparable(text: str) -> list[str]:
    """Return the lines without what differs between machines: wall times, trailing blanks."""
    lines = [line.rstrip() for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("wall time")]


def run_command(command: str, *, alone: bool = False) -> tuple[int, str]:
    """Run a command as a shell would, perhaps in a process of its own.

    Returns
    -------
    code : int
    printed : str
    """
    words = shlex.split(EXIT_CODE.sub("", command))
    if words[0] == "python":
        code, printed, errors = run_process(words[1:])
        return code, printed + errors if code else printed  # libraries log to stderr
    assert words[0] == "cosim", command
    target = words[-1] if ">" in words else None
    if target is not None:
        words = words[:-2]
    if alone:
        code, *texts = run_process(["-m", "cosim", *words[1:]])
        printed = "".join(texts)
    else:
        code, printed = run_here(words[1:])
    if target is None:
        return code, printed
    Path(target).write_text(printed, encoding="utf-8")
    return code, ""


def run_here(words: list[str]) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it prints."""
    printed = io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
    errors = io.StringIO()
    code: object = 0
    with (
        contextlib.redirect_stdout(printed),
        contextlib.redirect_stderr(errors),
        mock.patch.object(console, "terminal_width", return_value=WIDTH),
    ):
        try:
            main(words)
        except SystemExit as left:
            code = left.code or 0
    assert isinstance(code, int)
    return code, printed.buffer.getvalue().decode() + errors.getvalue()


def run_process(words: list[str]) -> tuple[int, str, str]:
    """Run Python in a process of its own; return its exit code, stdout and stderr."""
    environment = {**os.environ, console.COMMAND_VARIABLE: str(WIDTH)}
    result = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, env=environment
    )
    return result.returncode, result.stdout, result.stderr


def run_python(text: str) -> tuple[str, dict[str, Any]]:
    """Run a block of Python; return what it prints and the names that it defines."""
    printed = io.StringIO()
    names = {"__name__": "page"}
    with contextlib.redirect_stdout(printed):
        exec(compile(text, "page", "exec"), names)
    return printed.getvalue(), names


def run_page(text: str, *, alone: bool = False) -> Iterator[tuple[Shown, Block]]:
    """Run a page in the working directory; yield what it shows beside what is printed."""
    found = blocks(text)
    for block, following in zip(found, [*found[1:], None], strict=bool(found)):
        if block.file is not None:
            Path(block.file).write_text(block.text, encoding="utf-8")
        elif block.language == "python":
            printed, _ = run_python(block.text)
            first = block.text.partition("\n")[0]
            adjacent = (
                following is not None and not text[block.end + 4 : following.start - 8].strip()
            )
            if following is not None and following.language == "text" and adjacent:
                yield Shown(first, following.text, printed), following
        elif block.language == "console":
            for command, output in commands(block):
                code, printed = run_command(command, alone=alone)
                stated = EXIT_CODE.search(command)
                expected = int(stated.group(1)) if stated else 0
                yield Shown(command, output, printed, None if code == expected else code), block


def rewritten(text: str) -> str:
    """Return a page with the output that its commands and its Python have now."""
    for shown, block in reversed(list(run_page(text, alone=True))):
        if not shown.shown:
            continue
        if block.language == "text":
            text = text[: block.start] + shown.printed + text[block.end :]
        else:
            output = "\n".join(line.rstrip() for line in shown.printed.strip("\n").splitlines())
            place = text.index(f"$ {shown.source}\n{shown.shown}", block.start)
            start = place + len(f"$ {shown.source}\n")
            text = text[:start] + f"{output}\n" + text[start + len(shown.shown) :]
        if shown.code is not None:
            sys.stderr.write(f"exit code {shown.code}: {shown.source}\n")
    return text


if __name__ == "__main__":
    for name in sys.argv[1:] or PATHS:
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            text = rewritten(PATHS[name].read_text(encoding="utf-8"))
        PATHS[name].write_text(text, encoding="utf-8")
        sys.stderr.write(f"{name}: {len(text.encode())} bytes\n")
