"""What makes a command that ran fail: warnings, bad verdicts, assertions."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from cosim import completion
from cosim.cli.options import print_notice
from cosim.errors import UsageError, listing, nearest, option, quoted

if TYPE_CHECKING:
    from cosim.studies.measuring import AssertedView, Assertions
    from cosim.studies.study import Study

# what fails a verdict of a study, by the words in it
_WORDS: Final = {
    "inconsistent": ("INCONSISTENT", "no verdict"),
    "no-estimate": ("NO_ESTIMATE", "NOT_IDENTIFIABLE", "no verdict"),
}
OF_VERDICTS: Final = _WORDS.keys()

FailOnOption = Annotated[
    list[str] | None,
    typer.Option(
        "--fail-on",
        metavar="WHAT,...",
        autocompletion=completion.complete_failures,
        help="Exit 1 if an estimate is inconsistent with the data (inconsistent), has no value "
        "(no-estimate), or the run warns of something (warning). Repeatable.",
    ),
]

AssertOption = Annotated[
    list[str] | None,
    typer.Option(
        "--assert",
        metavar="CONDITION",
        help="Exit 1 unless this holds, such as 'rms(plant.y) < 0.1': metrics as of 'cosim "
        "metrics', compared and joined by 'and'. Repeatable.",
    ),
]

NoVerdictsOption = Annotated[
    bool,
    typer.Option(
        "--no-verdicts",
        help="Do not judge estimates by a fit at the end; the same as --set "
        "scenario.verdicts=false.",
    ),
]


def read_fail_on(texts: Iterable[str] | None, *, no_verdicts: bool = False) -> frozenset[str]:
    """Return what a command fails on.

    Raises
    ------
    UsageError
        If it is none of ``completion.FAILURES``, or a verdict where none is made.
    """
    found = set()
    for text in texts or ():
        for name in map(str.strip, text.split(",")):
            if name not in completion.FAILURES:
                raise UsageError(
                    f"{option('fail-on')}: nothing is called {quoted(name)}; "
                    f"{nearest(name, completion.FAILURES)}"
                )
            if no_verdicts and name in OF_VERDICTS:
                raise UsageError(f"{option('fail-on', name)} needs verdicts; omit --no-verdicts")
            found.add(name)
    return frozenset(found)


def read_assertions(
    texts: Iterable[str] | None, known: Mapping[str, str] | None = None
) -> Assertions | None:
    """Return what a run must fulfil; None: nothing.

    ``known``: metrics of a study by name, which may stand for their texts.

    Raises
    ------
    UsageError
        If a text is no assertion.
    """
    if not texts:
        return None
    from cosim.studies.measuring import Assertions

    return Assertions(texts, known or {})


def fail_if(run: Any, fail_on: Collection[str], view: AssertedView | None, *, quiet: bool) -> None:
    """Exit with 1 if a run has what a command fails on, or an assertion is not fulfilled.

    Parameters
    ----------
    run : Log or Memory
    fail_on : collection of str
        Some of ``completion.FAILURES``.
    view : AssertedView or None
        Knows why assertions are not fulfilled.
    quiet : bool
        Its warnings have not been printed.
    """
    problems = {} if view is None else view.problems
    lines = [f"{option('assert', text)}: {found}" for text, found in problems.items()]
    if fail_on:
        from cosim.report.tables.run import failure_lines

        lines += failure_lines(run, fail_on, quiet=quiet)
    _fail(lines)


def fail_if_members(study: Study, fail_on: Collection[str], assertions: Assertions | None) -> None:
    """Exit with 1 if members have what a command fails on, or do not fulfil an assertion."""
    metrics = {} if assertions is None else assertions.metrics
    verdicts: list[str] = []
    if not OF_VERDICTS.isdisjoint(fail_on):
        verdicts = [name for name in study.metrics if name.endswith(" verdict")]
    columns = list(dict.fromkeys(["member", "status", "warnings", *metrics, *verdicts]))
    found: dict[str, list[tuple[int, str]]] = {}
    for row in study.table(columns).to_pylist():
        if row["status"] != "complete":
            continue
        problems = {} if assertions is None else assertions.problems(row)
        own = [(option("assert", text), problem) for text, problem in problems.items()]
        if "warning" in fail_on and row["warnings"]:
            own.append((option("fail-on", "warning"), row["warnings"]))
        for verdict in (row[column] or "no verdict" for column in verdicts):
            for name, words in _WORDS.items():
                if name in fail_on and any(word in verdict for word in words):
                    own.append((option("fail-on", name), verdict))
        for label, text in own:
            found.setdefault(label, []).append((row["member"], text))
    lines = []
    for label, members in found.items():
        numbers = listing([str(number) for number, _ in members])
        first, text = members[0]
        count = f"{len(members)} of {len(study)} members ({numbers})"
        lines.append(f"{label}: {count}; member {first}: {text.partition(chr(10))[0]}")
    _fail(lines)


def _fail(lines: Collection[str]) -> None:
    for line in lines:
        print_notice(f"cosim: {line}")
    if lines:
        raise typer.Exit(1)
