"""How many small faults of the package the fast tests find.

Run with ``python tests/bench/bench_mutants.py``; needs pytest-cov. One run of the fast tests notes
which tests execute which lines, and what each takes. Then, in a copy of the package, one statement
of each of many modules is changed: a comparison or an operator is another one, a whole number is
larger by one, a boolean is flipped, a condition is negated, a statement is removed. The tests of
the mutant's layer that execute the line run, those of its mirror first, at most for a minute, until
one fails; one that hangs has found it, too.

What survives is printed as ``file:line``, before and after. Mutants of lines that no fast test of
their layer executes are counted apart.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from coverage import CoverageData

ROOT = Path(__file__).parents[2]
MOST_SECONDS = 60.0  # of tests that run for a mutant
TIMEOUT = 300.0  # [s]
COMPARISONS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}


@dataclass(frozen=True)
class Mutant:
    """A changed statement.

    Attributes
    ----------
    path : Path
        Of the module, from the root.
    line : int
    before, after : str
        The statement.
    source : str
        The whole module with the change.
    """

    path: Path
    line: int
    before: str
    after: str
    source: str


def changed_nodes(statement: ast.stmt) -> Iterator[ast.stmt]:
    """Yield copies of a simple statement, or of the head of a compound one, each changed once."""
    for number in range(sum(1 for _ in expressions(statement))):
        changed = copy.deepcopy(statement)
        node = list(expressions(changed))[number]
        if change(node):
            yield ast.fix_missing_locations(changed)
    if isinstance(statement, ast.If | ast.While):
        changed = copy.deepcopy(statement)
        changed.test = ast.UnaryOp(ast.Not(), changed.test)
        yield ast.fix_missing_locations(changed)
    removable = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call)
    if removable or isinstance(statement, ast.AugAssign | ast.Raise):
        yield ast.copy_location(ast.Pass(), statement)


def expressions(statement: ast.stmt) -> Iterator[ast.expr]:
    """Yield the expressions of a statement, without bodies, annotations, texts of messages."""
    if isinstance(statement, ast.Raise | ast.AnnAssign):
        return
    for _, value in ast.iter_fields(statement):
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.expr):
                yield from (node for node in ast.walk(part) if isinstance(node, ast.expr))


def change(node: ast.expr) -> bool:
    """Change a node in place; return whether there is such a change."""
    if isinstance(node, ast.Compare):
        node.ops[0] = COMPARISONS[type(node.ops[0])]()
    elif isinstance(node, ast.BinOp | ast.BoolOp) and type(node.op) in OPERATORS:
        node.op = OPERATORS[type(node.op)]()
    elif isinstance(node, ast.Constant) and type(node.value) is int:
        node.value += 1
    elif isinstance(node, ast.Constant) and type(node.value) is bool:
        node.value = not node.value
    else:
        return False
    return True


def mutants_of(path: Path) -> list[Mutant]:
    """Return every mutant of a module."""
    text = (ROOT / path).read_text(encoding="utf-8")
    lines = text.splitlines(keepends=True)
    found = []
    functions = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]
    for function in functions:
        for statement in ast.walk(function):
            if not isinstance(statement, ast.stmt) or isinstance(statement, ast.FunctionDef):
                continue
            if isinstance(statement, ast.Assert | ast.Import | ast.ImportFrom | ast.ClassDef):
                continue
            end = statement.end_lineno
            assert end is not None
            for changed in changed_nodes(statement):
                indent = " " * statement.col_offset
                body = ast.unparse(changed).splitlines(keepends=True)
                written = [indent + line for line in body]
                source = [*lines[: statement.lineno - 1], *written, "\n", *lines[end:]]
                before = ast.unparse(statement).splitlines()[0]
                found.append(
                    Mutant(path, statement.lineno, before, body[0].rstrip(), "".join(source))
                )
    return found


def chosen(count: int, seed: int) -> list[Mutant]:
    """Return one mutant each of as many modules, drawn by the number of their lines."""
    rng = random.Random(seed)
    paths = [path.relative_to(ROOT) for path in sorted((ROOT / "cosim").rglob("*.py"))]
    paths = [path for path in paths if path.name != "__init__.py" and len(path.parts) > 2]
    weights = {path: len((ROOT / path).read_text(encoding="utf-8").splitlines()) for path in paths}
    found: list[Mutant] = []
    while len(found) < count and weights:
        (path,) = rng.choices(list(weights), list(weights.values()))
        del weights[path]
        mutants = mutants_of(path)
        if mutants:
            found.append(rng.choice(mutants))
    return found


def copied(folder: Path) -> Path:
    """Copy what tests need; return the copy."""
    ignored = shutil.ignore_patterns(".git", ".venv", "__pycache__", "*.mcap", ".*_cache")
    return Path(shutil.copytree(ROOT, folder, ignore=ignored))


def executed(folder: Path) -> tuple[CoverageData, dict[str, float]]:
    """Run the fast tests; return which execute each line, and what each takes [s].

    What fails without a mutant has no time.
    """
    report = folder / "durations.xml"
    arguments = ["-n", "2", "-q", "--cov=cosim", "--cov-context=test", "--cov-report="]
    arguments += ["-o", "junit_family=xunit1", f"--junit-xml={report}"]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [sys.executable, "-m", "pytest", *arguments]
    subprocess.run(command, cwd=folder, env=environment, check=False)
    durations = {}
    for case in ElementTree.parse(report).iter("testcase"):
        if not case.findall("failure") and not case.findall("error"):
            durations[f"{case.get('file')}::{case.get('name')}"] = float(case.get("time", "0"))
    data = CoverageData(str(folder / ".coverage"))
    data.read()
    return data, durations


def tests_of(
    mutant: Mutant, data: CoverageData, folder: Path, durations: dict[str, float]
) -> list[str]:
    """Return the tests of a mutant's layer that execute it: its mirror first, then by duration."""
    layer = f"tests/{mutant.path.parts[1]}/"
    mirror = f"/test_{mutant.path.stem}.py::"
    contexts = data.contexts_by_lineno(str(folder / mutant.path)).get(mutant.line, [])
    executing = {context.partition("|")[0] for context in contexts}
    found = {test for test in executing if test.startswith(layer)}
    found &= durations.keys()
    ordered = sorted(found, key=lambda test: (mirror not in test, durations[test], test))
    selected = []
    seconds = 0.0
    for test in ordered:
        seconds += durations[test]
        if seconds > MOST_SECONDS and selected:
            break
        selected.append(test)
    return selected


