"""Swap reports: how a swapped component compares with the one it replaces."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from typing import Any, Final

from cosim.core.signals import Interface
from cosim.errors import ScenarioError, option
from cosim.scenario.record import ComparedAspect, port_label
from cosim.scenario.recordings.port_comparison import (
    INITIAL,
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
SWAP_WARNINGS: Final = (_DIFFERS, _UNITS, _SIZES, _UNBUILT)  # how the warnings of a report begin
_MOST_ENTRIES: Final = 4  # of a response, that a warning names


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
        return {
            "ports": [{**asdict(row), "port": self._port(row.port)} for row in self.rows],
            "proposals": [{**asdict(one), "option": self._option(one)} for one in self.proposals],
        }

    @property
    def lines(self) -> list[dict[str, str]]:
        """Return the report for people.

        One line for a port in which both components agree, else one for each aspect that is not ok.
        """
        lines = []
        for port, group in groupby(self.rows, key=lambda row: row.port):
            rows = list(group)
            different = [row for row in rows if row.verdict != "ok"]
            for row in different or [_agreed(rows)]:
                lines.append(row_texts({**asdict(row), "port": self._port(port)}))
        return lines

    @property
    def warnings(self) -> list[str]:
        """What differs or cannot be compared on connected ports, of outputs, and in the whole."""
        differences = []
        units = []
        sizes = []
        for row in self.rows:
            if not (row.connected or _is_response(row)):
                continue
            is_added = row.aspect == "causality" and row.before is None  # nothing relied on it
            if row.verdict == "differs" and not is_added:
                differences.append(_change_text(row))
            if row.aspect == "unit" and self._is_taken_as_it_is(row):
                units.append(_change_text(row))
            if row.ratio is not None and row.of_another_size:
                factor = f"{row.ratio:.3g}" if row.ratio > 1.0 else f"1/{1.0 / row.ratio:.3g}"
                sizes.append(f"{row.label} {row.aspect} {factor} times as large")
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
        """Return whether nothing converts what has another unit."""
        is_lost = row.verdict == "unknown" and row.before is not None
        return is_lost or (row.verdict != "ok" and row.port in self.unconverted)

    @property
    def hints(self) -> list[str]:
        """The proposals, in words."""
        hints = []
        for one in self.proposals:
            ports = f"{self._port(one.name)} may be {self._port(one.port)}"
            hints.append(f"{self._option(one)}: {ports} ({'; '.join(one.reasons)})")
        return hints

    def _option(self, proposal: Proposal) -> str:
        return option("map", self._port(proposal.port), proposal.name)

    def _port(self, port: str) -> str:
        return f"{self.component}.{port}" if port else self.component


def _is_response(row: ComparedAspect) -> bool:
    """Return whether a row compares what an output does, which the log has, connected or not."""
    return isinstance(row.before, Mapping) and isinstance(row.after, Mapping)


def _change_text(row: ComparedAspect) -> str:
    subject = f"{row.label} {row.aspect}".strip()
    if _is_response(row):
        return f"{subject} {', '.join(_entry_changes(row.before, row.after))}"
    before, after = different_texts(row.before, row.after)
    recorded = row.aspect == "kind" and row.after in ("recording", "field-data")
    reaction = ", which does not react to inputs" if recorded else ""
    return f"{subject} {after} (was {before}){reaction}"


def _entry_changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> Iterator[str]:
    """Yield the entries of a response that differ, the first of many."""
    for name in list(before)[:_MOST_ENTRIES]:
        old, new = different_texts({name: before[name]}, {name: after[name]})
        yield f"{new} (was {old.removeprefix(f'{name} ')})"
    if len(before) > _MOST_ENTRIES:
        yield f"and {len(before) - _MOST_ENTRIES} more"


def _agreed(rows: Sequence[ComparedAspect]) -> ComparedAspect:
    """Return one row for all that both components agree in at a port."""
    first = rows[0]
    values = {row.aspect: row.before for row in rows}
    if not first.port:
        texts = [f"{aspect} {shown(value)}" for aspect, value in values.items()]
        return replace(first, aspect="as a whole", before=", ".join(texts))
    text = with_unit(f"size {values['size']}, {values['type']}", values.get("unit"))
    if "feedthrough" in values:
        text += f", {feedthrough_text('output', values['feedthrough'])}"
    if INITIAL in values:
        text += f", {INITIAL} {shown(values[INITIAL])}"
    return replace(first, aspect=first.before, before=text)


def row_texts(row: Mapping[str, Any]) -> dict[str, str]:
    """Return a row of :meth:`SwapReport.to_dict` as people read it."""
    before, after = different_texts(row["before"], row["after"])
    is_port = "." in row["port"]  # else the component as a whole, which nothing connects
    return {
        "": port_label(row["port"], row.get("source")),
        "aspect": row["aspect"],
        "before": before,
        "after": "the same" if row["verdict"] == "ok" else after,
        "verdict": row["verdict"],
        "connected": shown(row["connected"]) if is_port else "",
    }


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
    replaced : mapping of component name to Interface
        Of what they replace, as far as that could be built.
    """

    reports: Mapping[str, SwapReport] = field(default_factory=dict)
    problems: tuple[str, ...] = ()
    failure: str = ""
    imported: Mapping[str, str] = field(default_factory=dict)
    of_run: tuple[tuple[str, str], ...] = ()
    unbuilt: Mapping[str, str] = field(default_factory=dict)
    replaced: Mapping[str, Interface] = field(default_factory=dict)

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
        return [*self.problems, *([self.failure] if self.failure else [])]

    @property
    def hints(self) -> list[str]:
        """The proposals of all reports, in words."""
        return [hint for report in self.reports.values() for hint in report.hints]

    @property
    def warnings(self) -> list[tuple[str, str]]:
        """What differs or cannot be compared, by component."""
        warnings = [(name, f"{_UNBUILT}{problem}") for name, problem in self.unbuilt.items()]
        for name, report in self.reports.items():
            warnings += [(name, text) for text in report.warnings]
        return warnings
