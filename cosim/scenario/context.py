"""What kinds may ask of the scenario while their components are built, and what each records."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from cosim.blocks.replay import Replay
from cosim.core.contracts import Component, MessageLevel, Recording
from cosim.errors import CosimError, UsageError, nearest
from cosim.scenario.document import Problem
from cosim.scenario.kinds import Kind
from cosim.scenario.parsing import Parsed
from cosim.scenario.schema import matrix
from cosim.theory.descriptor import DescriptorSystem

if TYPE_CHECKING:
    from cosim.fmi.linearizing.linearization import Linearization
    from cosim.fmi.options import FmuOptions


class MessageSource(Protocol):
    """The messages of an opened FMU."""

    def drain(self) -> Sequence[tuple[float | None, MessageLevel, str, str]]:
        """Return the messages since the last call, as (time [s] or None, level, category, text)."""
        ...


class _DependsOnInvalidComponent(UsageError):
    """A component cannot be checked because one that it reads is wrong, which is reported."""


class ScenarioBuildContext:
    """Builds every component and records which tables each one reads.

    See :class:`cosim.scenario.kinds.BuildContext`.
    """

    step_ns: int
    stop: float

    def __init__(self, scenario: Parsed, resources: ExitStack, recording: Recording | None) -> None:
        self._scenario = scenario
        self._resources = resources
        self._recording = recording
        self._current = ""
        self.stop = scenario.file.scenario.stop
        self.metadata: dict[str, dict[str, Any]] = {}
        self.warnings: list[tuple[str, str]] = []
        self.reads: dict[str, frozenset[str]] = {"": frozenset()}
        self.attachments: dict[str, str] = {}
        self.fmus: dict[str, MessageSource] = {}
        self._linearized: dict[str, Linearization] = {}
        self.files: set[Path] = set()

    def build_all(
        self, problems: list[Problem]
    ) -> tuple[dict[str, Component], dict[str, int], set[str]]:
        """Build every component that can be built; add the problems of the others to ``problems``.

        Returns
        -------
        tuple
            Components by name, their sample periods in communication steps, and the names of the
            components that could not be built.
        """
        components: dict[str, Component] = {}
        periods: dict[str, int] = {}
        for name in self._scenario.file.models:
            try:
                self.model(name)
            except (CosimError, ValueError) as error:
                problems.append((("models", name), str(error)))
        for name, spec in self._scenario.specs.items():
            self._current = name
            self.reads[name] = frozenset()
            try:
                component = self._build(name, spec)
                periods[name] = spec.period_steps(name, self.step_ns)
                components[name] = spec.with_period(component, periods[name])
            except _DependsOnInvalidComponent:
                pass
            except (CosimError, ValueError) as error:
                problems.append((("components", name), str(error)))
        missing = set(self._scenario.file.components) - set(components)
        return components, periods, missing

    def _build(self, name: str, spec: Kind) -> Component:
        if self._recording is not None and not spec.computable:
            return Replay(self._recording, name)
        return spec.build(name, self)

    # --- what a kind may ask for ---

    def model(self, name: str) -> DescriptorSystem:
        """Return a model of [models], and record that it was read."""
        models = self._scenario.file.models
        if name not in models:
            raise UsageError(f"there is no model {name!r} in [models]; {nearest(name, models)}")
        self._read(f"models.{name}")
        table = models[name]
        matrices = {}
        for letter in ("A", "Bu", "Bd", "C"):
            rows = getattr(table, letter)
            matrices[letter] = matrix(rows, f"models.{name}.{letter}")
        return DescriptorSystem(n_a=table.n_a, **matrices)

    def spec(self, name: str) -> Kind:
        """Return the table of another component, and record that it was read."""
        self._read(f"components.{name}")
        if name not in self._scenario.specs:
            raise _DependsOnInvalidComponent
        return self._scenario.specs[name]

    def driver(self, to: str) -> str | None:
        """Return the component that drives an input, ``component.input``."""
        return self._scenario.driver(to)

    def file(self, path: str) -> Path:
        """Return the path of a file named in the scenario, and record that it is read."""
        file = self._scenario.document.folder / path
        self.files.add(file.resolve())
        return file

    def recording(self, path: str) -> Recording:
        """Open a log with the scenario's communication step."""
        from cosim.log import open_log

        log = open_log(self.file(path))
        if log.step_ns != self.step_ns:
            log_step = log.step_ns / 1e9
            step = self.step_ns / 1e9
            raise UsageError(
                f"log {path!r} has steps of {log_step} s, the scenario of {step} s; needed the same"
            )
        return log

    def fmu(
        self,
        name: str,
        path: str,
        options: FmuOptions,
    ) -> Component:
        """Load an FMU; it is freed at the end of the run."""
        from cosim.fmi.component import load

        opened = load(
            self.file(path),
            options,
            instance_name=name,
        )
        loaded = self._resources.enter_context(opened)
        metadata = loaded.metadata
        self.attachments[f"{name}/modelDescription.xml"] = metadata.pop("model_description")
        self.add_metadata(name, metadata)
        for note in loaded.notes:
            self.warn(name, note)
        self.fmus[name] = loaded
        return loaded.component

    def linearization(
        self,
        name: str,
        path: str,
        *,
        at: float,
        start: Mapping[str, Any],
        inputs: Sequence[str] | None,
        outputs: Sequence[str],
    ) -> Linearization:
        """Linearize an FMU for a component, or take the recorded result of the same request."""
        from cosim.fmi.linearizing.linearization import Linearization

        if name not in self._linearized:
            request = {
                "fmu": path,
                "at": at,
                "start": dict(start),
                "inputs": None if inputs is None else list(inputs),
                "outputs": list(outputs),
            }
            record = self._recorded_metadata(name).get("linearization", {})
            if record.get("request") != request:
                record = self._linearize(path, request)
            linearization = Linearization.of(record["result"])
            self._linearized[name] = linearization
            self.add_metadata(name, {"linearization": record})
            for note in linearization.notes:
                self.warn(name, note)
        return self._linearized[name]

    def _linearize(self, path: str, request: Mapping[str, Any]) -> dict[str, Any]:
        from cosim.fmi.linearizing.linearize import linearize
        from cosim.fmi.reading.model_description import read

        file = self.file(path)
        sha256 = read(file).sha256
        arguments = {key: value for key, value in request.items() if key != "fmu"}
        result = linearize(file, **arguments)
        return {"request": request, "sha256": sha256, "result": result.to_dict()}

    def _recorded_metadata(self, name: str) -> dict[str, Any]:
        if self._recording is None:
            return {}
        record = self._recording.metadata.get(f"cosim.component.{name}", {})
        metadata: dict[str, Any] = json.loads(record.get("metadata", "{}"))
        return metadata

    def add_metadata(self, name: str, metadata: Mapping[str, Any]) -> None:
        """Record metadata of a component."""
        self.metadata.setdefault(name, {}).update(metadata)

    def warn(self, name: str, text: str) -> None:
        """Record a warning about a component."""
        self.warnings.append((name, text))

    def _read(self, table: str) -> None:
        self.reads[self._current] |= {table}
