"""What a recording keeps of an experiment from the start: metadata and attachments.

One of these is a layout for viewers: outputs that are measured, and estimates beside their truth.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from cosim.core.connections import Connection
from cosim.core.graph import Graph
from cosim.core.port import Port, named_ports
from cosim.core.recorded.partial import partial_layout
from cosim.core.recorded.run import SCENARIO_FILE
from cosim.core.recorded.selection import chosen_signals
from cosim.core.recorded.signals import RecordedPort, find_signal
from cosim.core.signals import Channel
from cosim.documents import plain
from cosim.errors import FmuError, UnknownSignalError, flag
from cosim.files import read_bounded
from cosim.log import Attachment
from cosim.log.places import MOST_ATTACHED
from cosim.log.viewer_layout import LAYOUT_FILE, ViewerPanel, layout_json, output_panels
from cosim.scenario.building.actions import SETTINGS
from cosim.scenario.building.build import asks_for_means
from cosim.scenario.building.experiment import Experiment, fingerprint
from cosim.scenario.record import MEANS

MOST_EMBEDDED: Final = MOST_ATTACHED - 2**12  # bytes; the record of an attachment has a head, too
# Estimates that viewers show where no truth is given; of the others only some are beside these.
_SHOWN: Final = ("delta", "theta")
_MEASURED: Final = "y"


def metadata_of(experiment: Experiment) -> dict[str, dict[str, str]]:
    """Return the metadata records of a run.

    Scenario and edits, connections, and each component's table, metadata and fingerprint.
    """
    scenario = experiment.scenario
    settings = scenario.file.scenario
    graph = experiment.graph
    run = {
        "scenario": scenario.name,
        "edits": scenario.document.edits(),
        "start_time": repr(settings.start_time),
        "stop": repr(settings.stop),
        "step": str(settings.step),
        "truth": json.dumps(experiment.truth),
        "first_order_loops": json.dumps([s.description for s in graph.stages if s.is_first_order]),
        "warnings": json.dumps(experiment.built.warnings),
    }
    if scenario.actions:
        run["actions"] = json.dumps(scenario.tree["actions"])
    if settings.until is not None:
        run["until"] = settings.until
    further = {
        "loop_gains": list(map(plain, experiment.gains)),
        "models": experiment.built.model_records,
        "replay": experiment.origin and plain(experiment.origin),
    }
    run |= {key: json.dumps(value) for key, value in further.items() if value}
    records = {"cosim.run": run, "cosim.connections": {}}
    for to, connection in graph.connections.items():
        written = scenario.connections.get(to, connection)
        values: dict[str, Any] = {
            "from": written.label,
            "gain": written.matrix.tolist(),
            "offset": written.offset,
            "unit": written.unit,
        }
        if to in graph.conversions:
            values["conversions"] = _plain_conversions(graph, to, connection)
        records["cosim.connections"][str(to)] = json.dumps(values)
    if experiment.setting_designs:
        records[SETTINGS] = dict(experiment.setting_designs)
    means = graph.mean_inputs
    for name, spec in scenario.specs.items():
        record = {
            "table": json.dumps(scenario.tree["components"][name]),
            "metadata": json.dumps(experiment.built.metadata.get(name, {})),
            "fingerprint": fingerprint(scenario, name, experiment.built.reads[name]),
        }
        as_of_old = name in graph.means and not asks_for_means(spec)
        if graph.members[name].channel.interface.one_value and not as_of_old:
            record[MEANS] = json.dumps(means.get(name, []))
        records[f"cosim.component.{name}"] = record
    return records


def _plain_conversions(graph: Graph, to: Port, connection: Connection) -> list[dict[str, float]]:
    """Return one conversion for each source; where its elements differ, one for each element."""
    conversions = graph.conversions[to]
    sizes = [graph.ports.output(source).size for source in connection.sources]
    ends = np.cumsum(sizes).tolist()
    parts = [conversions[end - size : end] for end, size in zip(ends, sizes, strict=True)]
    if connection.matrix.ndim:
        parts = [conversions] * len(sizes)
    if all(len(set(part)) == 1 for part in parts):
        conversions = tuple(part[0] for part in parts)
    return [asdict(conversion) for conversion in conversions]


def recorded_channels(experiment: Experiment) -> dict[str, Channel]:
    """Return what an experiment records, by component."""
    layout = experiment.graph.layout
    selection = experiment.scenario.file.record.selection
    channels = {channel.name: channel for channel in layout.channels}
    signals = chosen_signals(channels, selection, beside=experiment.declared)
    chosen, _ = partial_layout(layout, signals, selection.every)
    return {channel.name: channel for channel in chosen.channels}


def attachments_of(experiment: Experiment, *, embed: bool = False) -> list[Attachment]:
    """Return the files for the log.

    The scenario's text, each FMU's modelDescription.xml, and a layout for viewers; with ``embed``
    the FMUs themselves, too.

    Raises
    ------
    FmuError
        If one of these is too large, or is not the one any more that was opened.
    """
    text = experiment.scenario.document.text
    recorded = recorded_channels(experiment)
    panels = _viewer_panels(recorded, experiment.graph.connections, experiment.truth)
    attachments = [
        Attachment(SCENARIO_FILE, "application/toml", text.encode()),
        *(
            Attachment(name, "application/xml", x.encode())
            for name, x in experiment.built.attachments.items()
        ),
        Attachment(LAYOUT_FILE, "application/json", layout_json(panels)),
    ]
    if embed:
        attachments += _embedded_fmus(experiment.built.fmu_files)
    return attachments


def embedded_name(sha256: str) -> str:
    """Return the name of the attachment that an FMU is, by its hash."""
    return f"{sha256}.fmu"


def _embedded_fmus(files: Mapping[str, Path]) -> list[Attachment]:
    """Return FMUs as attachments of a log.

    Parameters
    ----------
    files : mapping of SHA-256 to Path

    Raises
    ------
    FmuError
        If one is too large to be read back, or is not the one any more that was opened.
    """
    attachments = []
    for sha256, path in files.items():
        try:
            content = read_bounded(path, MOST_EMBEDDED)
        except OSError as error:
            reason = error.strerror or error
            raise FmuError(
                f"{path} cannot be put into the log: {reason}; omit {flag('embed')}"
            ) from error
        if hashlib.sha256(content).hexdigest() != sha256:
            raise FmuError(f"{path}: changed while it was being read; try again")
        attachments.append(Attachment(embedded_name(sha256), "application/zip", content))
    return attachments


# --- what viewers show ---


def _viewer_panels(
    channels: Mapping[str, Channel],
    connections: Mapping[Port, Connection],
    truth: Mapping[str, Any],
) -> list[ViewerPanel]:
    """Return the panels of a run; of one without estimates those of all outputs."""
    estimates = {}  # of the components that have some
    for name, channel in channels.items():
        own = [signal.name for signal in channel.interface.outputs if signal.role == "estimate"]
        if own:
            estimates[name] = own
    if not estimates:
        return output_panels(channels)
    sources: dict[str, None] = {}  # what drives the inputs y of estimators, each signal once
    for to, connection in connections.items():
        if to.component in estimates and to.signal == _MEASURED:
            sources |= dict.fromkeys(map(str, connection.sources))
    panels = [ViewerPanel("measured outputs", tuple(_recorded(channels, sources)))]
    shown = dict.fromkeys(truth)
    known = {key.partition("[")[0] for key in truth}
    for name, own in estimates.items():
        ports = [f"{name}.{estimate}" for estimate in own if estimate in _SHOWN]
        shown |= dict.fromkeys(port for port in ports if port not in known)
    for estimate in shown:
        true = truth.get(estimate)
        signals = tuple(_recorded(channels, [estimate, *named_ports(true)]))
        levels = []
        if true is not None and not named_ports(true):
            levels = np.atleast_1d(np.array(true, np.float64)).tolist()
        panels.append(ViewerPanel(estimate, signals, tuple(levels)))
    return [panel for panel in panels if panel.signals]


def _recorded(channels: Mapping[str, Channel], names: Iterable[str]) -> Iterator[RecordedPort]:
    """Yield the signals that are recorded, in their order."""
    for name in names:
        with suppress(UnknownSignalError):
            yield find_signal(channels, name, source="the run")
