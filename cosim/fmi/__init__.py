"""FMI in both directions: an FMU as a component, a model of ours as an FMU.

fmpy is imported in here only, and only for CVode; its headers and schemas are read as files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from cosim.lazy import lazy_names

if TYPE_CHECKING:
    from cosim.fmi.checking.check import check
    from cosim.fmi.component import Fmu, load
    from cosim.fmi.exporting.export import export
    from cosim.fmi.generated import GeneratedInstance
    from cosim.fmi.linearizing.linearize import linearize
    from cosim.fmi.options import FmuOptions
    from cosim.fmi.reading.model_description import read

_HOMES = {
    "check": "cosim.fmi.checking.check",
    "export": "cosim.fmi.exporting.export",
    "Fmu": "cosim.fmi.component",
    "FmuOptions": "cosim.fmi.options",
    "GeneratedInstance": "cosim.fmi.generated",
    "linearize": "cosim.fmi.linearizing.linearize",
    "load": "cosim.fmi.component",
    "read": "cosim.fmi.reading.model_description",
}

__all__ = ["Fmu", "FmuOptions", "GeneratedInstance", "check", "export", "linearize", "load", "read"]

__getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return list(__all__)
