'''The component kinds of a scenario: one table class each, which builds its component.

A component of one's own needs no kind: ``kind = "python"`` takes any class, and an installed
package makes a class a kind by an entry point: :mod:`cosim.scenario.kinds.user_component`.

To make a component a kind of scenario files, derive a class from :class:`Kind` in a module of this
package, and add it to ``KINDS`` below. A dead zone, for example::

    from typing import ClassVar, Literal

    import numpy as np
    from pydantic import Field

    from cosim.arrays import Matrix
    from cosim.blocks.static import Static
    from cosim.core.contracts import Component
    from cosim.core.signals import Interface, Signal
    from cosim.errors import UsageError
    from cosim.scenario.kinds.base import BuildContext, Kind
    from cosim.scenario.document.schema import Number


    class DeadZoneKind(Kind):
        """y = 0 for u within -width to width; outside, u reduced by width."""

        ports: ClassVar[str] = "u -> y"
        kind: Literal["dead-zone"]
        width: Number = Field(description="half the width of the zone")

        def build(self, name: str, context: BuildContext) -> Component:
            if self.width < 0.0:
                raise UsageError(f"width: expected a number >= 0, got {self.width}")
            u = Signal("u", unit=self.unit_name)
            y = Signal("y", unit=self.unit_name, variability="inherited")
            return Static(Interface((u,), (y,), {"y": ("u",)}), self._reduced)

        def _reduced(self, u: Matrix) -> Matrix:
            return u - np.clip(u, -self.width, self.width)

With the class in ``dead_zone.py`` and the entry ``"dead-zone": "dead_zone.DeadZoneKind"`` in
``KINDS``, ``cosim list`` shows the kind, and a file may say
``dead = { kind = "dead-zone", width = 0.1 }`` under ``[components]``. A module is imported when one
of its kinds is asked for.

* ``kind`` is the name as a ``Literal``. Every other field is a key of the table; without a default
  it must be given. Numbers are ``Number``, ``Whole`` or ``Flag``, lists ``NumberRow`` or
  ``NumberRows``, of :mod:`cosim.scenario.document.schema`: they accept no other type. Tables
  inside derive from ``TomlTable``. The ``description`` of a field stands in ``cosim list`` and in
  the message where the key is missing.
* Every kind has the key ``unit``: units by port, or one, which is that of ``y``. A kind where one
  unit is that of other ports too, as here, gives it to them: ``unit_name``.
* ``ports`` names inputs and outputs in ``cosim list``.
* The first line of the docstring is the description in ``cosim list``.
* ``build`` returns the component (:class:`cosim.core.contracts.Component`). ``name`` is its name,
  ``context`` gives what else it needs: communication step, models, files, logs, other components
  (:class:`BuildContext`). A ``UsageError`` or ``ValueError`` from it becomes a problem of the file,
  with the line of the component.
* ``computable`` (True) says that the scenario alone is enough to compute the component again. Where
  it is not, because a file or an FMU is needed, return ``self._is_allowed``: a replay then takes
  the component from the recording, unless it is told to compute it. ``is_rerun`` says that
  ``replay --rerun`` does that: by a model, or by the FMU of the run.
* ``lag`` returns how far an output is behind what it estimates, where that is known: a regressor
  reads its alphas that much earlier. ``is_static`` says that the component hands on the lag of its
  inputs.
* ``tunable`` names keys with numbers that an action may set in a run. A component that is built
  with other values then goes on from the state that ``save`` returned of the first one.

More bases, in :mod:`cosim.scenario.kinds.base`:

* ``PeriodicKind`` adds the key ``period``, a sample period; it needs ``with_period``, which makes
  the component run with it.
* ``LinearKind`` needs ``linear_model`` instead of ``build``. It can be exported as an FMU.
* ``ExportableKind`` needs ``build``, and ``exportable``, which returns the model that the FMU is
  made of.
* What only some kinds can do, such as warnings that depend on what drives the inputs, has a base
  each in :mod:`cosim.scenario.kinds.capabilities`.
'''

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from cosim.lazy import LazyMapping
from cosim.scenario.document.problems import table_in
from cosim.scenario.kinds.base import BuildContext, ExportableKind, Kind, LinearKind

KINDS = LazyMapping[type[Kind]](
    __name__,
    {
        "constant": "sources.ConstantKind",
        "step": "sources.StepKind",
        "ramp": "sources.RampKind",
        "sine": "sources.SineKind",
        "chirp": "sources.ChirpKind",
        "expression": "sources.ExpressionKind",
        "table": "tables.TableKind",
        "noise": "sources.NoiseKind",
        "disturbance": "sources.DisturbanceKind",
        "sum": "parts.SumKind",
        "gain": "parts.GainKind",
        "product": "parts.ProductKind",
        "limit": "parts.LimitKind",
        "switch": "parts.SwitchKind",
        "look-up-table": "tables.LookUpTableKind",
        "lag": "parts.LagKind",
        "integrator": "parts.IntegratorKind",
        "transfer-function": "parts.TransferFunctionKind",
        "delay": "parts.DelayKind",
        "sensor": "parts.SensorKind",
        "controller": "parts.ControllerKind",
        "discrete-state-space": "parts.DiscreteStateSpaceKind",
        "pid": "parts.PidKind",
        "descriptor": "plants.DescriptorKind",
        "fmu": "plants.FmuKind",
        "recording": "plants.RecordingKind",
        "field-data": "field_data.FieldDataKind",
        "python": "user_component.PythonKind",
        "unknown-input-observer": "observers.UnknownInputObserverKind",
        "regressor": "regressor.RegressorKind",
        "identifier": "identification.IdentifierKind",
        "compensator": "compensators.CompensatorKind",
    },
)

__all__ = [
    "KINDS",
    "BuildContext",
    "ExportableKind",
    "Kind",
    "LinearKind",
    "Parameter",
    "parameters_of",
]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A key of a component's table.

    Parameters
    ----------
    name : str
        ``key.inner`` for a key of a table inside.
    required : bool
    default : object
        None where it is required, or where its description tells what holds without it.
    description : str
    """

    name: str
    required: bool
    default: Any
    description: str


def parameters_of(table: type[BaseModel]) -> list[Parameter]:
    """Return the keys of a table, as of a kind, each with those inside it.

    The required ones come first, those that every kind has, or every table, last.
    """
    from cosim.scenario.data_files.table import TableForm  # rarely needed

    shared = Kind.model_fields.keys() | TableForm.model_fields.keys()
    fields = table.model_fields

    def place(name: str) -> int:
        return 0 if fields[name].is_required() else 1 + (name in shared)

    names = sorted((name for name in fields if name != "kind"), key=place)
    return [parameter for name in names for parameter in _with_inner(name, table)]


def _with_inner(name: str, table: type[BaseModel], prefix: str = "") -> Iterator[Parameter]:
    """Yield a field of a table, then the fields of the table that it may be."""
    field = table.model_fields[name]
    required = field.is_required()
    default = None if required else field.default
    key = field.alias or name
    yield Parameter(prefix + key, required, default, field.description or "")
    inner = table_in(field.annotation)
    if inner is not None:
        for inner_name in inner.model_fields:
            yield from _with_inner(inner_name, inner, f"{prefix}{key}.")
