"""What a run may be failed for: verdicts that are bad, and warnings."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Final

from cosim.core.recorded.partial import declared_channels
from cosim.core.recorded.run import RecordedRun
from cosim.core.recorded.signals import warning_texts
from cosim.core.recording import Recording
from cosim.errors import option
from cosim.report.summary import parameter_summaries
from cosim.scenario.identification.run_verdicts import OUTPUT_ERROR
from cosim.scenario.recorded_metadata import component_record, recorded_identification

INCONSISTENT: Final = "INCONSISTENT"
NO_ESTIMATE: Final = "NO_ESTIMATE"
OF_VERDICTS: Final = frozenset({"inconsistent", "no-estimate"})


def bad_verdicts(recording: Recording) -> Iterator[tuple[str, str, str]]:
    """Yield estimates, verdict and reason where estimates contradict the data, or have no value.

    The verdict is ``INCONSISTENT``, another one of what has no value, or empty: none was made.
    """
    found = recorded_identification(recording)
    for name in declared_channels(recording.channels):
        record = component_record(recording, name)
        if not record.is_identifier:
            continue
        if name not in found:
            yield name, "", "no verdict was made"
            continue
        identification = found[name]
        if identification.problem:
            yield name, NO_ESTIMATE, identification.problem
        own = identification.estimate
        if record.method == OUTPUT_ERROR:
            own = identification.parameters
        labels: dict[tuple[str, str], list[str]] = {}
        for parameter in parameter_summaries(recording, name, own):
            if parameter.verdict == INCONSISTENT or parameter.value is None:
                key = (parameter.verdict, parameter.reason)
                labels.setdefault(key, []).append(parameter.estimate)
        for (verdict, reason), names in labels.items():
            yield ", ".join(names), verdict, reason


def failure_lines(run: RecordedRun, fail_on: Collection[str], *, quiet: bool) -> list[str]:
    """Return a line for each reason to fail that a run has.

    Parameters
    ----------
    run : RecordedRun
    fail_on : collection of str
        Some of "inconsistent", "no-estimate" and "warning".
    quiet : bool
        Its warnings have not been printed.
    """
    lines = []
    if not OF_VERDICTS.isdisjoint(fail_on):
        for names, verdict, reason in bad_verdicts(run):
            name = "inconsistent" if verdict == INCONSISTENT else "no-estimate"
            if not verdict or name in fail_on:
                lines.append(f"{option('fail-on', name)}: {names}: {verdict or reason}")
    count = len(run.warnings) if "warning" in fail_on else 0
    if count:
        texts = warning_texts(run.warnings) if quiet else [f"{count} in all"]
        lines += [f"{option('fail-on', 'warning')}: {text}" for text in texts]
    return lines
