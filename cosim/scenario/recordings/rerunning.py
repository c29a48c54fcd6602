"""The plants of a recorded run, computed again: by their models, and by their FMUs."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from cosim.core.port import Port
from cosim.core.recording import CompleteRecording
from cosim.errors import UsageError, flag, listing
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.kinds import Kind
from cosim.scenario.kinds.plants import FmuKind
from cosim.scenario.record import component_table, recorded_warnings
from cosim.scenario.recordings.swap_report import SWAP_WARNINGS


def rerun_specs(
    source: CompleteRecording,
    specs: Mapping[str, Kind],
    swapped: Collection[str],
    *,
    allow_code: bool,
) -> dict[str, Kind]:
    """Return the tables of the plants that are computed again, which then are computable.

    Parameters
    ----------
    source : CompleteRecording
    specs : mapping of component name to Kind
        All.
    swapped : collection of str
        Those that are replaced by others, and computed anyway.
    allow_code : bool

    Raises
    ------
    UsageError
        If there are FMUs and their code is not allowed to run, or a plant was swapped in the run.
    """
    again = {}
    for name, spec in specs.items():
        if spec.is_rerun and name not in swapped:
            again[name] = spec.with_code()
    fmus = [name for name, spec in again.items() if isinstance(spec, FmuKind)]
    if fmus and not allow_code:
        raise UsageError(
            f"{flag('rerun')} runs the code of the FMUs {listing(fmus)}; expected "
            f"{flag('allow_code')}, too"
        )
    for event in source.events():
        name = Port.parse(event.signal).component
        if event.cause == "swap" and name in again:
            raise UsageError(
                f"{flag('rerun')}: {name!r} was swapped during the run, at t = "
                f"{event.time_ns / 1e9} s, which a replay cannot repeat; run the scenario"
            )
    return again


def add_recorded_reports(experiment: Experiment, source: CompleteRecording) -> None:
    """Add the recorded swap reports of what is computed again.

    What a plant of the run had replaced is not there any more to be compared with.
    """
    metadata = experiment.metadata
    compared = {name for name, text in experiment.warnings if text.startswith(SWAP_WARNINGS)}
    again = metadata.keys() - set(experiment.recorded) - compared
    again = {name for name in again if "swap_report" not in metadata[name]}
    for name in again:
        recorded = component_table(source, name)
        if "swap_report" in recorded:
            experiment.built.add_metadata(name, {"swap_report": recorded["swap_report"]})
    for name, text in recorded_warnings(source):
        if name in again and text.startswith(SWAP_WARNINGS):
            experiment.built.warn(name, text)


def fmu_paths(specs: Mapping[str, Kind]) -> dict[str, str]:
    """Return the paths of the FMUs among some tables, by component."""
    return {name: spec.path for name, spec in specs.items() if isinstance(spec, FmuKind)}
