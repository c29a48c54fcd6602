"""The logs of the members that are kept, and what is known of how they came to be.

::

    logs/7.mcap                log of member 7, put there whole
    logs/_7.unfinished.mcap    while it is written (in folders)
    _logs.jsonl                a line for each log that was made, or that could not be made

A log without a line is one that this study does not know: it was killed before it wrote the line,
or somebody else put the log there.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, final

from pydantic import TypeAdapter

from cosim.log.mcap_file.unfinished import is_written
from cosim.studies.dataset.storage import DatasetJournal, Storage

LOGS: Final = "logs"
LOG_RECORDS: Final = "_logs.jsonl"
_LOG_NAME: Final = re.compile(r"(\d+)\.mcap")
_BEGUN: Final = r"_\d+(\.recovered)?\.unfinished\.mcap"
_HIDDEN: Final = rf"\.{_BEGUN}\.[0-9a-f]+\.part"  # without a row
_UNFINISHED: Final = re.compile(f"{_BEGUN}|{_HIDDEN}")


@dataclass(frozen=True, slots=True)
class LogRecord:
    """How the log of a member came to be.

    Parameters
    ----------
    member : int
    recording : str
        SHA-256 of what logs were to have: which signals, how often.
    is_same : bool
        The run with the log came to what is recorded of the member: made again, it is the same.
    problem : str
        Why there is no log; empty: there is one.
    size : int or None
        Of the log [bytes]: one of another size was cut or replaced. None: a worker put it there.
    """

    member: int
    recording: str
    is_same: bool
    problem: str = ""
    size: int | None = None


def log_name(number: int) -> str:
    """Return the name of the log of a member."""
    return f"{LOGS}/{_name_in_folder(number)}"


def _name_in_folder(number: int) -> str:
    return f"{number}.mcap"


def unfinished_name(number: int) -> str:
    """Return the name, in its folder, of a log that is being written."""
    return f"_{number}.unfinished.mcap"


def log_places(storage: Storage) -> dict[int, str]:
    """Return the places of the logs that are there, by member."""
    places = {}
    for name in storage.names(LOGS):
        matched = _LOG_NAME.fullmatch(name)
        if matched is not None:
            places[int(matched[1])] = storage.label(f"{LOGS}/{name}")
    return places


def log_names(storage: Storage) -> list[str]:
    """Return the names of all files of logs, those that were begun and their records, too."""
    names = []
    for name in storage.names(LOGS):
        if _LOG_NAME.fullmatch(name) or _UNFINISHED.fullmatch(name):
            names.append(f"{LOGS}/{name}")
    return names + ([LOG_RECORDS] if LOG_RECORDS in storage.names("") else [])


@final
class LogFiles:
    """The logs of a dataset, for who writes it; a journal keeps their records.

    Parameters
    ----------
    storage : Storage

    Attributes
    ----------
    records : dict of int to LogRecord
        By member.
    """

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._journal: DatasetJournal | None = None
        self.records = {record.member: record for record in _records(storage)}
        self._sizes: dict[int, int] = {}  # of the logs that were put

    def close(self) -> None:
        """Write what is not written yet. Twice does no harm."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None

    def folder(self) -> Path | None:
        """Return the folder in which logs can be written; None: it is none of this machine."""
        return self._storage.folder(LOGS)

    def present(self) -> set[int]:
        """Return the members that have a log."""
        return set(log_places(self._storage))

    def changed(self) -> set[int]:
        """Return the members whose log has another size than when it was put there."""
        sizes = self._storage.sizes(LOGS)
        changed = set()
        for number, record in self.records.items():
            size = sizes.get(_name_in_folder(number))
            if None not in (size, record.size) and size != record.size:
                changed.add(number)
        return changed

    def put(self, number: int, log: Path) -> None:
        """Move a log that is whole to its name; nobody ever finds a part of it.

        Raises
        ------
        DatasetWriteError
            If it cannot be written.
        """
        self._sizes[number] = log.stat().st_size
        self._storage.put(log_name(number), log)

    def note(self, record: LogRecord) -> None:
        """Record how a log came to be, or why there is none; the size of one that was put.

        Raises
        ------
        DatasetWriteError
            If it cannot be written.
        """
        record = replace(record, size=self._sizes.get(record.member))
        if self._journal is None:
            self._journal = self._storage.journal(LOG_RECORDS)
        self._journal.append((json.dumps(asdict(record)) + "\n").encode())
        self.records[record.member] = record

    def remove(self, numbers: Iterable[int]) -> None:
        """Remove the logs of members."""
        self._storage.remove([log_name(number) for number in numbers], [])

    def clear_unfinished(self) -> None:
        """Remove logs that were begun, and that nobody writes any more."""
        folder = self._storage.folder(LOGS)
        if folder is None:
            return
        left = []
        for name in self._storage.names(LOGS):
            if _UNFINISHED.fullmatch(name) and not is_written(folder / name):
                left.append(f"{LOGS}/{name}")
        self._storage.remove(left, [])


def _records(storage: Storage) -> list[LogRecord]:
    """Return the records that can be read; a log whose record cannot has none."""
    adapter = TypeAdapter(LogRecord)
    records = []
    for line in (storage.read(LOG_RECORDS) or b"").splitlines():
        with suppress(ValueError):
            records.append(adapter.validate_json(line))
    return records
