"""Build a scenario to run it, with its swaps compared."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from cosim.scenario.building.build import Builder
from cosim.scenario.building.coupling import with_loop_gains
from cosim.scenario.building.experiment import Experiment
from cosim.scenario.building.parsing import Scenario
from cosim.scenario.kinds.build_record import Origins

if TYPE_CHECKING:
    from cosim.fmi.unpacked import UnpackedFmus
    from cosim.scenario.recordings.swap_report import SwapReports


def build_experiment(
    scenario: Scenario,
    resources: ExitStack,
    block: int | None,
    *,
    unpacked: UnpackedFmus | None = None,
    reports: SwapReports | None = None,
) -> Experiment:
    """Build a scenario; one with swaps is compared with what it was, for its log and warnings.

    Parameters
    ----------
    scenario : Scenario
    resources : ExitStack
        Closes what was opened, when the run is over.
    block : int or None
        Fixed number of communication steps in a block.
    unpacked : UnpackedFmus, optional
        Where FMUs are unpacked and loaded for all builds of a process.
    reports : SwapReports, optional
        How the swaps compare, where that is known.

    Raises
    ------
    ScenarioError
        With every problem of the file; or if the coupling of a loop is refused.
    """
    experiment = _built(scenario, resources, block, unpacked, reports)
    if not experiment.settings:
        return experiment
    from cosim.scenario.building.actions import prepare_settings

    step_ns = experiment.clock.step_ns
    experiment.setting_designs = prepare_settings(
        experiment.graph, step_ns, experiment.settings, {}
    )
    return experiment


def _built(
    scenario: Scenario,
    resources: ExitStack,
    block: int | None,
    unpacked: UnpackedFmus | None,
    reports: SwapReports | None,
) -> Experiment:
    def build() -> Experiment:
        return Builder(scenario, resources, Origins(unpacked=unpacked), block=block).experiment()

    def rebuild() -> Experiment:
        resources.close()
        return build()

    if not scenario.file.swap:
        return with_loop_gains(build(), rebuild)
    if reports is None:
        from cosim.scenario.recordings.swap_comparison import build_swapped

        experiment, known = build_swapped(scenario, resources, block, unpacked)
    else:
        experiment, known = build(), reports
    compared = with_reports(experiment, known)
    return with_loop_gains(compared, lambda: with_reports(rebuild(), known))


def with_reports(experiment: Experiment, reports: SwapReports) -> Experiment:
    """Keep in the log how swapped components compare with those they replace."""
    for name, report in reports.reports.items():
        experiment.built.add_metadata(name, {"swap_report": report.to_dict()})
    for name, text in reports.warnings:
        experiment.built.warn(name, text)
    return experiment
