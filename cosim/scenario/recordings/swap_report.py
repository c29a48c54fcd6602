"""Swap reports: how a swapped component compares with the one it replaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from typing import Any, Final

from cosim.errors import ScenarioError, option
from cosim.scenario.record import ComparedAspect, port_label
from cosim.scenario.recordings.port_comparison import (
    Proposal,
    different_texts,
    feedthrough_text,
    shown,
)
from cosim.units import with_unit

_DIFFERS: Final = "differs from what it replaces: "
_UNITS: Final = "units that cannot be compared with what is connected: "
_SIZES: Final = "of another size than what it replaces: "
_UNBUILT: Final = "cannot be compared with what it replaces, which cannot be built: "
MOST_ENTRIES: Final = 4  # of a response, that a warning names
SWAP_WARNINGS: Final = (_DIFFERS, _UNITS, _SIZES, _UNBUILT)  # how the warnings of a report begin


@dataclass(frozen=True)
class SwapReport:
    """How a swapped component compares with the one it replaces.

    Parameters
    ----------
    component : str
    rows : tuple of ComparedAspect
    proposals : tuple of Proposal
    unconverted : frozenset of str
        Ports that are connected to one without a unit, so that values are not converted there.
    """

    component: str
    rows: tuple[ComparedAspect, ...]
    proposals: tuple[Proposal, ...]
    unconverted: frozenset[str] = frozenset()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values; ports by their full names."""
        ports = []
        for row in self.rows:
            ports.append({**asdict(row), "port": self._port(row.port)})
        proposals = []
        for proposal in self.proposals:
            proposals.append({**asdict(proposal), "option": self._option(proposal)})
        return {"ports": ports, "proposals": proposals}

    @property
    def lines(self) -> list[dict[str, str]]:
        """Return the report for people.

        One line for a port in which both components agree, else one for each aspect that is not ok.
        """
        lines = []
        for _, group in groupby(self.rows, key=lambda row: row.port):
            rows = list(group)
            different = [row for row in rows if row.verdict != "ok"]
            for row in different or [_agreed(rows)]:
                lines.append(self._line(row))
        return lines

    def _line(self, row: ComparedAspect) -> dict[str, str]:
        return row_texts({**asdict(row), "port": self._port(row.port)}, whole=not row.port)

    @property
    def warnings(self) -> list[str]:
        """What differs or cannot be compared on connected ports, of outputs, and in the whole."""
        rows = [row for row in self.rows if row.connected or _is_response(row)]
        different = [row for row in rows if row.verdict == "differs" and not _is_added(row)]
        differences = [_change_text(row) for row in different]
        units = [_change_text(row) for row in rows if self._is_taken_as_it_is(row)]
        sizes = [_size_text(row) for row in rows if row.of_another_size]
        warnings = []
        if differences:
            warnings.append(f"{_DIFFERS}{'; '.join(differences)}")
        if units:
            warnings.append(f"{_UNITS}{'; '.join(units)}; values are taken as they are")
        if sizes:
            warnings.append(
                f"{_SIZES}{'; '.join(sizes)}; is it in other units? "
                f"{self.component}.unit declares them, a connection converts them"
            )
        return warnings

    def _is_taken_as_it_is(self, row: ComparedAspect) -> bool:
        """Return whether a row has another unit which nothing converts."""
        if row.aspect != "unit" or row.verdict == "ok":
            return False
        is_lost = row.verdict == "unknown" and row.before is not None
        return is_lost or row.port in self.unconverted

    @property
    def hints(self) -> list[str]:
        """The proposals, in words."""
        hints = []
        for proposal in self.proposals:
            entry = self._option(proposal)
            new = self._port(proposal.name)
            old = self._port(proposal.port)
            reasons = "; ".join(proposal.reasons)
            hints.append(f"{entry}: {new} may be {old} ({reasons})")
        return hints

    def _option(self, proposal: Proposal) -> str:
        return option("map", f"{self.component}.{proposal.port}", proposal.name)

    def _port(self, port: str) -> str:
        return f"{self.component}.{port}" if port else self.component


def _is_added(row: ComparedAspect) -> bool:
    """Return whether a row says that a port is new: nothing relied on it."""
    return row.aspect == "causality" and row.before is None


def _is_response(row: ComparedAspect) -> bool:
    """Return whether a row compares what an output does, which the log has, connected or not."""
    return isinstance(row.before, Mapping) and isinstance(row.after, Mapping)


