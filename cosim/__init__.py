"""Co-simulation of descriptor plants, FMUs, observers and disturbance identifiers.

The names below load what they need when they are first used: ``import cosim`` costs little.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cosim.lazy import lazy_names
from cosim.version import __version__

if TYPE_CHECKING:
    from cosim.errors import CosimWarning
    from cosim.fmi.linearizing.linearize import linearize
    from cosim.log.diff import diff
    from cosim.log.reader import open_log
    from cosim.report.certificate import certificate
    from cosim.report.comparing import compare, compare_estimators
    from cosim.scenario.assumptions.report import check_assumptions
    from cosim.scenario.data_files.field_file import read_field_data
    from cosim.scenario.data_files.recording_file import open_recording
    from cosim.scenario.experiment_design.ranking import design
    from cosim.scenario.kinds.models import model_table
    from cosim.scenario.running.execution import load, run
    from cosim.scenario.running.identifying import identify
    from cosim.scenario.running.replay import replay
    from cosim.studies.metrics import metrics
    from cosim.studies.study import open_study
    from cosim.studies.studying import study
    from cosim.studies.sweeping import replay_sweep
    from cosim.studies.tuning import tune

_HOMES = {
    "CosimWarning": "cosim.errors",
    "certificate": "cosim.report.certificate",
    "check_assumptions": "cosim.scenario.assumptions.report",
    "compare": "cosim.report.comparing",
    "compare_estimators": "cosim.report.comparing",
    "design": "cosim.scenario.experiment_design.ranking",
    "diff": "cosim.log.diff",
    "identify": "cosim.scenario.running.identifying",
    "linearize": "cosim.fmi.linearizing.linearize",
    "load": "cosim.scenario.running.execution",
    "metrics": "cosim.studies.metrics",
    "model_table": "cosim.scenario.kinds.models",
    "open_log": "cosim.log.reader",
    "open_recording": "cosim.scenario.data_files.recording_file",
    "open_study": "cosim.studies.study",
    "read_field_data": "cosim.scenario.data_files.field_file",
    "replay_sweep": "cosim.studies.sweeping",
    "replay": "cosim.scenario.running.replay",
    "run": "cosim.scenario.running.execution",
    "study": "cosim.studies.studying",
    "tune": "cosim.studies.tuning",
}

__all__ = [
    "CosimWarning",
    "__version__",
    "certificate",
    "check_assumptions",
    "compare",
    "compare_estimators",
    "design",
    "diff",
    "identify",
    "linearize",
    "load",
    "metrics",
    "model_table",
    "open_log",
    "open_recording",
    "open_study",
    "read_field_data",
    "replay",
    "replay_sweep",
    "run",
    "study",
    "tune",
]

_named = lazy_names(__name__, _HOMES)


def __getattr__(name: str) -> Any:
    if name == "gym":  # a module of its own, which needs an extra
        return import_module("cosim.gym")
    return _named(name)


def __dir__() -> list[str]:
    return list(__all__)
