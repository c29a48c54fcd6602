"""What a replay proves of its log, line by line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from cosim.core.recording import Recording
from cosim.report.tables.console import print_json, print_line
from cosim.scenario.record import component_record

if TYPE_CHECKING:
    from cosim.report.verification_result import Verification


def print_verification(
    verification: Verification, source: Recording, *, path: Path, as_json: bool, quiet: bool
) -> None:
    """Print what a replay proves of its log."""
    if as_json:
        print_json(verification.to_dict())
    elif verification.passed and not quiet:
        for line in verification.lines:
            print_line(f"{path}: {line}")
    if verification.passed:
        return
    if not as_json:
        for problem in verification.problems:
            print_line(f"{path}: {problem}", error=True)
        if verification.contradictions or not verification.difference.same_rows:
            _warn_of_environment(verification, source)


def _warn_of_environment(verification: Verification, source: Recording) -> None:
    for key, (recorded, current) in verification.environment.items():
        print_line(f"note: {key} was {recorded}, is {current}", error=True)
    for name in source.channels:
        bits = component_record(source, name).bits
        if bits is not None:
            print_line(f"note: {name}: {bits}", error=True)