def survives(mutant: Mutant, tests: list[str], folder: Path) -> bool:
    """Return whether all tests pass with a mutant in a copy of the project."""
    target = folder / mutant.path
    original = target.read_text(encoding="utf-8")
    target.write_text(mutant.source, encoding="utf-8")
    selection = folder / "selection.txt"
    selection.write_text("\n".join(tests), encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    try:
        result = subprocess.run(
            [*command, f"@{selection}"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(folder)},
            capture_output=True,
            timeout=TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return False
    finally:
        target.write_text(original, encoding="utf-8")
    return result.returncode == 0


def main() -> None:
    """Print the survivors, then how many there are."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=162)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    mutants = chosen(options.count, options.seed)
    with tempfile.TemporaryDirectory() as temporary:
        copies: SimpleQueue[Path] = SimpleQueue()
        for number in range(options.jobs):
            copies.put(copied(Path(temporary) / str(number)))
        first = copies.get()
        data, durations = executed(first)
        selected = [tests_of(mutant, data, first, durations) for mutant in mutants]
        copies.put(first)

        def judged(mutant: Mutant, tests: list[str]) -> tuple[Mutant, int, bool]:
            folder = copies.get()
            try:
                return mutant, len(tests), not tests or survives(mutant, tests, folder)
            finally:
                copies.put(folder)

        killed = 0
        unseen = 0
        with ThreadPoolExecutor(options.jobs) as pool:
            for mutant, count, alive in pool.map(judged, mutants, selected):
                killed += not alive
                unseen += count == 0
                if alive and count:
                    place = f"{mutant.path}:{mutant.line}"
                    print(
                        f"{place}: {count} tests: {mutant.before}  ->  {mutant.after}", flush=True
                    )
    judged_mutants = len(mutants) - unseen
    print(f"{killed} of {judged_mutants} killed: {100 * killed / judged_mutants:.1f} %")
    print(f"{unseen} more are in lines that no fast test of their layer executes")


if __name__ == "__main__":
    main()
