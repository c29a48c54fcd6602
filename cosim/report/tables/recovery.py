"""What was recovered of a damaged log, and which rows are lost."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from cosim.instants import NANOSECONDS
from cosim.log.contents.result import PARTIAL_STATUS
from cosim.report.tables.console import new_table, print_json, print_line, print_table

if TYPE_CHECKING:
    from cosim.log.editing.recovering import RecoveredLog

_MOST_INTERVALS: Final = 8  # of a component that are shown


def print_recovery(recovery: RecoveredLog, *, as_json: bool) -> None:
    """Print the rows of each component that are there, and the times of those that are lost."""
    if as_json:
        print_json(recovery.to_dict())
        return
    table = new_table("", ("component", "rows", "lost"))
    for name, rows in recovery.rows.items():
        shown = []
        for interval in rows.lost[:_MOST_INTERVALS]:
            first = interval.first_ns / NANOSECONDS
            last = interval.last_ns / NANOSECONDS
            shown.append(f"{interval.count} from {first} s to {last} s")
        if len(rows.lost) > _MOST_INTERVALS:
            omitted = rows.lost[_MOST_INTERVALS:]
            count = sum(interval.count for interval in omitted)
            plural = "" if len(omitted) == 1 else "s"
            shown.append(f"{count} in {len(omitted)} more interval{plural}")
        table.add_row(name, str(rows.count), "; ".join(shown) or "0")
    print_table(table)
    end = recovery.end_ns / NANOSECONDS
    if not recovery.end_is_known:
        print_line(f"any rows after {end} s are lost, too: the file has no end")
    if not recovery.has_all_messages:
        print_line("messages, events or substeps are lost, too, or their number is unknown")
    if not recovery.has_scenario:
        print_line("the scenario is lost: the log can be read, but not replayed")
    log = recovery.log
    whole_ns = recovery.whole_until_ns
    if log.status == PARTIAL_STATUS and whole_ns is not None and not log.begins_late:
        print_line(
            f"no row is lost up to {whole_ns / NANOSECONDS} s: with '--to {whole_ns / NANOSECONDS}'"
            ", 'cosim cut' makes a log that can be replayed"
        )
    print_line(f"{log.path}: {log.status}{f', {log.reason}' if log.reason else ''}")