def _change_text(row: ComparedAspect) -> str:
    subject = f"{row.label} {row.aspect}".strip()
    if _is_response(row):
        return f"{subject} {_entry_changes(row.before, row.after)}"
    before, after = _aspect_texts(row.aspect, row.before, row.after)
    recorded = row.aspect == "kind" and row.after in ("recording", "field-data")
    reaction = ", which does not react to inputs" if recorded else ""
    return f"{subject} {after} (was {before}){reaction}"


def _entry_changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return the entries of a response that differ, the first of many."""
    texts = []
    for name in list(before)[:MOST_ENTRIES]:
        old, new = different_texts({name: before[name]}, {name: after[name]})
        texts.append(f"{new} (was {old.removeprefix(f'{name} ')})")
    if len(before) > MOST_ENTRIES:
        texts.append(f"and {len(before) - MOST_ENTRIES} more")
    return ", ".join(texts)


def _size_text(row: ComparedAspect) -> str:
    assert row.ratio is not None
    factor = f"{row.ratio:.3g}" if row.ratio > 1.0 else f"1/{1.0 / row.ratio:.3g}"
    return f"{row.label} {row.aspect} {factor} times as large"


def _agreed(rows: Sequence[ComparedAspect]) -> ComparedAspect:
    """Return one row for all that both components agree in at a port."""
    first = rows[0]
    values = {row.aspect: row.before for row in rows}
    if not first.port:
        texts = [f"{aspect} {shown(value)}" for aspect, value in values.items()]
        return replace(first, aspect="as a whole", before=", ".join(texts))
    text = with_unit(f"size {values['size']}, {values['type']}", values["unit"])
    if first.before == "output":
        text += f", {feedthrough_text('output', values['feedthrough'])}"
        text += f", initial output {shown(values['initial output'])}"
    return replace(first, aspect=first.before, before=text)


def row_texts(row: Mapping[str, Any], *, whole: bool) -> dict[str, str]:
    """Return a row of :meth:`SwapReport.to_dict` as people read it.

    Parameters
    ----------
    row : mapping
    whole : bool
        Whether it is of the component as a whole, which nothing connects.
    """
    aspect = row["aspect"]
    verdict = row["verdict"]
    same = verdict == "ok"
    before, after = _aspect_texts(aspect, row["before"], row["after"])
    return {
        "": port_label(row["port"], row.get("source")),
        "aspect": aspect,
        "before": before,
        "after": "the same" if same else after,
        "verdict": verdict,
        "connected": "" if whole else shown(row["connected"]),
    }


def _aspect_texts(aspect: str, before: Any, after: Any) -> tuple[str, str]:
    """Return the values of a row as people read them, told apart."""
    if aspect == "feedthrough":
        return _feedthrough_text(before), _feedthrough_text(after)
    return different_texts(before, after)


def _feedthrough_text(inputs: str | Sequence[str] | None) -> str:
    return "no direct feedthrough" if inputs is not None and not inputs else shown(inputs)


@dataclass(frozen=True)
class SwapReports:
    """The reports of all swapped components, and why the scenario cannot run with them.

    Parameters
    ----------
    reports : mapping of component name to SwapReport
        Of those of which both components could be built.
    problems : tuple of str
        Found before the first step.
    failure : str
        Why the initialization failed; empty: it did not.
    imported : mapping of component name to str
        The classes of users that were imported.
    of_run : tuple of (component, text)
        What a run warns of before its first step, whatever was swapped.
    unbuilt : mapping of component name to str
        Why what it replaces could not be built.
    """

    reports: Mapping[str, SwapReport] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    failure: str = ""
    imported: Mapping[str, str] = field(default_factory=dict)
    of_run: tuple[tuple[str, str], ...] = ()
    unbuilt: Mapping[str, str] = field(default_factory=dict)

    def check(self) -> None:
        """Check that the scenario can run.

        Raises
        ------
        ScenarioError
            With every problem of the scenario, and the ports that may have been meant.
        """
        if self.problems:
            raise ScenarioError("\n".join([*self.problems, *self.hints]))

    @property
    def refusals(self) -> list[str]:
        """Why the scenario cannot run: its problems, or that of its initialization."""
        failures = [self.failure] if self.failure else []
        return [*self.problems, *failures]

    @property
    def different(self) -> int:
        """How many aspects of all components differ."""
        rows = [row for report in self.reports.values() for row in report.rows]
        return sum(row.verdict == "differs" for row in rows)

    @property
    def hints(self) -> list[str]:
        """The proposals of all reports, in words."""
        hints: list[str] = []
        for report in self.reports.values():
            hints += report.hints
        return hints

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """What differs or cannot be compared, by component."""
        warnings = [(name, f"{_UNBUILT}{problem}") for name, problem in self.unbuilt.items()]
        for name, report in self.reports.items():
            for text in report.warnings:
                warnings.append((name, text))
        return warnings
